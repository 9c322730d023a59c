"""Contact detection: where fingers meet the slider during a step, and with what normals and gaps.

How long the hand moves freely is exact for straight relative paths of any length, so a finger can neither tunnel
through the slider nor meet the extension of an edge past its corner. From there every place where a finger and the
slider may touch is a contact with its own gap, closed or not: contacts that are made within the step are the contact
problem's to find.

A round finger has one such place, or two on an outline that is not convex. A pad against a convex polygon has two: of
all corners of either, seen from the other's outline, the two nearest in different places (an edge flat on an edge rests
on the two ends of what they share). So it has against a smooth outline, of the places that `_smooth_pads` finds.
Against a polygon that is not convex it has three: the nearest, and those that bind most of what that one leaves free.
All are chosen anew in each step, and stay the same within it.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax import _smooth_pads
from pushjax._smooth_pads import Seen
from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.hands import Finger, Pad, RoundFinger
from pushjax.shapes import DiskOutline, Outline, PolygonOutline
from pushjax.shapes._base import rounding
from pushjax.shapes.polygon import Edge

# How far, in units of the limit surface's length, a finger may overlap the slider and still be pushed out: a tracker's
# error, not a finger on the wrong side.
DEEPEST_OVERLAP = 0.2
# A corner may touch what lies in a direction if neither of its edges leads there; so much (sine) an edge may, so that
# both ends of an edge almost flat on another are contacts, and neither sinks in when it comes down.
BLUNT = 0.3
# By bytes of a float, of an edge's length: how far past its end a corner still lies beside it. Two corners that come to
# lie on each other to rounding (a pad's, whose side rests on an arm, and that of the arm's end) would else both be past
# the other's edge, and touch nowhere.
LOOSE = {4: 2e-5, 8: 1e-6}
# In units of the length: how far an edge goes on past an inner corner, inside the slider, so that what sinks into one
# of its edges still lies beside the other.
PAST = 0.05
FAR = 1e3  # m, out of any reach
# Two places nearer to each other than this, in the same unit, are one: of a polygon, and of a smooth outline, where a
# pad's corner and its edge both find the same bump.
SAME_PLACE, SAME_BUMP = 1e-3, 0.1


class Placement(NamedTuple):
    """Where a finger is: its centre, and its angle as a unit vector (None: it never turns)."""

    center: Vec2
    angle: Vec2 | None


class Touch(NamedTuple):
    """A place where a finger and the slider may touch, in the slider's frame, m: signed distance (negative in
    penetration), the slider's point, the inward unit normal. Or an array of such places."""

    distance: Scalar
    point: Vec2
    normal: Vec2


# One by one; or, of a pad, an array of them: written out, corner by corner, a jaw's program was twice as large, and
# took nearly twice as long to compile.
Touches = tuple[Touch, ...] | Touch


def places(
    finger: Finger, outline: Outline, at: Placement, path: Vec2, length: Scalar, seen: Seen | None = None
) -> Touches:
    """Every place where a finger and the slider may touch. path: the finger's, in the slider's frame, which tells what
    is touched where a corner lies on a corner. seen: what `facing` gives, if it is known."""
    if isinstance(finger, RoundFinger):
        return tuple(Touch(s.distance - finger.radius, s.point, -s.normal) for s in outline.touches(at.center))
    pad, angle = finger.shape.outline(), _angle(at)
    if isinstance(outline, DiskOutline):
        near = pad.closest((outline.center - at.center).unrotate(angle))
        normal = near.normal.rotate(angle)
        return (Touch(near.distance - outline.radius, outline.center - normal.scale(outline.radius), normal),)
    if not isinstance(outline, PolygonOutline):
        if seen is None:
            seen = facing(finger, outline, at)
        return _beside_smooth(pad, outline, at.center, angle, length, seen)
    mine, next_ = _beside(outline, corners(pad).turned(angle, at.center), path, length)
    away, own = Vec2(angle.x, -angle.y), corners(outline)
    near, _ = _beside(pad, own.turned(away, (-at.center).unrotate(angle)), (-path).unrotate(angle), length)
    theirs = Touch(near.distance, own.point, -near.normal.rotate(angle))
    # in an inner corner a pad's corner touches both edges
    each = (mine, theirs) if outline.convex else (mine, theirs, next_)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *each)


