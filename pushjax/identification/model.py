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
from pushjax.identification.prior import Prior
from pushjax.identification.pushes import Pushes, PushInput
from pushjax.identification.unknowns import TABLE, Parameters
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.path import arc_length, interpolate_arc_length
from pushjax.simulation.rollout import rollout
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory

# Beyond an end, a path goes on straight. Its direction there is that of the first or last of this many parts.
DIRECTION_PARTS = 5


class PerKind(NamedTuple):
    """One value for each kind of residual."""

    poses: Any
    directions: Any  # of motion under measured wrenches
    gap: Any  # between finger and slider at the end


class Problem(eqx.Module):
    """Everything that stays constant during a fit."""

    shape: Shape
    hand: Hand
    surface: LimitSurface  # of each condition, with a leading axis of conditions; the fit replaces its coefficients
    prior: Prior
    length: Float[Array, ""]  # of the metric, m
    contact_at_end: bool = eqx.field(static=True, default=False)  # whether the gap at the end of a push is a residual

    def residuals(self, z: Float[Array, "size"], pushes: Pushes) -> PerKind:
        """Return the residuals (conditions, pushes, rows) of each kind for all pushes, predicted less measured."""
        # Poses are x, y, length * theta, in m. They are divided by the root of their number, so that all poses of a
        # push together weigh as much as one. So are directions of motion. A gap, in m, separates the finger from the
        # slider's measured final pose. A kind that was not measured has no rows.
        free, parameters = self._free_and_all(z)
        blocks = self._residual_blocks(lambda f: f, free, parameters, pushes)
        return PerKind(*(value for value, _ in blocks))

    def linearize(self, z: Float[Array, "size"], pushes: Pushes) -> "Linearized":
        """Return residuals and their Jacobian with respect to the parameters of each push's own condition."""
        # A condition has some twenty parameters, however many entries z has. The result is constant in every
        # derivative: gradients do not flow through it. The Jacobian uses forward mode, also for the fifteen
        # coefficients of a quartic: it takes half the run time and half the compilation time of three reverse sweeps.
        free, parameters = self._free_and_all(jax.lax.stop_gradient(z))
        blocks = self._residual_blocks(lambda f: jax.jacfwd(f, has_aux=True), free, parameters, pushes)
        jacobians, values = zip(*blocks, strict=True)
        return Linearized(PerKind(*values), PerKind(*jacobians), free)

    def _residual_blocks(
        self,
        transformation: Callable,  # of the function of each kind: the identity, or `jacfwd`
        free: dict[str, Array],  # by name, with a leading axis of conditions; what to differentiate with respect to
        parameters: Parameters,  # `free` replaces some of them
        pushes: Pushes,
    ) -> PerKind:
        """Return, for each kind, the transformed residuals and the residuals of all conditions and pushes."""
        # The functions return their residual twice, because `jacfwd` drops the value and keeps only an auxiliary output
        # beside the Jacobian by name of parameter.
        steps = tuple(pushes.observed_steps.tolist())
        constants = (Scene(self.shape, self.hand, self.prior.origin), self.length)
        data = _PushData(self.surface, pushes.inputs, pushes.poses)

        def pose_residual(free, parameters, data, constants):
            return _pose_residual(free, parameters, data, constants, steps)

        poses = _over_conditions_and_pushes(transformation(pose_residual), free, parameters, data, constants)
        directions = gap = jax.tree.map(lambda leaf: leaf[:, :, :0], poses)  # no rows
        if pushes.wrench.shape[-2]:
            pairs = _WrenchMotionPairs(self.surface, pushes.wrench, pushes.twist, pushes.has_pair)
            directions = _over_conditions_and_pushes(transformation(_direction_residual), free, parameters, pairs, ())
        if self.contact_at_end:
            gap = _over_conditions_and_pushes(transformation(_gap_residual), free, parameters, data, constants)
        return PerKind(poses, directions, gap)

    def linear_residuals(self, z: Float[Array, "size"], linearized: "Linearized") -> PerKind:
        """Return the residuals at z, to first order about the point of `linearized`."""
        # At that point the values and the derivatives with respect to z are exact, at the cost of matrix products only.
        free, _ = self._free_and_all(z)

        def extrapolate(value: Array, jacobian: dict[str, Array]) -> Array:
            """Add to each residual its Jacobian (conditions, pushes, rows, ...) times the changes (conditions, ...)."""
            changes = []
            for name, new in free.items():
                difference = (new - linearized.free[name]).reshape(len(new), -1)
                by_entry = jacobian[name].reshape(*value.shape, difference.shape[1])
                changes.append(jnp.einsum("cnri,ci->cnr", by_entry, difference))
            return value + jnp.sum(jnp.stack(changes), axis=0)

        return PerKind(*map(extrapolate, linearized.value, linearized.jacobian))

    def jacobian(self, z: Float[Array, "size"], linearized: "Linearized") -> PerKind:
        """Return the Jacobian (conditions, pushes, rows, size) of each kind of residuals with respect to z."""
        return jax.jacfwd(lambda z: self.linear_residuals(z, linearized))(z)

    def _free_and_all(self, z: Float[Array, "size"]) -> tuple[dict[str, Array], Parameters]:
        """Return the free (estimated) parameters by name, and all parameters."""
        parameters = self.prior.parameters(z)
        # pushes depend on the center of pressure through the surface alone, so it is not free itself
        free = {"surface" if name == "pressure_center" else name for name in self.prior.layout.names}
        return {name: value for name, value in parameters._asdict().items() if name in free}, parameters


