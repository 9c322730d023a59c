"""Residuals of predicted poses, directions of motion and gaps, and their derivatives with respect to the unknowns."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.table import Table
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.se2 import compose, inverse, transform
from pushjax.geometry.shape import Shape
from pushjax.identification.pushes import Pushes, PushInput
from pushjax.identification.unknowns import TABLE, Parameters, Prior
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.path import arc_length, interpolate_arc_length
from pushjax.simulation.rollout import rollout
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory

STRAIGHT = 5  # beyond its end, a path goes on in the direction of this part (a fifth) of it


class Problem(eqx.Module):
    """Everything that stays constant during a fit.

    Attributes:
        shape: Outline of the slider.
        hand: The hand that pushes.
        surface: Limit surface of each condition, with a leading axis of conditions. The fit replaces its coefficients.
        prior: Prior of the unknowns.
        length: Length of the metric, m.
        touching: Whether the gap at the end of every push is a residual.
    """

    shape: Shape
    hand: Hand
    surface: LimitSurface
    prior: Prior
    length: Float[Array, ""]
    touching: bool = eqx.field(static=True, default=False)

    def residuals(self, z: Float[Array, "size"], pushes: Pushes) -> Float[Array, "conditions pushes rows"]:
        """Return the residuals of all pushes, predicted less measured.

        The rows are, in this order: the poses (x, y, length * theta, in m), divided by the root of the number of poses;
        the directions of motion under the wrenches, divided by the root of the number of pairs; and, with `touching`,
        the gap in m between the finger and the slider as it was measured at the end.
        """
        varied, rest = self._split(z)
        return jnp.concatenate([each[0] for each in self._kinds(lambda f: f, varied, rest, pushes)], axis=-1)

    def local(self, z: Float[Array, "size"], pushes: Pushes) -> "Local":
        """Return residuals and their Jacobian with respect to the parameters of each push's own condition.

        These are some twenty numbers, whatever the size of z. The result is constant in every derivative: gradients do
        not flow through it.

        The Jacobian uses forward mode, also for the fifteen coefficients of a quartic. This takes half the run time and
        half the compilation time of three reverse sweeps.
        """
        varied, rest = self._split(jax.lax.stop_gradient(z))
        kinds = self._kinds(lambda f: jax.jacfwd(f, has_aux=True), varied, rest, pushes)
        slopes, value = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=2), *kinds)
        return Local(value, slopes, varied)

    def _kinds(self, of: Callable, varied: dict[str, Array], rest: Parameters, pushes: Pushes) -> list:
        """Evaluate each kind of residual over all conditions and pushes.

        Args:
            of: Transformation (the identity or `jacfwd`) applied to functions that return the pair (residual,
                residual).
            varied: Parameters to differentiate with respect to, with a leading axis of conditions.
            rest: All parameters; `varied` replaces some of them.
            pushes: Pushes with a leading axis of conditions.
        """
        rows = tuple(pushes.rows.tolist())
        fixed = (Scene(self.shape, self.hand, self.prior.origin), self.length)
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
        """Return the residuals to first order about the point where `local` was evaluated.

        At that point the values and the derivatives with respect to z are exact, and they cost matrix products only.
        """
        varied, _ = self._split(z)

        def along(name: str) -> Array:
            """Return the change due to `name`.

            It is the product of slopes (conditions, pushes, rows, *own shape) and differences (conditions, *own shape).
            """
            off = varied[name] - local.varied[name]
            return jnp.einsum(
                "cnri,ci->cnr", local.slopes[name].reshape(*local.value.shape, -1), off.reshape(len(off), -1)
            )

        return local.value + jnp.sum(jnp.stack([along(name) for name in varied]), axis=0)

    def slopes(self, z: Float[Array, "size"], local: "Local") -> Float[Array, "conditions pushes rows size"]:
        """Return the Jacobian of the residuals with respect to z."""
        return jax.jacfwd(lambda z: self.expanded(z, local))(z)

    def _split(self, z: Float[Array, "size"]) -> tuple[dict[str, Array], Parameters]:
        """Return the parameters that are varied, by name, and all parameters that pushes depend on."""
        theta = self.prior.physical(z)
        free = {"surface" if name == "center" else name for name in self.prior.layout.names}
        return {name: value for name, value in theta._asdict().items() if name in free}, theta


class Local(NamedTuple):
    """Residuals and their Jacobian at one point.

    Attributes:
        value: (conditions, pushes, rows) residuals.
        slopes: Derivatives (conditions, pushes, rows, ...) with respect to each entry of `varied`.
        varied: Parameters (conditions, ...) by name, at that point.
    """

    value: Float[Array, "conditions pushes rows"]
    slopes: dict[str, Array]
    varied: dict[str, Array]


class Scene(NamedTuple):
    """The bodies in contact, and the reference point of the table.

    Attributes:
        shape: Outline of the slider.
        hand: The hand that pushes.
        origin: (2,) world, m, the point about which `Table` describes the friction.
    """

    shape: Shape
    hand: Hand
    origin: Float[Array, "2"]


def trajectories(theta: Parameters, surface: LimitSurface, body: Scene, pushes: Pushes) -> Trajectory:
    """Predict pushes.

    Args:
        theta: Parameters, with a leading axis of conditions.
        surface: Limit surfaces, with a leading axis of conditions.
        body: Slider and hand.
        pushes: Pushes with a leading axis of conditions.

    Returns:
        Trajectories with leading axes (conditions, pushes).
    """
    over_pushes = jax.vmap(push, in_axes=(None, None, None, 0))
    over_all = jax.vmap(over_pushes, in_axes=(0, 0, None, 0))
    return over_all(theta, surface, body, pushes.given)


class _Own(NamedTuple):
    """Data of one push; the surface is that of its condition."""

    surface: LimitSurface
    given: PushInput
    poses: Array


class _Pairs(NamedTuple):
    """Wrenches and motions of one push, and where they exist; the surface is that of its condition."""

    surface: LimitSurface
    wrench: Array
    twist: Array
    there: Array


def _off(varied: dict[str, Array], rest: Parameters, own: _Own, fixed: tuple[Scene, Array], rows: tuple[int, ...]):
    """Return the pose residuals of one push, twice (value and auxiliary)."""
    body, length = fixed
    predicted = push(rest._replace(**varied), own.surface, body, own.given)
    off = predicted.pose[np.array(rows)] - own.poses
    residual = off.at[:, 2].mul(length).reshape(-1) / float(np.sqrt(len(rows)))
    return residual, residual


def _gap(varied: dict[str, Array], rest: Parameters, own: _Own, fixed: tuple[Scene, Array]):
    """Return the gap between the finger and the slider at its measured final pose, twice (value and auxiliary)."""
    theta, body = rest._replace(**varied), fixed[0]
    shape, hand = apply_inset(body.shape, body.hand, theta.inset)
    end = own.poses[-1] if theta.marker is None else compose(own.poses[-1], theta.marker)
    tip = correct_path(own.given.path, theta.end, theta.lag, theta.offset)[-1]
    distance, _, radius = nearest(shape, hand, end, tip)
    residual = (distance - radius)[None]
    return residual, residual


def _astray(varied: dict[str, Array], rest: Parameters, own: _Pairs, fixed: tuple[()]):
    """Return the direction residuals of one push, twice (value and auxiliary).

    Directions are unit vectors along (vx, vy, length * omega). So wrenches may have any scale, and motions any size.
    """
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


def _each(function: Callable, varied: dict[str, Array], rest: Parameters, own: "_Own | _Pairs", fixed: tuple):
    # the pushes of a condition share its surface
    """Map `function` over conditions and pushes."""
    each: Any = own._replace(**{name: None if name == "surface" else 0 for name in own._fields})
    over_pushes = jax.vmap(function, in_axes=(None, None, each, None))
    return jax.vmap(over_pushes, in_axes=(0, 0, 0, None))(varied, rest, own, fixed)


def coefficients_of(surface: LimitSurface) -> Array:
    """Return the array of the surface that is identified: the coefficients of a quartic, A of an ellipsoid."""
    return getattr(surface, "coefficients" if surface.degree == 4 else "A")


def with_coefficients(surface: LimitSurface, coefficients: Array) -> LimitSurface:
    """Return the surface with other coefficients."""
    return eqx.tree_at(coefficients_of, surface, coefficients)


def push(theta: Parameters, surface: LimitSurface, body: Scene, given: PushInput) -> Trajectory:
    """Predict one push, with the poses that the tracker reports.

    Args:
        theta: Parameters of the push's condition.
        surface: Limit surface; `theta` replaces its coefficients.
        body: Slider and hand.
        given: Recorded start, path, age and side of the push.

    Returns:
        The trajectory. Its poses are those of the tracked frame, also if `theta.marker` is not zero.
    """
    shape, hand = apply_inset(body.shape, body.hand, theta.inset)
    slider = Slider(shape, with_coefficients(surface, theta.surface))
    path = correct_path(given.path, theta.end, theta.lag, theta.offset)
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
    """Return the shortest displacement (world, m) that separates a round finger from the slider it penetrates."""
    distance, normal, radius = nearest(slider.shape, hand, start, configuration)
    return jnp.maximum(radius - distance, 0.0) * transform(start.at[:2].set(0.0), normal)


def nearest(shape: Shape, hand: Hand, pose: Array, configuration: Array) -> tuple[Array, Array, Array]:
    """Find the place of the outline that is nearest to the center of a single round finger.

    Returns:
        Signed distance of the center in m, outward normal (2,) in the body frame, and radius of the finger in m.
    """
    finger = hand.fingers[0]
    assert isinstance(finger, RoundFinger)  # `identify` checks this
    distance, _, normal = shape.closest(transform(inverse(pose), configuration[:2]))
    return distance, normal, finger.radius


def apply_inset(shape: Shape, hand: Hand, inset: Array) -> tuple[Shape, Hand]:
    """Return slider and hand with an outline that is smaller by `inset`.

    The outline of a polygon moves inwards. For other shapes the radii of the fingers shrink instead. They must be at
    least as large as `inset`.
    """
    if isinstance(shape, Polygon):
        return shape.inset(inset), hand
    fingers = tuple(
        eqx.tree_at(lambda f: f.radius, finger, finger.radius - inset) if isinstance(finger, RoundFinger) else finger
        for finger in hand.fingers
    )
    return shape, eqx.tree_at(lambda h: h.fingers, hand, fingers)


def correct_path(path: Array, end: Array, lag: Array, offset: Array) -> Array:
    """Return the true path of the hand, from the logged one.

    The configurations are those of the logged path at the arc lengths s (1 + end / whole) - lag, shifted by `offset`.
    Beyond an end of the path it goes straight on. Its direction there is that of a fifth of the path, because local
    directions of a recording are mostly roundoff.

    Args:
        path: (steps + 1, dof) logged path.
        end: Distance in m that the hand went on after the end of its path.
        lag: Distance in m by which the hand was behind its logged position.
        offset: (2,) displacement of the hand, world, m.
    """
    arc = arc_length(path[:, :2])
    whole = arc[-1]
    at = arc * (1 + end / jnp.where(whole > 0, whole, 1.0)) - lag
    there = interpolate_arc_length(path, arc, jnp.clip(at, 0, whole))
    part = max(len(path) // STRAIGHT, 1)
    beyond, before = jnp.maximum(at - whole, 0), jnp.minimum(at, 0)
    there = there + beyond[:, None] * _slope(path, arc, -1 - part, -1)[None]
    there = there + before[:, None] * _slope(path, arc, 0, part)[None]
    return there.at[:, :2].add(offset[None])


def _slope(path: Array, arc: Array, one: int, other: int) -> Float[Array, "dof"]:
    """Return the change of configuration per arc length between two rows; zero if their arc lengths are equal."""
    apart = arc[other] - arc[one]
    return jnp.where(apart > 0, (path[other] - path[one]) / jnp.where(apart > 0, apart, 1.0), 0.0)


def surfaces(prior: Prior, theta: Parameters) -> LimitSurface:
    """Return the limit surfaces of all conditions, with a leading axis of conditions."""
    kind = Quartic if prior.mean.lower.shape[1] > 1 else Ellipsoid
    return jax.vmap(kind)(theta.surface, prior.mean.length)
