"""Predicted poses and directions of motion, and their derivatives by what is to be found."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax.hands import Hand, RoundFinger, arc_length, at_lengths
from pushjax.identify.pushes import Given, Pushes
from pushjax.identify.unknowns import TABLE, Physical, Prior
from pushjax.limit_surface import LimitSurface
from pushjax.rollout import Slider, Trajectory, rollout
from pushjax.se2 import compose, inverse, transform
from pushjax.shapes import Polygon, Shape
from pushjax.table import Table

STRAIGHT = 5  # the direction in which a path goes on is that of a fifth of it


class Setup(eqx.Module):
    """Everything that stays as it is. surface: with a leading axis of conditions; length: of the metric. touching: at
    the end of every push."""

    shape: Shape
    hand: Hand
    surface: LimitSurface
    prior: Prior
    length: Float[Array, ""]
    touching: bool = eqx.field(static=True, default=False)

    def residuals(self, z: Float[Array, "size"], pushes: Pushes) -> Float[Array, "conditions pushes rows"]:
        """Predicted less measured poses: x, y, length * theta, m; and predicted less measured directions of motion
        under the wrenches. Each kind is divided by the root of how many there are of it. Last the gap between the
        finger and the slider as it was seen in the end, m."""
        varied, rest = self._split(z)
        return jnp.concatenate([each[0] for each in self._kinds(lambda f: f, varied, rest, pushes)], axis=-1)

    def local(self, z: Float[Array, "size"], pushes: Pushes) -> "Local":
        """Residuals, and their derivatives by what a push depends on itself: some twenty numbers of its own condition,
        whatever the size of z. Constants, to every derivative.

        Forward, also by a quartic's fifteen coefficients: half the time and the compilation of three reverse sweeps.
        """
        varied, rest = self._split(jax.lax.stop_gradient(z))
        kinds = self._kinds(lambda f: jax.jacfwd(f, has_aux=True), varied, rest, pushes)
        slopes, value = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=2), *kinds)
        return Local(value, slopes, varied)

    def _kinds(self, of: Callable, varied: dict[str, Array], rest: Physical, pushes: Pushes) -> list:
        """`of` the residuals (value, value), for each kind, over all conditions and pushes."""
        rows = tuple(pushes.rows.tolist())
        fixed = (Body(self.shape, self.hand, self.prior.origin), self.length)
        own = _Own(self.surface, pushes.given, pushes.poses)

        def off(varied, rest, own, fixed):
            return _off(varied, rest, own, fixed, rows)

        kinds = [_each(of(off), varied, rest, own, fixed)]
        if pushes.wrench.shape[-2]:
            pairs = _Pairs(self.surface, pushes.wrench, pushes.twist, pushes.paired)
            kinds.append(_each(of(_astray), varied, rest, pairs, ()))
        if self.touching:
            kinds.append(_each(of(_gap), varied, rest, own, fixed))
        return kinds

    def expanded(self, z: Float[Array, "size"], local: "Local") -> Float[Array, "conditions pushes rows"]:
        """Residuals to first order about where `local` was worked out: there, with their derivatives by z, which cost
        products of matrices only."""
        varied, _ = self._split(z)

        def along(name: str) -> Array:
            """(conditions, pushes, rows, *own shape) by (conditions, *own shape)"""
            off = varied[name] - local.varied[name]
            return jnp.einsum(
                "cnri,ci->cnr", local.slopes[name].reshape(*local.value.shape, -1), off.reshape(len(off), -1)
            )

        return local.value + jnp.sum(jnp.stack([along(name) for name in varied]), axis=0)

    def slopes(self, z: Float[Array, "size"], local: "Local") -> Float[Array, "conditions pushes rows size"]:
        return jax.jacfwd(lambda z: self.expanded(z, local))(z)

    def _split(self, z: Float[Array, "size"]) -> tuple[dict[str, Array], Physical]:
        """What is varied of everything that pushes depend on, and all of it."""
        theta = self.prior.physical(z)
        free = {"surface" if name == "center" else name for name in self.prior.layout.names}
        return {name: value for name, value in theta._asdict().items() if name in free}, theta


class Local(NamedTuple):
    """value: (conditions, pushes, rows), slopes: (conditions, pushes, rows, ...) by each of `varied`,
    (conditions, ...)."""

    value: Float[Array, "conditions pushes rows"]
    slopes: dict[str, Array]
    varied: dict[str, Array]


class Body(NamedTuple):
    """What touches, and where the table is."""

    shape: Shape
    hand: Hand
    origin: Float[Array, "2"]


def trajectories(theta: Physical, surface: LimitSurface, body: Body, pushes: Pushes) -> Trajectory:
    """Predicted pushes, with axes (conditions, pushes); theta and surface with a leading axis of conditions."""
    over_pushes = jax.vmap(push, in_axes=(None, None, None, 0))
    over_all = jax.vmap(over_pushes, in_axes=(0, 0, None, 0))
    return over_all(theta, surface, body, pushes.given)


class _Own(NamedTuple):
    """What belongs to one push; the surface to its condition."""

    surface: LimitSurface
    given: Given
    poses: Array


class _Pairs(NamedTuple):
    """Wrenches and motions of one push; the surface belongs to its condition."""

    surface: LimitSurface
    wrench: Array
    twist: Array
    there: Array


def _off(varied: dict[str, Array], rest: Physical, own: _Own, fixed: tuple[Body, Array], rows: tuple[int, ...]):
    body, length = fixed
    predicted = push(rest._replace(**varied), own.surface, body, own.given)
    off = predicted.pose[np.array(rows)] - own.poses
    residual = off.at[:, 2].mul(length).reshape(-1) / float(np.sqrt(len(rows)))
    return residual, residual


def _gap(varied: dict[str, Array], rest: Physical, own: _Own, fixed: tuple[Body, Array]):
    theta, body = rest._replace(**varied), fixed[0]
    shape, hand = smaller(body.shape, body.hand, theta.inset)
    end = own.poses[-1] if theta.marker is None else compose(own.poses[-1], theta.marker)
    tip = moved(own.given.path, theta.end, theta.lag, theta.offset)[-1]
    distance, _, radius = nearest(shape, hand, end, tip)
    residual = (distance - radius)[None]
    return residual, residual


def _astray(varied: dict[str, Array], rest: Physical, own: _Pairs, fixed: tuple[()]):
    """Of directions in (vx, vy, length * omega): wrenches may be of any scale, and motions of any size."""
    theta = rest._replace(**varied)
    surface = with_coefficients(own.surface, theta.surface)
    metric = jnp.stack([jnp.ones_like(surface.length)] * 2 + [surface.length])

    def direction(v: Array) -> Array:
        squared = jnp.sum(v**2, axis=-1, keepdims=True)
        return jnp.where(squared > 0, v / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)

    there = own.there
    wrench = jnp.where(there[:, None], direction(own.wrench / metric[None]), 1.0)
    predicted = jax.vmap(surface.twist)(wrench * metric[None])
    astray = direction(predicted * metric[None]) - direction(own.twist * metric[None])
    residual = jnp.where(there[:, None], astray, 0.0).reshape(-1)
    residual = residual / jnp.sqrt(jnp.maximum(jnp.sum(there), 1).astype(residual.dtype))
    return residual, residual


def _each(function: Callable, varied: dict[str, Array], rest: Physical, own: "_Own | _Pairs", fixed: tuple):
    # the surface is its condition's
    each: Any = own._replace(**{name: None if name == "surface" else 0 for name in own._fields})
    over_pushes = jax.vmap(function, in_axes=(None, None, each, None))
    return jax.vmap(over_pushes, in_axes=(0, 0, 0, None))(varied, rest, own, fixed)


def coefficients_of(surface: LimitSurface) -> Array:
    return getattr(surface, "coefficients" if surface.degree == 4 else "A")


def with_coefficients(surface: LimitSurface, coefficients: Array) -> LimitSurface:
    return eqx.tree_at(coefficients_of, surface, coefficients)


def push(theta: Physical, surface: LimitSurface, body: Body, given: Given) -> Trajectory:
    """One push, as it is seen. surface: of which only the coefficients are those of `theta`."""
    shape, hand = smaller(body.shape, body.hand, theta.inset)
    slider = Slider(shape, with_coefficients(surface, theta.surface))
    path = moved(given.path, theta.end, theta.lag, theta.offset)
    start = given.start if theta.marker is None else compose(given.start, theta.marker)
    if theta.overlap is not None:
        path = path.at[:, :2].add(theta.overlap * apart(slider, hand, start, path[0])[None])
    mu = theta.friction
    if theta.drift is not None:
        mu = mu * jnp.exp(theta.drift * given.age)
    if theta.side is not None:
        mu = mu * jnp.exp(theta.side[jnp.clip(given.side.astype(int), 0, len(theta.side) - 1)])
    table = None
    if not (theta.grain is None and theta.slope is None and theta.curvature is None):
        known = {name: getattr(theta, name) for name in TABLE if getattr(theta, name) is not None}
        table = Table(**known, origin=body.origin)
    pushed = rollout(slider, hand, path, pose=start, friction=mu, table=table)
    if theta.marker is None:
        return pushed
    seen = compose(pushed.pose, inverse(theta.marker)[None])
    return eqx.tree_at(lambda p: p.pose, pushed, seen)


def apart(slider: Slider, hand: Hand, start: Array, configuration: Array) -> Float[Array, "2"]:
    """The way, world, m, on which a round finger that overlaps the slider just leaves it."""
    distance, normal, radius = nearest(slider.shape, hand, start, configuration)
    return jnp.maximum(radius - distance, 0.0) * transform(start.at[:2].set(0.0), normal)


def nearest(shape: Shape, hand: Hand, pose: Array, configuration: Array) -> tuple[Array, Array, Array]:
    """Of the slider to a single round finger's centre: distance and normal (2,), body; and the finger's radius."""
    finger = hand.fingers[0]
    assert isinstance(finger, RoundFinger)  # as `identify` saw to
    distance, _, normal = shape.closest(transform(inverse(pose), configuration[:2]))
    return distance, normal, finger.radius


def smaller(shape: Shape, hand: Hand, inset: Array) -> tuple[Shape, Hand]:
    """The outline of a polygon moved inwards; of other shapes the fingers, which must be as large at least."""
    if isinstance(shape, Polygon):
        return shape.inset(inset), hand
    fingers = tuple(
        eqx.tree_at(lambda f: f.radius, finger, finger.radius - inset) if isinstance(finger, RoundFinger) else finger
        for finger in hand.fingers
    )
    return shape, eqx.tree_at(lambda h: h.fingers, hand, fingers)


def moved(path: Array, end: Array, lag: Array, offset: Array) -> Array:
    """The hand's path as it really was, from what was logged: its configurations at other lengths along it, and where
    that is past an end, straight on. Local directions of a recording are no good for that: they are mostly rounding."""
    arc = arc_length(path[:, :2])
    whole = arc[-1]
    at = arc * (1 + end / jnp.where(whole > 0, whole, 1.0)) - lag
    there = at_lengths(path, arc, jnp.clip(at, 0, whole))
    part = max(len(path) // STRAIGHT, 1)
    beyond, before = jnp.maximum(at - whole, 0), jnp.minimum(at, 0)
    there = there + beyond[:, None] * _slope(path, arc, -1 - part, -1)[None]
    there = there + before[:, None] * _slope(path, arc, 0, part)[None]
    return there.at[:, :2].add(offset[None])


def _slope(path: Array, arc: Array, one: int, other: int) -> Float[Array, "dof"]:
    """Per length of the way between two rows; zero if there is none."""
    apart = arc[other] - arc[one]
    return jnp.where(apart > 0, (path[other] - path[one]) / jnp.where(apart > 0, apart, 1.0), 0.0)
