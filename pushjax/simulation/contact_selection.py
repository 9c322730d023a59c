"""Selection of a finger's contacts from its contact candidates, and the same contacts later in the step.

A pad has more candidates than are needed to constrain it. The nearest of them is selected, and one or two others that
constrain a different motion.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, decide
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import Candidate, Candidates, take
from pushjax.simulation.detection import edges, is_nonconvex_polygon
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Finger, Pad

# Two candidates nearer to each other than this, in units of the limit surface's length, count as one. The first is for
# a polygon. The second is for a smooth outline, where a corner of a pad and its edge both find the same bump.
SAME_PLACE, SAME_BUMP = 1e-3, 0.1
# In units of the same length. A candidate that is farther than the nearest by more than this does not exist
# (`OUT_OF_REACH`).
EXISTING = 1e3


def select_contacts(
    candidates: Candidates, length: Scalar, outline: Outline, path: Vec2
) -> tuple[Int[Array, ""] | int, ...]:
    """Select which candidates are contacts, the likeliest first. The selection is not differentiated.

    Of the candidates of a pad, it selects the nearest, and the nearest of those that are at a different place. On a
    polygon that is not convex, distances are compared after the displacement `path`, and a third candidate is selected.
    A tuple of candidates (of a round finger, or on a disk) is selected as a whole.

    Args:
        candidates: All candidates, as from `contact_candidates`.
        length: Characteristic length of the limit surface, m.
        outline: The slider's outline.
        path: Displacement of the finger in the rest of the step, slider's frame, m.

    Returns:
        Indices of the selected candidates. If there is no second or third one, the first index is repeated.
    """
    if not isinstance(candidates, Candidate):
        return tuple(range(len(candidates)))
    candidates, path = jax.lax.stop_gradient((candidates, path))
    if is_nonconvex_polygon(outline):
        candidates = candidates._replace(distance=candidates.distance - candidates.normal.dot(path))
        return _select_three(candidates, length)
    distance = candidates.distance
    first = jnp.argmin(distance)
    nearest = take(candidates, first)
    offset = candidates.point - nearest.point
    separation = SAME_PLACE if isinstance(outline, PolygonOutline) else SAME_BUMP
    is_other = offset.dot(offset) > (separation * length) ** 2
    is_other = decide(is_other & (distance < nearest.distance + EXISTING * length), length)
    second = jnp.where(jnp.any(is_other), jnp.argmin(jnp.where(is_other, distance, jnp.inf)), first)
    return first.astype(jnp.int32), second.astype(jnp.int32)


def _select_three(candidates: Candidate, length: Scalar) -> tuple[Int[Array, ""], ...]:
    """Return the indices of the nearest candidate, and of two that constrain most of the motions that it leaves free.

    A pad that lies flat across two arms then rests on its outermost candidates. A pad in an inner corner then rests on
    both edges. Neither rests on two candidates side by side.
    """
    chosen = [jnp.argmin(candidates.distance).astype(jnp.int32)]
    nearest = take(candidates, chosen[0])
    eligible = candidates.distance < nearest.distance + EXISTING * length
    travel = jnp.zeros_like(candidates.distance)
    previous = nearest
    for _ in range(2):
        differs, distance = _distances_in_other_directions(candidates, previous, length)
        eligible, travel = compute_once((eligible & differs, jnp.maximum(travel, distance)), length)
        best = jnp.argmin(jnp.where(eligible, travel, jnp.inf))
        chosen.append(jnp.where(jnp.any(eligible), best, chosen[0]).astype(jnp.int32))
        previous = take(candidates, chosen[-1])
    return tuple(chosen)


def _distances_in_other_directions(
    candidates: Candidate, previous: Candidate, length: Scalar
) -> tuple[Bool[Array, " candidates"], Scalar]:
    """Return which candidates constrain a different motion than `previous`, and the distance to each, m.

    The distance is how far a slider that stays in contact at `previous` has to move until it touches at the candidate.
    """
    lever = (candidates.point - previous.point).cross(candidates.normal) / length
    shared = candidates.normal.dot(previous.normal)
    freedom = jnp.sqrt(jnp.maximum(1 - jnp.maximum(shared, 0) ** 2, 0) + lever**2)
    gap = jnp.maximum(candidates.distance - shared * previous.distance, 0) + SAME_PLACE * length
    return freedom > SAME_PLACE, gap / jnp.maximum(freedom, SAME_PLACE)


def selected_candidates(candidates: Candidates, chosen: tuple[Any, ...]) -> tuple[Candidate, ...]:
    """Return the selected candidates; one that is selected a second time is moved 1 m away, which is out of reach."""
    if not isinstance(candidates, Candidate):
        return candidates
    first, *others = (take(candidates, index) for index in chosen)
    repeated = [index == chosen[0] for index in chosen[1:]]
    offsets = [jnp.where(same, 1.0, 0.0).astype(first.distance.dtype) for same in repeated]
    return first, *(
        other._replace(distance=other.distance + offset) for other, offset in zip(others, offsets, strict=True)
    )


def track_contacts(
    candidates: Candidates,
    chosen: tuple[Any, ...],
    at_start: tuple[Candidate, ...],
    finger: Finger | Wall,
    outline: Outline,
) -> tuple[Any, ...]:
    """Return the indices of the same contacts later in the step, where `contact_candidates` may order them differently.

    The order changes in an inner corner, where the edge that a pad's corner is nearest to changes.

    Args:
        candidates: All candidates now.
        chosen: Indices at the start of the step.
        at_start: The selected candidates at the start of the step.
        finger: The finger, or a wall.
        outline: The slider's outline.
    """
    if not isinstance(finger, Pad) or not isinstance(candidates, Candidate) or not is_nonconvex_polygon(outline):
        return chosen
    pad_corners = len(edges(finger.shape.outline()))
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
