"""Predicted final poses, and their derivatives by what is to be found."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax.hands import Hand, RoundFinger, arc_length, at_lengths
from pushjax.identify.pushes import Pushes
from pushjax.identify.unknowns import Physical, Prior
from pushjax.limit_surface import LimitSurface
from pushjax.rollout import Slider, Trajectory, rollout
from pushjax.shapes import Polygon, Shape

STRAIGHT = 5  # the direction in which a path goes on is that of a fifth of it


class Setup(eqx.Module):
    """Everything that stays as it is. surface: with a leading axis of conditions; length: of the metric."""

    shape: Shape
    hand: Hand
    surface: LimitSurface
    prior: Prior
    length: Float[Array, ""]

    def residuals(self, z: Float[Array, "size"], pushes: Pushes) -> Float[Array, "conditions pushes 3"]:
        """Predicted less measured final pose: x, y, length * theta, m."""
        return _each(lambda *args: _residual(*args)[0], *self._split(z), self, pushes)

    def local(self, z: Float[Array, "size"], pushes: Pushes) -> "Local":
        """Residuals, and their derivatives by what a push depends on itself: some twenty numbers of its own condition,
        whatever the size of z. Constants, to every derivative.

        Forward, also by a quartic's fifteen coefficients: half the time and the compilation of three reverse sweeps.
        """
        varied, rest = self._split(jax.lax.stop_gradient(z))
        slopes, value = _each(jax.jacfwd(_residual, has_aux=True), varied, rest, self, pushes)
        return Local(value, slopes, varied)

    def expanded(self, z: Float[Array, "size"], local: "Local") -> Float[Array, "conditions pushes 3"]:
        """Residuals to first order about where `local` was worked out: there, with their derivatives by z, which cost
        products of matrices only."""
        varied, _ = self._split(z)

        def along(name: str) -> Array:
            """(conditions, pushes, 3, *own shape) by (conditions, *own shape)"""
            off = varied[name] - local.varied[name]
            return jnp.einsum(
                "cnri,ci->cnr", local.slopes[name].reshape(*local.value.shape, -1), off.reshape(len(off), -1)
            )

        return local.value + jnp.sum(jnp.stack([along(name) for name in varied]), axis=0)

    def slopes(self, z: Float[Array, "size"], local: "Local") -> Float[Array, "conditions pushes 3 size"]:
        return jax.jacfwd(lambda z: self.expanded(z, local))(z)

    def _split(self, z: Float[Array, "size"]) -> tuple[dict[str, Array], Physical]:
        """What is varied of everything that pushes depend on, and all of it."""
        theta = self.prior.physical(z)
        free = {"surface" if name == "center" else name for name in self.prior.layout.names}
        return {name: value for name, value in theta._asdict().items() if name in free}, theta


class Local(NamedTuple):
    """value: (conditions, pushes, 3), slopes: (conditions, pushes, 3, ...) by each of `varied`, (conditions, ...)."""

    value: Float[Array, "conditions pushes 3"]
    slopes: dict[str, Array]
    varied: dict[str, Array]


def trajectories(theta: Physical, surface: LimitSurface, shape: Shape, hand: Hand, pushes: Pushes) -> Trajectory:
    """Predicted pushes, with axes (conditions, pushes); theta and surface with a leading axis of conditions."""
    over_pushes = jax.vmap(_push, in_axes=(None, None, None, 0, 0))
    over_all = jax.vmap(over_pushes, in_axes=(0, 0, None, 0, 0))
    return over_all(theta, surface, (shape, hand), pushes.start, pushes.path)


class _Own(NamedTuple):
    """What belongs to one push; the surface to its condition."""

    surface: LimitSurface
    start: Array
    path: Array
    end: Array


def _residual(varied: dict[str, Array], rest: Physical, own: _Own, fixed: tuple[Shape, Hand, Array]):
    shape, hand, length = fixed
    push = _push(rest._replace(**varied), own.surface, (shape, hand), own.start, own.path)
    off = push.pose[-1] - own.end
    residual = off.at[2].mul(length)
    return residual, residual


def _each(function, varied: dict[str, Array], rest: Physical, setup: Setup, pushes: Pushes):
    fixed = (setup.shape, setup.hand, setup.length)
    own = _Own(setup.surface, pushes.start, pushes.path, pushes.end)
    each: Any = _Own(None, 0, 0, 0)  # pyright: ignore[reportArgumentType]
    over_pushes = jax.vmap(function, in_axes=(None, None, each, None))
    return jax.vmap(over_pushes, in_axes=(0, 0, 0, None))(varied, rest, own, fixed)


def _push(theta: Physical, surface: LimitSurface, body: tuple[Shape, Hand], start: Array, path: Array) -> Trajectory:
    shape, hand = smaller(*body, theta.inset)
    field = "coefficients" if surface.degree == 4 else "A"
    surface = eqx.tree_at(lambda s: getattr(s, field), surface, theta.surface)
    path = moved(path, theta.end, theta.lag, theta.offset)
    return rollout(Slider(shape, surface), hand, path, pose=start, friction=theta.friction)


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
