"""Selection of a finger's or a fixture's contacts from the candidates, and the same contacts later in the step.

A pad or a wall has more candidates than are needed to constrain it. The nearest of them is selected, and one or two
others that constrain most of the motions that are left free. So whatever lies flat rests on the two ends of what it
touches, however many vertices lie in between.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, decide
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import OUT_OF_REACH, Candidate, Candidates, take
from pushjax.simulation.detection import DisplacementAt, is_nonconvex_polygon, num_contacts
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Finger, Pad

# Two candidates nearer to each other than this, in units of the limit surface's length, count as one. The first is for
# a polygon. The second is for a smooth outline, where a corner of a pad and its edge both find the same bump.
SAME_PLACE, SAME_BUMP = 1e-3, 0.1
# A candidate counts as nearer by this fraction of its distance from the middle of all candidates. So of candidates that
# are equally near up to roundoff, the outermost is selected. Not so on a polygon that is not convex, where two more are
# selected, and where a pad in an inner corner has to rest on that corner.
SAME_DISTANCE = 1e-5


def select_contacts(
    candidates: Candidates, finger: Finger | Wall, length: Scalar, outline: Outline, displacement_at: DisplacementAt
) -> tuple[Int[Array, ""] | int, ...]:
    """Return the indices of the candidates that are contacts, the likeliest first; a missing one repeats the first."""
    if not isinstance(candidates, Candidate):  # of a round finger, or of a pad on a disk
        return tuple(range(len(candidates)))
    # distances are compared after the displacement of the finger, with the slider at rest
    displacement = displacement_at(candidates.point)
    candidates, length, displacement = jax.lax.stop_gradient((candidates, length, displacement))
    eligible = candidates.distance < OUT_OF_REACH / 2
    candidates = candidates._replace(distance=candidates.distance - candidates.normal.dot(displacement))
    offset = candidates.point - _mean(candidates.point, eligible)
    distance = jnp.where(eligible, candidates.distance, OUT_OF_REACH)
    outermost = distance - (0.0 if is_nonconvex_polygon(outline) else SAME_DISTANCE) * jnp.sqrt(offset.dot(offset))
    chosen, travel = [jnp.argmin(outermost).astype(jnp.int32)], jnp.zeros_like(distance)
    for _ in range(num_contacts(finger, outline) - 1):
        previous = take(candidates, chosen[-1])
        differs, other = _distances_in_other_directions(candidates, previous, length)
        if not is_nonconvex_polygon(outline):  # in an inner corner, both contacts are at one place
            offset = candidates.point - previous.point
            separation = SAME_PLACE if isinstance(outline, PolygonOutline) else SAME_BUMP
            differs &= offset.dot(offset) > (separation * length) ** 2
        eligible, travel = compute_once((eligible & differs, jnp.maximum(travel, other)), length)
        best = jnp.argmin(jnp.where(eligible, travel, jnp.inf))
        chosen.append(jnp.where(jnp.any(eligible), best, chosen[0]).astype(jnp.int32))
    return tuple(chosen)


def _mean(points: Vec2, mask: Bool[Array, " candidates"]) -> Vec2:
    """Return the mean of the points that a mask marks."""
    count = jnp.maximum(jnp.sum(mask), 1)
    return Vec2(*(jnp.sum(jnp.where(mask, entry, 0.0)) / count for entry in points))


def _distances_in_other_directions(
    candidates: Candidate, previous: Candidate, length: Scalar
) -> tuple[Bool[Array, " candidates"], Scalar]:
    """Return which candidates constrain a different motion than `previous`, and the distance to each, m."""
    # the distance: how far a slider that stays in contact at `previous` has to move until it touches at the candidate
    lever = (candidates.point - previous.point).cross(candidates.normal) / length
    shared = candidates.normal.dot(previous.normal)
    freedom = jnp.sqrt(jnp.maximum(1 - jnp.maximum(shared, 0) ** 2, 0) + lever**2)
    gap = jnp.maximum(candidates.distance - shared * previous.distance, 0) + SAME_PLACE * length
    return freedom > SAME_PLACE, gap / jnp.maximum(freedom, SAME_PLACE)


def selected_candidates(candidates: Candidates, chosen: tuple[Any, ...]) -> tuple[Candidate, ...]:
    """Return the selected candidates; one that is selected a second time is moved out of reach."""
    if not isinstance(candidates, Candidate):
        return candidates
    first, *others = (take(candidates, index) for index in chosen)
    repeated = [index == chosen[0] for index in chosen[1:]]
    offsets = [jnp.where(same, OUT_OF_REACH, 0.0).astype(first.distance.dtype) for same in repeated]
    return first, *(
        other._replace(distance=other.distance + offset) for other, offset in zip(others, offsets, strict=True)
    )


def track_contacts(
    candidates: Candidates,
    chosen: tuple[Any, ...],  # indices at the start of the step
    at_start: tuple[Candidate, ...],  # the candidates of these indices at the start of the step
    finger: Finger | Wall,
    outline: Outline,
) -> tuple[Any, ...]:
    """Return the indices of the same contacts later in the step, where the candidates may have another order."""
    # the order changes in an inner corner, where another edge becomes nearest to a pad's corner
    if not isinstance(finger, Pad) or not isinstance(candidates, Candidate) or not is_nonconvex_polygon(outline):
        return chosen
    pad_corners = len(finger.shape.vertices)
    # Index offset from a corner of the pad with its nearest edge to the same corner with its next nearest edge.
    twin_offset = candidates.distance.size - pad_corners
    indices = []
    for index, original in zip(chosen, at_start, strict=True):
        twin = jnp.where(
            index < pad_corners, index + twin_offset, jnp.where(index >= twin_offset, index - twin_offset, index)
        )
        same_normal, twin_normal = (take(candidates, k).normal.dot(original.normal) for k in (index, twin))
        indices.append(jnp.where(decide(twin_normal > same_normal + SAME_PLACE, same_normal), twin, index))
    return tuple(indices)