class Linearized(NamedTuple):
    """Residuals and their Jacobian at one point z."""

    value: PerKind  # (conditions, pushes, rows) of each kind
    jacobian: PerKind  # for each kind, derivatives (conditions, pushes, rows, ...) with respect to each entry of `free`
    free: dict[str, Array]  # estimated parameters (conditions, ...) by name, at that point


class Scene(NamedTuple):
    """The bodies in contact, and the reference point of the table."""

    shape: Shape  # outline of the slider
    hand: Hand
    origin: Float[Array, "2"]  # world, m, the point about which `Table` describes the friction


def predict_pushes(parameters: Parameters, surface: LimitSurface, scene: Scene, pushes: Pushes) -> Trajectory:
    """Predict the pushes of all conditions, as trajectories with leading axes (conditions, pushes)."""
    # `parameters` replaces the coefficients of the surfaces
    over_pushes = jax.vmap(predict_push, in_axes=(None, None, None, 0))
    over_all = jax.vmap(over_pushes, in_axes=(0, 0, None, 0))
    return over_all(parameters, surface, scene, pushes.inputs)


class _PushData(NamedTuple):
    """Record of one push, with the surface of its condition."""

    surface: LimitSurface
    inputs: PushInput
    poses: Array


class _WrenchMotionPairs(NamedTuple):
    """Wrenches and motions of one push and where they exist, with the surface of its condition."""

    surface: LimitSurface
    wrench: Array
    twist: Array
    valid: Array


def _pose_residual(
    free: dict[str, Array],
    parameters: Parameters,
    data: _PushData,
    constants: tuple[Scene, Array],
    steps: tuple[int, ...],
):
    """Return the pose residuals (3 * steps,) of one push, in m, as value and again as auxiliary output."""
    scene, length = constants
    predicted = predict_push(parameters._replace(**free), data.surface, scene, data.inputs)
    difference = predicted.pose[np.array(steps)] - data.poses
    residual = difference.at[:, 2].mul(length).reshape(-1) / float(np.sqrt(len(steps)))
    return residual, residual


def _gap_residual(
    free: dict[str, Array], parameters: Parameters, data: _PushData, constants: tuple[Scene, Array]
) -> tuple[Array, Array]:
    """Return the gap (1,) in m between finger and measured final pose, as value and again as auxiliary output."""
    parameters, scene = parameters._replace(**free), constants[0]
    shape, hand = apply_inset(scene.shape, scene.hand, parameters.inset)
    offset, end = parameters.frame_offset, data.poses[-1]
    end = end if offset is None else compose(end, offset)
    path = correct_path(data.inputs.path, parameters.overshoot, parameters.lag_distance, parameters.hand_offset)
    distance, _, radius = finger_distance(shape, hand, end, path[-1])
    residual = (distance - radius)[None]
    return residual, residual


