"""How a slider comes apart from a finger or a wall that is inside it.

An episode may start with the finger inside the slider, or with the slider inside a wall, and quasi-static contact says
nothing about such a state. As pymunk does it, the overlap then decays over time: in 0.01 s a contact is opened by a
fixed fraction of its depth, in addition to the motion of the finger. The contacts are taken one after another, the
deepest point of each, without friction. Walls are last, so that no finger pushes the slider deeper into one. The slider
moves as under an elliptic limit surface: a push with the force n at the point x moves it by n, and turns it by
(x cross n) / length^2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._math.vec import Scalar, Vec2, Vec3, cos_sin
from pushjax.geometry.polygon import Polygon
from pushjax.simulation.candidate import pick
from pushjax.simulation.fixtures import Wall

# In units of the surface's length. Deeper overlaps are treated here. It is two pixels in PushT, and 1.4 mm in the tasks
# on a table, where the longest ordinary steps may leave overlaps up to this depth.
DEEP = 0.04
ROUNDS = 10  # in a control step of 0.1 s
OPENING = 1 - 0.9**0.6  # fraction of the depth that pymunk removes in 0.01 s: a tenth in 1/60 s


class Overlap(NamedTuple):
    """The deepest point of a contact."""

    depth: Scalar  # m; negative where the bodies are apart
    point: Vec2  # relative to the slider's origin, but in the world's axes, m
    normal: Vec2  # unit, into the slider, world


def overlap_of_finger(polygon: Polygon, radius: Scalar, center: Vec2, pose: Vec3) -> Overlap:
    """Return the overlap of a round finger and the slider."""
    angle = cos_sin(pose.z)
    closest = polygon.outline().closest((center - pose.xy).unrotate(angle))
    return Overlap(radius - closest.distance, closest.point.rotate(angle), -closest.normal.rotate(angle))


def overlap_of_wall(polygon: Polygon, wall: Wall, pose: Vec3) -> Overlap:
    """Return the overlap of a wall and the slider, at the corner that is deepest behind the wall."""
    angle, normal = cos_sin(pose.z), Vec2.of(wall.normal)
    corner, local_normal = polygon.outline().edges.start, normal.unrotate(angle)
    distance = local_normal.dot(corner - (Vec2.of(wall.point) - pose.xy).unrotate(angle))
    deepest, point = pick((distance, corner), jnp.argmin(distance))
    return Overlap(-deepest, point.rotate(angle), normal)


def separate(
    polygon: Polygon,  # outline of the slider
    length: Scalar,  # of the limit surface, m
    radius: Scalar,  # of the finger, m
    walls: tuple[Wall, ...],
    path: Float[Array, "steps+1 2"],  # of the finger's center, world, m
    pose: Float[Array, "3"],  # of the slider at the start, world, m and rad
) -> Float[Array, "3"]:
    """Return the pose of a slider that overlaps a finger or walls, after one control step."""
    steps = len(path) - 1
    times = jnp.arange(ROUNDS + 1, dtype=path.dtype) * (steps / ROUNDS)
    old_times = jnp.arange(steps + 1, dtype=path.dtype)
    centers = jnp.stack([jnp.interp(times, old_times, column) for column in path.T], axis=1)  # of the finger

    def open_contact(pose: Vec3, overlap: Overlap, approach: Scalar) -> Vec3:
        """Return the pose after a round, in which the contact opens by a fraction of its depth and by `approach`, m."""
        # `approach` is how far the finger came nearer, or how much deeper the slider was pushed into the wall.
        touches = overlap.depth > 0
        opening = jnp.where(touches, jnp.maximum(approach, 0) + OPENING * jnp.maximum(overlap.depth, 0), 0.0)
        lever = overlap.point.cross(overlap.normal) / length
        shift = opening / (1 + lever**2)
        return pose + Vec3(shift * overlap.normal.x, shift * overlap.normal.y, shift * lever / length)

    def one_round(pose: Vec3, ends: tuple[Array, Array]):
        before, after = (Vec2.of(end) for end in ends)
        depths = [overlap_of_wall(polygon, wall, pose).depth for wall in walls]
        finger = overlap_of_finger(polygon, radius, after, pose)
        pose = open_contact(pose, finger, finger.normal.dot(after - before))
        for wall, depth in zip(walls, depths, strict=True):
            at_wall = overlap_of_wall(polygon, wall, pose)
            pose = open_contact(pose, at_wall, at_wall.depth - jnp.maximum(depth, 0))
        return pose, None

    last, _ = jax.lax.scan(one_round, Vec3.of(pose), (centers[:-1], centers[1:]))
    return last.array()