class Corner(NamedTuple):
    """A polygon's corners, as arrays, and the unit directions in which the two edges of each leave it."""

    point: Vec2
    onward: Vec2
    back: Vec2

    def turned(self, angle: Vec2, shift: Vec2) -> "Corner":
        return Corner(shift + self.point.rotate(angle), self.onward.rotate(angle), self.back.rotate(angle))


def _beside(outline: Outline, corner: Corner, path: Vec2, length: Scalar) -> tuple[Touch, Touch]:
    """Corners that move along `path`, each against the edge of a polygon that it lies beside and points to, and against
    the next nearest such edge; far off if there is none. Of two edges whose common corner it lies on, that comes first
    which it is pressed against.

    Not the closest point: a corner that is a little inside, next to the other's corner, may be closest to the wrong
    edge, and one that is past an edge's end touches nothing, though it is near.
    """
    found: tuple[tuple[Touch, Scalar, Scalar, Array], tuple[Touch, Scalar, Scalar, Array]] | None = None
    # an inner corner touches nothing that is straight
    outer = corner.onward.cross(corner.back) >= -rounding(jnp.ones_like(corner.point.x))
    sides = edges(outline)
    inside = settle(_inside(sides, corner.point), corner.point.x)
    for k, edge in enumerate(sides):
        rel = corner.point - edge.start
        along, height = rel.dot(edge.along), edge.normal.dot(rel)
        loose = LOOSE[edge.length.dtype.itemsize] * edge.length
        begin, end = -loose, edge.length + loose
        past = jnp.zeros(along.shape, bool)
        if _cornered(outline):
            # at an inner corner an edge goes on: what is past it there is inside, beyond this edge and the next
            before, after = sides[k - 1].along, sides[(k + 1) % len(sides)].along
            past = (along < begin) | (along > end)
            begin -= jnp.where(before.cross(edge.along) < 0, PAST * length, 0.0)
            end += jnp.where(edge.along.cross(after) < 0, PAST * length, 0.0)
        points = (corner.onward.dot(edge.normal) >= -BLUNT) & (corner.back.dot(edge.normal) >= -BLUNT) & outer
        # behind an edge, and not inside, it is on the far side of another; so it is deeper than the limit
        behind = (height >= -loose) | (inside & (height > -2 * DEEPEST_OVERLAP * length))
        beside = points & (along >= begin) & (along <= end) & behind
        touch = Touch(jnp.where(beside, height, FAR), corner.point - edge.normal.scale(height), -edge.normal)
        away = jnp.maximum(jnp.abs(touch.distance), loose)
        pressed = jnp.broadcast_to(-edge.normal.dot(path), away.shape)
        this = touch, away, pressed, past
        if found is None:
            far = touch._replace(distance=jnp.full_like(away, FAR))
            found = this, (far, jnp.full_like(away, FAR), pressed, past)
            continue
        first, second = found
        nearer = (away < first[1]) | ((away == loose) & (first[1] <= loose) & (pressed > first[2]))
        nearer, next_ = settle((nearer, away < second[1]), corner.point.x)
        found = select(nearer, this, first), select(nearer, first, select(next_, this, second))
    assert found is not None
    (nearest, *_, past), (next_, *_, beyond) = found
    # next to an outer corner, what is inside is pushed out by the nearest edge alone
    outside = next_.distance >= -LOOSE[length.dtype.itemsize] * length
    both = settle(outside | past | beyond, corner.point.x)
    return nearest, next_._replace(distance=jnp.where(both, next_.distance, FAR))


