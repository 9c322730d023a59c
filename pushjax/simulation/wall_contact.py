"""Contact detection for a wall: a straight line without ends, behind which the slider must not be.

The slider touches a wall at corners of a polygon, or at points of a smooth outline whose normal is opposite to the
wall's normal.
"""

import jax
import jax.numpy as jnp

from pushjax.geometry.disk import DiskOutline
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import OUT_OF_REACH, Candidate, FingerPose


def wall_candidates(outline: Outline, wall: FingerPose) -> Candidate:
    """Return every place where a slider may touch a wall, in the slider's frame, as arrays."""
    normal = wall.angle
    assert normal is not None
    if isinstance(outline, PolygonOutline):
        points = outline.edges.start
        valid = jnp.ones(points.x.shape, bool)
    else:
        points, valid = outline.facing(-normal)
    distance = jnp.where(valid, normal.dot(points - wall.center), OUT_OF_REACH)
    return Candidate(distance, points, jax.tree.map(lambda entry: jnp.broadcast_to(entry, distance.shape), normal))


def num_wall_contacts(outline: Outline) -> int:
    """Return the number of contacts with one wall."""
    return 1 if isinstance(outline, DiskOutline) else 2
