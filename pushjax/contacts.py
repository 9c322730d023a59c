"""Contact detection: where fingers meet the slider during a step, and with what normals and gaps.

How long the hand moves freely is exact for straight relative paths of any length, so a finger can neither tunnel
through the slider nor meet the extension of an edge past its corner. From there every place where a finger and the
slider may touch is a contact with its own gap, closed or not: contacts that are made within the step are the contact
problem's to find.

A round finger has one such place, or two on an outline that is not convex. A pad against a polygon has two: of all
corners of either, seen from the other's outline, the two nearest in different places (an edge flat on an edge rests
on the two ends of what they share). So it has against a smooth outline, of the places that `_smooth_pads` finds. All
are chosen anew in each step, and stay the same within it.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from pushjax import _smooth_pads
from pushjax._smooth_pads import Seen
from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.hands import Finger, RoundFinger
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
FAR = 1e3  # m, out of any reach
# Two places nearer to each other than this, in the same unit, are one: of a polygon, and of a smooth outline, where a
# pad's corner and its edge both find the same bump.
SAME_PLACE, SAME_BUMP = 1e-3, 0.1
SAME_WAY = 0.9  # cosine between normals, above which two places in one are one


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
    found: tuple[tuple[Touch, Scalar, Scalar], tuple[Touch, Scalar, Scalar]] | None = None
    # an inner corner touches nothing that is straight
    outer = corner.onward.cross(corner.back) >= -rounding(jnp.ones_like(corner.point.x))
    for edge in edges(outline):
        rel = corner.point - edge.start
        along, height = rel.dot(edge.along), edge.normal.dot(rel)
        loose = LOOSE[edge.length.dtype.itemsize] * edge.length
        points = (corner.onward.dot(edge.normal) >= -BLUNT) & (corner.back.dot(edge.normal) >= -BLUNT) & outer
        # deeper than this it is on the far side of another edge
        beside = points & (along >= -loose) & (along <= edge.length + loose) & (height > -2 * DEEPEST_OVERLAP * length)
        touch = Touch(jnp.where(beside, height, FAR), corner.point - edge.normal.scale(height), -edge.normal)
        away = jnp.maximum(jnp.abs(touch.distance), loose)
        pressed = jnp.broadcast_to(-edge.normal.dot(path), away.shape)
        this = touch, away, pressed
        if found is None:
            far = touch._replace(distance=jnp.full_like(away, FAR))
            found = this, (far, jnp.full_like(away, FAR), pressed)
            continue
        first, second = found
        nearer = (away < first[1]) | ((away == loose) & (first[1] <= loose) & (pressed > first[2]))
        nearer, next_ = settle((nearer, away < second[1]), corner.point.x)
        found = select(nearer, this, first), select(nearer, first, select(next_, this, second))
    assert found is not None
    return found[0][0], found[1][0]


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
    """How many contacts a finger takes part in: known before anything is."""
    zero = jnp.zeros(())
    still = Vec2(zero, zero)
    found = jax.eval_shape(lambda: places(finger, outline, Placement(still, still), still, zero))
    return 2 if isinstance(found, Touch) else len(found)


def choose(touches: Touches, length: Scalar, outline: Outline) -> tuple[Int[Array, ""] | int, ...]:
    """Which places are contacts: of an array the nearest and the nearest elsewhere, the same one twice if there is
    none; else all."""
    if not isinstance(touches, Touch):
        return tuple(range(len(touches)))
    distance = jax.lax.stop_gradient(touches.distance)
    first = jnp.argmin(distance)
    nearest = _at(touches, first)
    apart = touches.point - nearest.point
    same = SAME_PLACE if isinstance(outline, PolygonOutline) else SAME_BUMP
    elsewhere = apart.dot(apart) > (same * length) ** 2
    if isinstance(outline, PolygonOutline) and not outline.convex:
        elsewhere |= touches.normal.dot(nearest.normal) < SAME_WAY
    elsewhere = settle(elsewhere & (distance < nearest.distance + 1e3 * length), length)
    second = jnp.where(jnp.any(elsewhere), jnp.argmin(jnp.where(elsewhere, distance, jnp.inf)), first)
    return first.astype(jnp.int32), second.astype(jnp.int32)


def taken(touches: Touches, chosen: tuple[Any, ...]) -> tuple[Touch, ...]:
    """The chosen places; the second, where there is none but the first, is out of reach."""
    if not isinstance(touches, Touch):
        return touches
    first, second = (_at(touches, index) for index in chosen)
    alone = chosen[0] == chosen[1]
    return first, second._replace(distance=second.distance + jnp.where(alone, 1.0, 0.0))


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
    after = jax.tree.map(lambda entry: jnp.roll(entry, -1), corner)
    enter, leave = jnp.zeros_like(corner.x), jnp.ones_like(corner.x)
    depths = []
    for side in edges(pad):
        first, last = (-side.normal.dot(end - side.start) for end in (corner, after))
        depths.append((first, last))
        crossing = first / jnp.where(first != last, first - last, 1.0)
        enter = jnp.where((first < 0) & (last > first), jnp.maximum(enter, crossing), enter)
        leave = jnp.where((last < 0) & (first > last), jnp.minimum(leave, crossing), leave)
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
