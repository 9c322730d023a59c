"""Residuals of predicted poses, directions of motion and gaps, and their derivatives with respect to the unknowns."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.jit import quick_jit
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.table import Table
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.se2 import compose, inverse, transform
from pushjax.geometry.shape import Shape
from pushjax.identification.prior import Prior
from pushjax.identification.pushes import Pushes
from pushjax.identification.pushes_of_recordings import in_meters
from pushjax.identification.unknowns import TABLE, Parameters
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.path import arc_length, interpolate_arc_length
from pushjax.simulation.rollout import rollout
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory

# Beyond an end, a path goes on straight. Its direction there is that of the first or last of this many parts.
DIRECTION_PARTS = 5


class ResidualKinds(NamedTuple):
    """One value for each kind of residual."""

    poses: Any
    directions: Any  # of motion under measured wrenches
    gap: Any  # between finger and slider at the end


class Scene(NamedTuple):
    """The bodies in contact, and the reference point of the table."""

    shape: Shape  # outline of the slider
    hand: Hand
    origin: Float[Array, "2"]  # world, m, the point about which `Table` describes the friction


class Problem(eqx.Module):
    """Everything that stays constant during a fit."""

    scene: Scene
    surface: LimitSurface  # of each condition, with a leading axis of conditions; the fit replaces its coefficients
    prior: Prior
    length: Float[Array, ""]  # of the metric, m
    contact_at_end: bool = eqx.field(static=True, default=False)  # whether the gap at the end of a push is a residual

    def residuals(self, z: Float[Array, "size"], pushes: Pushes) -> ResidualKinds:
        """Return the residuals (conditions, pushes, rows) of each kind for all pushes, predicted less measured."""
        # Poses are x, y, length * theta, in m. They are divided by the root of their number, so that all poses of a
        # push together weigh as much as one. So are directions of motion. A gap, in m, separates the finger from the
        # slider's measured final pose. A kind that was not measured has no rows.
        return self._residual_kinds(lambda residual: residual, *self._free_and_all(z), pushes)

    def linearize(self, z: Float[Array, "size"], pushes: Pushes) -> "Linearized":
        """Return residuals and their Jacobian with respect to the parameters of each push's own condition."""
        # A condition has some twenty parameters, however many entries z has. The result is constant in every
        # derivative: gradients do not flow through it. The Jacobian uses forward mode, also for the fifteen
        # coefficients of a quartic: it takes half the run time and half the compilation time of three reverse sweeps.

        def with_jacobian(residual: Callable) -> Callable:
            return jax.jacfwd(lambda free, *rest: (residual(free, *rest),) * 2, has_aux=True)

        free, parameters = self._free_and_all(jax.lax.stop_gradient(z))
        jacobians, values = zip(*self._residual_kinds(with_jacobian, free, parameters, pushes), strict=True)
        return Linearized(ResidualKinds(*values), ResidualKinds(*jacobians), free)

    def _residual_kinds(
        self,
        transformation: Callable,  # of the residual function of one push
        free: dict[str, Array],  # by name, with a leading axis of conditions; what to differentiate with respect to
        parameters: Parameters,  # `free` replaces some of them
        pushes: Pushes,
    ) -> ResidualKinds:
        """Return the result of the transformed residual function of each kind, for all conditions and pushes."""

        def over_all(residual: Callable) -> Any:
            over_pushes = jax.vmap(transformation(residual), in_axes=(None, None, None, 0))
            return jax.vmap(over_pushes)(free, parameters, self.surface, pushes)

        poses = over_all(self._pose_residual)
        directions = gap = jax.tree.map(lambda leaf: leaf[:, :, :0], poses)  # no rows
        if pushes.wrench.shape[-2]:
            directions = over_all(_direction_residual)
        if self.contact_at_end:
            gap = over_all(self._gap_residual)
        return ResidualKinds(poses, directions, gap)

    def _pose_residual(self, free: dict[str, Array], parameters: Parameters, surface: LimitSurface, push: Pushes):
        """Return the pose residuals (3 * poses,) of one push, in m."""
        predicted = predict_push(parameters._replace(**free), surface, self.scene, push)
        steps = push.observed_steps
        difference = predicted.pose[steps] - push.poses
        return difference.at[:, 2].mul(self.length).reshape(-1) / float(np.sqrt(len(steps)))

    def _gap_residual(self, free: dict[str, Array], parameters: Parameters, surface: LimitSurface, push: Pushes):
        """Return the gap (1,) in m between finger and measured final pose."""
        parameters = parameters._replace(**free)
        shape, hand = apply_inset(self.scene.shape, self.scene.hand, parameters.inset)
        end = push.end if parameters.frame_offset is None else compose(push.end, parameters.frame_offset)
        distance, _, radius = finger_distance(shape, hand, end, _true_path(parameters, push)[-1])
        return (distance - radius)[None]

    def linear_residuals(self, z: Float[Array, "size"], linearized: "Linearized") -> ResidualKinds:
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

        return ResidualKinds(*map(extrapolate, linearized.value, linearized.jacobian))

    def jacobian(self, z: Float[Array, "size"], linearized: "Linearized") -> ResidualKinds:
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

    value: ResidualKinds  # (conditions, pushes, rows) of each kind
    jacobian: (
        ResidualKinds  # for each kind, derivatives (conditions, pushes, rows, ...) with respect to each entry of `free`
    )
    free: dict[str, Array]  # estimated parameters (conditions, ...) by name, at that point


