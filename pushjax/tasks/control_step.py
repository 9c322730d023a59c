"""One control step of a task: a hand pushes a polygon along a short path, among walls.

A round finger mostly touches a polygon in one place, and mostly there is no wall near. So the step is first computed
with one contact and without walls, which takes a tenth of the time. Where that leaves the finger inside the slider, or
the slider inside a wall, it is computed again with all contacts; in a batch, only for the examples that need it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.compaction import where_needed
from pushjax._math.vec import Vec2, Vec3
from pushjax.contact.frictionless import Frictionless
from pushjax.contact.problem import to_scalars
from pushjax.contact.status import Status
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.simulation.finger_motion import DEPTH_PER_DISPLACEMENT
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.rollout import simulate
from pushjax.simulation.trajectory import Trajectory
from pushjax.tasks.separation import DEEP, overlap_of_finger, overlap_of_wall, separate

# In units of the surface's length: an overlap that is left as it is.
NEGLIGIBLE = 1e-3


class Pushed(NamedTuple):
    """What a control step leaves.

    Attributes:
        pose: Pose of the slider, (3,), world, m and rad.
        configuration: Configuration of the hand, (dof,).
        status: `Status` of each of the steps of the path, (steps,).
    """

    pose: Float[Array, "3"]
    configuration: Float[Array, "dof"]
    status: Int[Array, "steps"]

    @staticmethod
    def of(push: Trajectory) -> "Pushed":
        """The end of a push."""
        return Pushed(push.pose[-1], push.configuration[-1], push.status)


class _TouchedOnce(Polygon):
    """A polygon that a finger touches in no more than one place, the nearest, also if it is not convex."""

    def __init__(self, polygon: Polygon):
        self.vertices, self.convex = polygon.vertices, polygon.convex

    def outline(self) -> PolygonOutline:
        return PolygonOutline(super().outline().edges, convex=True)


def control_step(
    polygon: Polygon,
    surface: LimitSurface,
    friction: Float[Array, ""] | None,
    hand: Hand,
    walls: tuple[Wall, ...],
    path: Float[Array, "steps+1 dof"],
    pose: Float[Array, "3"],
) -> Pushed:
    """Push a slider along a short path, among walls.

    A slider that overlaps a finger or a wall deeply at the start is pushed out (`separation`); the status of all steps
    is then OVERLAPPING.

    Args:
        polygon: Outline of the slider.
        surface: Its limit surface.
        friction: Coefficient of friction between fingers and slider. None if there is none, and the surface is an
            ellipsoid: programs are then smaller and faster.
        hand: The hand.
        walls: Walls, which the slider cannot pass.
        path: Configurations of the hand, world, m.
        pose: Pose of the slider at the start, world, m and rad.
    """
    if not _is_finger(hand):
        return Pushed.of(_simulated(polygon, surface, friction, hand, walls, path, pose))
    push = _simulated(_TouchedOnce(polygon), surface, friction, hand, (), path, pose)
    valid = jax.lax.stop_gradient(_is_valid(push, polygon, surface, walls, path))
    args = polygon, surface, friction, hand, walls, path, pose
    return where_needed(~valid, _with_all_contacts, Pushed.of(push), *args)


def _is_finger(hand: Hand) -> bool:
    """Whether a hand is one round finger."""
    return len(hand.fingers) == 1 and isinstance(hand.fingers[0], RoundFinger)


def _simulated(shape, surface, friction, hand, walls, path, pose) -> Trajectory:
    """The push along the path. Arguments as in `control_step`."""
    mu = jnp.zeros_like(pose[0]) if friction is None else friction
    form = to_scalars(surface, jnp.broadcast_to(mu, (len(hand.fingers),)))
    solver = Frictionless() if friction is None and not isinstance(shape, _TouchedOnce) else None
    return simulate(shape, hand, path, pose, solver, lambda step, pose: form, walls)


def _is_valid(
    push: Trajectory, polygon: Polygon, surface: LimitSurface, walls: tuple[Wall, ...], path: Array
) -> Bool[Array, ""]:
    """Whether a push with one contact and without walls is what it would be with all of them."""
    displacement = jnp.sqrt(jnp.max(jnp.sum(jnp.diff(path, axis=0) ** 2, axis=1)))
    allowed = jnp.maximum(NEGLIGIBLE * surface.length, DEPTH_PER_DISPLACEMENT * displacement)
    valid = jnp.all((push.status == Status.MOVING) | (push.status == Status.FREE)) & jnp.all(push.overlap <= allowed)
    for wall in walls:
        valid &= overlap_of_wall(polygon, wall, Vec3.of(push.pose[-1])).depth <= NEGLIGIBLE * surface.length
    return valid


@jax.jit  # saves tracing time: loops trace their bodies several times
def _with_all_contacts(polygon, surface, friction, hand, walls, path, pose) -> Pushed:
    """The control step in full. Arguments as in `control_step`."""
    push = Pushed.of(_simulated(polygon, surface, friction, hand, walls, path, pose))
    start, radius = Vec3.of(pose), hand.fingers[0].radius
    depth = overlap_of_finger(polygon, radius, Vec2.of(path[0]), start).depth
    for wall in walls:
        depth = jnp.maximum(depth, overlap_of_wall(polygon, wall, start).depth)
    deep = jax.lax.stop_gradient(depth > DEEP * surface.length)
    separated = separate(polygon, surface.length, radius, walls, path, pose)
    overlapping = Pushed(separated, path[-1], jnp.full_like(push.status, Status.OVERLAPPING))
    return jax.tree.map(lambda a, b: jnp.where(deep, a, b), overlapping, push)
