"""Contact detection: where a finger meets the slider during a step, and with what normal and gap.

Everything is exact for a straight relative path of any length, so a finger can neither tunnel through the slider nor
meet the extension of an edge past its corner: first the time of impact with the slider at rest, then the boundary
as seen from where the finger then is.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec2, settle
from pushjax.shapes import Outline

# How far, in units of the limit surface's length, a finger may overlap the slider and still be pushed out: a tracker's
# error, not a finger on the wrong side.
DEEPEST_OVERLAP = 0.2


class Meeting(NamedTuple):
    """When, within a step, one finger meets the slider. Body frame, m.

    start: fraction of the path after which they are in contact. reached: whether they are at all. overlapping: whether
    the finger is too deep inside for the closest side to mean anything. gap: the gap then, which is the depth
    of an overlap (negative) or zero.
    """

    start: Scalar
    reached: Bool[Array, ""]
    overlapping: Bool[Array, ""]
    gap: Scalar


def meet(outline: Outline, center: Vec2, path: Vec2, radius: Scalar, length: Scalar) -> Meeting:
    """The first contact of a disc that moves from `center` along `path`, both in the frame of a slider at rest."""
    here = outline.closest(center)
    gap = here.distance - radius
    # In contact and pressing on: from the start. Else, also when touching but leaving, whatever is hit first.
    hit = outline.sweep(center, path, radius)
    pressing, hits = settle(((gap <= 0) & (-here.normal.dot(path) > gap), hit <= 1), center.x)
    reached = pressing | hits
    return Meeting(
        jnp.where(pressing, 0.0, jnp.where(reached, hit, 1.0)),
        reached,
        gap < -DEEPEST_OVERLAP * length,
        jnp.where(pressing, gap, 0.0),
    )