def _direction_residual(
    free: dict[str, Array], parameters: Parameters, pairs: _WrenchMotionPairs, constants: tuple[()]
) -> tuple[Array, Array]:
    """Return the direction residuals (3 * pairs,) of one push, as value and again as auxiliary output."""
    # Directions are unit vectors along (vx, vy, length * omega), so wrenches and motions may have any scale.
    # `constants` is empty, because the table's reference point and the hand do not matter here.
    parameters = parameters._replace(**free)
    surface = with_coefficients(pairs.surface, parameters.surface)
    metric = jnp.stack([jnp.ones_like(surface.length)] * 2 + [surface.length])

    def direction(v: Array) -> Array:
        squared = jnp.sum(v**2, axis=-1, keepdims=True)
        return jnp.where(squared > 0, v / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)

    valid = pairs.valid
    wrench = jnp.where(valid[:, None], direction(pairs.wrench / metric[None]), 1.0)
    predicted = jax.vmap(surface.twist)(wrench * metric[None])
    difference = direction(predicted * metric[None]) - direction(pairs.twist * metric[None])
    residual = jnp.where(valid[:, None], difference, 0.0).reshape(-1)
    residual = residual / jnp.sqrt(jnp.maximum(jnp.sum(valid), 1).astype(residual.dtype))
    return residual, residual


def _over_conditions_and_pushes(
    function: Callable,
    free: dict[str, Array],
    parameters: Parameters,
    data: "_PushData | _WrenchMotionPairs",
    constants: tuple,
):
    """Map `function` over conditions and over the pushes that share a condition's parameters and surface."""
    data_axes: Any = data._replace(**{name: None if name == "surface" else 0 for name in data._fields})
    over_pushes = jax.vmap(function, in_axes=(None, None, data_axes, None))
    return jax.vmap(over_pushes, in_axes=(0, 0, 0, None))(free, parameters, data, constants)


def coefficients_of(surface: LimitSurface) -> Array:
    """Return the array of the surface that is estimated: coefficients (15,) of a quartic, A (3, 3) of an ellipsoid."""
    return getattr(surface, "coefficients" if surface.degree == 4 else "A")


def with_coefficients(surface: LimitSurface, coefficients: Array) -> LimitSurface:
    """Return the surface with other coefficients, in the form that `coefficients_of` returns."""
    return eqx.tree_at(coefficients_of, surface, coefficients)


def predict_push(
    parameters: Parameters,
    surface: LimitSurface,  # `parameters` replaces its coefficients
    scene: Scene,
    inputs: PushInput,  # recorded start, path, age and side
) -> Trajectory:
    """Predict one push, with the poses of the tracked frame, also if `frame_offset` is not zero."""
    shape, hand = apply_inset(scene.shape, scene.hand, parameters.inset)
    slider = Slider(shape, with_coefficients(surface, parameters.surface))
    path = correct_path(inputs.path, parameters.overshoot, parameters.lag_distance, parameters.hand_offset)
    offset = parameters.frame_offset
    start = inputs.start if offset is None else compose(inputs.start, offset)
    if parameters.overlap is not None:
        path = path.at[:, :2].add(parameters.overlap * overlap_vector(slider, hand, start, path[0])[None])
    mu = parameters.friction
    if parameters.friction_drift is not None:
        mu = mu * jnp.exp(parameters.friction_drift * inputs.age)
    by_side = parameters.friction_by_side
    if by_side is not None:
        mu = mu * jnp.exp(by_side[jnp.clip(inputs.side.astype(int), 0, len(by_side) - 1)])
    table_parameters = {name: getattr(parameters, name) for name in TABLE if getattr(parameters, name) is not None}
    table = Table(**table_parameters, origin=scene.origin) if table_parameters else None
    trajectory = rollout(slider, hand, path, pose=start, friction=mu, table=table)
    if offset is None:
        return trajectory
    return eqx.tree_at(lambda p: p.pose, trajectory, compose(trajectory.pose, inverse(offset)[None]))


