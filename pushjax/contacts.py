"""Contact detection: where a finger meets the slider during a step, and with what normal and gap.

Everything is exact for a straight relative path of any length, so a finger can neither tunnel through the slider nor
meet the extension of an edge past its corner: first the time of impact with the slider at rest, then the boundary
as seen from where the finger then is.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec2, select
from pushjax.shapes import Outline

# How deep, in units of the limit surface's length, a finger's centre may start inside the slider and still be pushed
# out: a few roundings or a tracker's error for a point finger, not a finger on the wrong side.
DEEPEST_CENTER = 0.1


class Meeting(NamedTuple):
    """One finger and the slider within a step. Body frame, m.

    start: fraction of the path after which they are in contact. reached: whether they are at all. overlapping: whether
    the finger's centre is too deep inside for the closest side to mean anything. point, normal (into the slider), gap:
    the contact at that fraction; the gap is zero but for rounding, or the depth of an overlap, negative.
    """

    start: Scalar
    reached: Bool[Array, ""]
    overlapping: Bool[Array, ""]
    point: Vec2
    normal: Vec2
    gap: Scalar


def meet(outline: Outline, center: Vec2, path: Vec2, radius: Scalar, length: Scalar) -> Meeting:
    """The contact of a disc that moves from `center` along `path`, both in the frame of a slider at rest."""
    here = outline.closest(center)
    gap = here.distance - radius
    # In contact and pressing on: from the start. Else, also when touching but leaving, whatever is hit first.
    pressing = (gap <= 0) & (-here.normal.dot(path) > gap)
    hit = outline.sweep(center, path, radius)
    hits = hit <= 1
    start = jnp.where(pressing, 0.0, jnp.where(hits, hit, 1.0))
    there = outline.closest(center + path.scale(start))
    return Meeting(
        start,
        pressing | hits,
        here.distance < -DEEPEST_CENTER * length,
        there.point,
        -there.normal,
        there.distance - radius,
    )


def touch(outline: Outline, center: Vec2, met: Meeting) -> tuple[Vec2, Vec2]:
    """Contact point and inward normal as seen from a finger at `center`; those of `met` where nothing was reached."""
    seen = outline.closest(center)
    return select(met.reached, seen.point, met.point), select(met.reached, -seen.normal, met.normal)
