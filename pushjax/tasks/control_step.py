"""One control step of a task: a hand pushes a polygon along a short path, among walls.

A round finger mostly touches a polygon in one place, and mostly there is no wall near. So the step is first computed
with one contact and without walls, which takes a tenth of the time. Where that leaves the finger inside the slider, or
the slider inside a wall, it is computed again with all contacts; in a batch, only for the examples that need it. Steps
of other hands are always computed with all contacts.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.compaction import Rounds, where_needed
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.frictionless import Frictionless
from pushjax.contact.problem import form_and_friction
from pushjax.contact.status import Status
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.geometry.shape import Shape
from pushjax.simulation.finger_motion import DEPTH_PER_DISPLACEMENT
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.prepared_push import FrictionAt, prepared_push
from pushjax.simulation.rollout import simulate
from pushjax.simulation.several_sliders import PreparedSliders, SlidersFriction, prepared_sliders, simulate_sliders
from pushjax.simulation.substeps import PreparedPush, PushState, max_trials
from pushjax.simulation.trajectory import Trajectory
from pushjax.tasks.separation import DEEP, overlap_of_finger, overlap_of_wall, separate

# In units of the surface's length: an overlap that is left as it is.
NEGLIGIBLE = 1e-3


class ControlStepResult(NamedTuple):
    """Where slider and hand are after a control step, and how its steps went."""

    pose: Float[Array, "3"]  # of the slider, world, m and rad
    configuration: Float[Array, "dof"]  # of the hand, world, m and rad
    status: Int[Array, "steps"]  # `Status` of each step of the path

    @staticmethod
    def of(push: Trajectory) -> "ControlStepResult":
        """Return the result of a push along the whole path."""
        return ControlStepResult(push.pose[-1], push.configuration[-1], push.status)


class _TouchedOnce(Polygon):
    """A polygon that a finger touches in no more than one place, the nearest, also if it is not convex."""

    def __init__(self, polygon: Polygon):
        self.vertices, self.convex = polygon.vertices, polygon.convex

    def outline(self) -> PolygonOutline:
        return PolygonOutline(super().outline().edges, self.convex, touched_once=True)


def control_step(
    polygon: Polygon,
    surface: LimitSurface,
    friction: Float[Array, ""] | None,  # None: none, on an ellipsoid; the program is smaller and faster
    hand: Hand,
    walls: tuple[Wall, ...],
    path: Float[Array, "steps+1 dof"],  # of the hand, world, m and rad
    pose: Float[Array, "3"],  # of the slider at the start, world, m and rad
) -> ControlStepResult:
    """Push a slider along a short path of the hand, among walls."""
    # If the hand is one round finger, a slider that overlaps the finger or a wall deeply at the start is pushed out
    # (`separation`), and the status of all steps is then OVERLAPPING.
    args = polygon, surface, friction, hand, walls, path, pose
    if not _is_finger(hand):
        return _in_rounds(_with_all_contacts, _divided, *args)
    with_one_contact = _simulated(_TouchedOnce(polygon), surface, friction, hand, (), path, pose)
    push, allowed = ControlStepResult.of(with_one_contact), _allowed_overlap(surface, path)
    deep = jax.lax.stop_gradient(_depth_at_start(*args) > jnp.maximum(DEEP * surface.length, allowed))
    if walls or not polygon.convex:  # else there is no other contact
        valid = jax.lax.stop_gradient(_is_valid(with_one_contact, polygon, surface, walls, allowed))
        push = where_needed(~valid & ~deep, _with_all_contacts, push, *args, rounds=_rounds(_divided))
    return where_needed(deep, _separated, push, *args)


def control_step_of_sliders(
    shapes: tuple[Shape, ...],
    friction: SlidersFriction,
    hand: Hand,
    path: Float[Array, "steps+1 dof"],
    pose: Float[Array, "sliders 3"],
) -> ControlStepResult:
    """Push several sliders along a short path of the hand."""
    return _in_rounds(_with_several, _divided_several, shapes, friction, hand, path, pose)


def _in_rounds(compute: Callable[..., ControlStepResult], divided: Callable[..., Any], *args) -> ControlStepResult:
    """Return the control step, with arguments whose last ones are path and pose."""
    # Always needed, and yet `where_needed`: in a batch it computes in rounds, so that no example waits for another.
    path, pose = args[-2:]
    at_start = ControlStepResult(pose, path[-1], jnp.full(len(path) - 1, Status.FREE, jnp.int8))
    return where_needed(jnp.ones((), bool), compute, at_start, *args, rounds=_rounds(divided))


@jax.jit
def _with_several(shapes, friction, hand, path, pose) -> ControlStepResult:
    return ControlStepResult.of(simulate_sliders(shapes, hand, path, pose, lambda step: friction, ()))


def _divided_several(shapes, friction, hand, path, pose) -> tuple[PreparedSliders, Array]:
    push, start, _ = prepared_sliders(shapes, hand, path, pose, lambda step: friction)
    return push, start.T


def _is_finger(hand: Hand) -> bool:
    """Return whether a hand is one round finger."""
    return len(hand.fingers) == 1 and isinstance(hand.fingers[0], RoundFinger)


def _simulated(shape, surface, friction, hand, walls, path, pose) -> Trajectory:
    """Return the push along the path, with arguments as in `control_step`."""
    solver, friction_at = _contact_model(shape, surface, friction, hand, path)
    return simulate(shape, hand, path, pose, solver, friction_at, walls)


def _contact_model(shape, surface, friction, hand, path) -> tuple[Frictionless | None, FrictionAt]:
    """Return the contact solver, and limit surface and friction of a step, with arguments as in `control_step`."""
    mu = jnp.zeros_like(path[0, 0]) if friction is None else friction
    form = form_and_friction(surface, jnp.broadcast_to(mu, (len(hand.fingers),)))
    # None: the default solver. It has a closed form for one contact, so `Frictionless` would not be faster there.
    solver = Frictionless() if friction is None and not isinstance(shape, _TouchedOnce) else None
    return solver, lambda step, pose: form


def _is_valid(
    push: Trajectory, polygon: Polygon, surface: LimitSurface, walls: tuple[Wall, ...], allowed: Scalar
) -> Bool[Array, ""]:
    """Return whether a push with one contact and without walls is the same as with all of them."""
    valid = jnp.all((push.status == Status.MOVING) | (push.status == Status.FREE)) & jnp.all(push.overlap <= allowed)
    for wall in walls:
        valid &= overlap_of_wall(polygon, wall, Vec3.of(push.pose[-1])).depth <= NEGLIGIBLE * surface.length
    return valid


def _allowed_overlap(surface: LimitSurface, path: Float[Array, "steps+1 dof"]) -> Scalar:
    """Return the depth of an overlap that a step of the path may leave, m."""
    displacement = jnp.sqrt(jnp.max(jnp.sum(jnp.diff(path, axis=0) ** 2, axis=1)))
    return jnp.maximum(NEGLIGIBLE * surface.length, DEPTH_PER_DISPLACEMENT * displacement)


@jax.jit  # saves tracing time: loops trace their bodies several times
def _with_all_contacts(*args) -> ControlStepResult:
    """Return the control step with all contacts, with arguments as in `control_step`, like the functions below."""
    return ControlStepResult.of(_simulated(*args))


def _depth_at_start(polygon, surface, friction, hand, walls, path, pose) -> Scalar:
    """Return the depth of the deepest overlap at the start, m."""
    start = Vec3.of(pose)
    depth = overlap_of_finger(polygon, hand.fingers[0].radius, Vec2.of(path[0]), start).depth
    for wall in walls:
        depth = jnp.maximum(depth, overlap_of_wall(polygon, wall, start).depth)
    return depth


def _separated(polygon, surface, friction, hand, walls, path, pose) -> ControlStepResult:
    """Return the control step of a slider that overlaps something deeply."""
    end = separate(polygon, surface.length, hand.fingers[0].radius, walls, path, pose)
    return ControlStepResult(end, path[-1], jnp.full(len(path) - 1, Status.OVERLAPPING, jnp.int8))


class _Progress(NamedTuple):
    """State of a control step between two trials of parts of its steps."""

    push: PushState
    trials_left: Int[Array, ""]  # trials that may follow
    status: Int[Array, "steps"]  # of the steps that are done; -1 for the others


def _divided(polygon, surface, friction, hand, walls, path, pose) -> tuple[PreparedPush, Array]:
    """Return the push with all contacts, and the pose at its start."""
    solver, friction_at = _contact_model(polygon, surface, friction, hand, path)
    return prepared_push(polygon, hand, path, pose, solver, friction_at, walls)


@cache
def _rounds(divided: Callable[..., Any]) -> Rounds:
    """Return the control step as rounds, each of which tries a part of a step of the push that `divided` returns."""

    @jax.jit
    def begin(*args) -> _Progress:
        """Return the state before the first trial."""
        push, start = divided(*args)
        trials = jnp.full((), max_trials(push.steps), jnp.int32)
        return _Progress(push.first_state(Vec3.of(start)), trials, jnp.full(push.steps, -1, jnp.int8))

    @jax.jit
    def advance(progress: _Progress, *args) -> _Progress:
        """Try the next part of a step, and note the status of the step if that ended it."""
        state, (_, end) = divided(*args)[0].trial(progress.push, progress.trials_left)
        status = progress.status.at[jnp.where(end.ended, end.step, len(progress.status))].set(
            end.outcome.status, mode="drop"
        )
        return _Progress(state, progress.trials_left - 1, status)

    return Rounds(begin, advance, _is_ongoing, _finish)


def _is_ongoing(progress: _Progress, *args) -> Bool[Array, ""]:
    """Return whether another trial follows."""
    return (progress.push.step < len(progress.status)) & (progress.trials_left > 0)


def _finish(progress: _Progress, *args) -> ControlStepResult:
    """Return the result, in which steps not done have the status that stopped the hand, or NOT_CONVERGED."""
    path, last, steps = args[-2], progress.push, len(progress.status)
    unfinished = jnp.where(last.stop_status != 0, last.stop_status, Status.NOT_CONVERGED)
    status = jnp.where(progress.status < 0, unfinished, progress.status).astype(jnp.int8)
    # The hand is at the end of the path, or within the last step that was done if something stopped it there.
    step = jnp.where(last.stop_status != 0, jnp.sum(progress.status >= 0) - 1, steps)
    before, after = path[step], path[jnp.minimum(step + 1, steps)]
    pose = jnp.stack(last.pose, axis=-1)
    return ControlStepResult(pose, before + last.done * (after - before), status)