def overlap_vector(slider: Slider, hand: Hand, start: Array, configuration: Array) -> Float[Array, "2"]:
    """Return the shortest displacement of a round finger, world, m, out of the slider; zero if they are apart."""
    distance, normal, radius = finger_distance(slider.shape, hand, start, configuration)
    return jnp.maximum(radius - distance, 0.0) * transform(start.at[:2].set(0.0), normal)


def finger_distance(shape: Shape, hand: Hand, pose: Array, configuration: Array) -> tuple[Array, Array, Array]:
    """Return a round finger's distance to the outline, the outward normal (2,), body frame, and its radius, in m."""
    # the distance is signed, from the finger's center to the nearest point of the outline
    finger = hand.fingers[0]
    assert isinstance(finger, RoundFinger)  # `identify` checks this
    distance, _, normal = shape.closest(transform(inverse(pose), configuration[:2]))
    return distance, normal, finger.radius


def apply_inset(shape: Shape, hand: Hand, inset: Array) -> tuple[Shape, Hand]:
    """Return slider and hand with an outline that is smaller by `inset`, m."""
    if isinstance(shape, Polygon):
        return shape.inset(inset), hand
    # instead of the outline, the radii of the fingers shrink; they must be at least as large as `inset`
    fingers = tuple(
        eqx.tree_at(lambda f: f.radius, finger, finger.radius - inset) if isinstance(finger, RoundFinger) else finger
        for finger in hand.fingers
    )
    return shape, eqx.tree_at(lambda h: h.fingers, hand, fingers)


def correct_path(
    path: Array,
    overshoot: Array,  # distance in m that the hand went on after the end of its path
    lag_distance: Array,  # distance in m by which the hand was behind its logged position
    hand_offset: Array,  # (2,), world, m
) -> Array:
    """Return the true path (steps + 1, dof) of the hand, from the logged one."""
    # The true path takes the configurations of the logged one at the arc lengths s (1 + overshoot / length) -
    # lag_distance, shifted by `hand_offset`. Arc lengths count x and y only. Beyond an end of the logged path it goes
    # straight on, in the direction of a fifth of the path: local directions of a recording are mostly roundoff.
    arc = arc_length(path[:, :2])
    length = arc[-1]
    true_arc = arc * (1 + overshoot / jnp.where(length > 0, length, 1.0)) - lag_distance
    # the change is added, because a hand that only closes or turns has no arc length to interpolate at
    at_logged, at_true = (interpolate_arc_length(path, arc, s) for s in (arc, jnp.clip(true_arc, 0, length)))
    corrected = path + (at_true - at_logged)
    rows = max(len(path) // DIRECTION_PARTS, 1)
    beyond, before = jnp.maximum(true_arc - length, 0), jnp.minimum(true_arc, 0)
    corrected = corrected + beyond[:, None] * _change_per_length(path, arc, -1 - rows, -1)[None]
    corrected = corrected + before[:, None] * _change_per_length(path, arc, 0, rows)[None]
    return corrected.at[:, :2].add(hand_offset[None])


def _change_per_length(path: Array, arc: Array, first: int, last: int) -> Float[Array, "dof"]:
    """Return the change of configuration per arc length between two rows; zero if their arc lengths are equal."""
    length = arc[last] - arc[first]
    return jnp.where(length > 0, (path[last] - path[first]) / jnp.where(length > 0, length, 1.0), 0.0)


def limit_surfaces(prior: Prior, parameters: Parameters) -> LimitSurface:
    """Return the limit surfaces of all conditions, with a leading axis of conditions."""
    surface_type = Quartic if prior.mean_surface.factors.shape[1] > 1 else Ellipsoid
    return jax.vmap(surface_type)(parameters.surface, prior.mean_surface.length)