def _inside(sides: tuple[Edge, ...], point: Vec2) -> Bool[Array, " points"]:
    """Whether points lie inside a polygon: a ray along x crosses its outline an odd number of times."""
    inside = jnp.zeros(point.x.shape, bool)
    for k, edge in enumerate(sides):
        below, next_below = edge.start.y <= point.y, sides[(k + 1) % len(sides)].start.y <= point.y
        left = edge.normal.dot(point - edge.start) < 0
        inside ^= (below != next_below) & (left == below)
    return inside


def facing(finger: Finger, outline: Outline, at: Placement) -> Seen | None:
    """What of a smooth outline faces a pad's edges: needed by all that follows, and worked out once. Else None."""
    if isinstance(finger, RoundFinger) or isinstance(outline, PolygonOutline | DiskOutline):
        return None
    return _smooth_pads.seen_by(edges(finger.shape.outline()), outline, at.center, _angle(at))


def _beside_smooth(
    pad: PolygonOutline, outline: Outline, center: Vec2, angle: Vec2, length: Scalar, seen: Seen | None
) -> Touch:
    """A pad's corners, each against the place of a smooth outline nearest to it, and what faces the pad's edges."""
    assert seen is not None
    deep, corner = -2 * DEEPEST_OVERLAP * length, corners(pad).turned(angle, center)
    near = jax.vmap(outline.closest)(corner.point)
    points = (corner.onward.dot(near.normal) >= -BLUNT) & (corner.back.dot(near.normal) >= -BLUNT)
    points &= near.distance > deep
    loose = LOOSE[seen.length.dtype.itemsize] * seen.length
    beside = seen.real & (seen.along >= -loose) & (seen.along <= seen.length + loose) & (seen.height > deep)
    at_corners = Touch(jnp.where(points, near.distance, FAR), near.point, -near.normal)
    at_edges = Touch(jnp.where(beside, seen.height, FAR), seen.point, seen.normal)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), at_corners, at_edges)


def count(finger: Finger, outline: Outline) -> int:
    """How many contacts a finger may take part in: known before anything is.

    Of a pad two; three on a polygon that is not convex, since three places bind every motion in the plane.
    """
    zero = jnp.zeros(())
    still = Vec2(zero, zero)
    found = jax.eval_shape(lambda: places(finger, outline, Placement(still, still), still, zero))
    return (3 if _cornered(outline) else 2) if isinstance(found, Touch) else len(found)


def _cornered(outline: Outline) -> bool:
    return isinstance(outline, PolygonOutline) and not outline.convex


def choose(touches: Touches, length: Scalar, outline: Outline, path: Vec2) -> tuple[Int[Array, ""] | int, ...]:
    """Which places are contacts, the likeliest first: of an array the nearest and the nearest elsewhere, the first one
    again if there is none; else all. On a polygon that is not convex it counts how near they are after `path`, and
    there is a third."""
    if not isinstance(touches, Touch):
        return tuple(range(len(touches)))
    touches, path = jax.lax.stop_gradient((touches, path))
    if _cornered(outline):
        touches = touches._replace(distance=touches.distance - touches.normal.dot(path))
        return _apart(touches, length)
    distance = touches.distance
    first = jnp.argmin(distance)
    nearest = _at(touches, first)
    apart = touches.point - nearest.point
    same = SAME_PLACE if isinstance(outline, PolygonOutline) else SAME_BUMP
    elsewhere = apart.dot(apart) > (same * length) ** 2
    elsewhere = settle(elsewhere & (distance < nearest.distance + 1e3 * length), length)
    second = jnp.where(jnp.any(elsewhere), jnp.argmin(jnp.where(elsewhere, distance, jnp.inf)), first)
    return first.astype(jnp.int32), second.astype(jnp.int32)