def _direction_residual(free: dict[str, Array], parameters: Parameters, surface: LimitSurface, push: Pushes) -> Array:
    """Return the direction residuals (3 * pairs,) of one push."""
    # Directions are unit vectors along (vx, vy, length * omega), so wrenches and motions may have any scale.
    parameters = parameters._replace(**free)
    surface = with_coefficients(surface, parameters.surface)
    metric = jnp.stack([jnp.ones_like(surface.length)] * 2 + [surface.length])

    def direction(v: Array) -> Array:
        squared = jnp.sum(v**2, axis=-1, keepdims=True)
        return jnp.where(squared > 0, v / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)

    valid = push.has_pair
    wrench = jnp.where(valid[:, None], direction(push.wrench / metric[None]), 1.0)
    predicted = jax.vmap(surface.twist)(wrench * metric[None])
    difference = direction(predicted * metric[None]) - direction(push.twist * metric[None])
    residual = jnp.where(valid[:, None], difference, 0.0).reshape(-1)
    return residual / jnp.sqrt(jnp.maximum(jnp.sum(valid), 1).astype(residual.dtype))


def coefficients_of(surface: LimitSurface) -> Array:
    """Return what is estimated: coefficients (15,) of a quartic, A (3, 3) of an ellipsoid, limits of support points."""
    return getattr(surface, {1: "limit", 2: "A", 4: "coefficients"}[surface.degree])


def with_coefficients(surface: LimitSurface, coefficients: Array) -> LimitSurface:
    """Return the surface with other coefficients, in the form that `coefficients_of` returns."""
    return eqx.tree_at(coefficients_of, surface, coefficients)


@quick_jit
def predict_pushes(parameters: Parameters, surface: LimitSurface, scene: Scene, pushes: Pushes) -> Trajectory:
    """Predict the pushes of all conditions, as trajectories with leading axes (conditions, pushes)."""
    over_pushes = jax.vmap(predict_push, in_axes=(None, None, None, 0))
    return jax.vmap(over_pushes, in_axes=(0, 0, None, 0))(parameters, surface, scene, pushes)


def predict_push(
    parameters: Parameters,
    surface: LimitSurface,  # `parameters` replaces its coefficients
    scene: Scene,
    push: Pushes,  # one push: its start, path, age and side
) -> Trajectory:
    """Predict one push, with the poses of the tracked frame, also if `frame_offset` is not zero."""
    shape, hand = apply_inset(scene.shape, scene.hand, parameters.inset)
    slider = Slider(shape, with_coefficients(surface, parameters.surface))
    path, start, offset = _true_path(parameters, push), push.start, parameters.frame_offset
    if offset is not None:
        start = compose(start, offset)
    if parameters.overlap is not None:
        distance, normal, radius = finger_distance(shape, hand, start, path[0])
        way_out = jnp.maximum(radius - distance, 0.0) * transform(start.at[:2].set(0.0), normal)  # world, m
        path = path.at[:, :2].add(parameters.overlap * way_out[None])
    mu, by_side = parameters.friction, parameters.friction_by_side
    if parameters.friction_drift is not None:
        mu = mu * jnp.exp(parameters.friction_drift * push.age)
    if by_side is not None:
        mu = mu * jnp.exp(by_side[jnp.clip(push.side.astype(int), 0, len(by_side) - 1)])
    table_parameters = {name: getattr(parameters, name) for name in TABLE if getattr(parameters, name) is not None}
    table = Table(**table_parameters, origin=scene.origin) if table_parameters else None
    trajectory = rollout(slider, hand, path, pose=start, friction=mu, table=table)
    if offset is None:
        return trajectory
    return eqx.tree_at(lambda p: p.pose, trajectory, compose(trajectory.pose, inverse(offset)[None]))


def _true_path(parameters: Parameters, push: Pushes) -> Array:
    """Return the true path (steps + 1, dof) of the hand in one push."""
    return correct_path(push.path, parameters.overshoot, parameters.lag_distance, parameters.hand_offset)


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
    # The true path takes the configurations of the logged one at the travels s (1 + overshoot / length) - lag_distance,
    # shifted by `hand_offset`. Beyond an end of the logged path it goes straight on, in the direction of a fifth of the
    # path: local directions of a recording are mostly roundoff.
    travel = arc_length(in_meters(path))
    length = travel[-1]
    true_travel = travel * (1 + overshoot / jnp.where(length > 0, length, 1.0)) - lag_distance
    # the change is added, so that a path without a correction keeps its bits
    at_logged, at_true = (interpolate_arc_length(path, travel, s) for s in (travel, jnp.clip(true_travel, 0, length)))
    corrected = path + (at_true - at_logged)
    rows = max(len(path) // DIRECTION_PARTS, 1)
    beyond, before = jnp.maximum(true_travel - length, 0), jnp.minimum(true_travel, 0)
    corrected = corrected + beyond[:, None] * _change_per_length(path, travel, -1 - rows, -1)[None]
    corrected = corrected + before[:, None] * _change_per_length(path, travel, 0, rows)[None]
    return corrected.at[:, :2].add(hand_offset[None])


def _change_per_length(path: Array, travel: Array, first: int, last: int) -> Float[Array, "dof"]:
    """Return the change of configuration per travel between two rows; zero if the hand rests."""
    length = travel[last] - travel[first]
    return jnp.where(length > 0, (path[last] - path[first]) / jnp.where(length > 0, length, 1.0), 0.0)


def limit_surfaces(prior: Prior, parameters: Parameters) -> LimitSurface:
    """Return the limit surfaces of all conditions, with a leading axis of conditions."""
    return jax.vmap(lambda mean, coefficients: mean.surface(coefficients))(prior.mean_surface, parameters.surface)
