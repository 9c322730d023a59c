"""Which of the places where a finger and the slider may touch are contacts, and the same places later in the step.

A pad may touch in more places than constrain it. Of those, the nearest is a contact, and others in different places.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, decide
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.geometry.shape import Outline
from pushjax.simulation.detection import Candidate, Candidates, edges, is_nonconvex_polygon
from pushjax.simulation.hand import Finger, Pad

# Two places nearer to each other than this, in units of the length, are one. The first is for a polygon. The second is
# for a smooth outline, where a corner of a pad and its edge both find the same bump.
SAME_PLACE, SAME_BUMP = 1e-3, 0.1


def select_contacts(
    candidates: Candidates, length: Scalar, outline: Outline, path: Vec2
) -> tuple[Int[Array, ""] | int, ...]:
    """Select which places are contacts, the likeliest first. The selection is not differentiated.

    Of an array of places, it selects the nearest, and the nearest in a different place. If there is no second, its
    index equals the first. On a polygon that is not convex, distances are compared after the displacement `path`, and a
    third place is selected. Places that are not in an array are all selected.

    Args:
        candidates: All places, as from `contact_candidates`.
        length: Characteristic length of the limit surface, m.
        outline: The slider's outline.
        path: Displacement of the finger in the rest of the step, slider's frame, m.
    """
    if not isinstance(candidates, Candidate):
        return tuple(range(len(candidates)))
    candidates, path = jax.lax.stop_gradient((candidates, path))
    if is_nonconvex_polygon(outline):
        candidates = candidates._replace(distance=candidates.distance - candidates.normal.dot(path))
        return _select_three(candidates, length)
    distance = candidates.distance
    first = jnp.argmin(distance)
    nearest = _take(candidates, first)
    apart = candidates.point - nearest.point
    separation = SAME_PLACE if isinstance(outline, PolygonOutline) else SAME_BUMP
    elsewhere = apart.dot(apart) > (separation * length) ** 2
    elsewhere = decide(elsewhere & (distance < nearest.distance + 1e3 * length), length)
    second = jnp.where(jnp.any(elsewhere), jnp.argmin(jnp.where(elsewhere, distance, jnp.inf)), first)
    return first.astype(jnp.int32), second.astype(jnp.int32)


def _select_three(candidates: Candidate, length: Scalar) -> tuple[Int[Array, ""], ...]:
    """The nearest place, and the two that constrain most of the motions that it leaves free.

    A pad that lies flat across two arms then rests on its outermost places. A pad in an inner corner then rests on both
    edges. Neither rests on places side by side.
    """
    chosen = [jnp.argmin(candidates.distance).astype(jnp.int32)]
    nearest = _take(candidates, chosen[0])
    elsewhere, travel = candidates.distance < nearest.distance + 1e3 * length, jnp.zeros_like(candidates.distance)
    previous = nearest
    for _ in range(2):
        differs, distance = _distances_in_other_directions(candidates, previous, length)
        elsewhere, travel = compute_once((elsewhere & differs, jnp.maximum(travel, distance)), length)
        best = jnp.argmin(jnp.where(elsewhere, travel, jnp.inf))
        chosen.append(jnp.where(jnp.any(elsewhere), best, chosen[0]).astype(jnp.int32))
        previous = _take(candidates, chosen[-1])
    return tuple(chosen)


def _distances_in_other_directions(
    candidates: Candidate, previous: Candidate, length: Scalar
) -> tuple[Bool[Array, " places"], Scalar]:
    """Return which candidates constrain a different motion than `previous`, and the distance to each, m.

    The distance is how far a slider that stays in contact at `previous` has to move until it touches at the candidate.
    """
    lever = (candidates.point - previous.point).cross(candidates.normal) / length
    shared = candidates.normal.dot(previous.normal)
    freedom = jnp.sqrt(jnp.maximum(1 - jnp.maximum(shared, 0) ** 2, 0) + lever**2)
    gap = jnp.maximum(candidates.distance - shared * previous.distance, 0) + SAME_PLACE * length
    return freedom > SAME_PLACE, gap / jnp.maximum(freedom, SAME_PLACE)


def selected_candidates(candidates: Candidates, chosen: tuple[Any, ...]) -> tuple[Candidate, ...]:
    """The selected places; a place that is selected a second time is moved out of reach."""
    if not isinstance(candidates, Candidate):
        return candidates
    first, *others = (_take(candidates, index) for index in chosen)
    repeated = [index == chosen[0] for index in chosen[1:]]
    offsets = [jnp.where(same, 1.0, 0.0).astype(first.distance.dtype) for same in repeated]
    return first, *(
        other._replace(distance=other.distance + offset) for other, offset in zip(others, offsets, strict=True)
    )


def track_contacts(
    candidates: Candidates, chosen: tuple[Any, ...], at_start: tuple[Candidate, ...], finger: Finger, outline: Outline
) -> tuple[Any, ...]:
    """Indices of the same places later in the step, when `contact_candidates` may return them in another order.

    The order changes in an inner corner, where the edge that a pad's corner is nearest to changes.

    Args:
        candidates: All places now.
        chosen: Indices at the start of the step.
        at_start: The selected places at the start of the step.
        finger: The finger.
        outline: The slider's outline.
    """
    if not isinstance(finger, Pad) or not isinstance(candidates, Candidate) or not is_nonconvex_polygon(outline):
        return chosen
    pad_corners = len(edges(finger.shape.outline()))
    twin_offset = (
        candidates.distance.size - pad_corners
    )  # index offset from (corner, nearest edge) to (same corner, next edge)
    indices = []
    for index, original in zip(chosen, at_start, strict=True):
        twin = jnp.where(
            index < pad_corners, index + twin_offset, jnp.where(index >= twin_offset, index - twin_offset, index)
        )
        same_normal, twin_normal = (_take(candidates, k).normal.dot(original.normal) for k in (index, twin))
        indices.append(jnp.where(decide(twin_normal > same_normal + SAME_PLACE, same_normal), twin, index))
    return tuple(indices)


def _take(candidates: Candidate, index: Int[Array, ""]) -> Candidate:
    """`touches[index]`, computed as a masked sum, which is cheap in a batch."""
    mark = jnp.arange(candidates.distance.size) == index
    return jax.tree.map(lambda entries: jnp.sum(jnp.where(mark, entries, 0.0)), candidates)