def _apart(touches: Touch, length: Scalar) -> tuple[Int[Array, ""], ...]:
    """The nearest place and the two that bind most of what it leaves free: a pad that lies flat across two arms rests
    on its outermost places, and in an inner corner on both edges, not on places side by side."""
    chosen = [jnp.argmin(touches.distance).astype(jnp.int32)]
    nearest = _at(touches, chosen[0])
    elsewhere, reach = touches.distance < nearest.distance + 1e3 * length, jnp.zeros_like(touches.distance)
    last = nearest
    for _ in range(2):
        free, far = _beyond(touches, last, length)
        elsewhere, reach = settle((elsewhere & free, jnp.maximum(reach, far)), length)
        best = jnp.argmin(jnp.where(elsewhere, reach, jnp.inf))
        chosen.append(jnp.where(jnp.any(elsewhere), best, chosen[0]).astype(jnp.int32))
        last = _at(touches, chosen[-1])
    return tuple(chosen)


def _beyond(touches: Touch, last: Touch, length: Scalar) -> tuple[Bool[Array, " places"], Scalar]:
    """Which places bind another motion than the last one does, and how far a slider that stays on that one has to move,
    m, until it is on them."""
    lever = (touches.point - last.point).cross(touches.normal) / length
    shared = touches.normal.dot(last.normal)
    free = jnp.sqrt(jnp.maximum(1 - jnp.maximum(shared, 0) ** 2, 0) + lever**2)
    gap = jnp.maximum(touches.distance - shared * last.distance, 0) + SAME_PLACE * length
    return free > SAME_PLACE, gap / jnp.maximum(free, SAME_PLACE)


def taken(touches: Touches, chosen: tuple[Any, ...]) -> tuple[Touch, ...]:
    """The chosen places; one that is chosen again is out of reach."""
    if not isinstance(touches, Touch):
        return touches
    first, *others = (_at(touches, index) for index in chosen)
    again = [index == chosen[0] for index in chosen[1:]]
    far = [jnp.where(same, 1.0, 0.0).astype(first.distance.dtype) for same in again]
    return first, *(one._replace(distance=one.distance + off) for one, off in zip(others, far, strict=True))


def still(
    touches: Touches, chosen: tuple[Any, ...], begun: tuple[Touch, ...], finger: Finger, outline: Outline
) -> tuple[Any, ...]:
    """The same places a little later, when `places` may have another order: which edge a corner is nearest to changes
    in an inner corner. begun: as they were."""
    if not isinstance(finger, Pad) or not isinstance(touches, Touch) or not _cornered(outline):
        return chosen
    tips = len(edges(finger.shape.outline()))
    other = touches.distance.size - tips  # from a corner against its nearest edge to it against the next
    found = []
    for index, before in zip(chosen, begun, strict=True):
        twin = jnp.where(index < tips, index + other, jnp.where(index >= other, index - other, index))
        now, then = (_at(touches, k).normal.dot(before.normal) for k in (index, twin))
        found.append(jnp.where(settle(then > now + SAME_PLACE, now), twin, index))
    return tuple(found)


def _at(touches: Touch, index: Int[Array, ""]) -> Touch:
    """touches[index], by selection, which a batch does in its stride."""
    mark = jnp.arange(touches.distance.size) == index
    return jax.tree.map(lambda entries: jnp.sum(jnp.where(mark, entries, 0.0)), touches)


def meet(finger: Finger, outline: Outline, at: Placement, path: Vec2, length: Scalar) -> Scalar:
    """The fraction of `path` after which a finger that moves along it, in the frame of a slider at rest and without
    turning, first touches; one if it never does."""
    seen = facing(finger, outline, at)
    pressing, touches = jnp.zeros((), bool), places(finger, outline, at, path, length, seen)
    for touch in (touches,) if isinstance(touches, Touch) else touches:
        # In contact and pressing on: from the start
        pressing |= jnp.any((touch.distance <= 0) & (touch.normal.dot(path) > touch.distance))
    # Else, also when touching but leaving, whatever is hit first
    hit = _sweep(finger, outline, at, path, seen)
    pressing, hits = settle((pressing, hit <= 1), at.center.x)
    return jnp.where(pressing, 0.0, jnp.where(hits, hit, 1.0))


