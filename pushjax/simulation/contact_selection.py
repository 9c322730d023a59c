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
    touches: Candidates, length: Scalar, outline: Outline, path: Vec2
) -> tuple[Int[Array, ""] | int, ...]:
    """Select which places are contacts, the likeliest first. The selection is not differentiated.

    Of an array of places, it selects the nearest, and the nearest in a different place. If there is no second, its
    index equals the first. On a polygon that is not convex, distances are compared after the displacement `path`, and a
    third place is selected. Places that are not in an array are all selected.

    Args:
        touches: All places, as from `contact_candidates`.
        length: Characteristic length of the limit surface, m.
        outline: The slider's outline.
        path: Displacement of the finger in the rest of the step, slider's frame, m.
    """
    if not isinstance(touches, Candidate):
        return tuple(range(len(touches)))
    touches, path = jax.lax.stop_gradient((touches, path))
    if is_nonconvex_polygon(outline):
        touches = touches._replace(distance=touches.distance - touches.normal.dot(path))
        return _apart(touches, length)
    distance = touches.distance
    first = jnp.argmin(distance)
    nearest = _at(touches, first)
    apart = touches.point - nearest.point
    same = SAME_PLACE if isinstance(outline, PolygonOutline) else SAME_BUMP
    elsewhere = apart.dot(apart) > (same * length) ** 2
    elsewhere = decide(elsewhere & (distance < nearest.distance + 1e3 * length), length)
    second = jnp.where(jnp.any(elsewhere), jnp.argmin(jnp.where(elsewhere, distance, jnp.inf)), first)
    return first.astype(jnp.int32), second.astype(jnp.int32)


def _apart(touches: Candidate, length: Scalar) -> tuple[Int[Array, ""], ...]:
    """The nearest place, and the two that constrain most of the motions that it leaves free.

    A pad that lies flat across two arms then rests on its outermost places. A pad in an inner corner then rests on both
    edges. Neither rests on places side by side.
    """
    chosen = [jnp.argmin(touches.distance).astype(jnp.int32)]
    nearest = _at(touches, chosen[0])
    elsewhere, reach = touches.distance < nearest.distance + 1e3 * length, jnp.zeros_like(touches.distance)
    last = nearest
    for _ in range(2):
        free, far = _beyond(touches, last, length)
        elsewhere, reach = compute_once((elsewhere & free, jnp.maximum(reach, far)), length)
        best = jnp.argmin(jnp.where(elsewhere, reach, jnp.inf))
        chosen.append(jnp.where(jnp.any(elsewhere), best, chosen[0]).astype(jnp.int32))
        last = _at(touches, chosen[-1])
    return tuple(chosen)


def _beyond(touches: Candidate, last: Candidate, length: Scalar) -> tuple[Bool[Array, " places"], Scalar]:
    """Which places constrain a different motion than `last`, and the distance to each, m.

    The distance is how far a slider that stays in contact at `last` has to move until it touches at the other place.
    """
    lever = (touches.point - last.point).cross(touches.normal) / length
    shared = touches.normal.dot(last.normal)
    free = jnp.sqrt(jnp.maximum(1 - jnp.maximum(shared, 0) ** 2, 0) + lever**2)
    gap = jnp.maximum(touches.distance - shared * last.distance, 0) + SAME_PLACE * length
    return free > SAME_PLACE, gap / jnp.maximum(free, SAME_PLACE)


def selected_candidates(touches: Candidates, chosen: tuple[Any, ...]) -> tuple[Candidate, ...]:
    """The selected places; a place that is selected a second time is moved out of reach."""
    if not isinstance(touches, Candidate):
        return touches
    first, *others = (_at(touches, index) for index in chosen)
    again = [index == chosen[0] for index in chosen[1:]]
    far = [jnp.where(same, 1.0, 0.0).astype(first.distance.dtype) for same in again]
    return first, *(one._replace(distance=one.distance + off) for one, off in zip(others, far, strict=True))


def track_contacts(
    touches: Candidates, chosen: tuple[Any, ...], begun: tuple[Candidate, ...], finger: Finger, outline: Outline
) -> tuple[Any, ...]:
    """Indices of the same places later in the step, when `contact_candidates` may return them in another order.

    The order changes in an inner corner, where the edge that a pad's corner is nearest to changes.

    Args:
        touches: All places now.
        chosen: Indices at the start of the step.
        begun: The selected places at the start of the step.
        finger: The finger.
        outline: The slider's outline.
    """
    if not isinstance(finger, Pad) or not isinstance(touches, Candidate) or not is_nonconvex_polygon(outline):
        return chosen
    tips = len(edges(finger.shape.outline()))
    other = touches.distance.size - tips  # index offset from (corner, nearest edge) to (same corner, next edge)
    found = []
    for index, before in zip(chosen, begun, strict=True):
        twin = jnp.where(index < tips, index + other, jnp.where(index >= other, index - other, index))
        now, then = (_at(touches, k).normal.dot(before.normal) for k in (index, twin))
        found.append(jnp.where(decide(then > now + SAME_PLACE, now), twin, index))
    return tuple(found)


def _at(touches: Candidate, index: Int[Array, ""]) -> Candidate:
    """`touches[index]`, computed as a masked sum, which is cheap in a batch."""
    mark = jnp.arange(touches.distance.size) == index
    return jax.tree.map(lambda entries: jnp.sum(jnp.where(mark, entries, 0.0)), touches)
