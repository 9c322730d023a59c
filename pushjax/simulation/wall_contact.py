"""Contact detection for a wall: a straight line without ends, behind which the slider must not be.

The slider touches a wall at corners of a polygon, or at points of a smooth outline whose normal is opposite to that of
the wall. Two of these candidates are contacts: a slider that lies flat on a wall rests on the outermost two.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from pushjax._internal.xla import compute_once
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.disk import DiskOutline
from pushjax.geometry.polygon_outline import Edge, PolygonOutline
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import OUT_OF_REACH, Candidate, FingerPose, take

# A candidate counts as nearer to the wall by this fraction of its distance along the wall from the middle of all
# candidates. So of candidates that are equally near up to roundoff, the outermost is selected.
SAME_DISTANCE = 1e-5
SAME_PLACE = 1e-3  # least distance of the second contact from the first, in units of the surface's length


def wall_candidates(outline: Outline, wall: FingerPose) -> Candidate:
    """Return every place where a slider may touch a wall, as arrays.

    Args:
        outline: The slider's outline.
        wall: A point of the wall, and its unit normal into the free space, in the slider's frame.
    """
    normal = wall.angle
    assert normal is not None
    if isinstance(outline, PolygonOutline):
        points = _vertices(outline)
        valid = jnp.ones(points.x.shape, bool)
    else:
        points, valid = outline.facing(-normal)
    distance = jnp.where(valid, normal.dot(points - wall.center), OUT_OF_REACH)
    return Candidate(distance, points, jax.tree.map(lambda entry: jnp.broadcast_to(entry, distance.shape), normal))


def num_wall_contacts(outline: Outline) -> int:
    """Number of contacts with one wall."""
    return 1 if isinstance(outline, DiskOutline) else 2


def select_on_wall(candidates: Candidate, length: Scalar, outline: Outline) -> tuple[Int[Array, ""], ...]:
    """Return the indices of the nearest candidate, and of the one on which a slider that rests on it can turn least.

    If there is no second candidate, the first index is repeated. Not differentiated.
    """
    distance, points, normal = jax.lax.stop_gradient(candidates)
    along = points.dot(normal.perp())
    middle = jnp.mean(along)
    first = jnp.argmin(distance - SAME_DISTANCE * jnp.abs(along - middle)).astype(jnp.int32)
    if num_wall_contacts(outline) == 1:
        return (first,)
    nearest = take(candidates, first)
    lever = jnp.abs(along - nearest.point.dot(nearest.normal.perp()))
    turn = (distance - nearest.distance + SAME_PLACE * length) / jnp.maximum(lever, SAME_PLACE * length)
    possible = compute_once((lever > SAME_PLACE * length) & (distance < OUT_OF_REACH / 2), length)
    second = jnp.argmin(jnp.where(possible, turn, jnp.inf)).astype(jnp.int32)
    return first, jnp.where(jnp.any(possible), second, first)


def _vertices(outline: PolygonOutline) -> Vec2:
    """Vertices of a polygon, as arrays."""
    if isinstance(outline.edges, Edge):
        return outline.edges.start
    return jax.tree.map(lambda *entries: jnp.stack(entries), *(edge.start for edge in outline.edges))