def overlap(finger: Finger, outline: Outline, at: Placement) -> Scalar:
    """How deep a finger is inside the slider, m; negative where they are apart, and then their distance.

    Of a pad: the deepest corner of either in the other, or, where edges cross and no corner is inside, at least half of
    how deep an edge of the slider is in the pad. Of a pad and a smooth outline: the deepest corner, or place of the
    outline that faces an edge.
    """
    if isinstance(finger, RoundFinger):
        return finger.radius - outline.closest(at.center).distance
    pad, angle = finger.shape.outline(), _angle(at)
    if isinstance(outline, DiskOutline):
        return outline.radius - pad.closest((outline.center - at.center).unrotate(angle)).distance
    tips = at.center + corners(pad).point.rotate(angle)
    if not isinstance(outline, PolygonOutline):
        seen = facing(finger, outline, at)
        assert seen is not None
        return _smooth_pads.overlap(pad, seen, outline, tips)
    own = (corners(outline).point - at.center).unrotate(angle)
    theirs = pad.closest(own).distance
    mine = outline.closest(tips).distance
    return jnp.maximum(jnp.maximum(jnp.max(-mine), jnp.max(-theirs)), _across(pad, own))


def _across(pad: PolygonOutline, corner: Vec2) -> Scalar:
    """How deep in the pad the middle is of what it cuts off an edge between two of these corners; negative where it
    cuts off nothing. The middle of a chord is at least half as deep as its deepest point: depth is concave."""
    begins = [-side.normal.dot(corner - side.start) for side in edges(pad)]
    depths = settle([(first, jnp.roll(first, -1)) for first in begins], corner.x[0])
    enter, leave = jnp.zeros_like(corner.x), jnp.ones_like(corner.x)
    for first, last in depths:
        crossing = first / jnp.where(first != last, first - last, 1.0)
        enter = jnp.where((first < 0) & (last > first), jnp.maximum(enter, crossing), enter)
        leave = jnp.where((last < 0) & (first > last), jnp.minimum(leave, crossing), leave)
    enter, leave = settle((enter, leave), corner.x[0])
    middle = (enter + leave) / 2
    depth = functools.reduce(jnp.minimum, [first + middle * (last - first) for first, last in depths])
    return jnp.max(jnp.where(enter < leave, depth, -jnp.inf))


def _sweep(finger: Finger, outline: Outline, at: Placement, path: Vec2, seen: Seen | None) -> Scalar:
    if isinstance(finger, RoundFinger):
        return outline.sweep(at.center, path, finger.radius)
    pad, angle, zero = finger.shape.outline(), _angle(at), jnp.zeros_like(path.x)
    back = (-path).unrotate(angle)
    if isinstance(outline, DiskOutline):
        return pad.sweep((outline.center - at.center).unrotate(angle), back, outline.radius)
    tips = at.center + corners(pad).point.rotate(angle)
    if not isinstance(outline, PolygonOutline):
        assert seen is not None
        return _smooth_pads.sweep(pad, seen, outline, tips, path, back)
    mine = outline.sweep(tips, path, zero)
    theirs = pad.sweep((corners(outline).point - at.center).unrotate(angle), back, zero)
    return jnp.minimum(jnp.min(mine), jnp.min(theirs))


def edges(outline: Outline) -> tuple[Edge, ...]:
    """Of a polygon with few of them, as pads and what they touch must be."""
    if not isinstance(outline, PolygonOutline):
        raise TypeError(f"not a polygon's outline: {type(outline).__name__}")
    if isinstance(outline.edges, Edge):
        many = outline.edges.start_x.shape[0]
        raise ValueError(f"hand: pads can touch a Polygon of up to twelve vertices; got {many}")
    return outline.edges


def corners(outline: Outline) -> Corner:
    sides = edges(outline)
    each = [Corner(edge.start, edge.along, -sides[k - 1].along) for k, edge in enumerate(sides)]
    return jax.tree.map(lambda *entries: jnp.stack(entries), *each)


def _angle(at: Placement) -> Vec2:
    if at.angle is None:
        raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centres")
    return at.angle
