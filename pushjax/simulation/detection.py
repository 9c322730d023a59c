"""Contact detection: contact points, normals and gaps between fingers and slider during a step.

The fraction of a step in which the hand moves freely is computed exactly, for straight relative paths of any length. So
a finger can neither tunnel through the slider nor meet the extension of an edge past its corner. From there on, every
place where a finger and the slider may touch is a contact with its own gap, closed or open. The contact problem finds
which of them are made within the step.

A round finger has one such place, or two on an outline that is not convex. A pad has one on a disk, and two against a
convex polygon: each corner of the pad and of the slider is compared with the outline of the other, and the two nearest
in different places are taken. (An edge that lies flat on an edge rests on the two ends of their common part.) Against a
smooth outline a pad also has two, selected from the places that `pad_on_curve` finds. Against a polygon that is not
convex it has three: the nearest place, and the two that constrain most of the motions that the nearest leaves free. All
are selected anew in each step and stay the same within the step.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.disk import DiskOutline
from pushjax.geometry.polygon_outline import Edge, PolygonOutline
from pushjax.geometry.shape import Outline, roundoff
from pushjax.simulation import pad_on_curve
from pushjax.simulation.hand import Finger, RoundFinger
from pushjax.simulation.pad_on_curve import EdgeSupport

# Largest overlap of finger and slider, in units of the limit surface's length, that is pushed out. Up to this it is a
# tracking error, not a finger on the wrong side.
MAX_PENETRATION = 0.2
# A corner can touch an edge only if neither of the two edges at the corner points toward it. A tilt up to this sine is
# allowed, so that where two edges are almost parallel both ends are contacts, and neither end sinks in as the edge
# comes down.
BLUNT = 0.3
# Keyed by the bytes of a float; in units of an edge's length. A corner that is past the end of an edge by up to this
# still projects onto the edge. Otherwise two corners that lie on each other to roundoff (the corner of a pad whose side
# rests on an arm, and the corner at the arm's end) would each be past the end of the other's edge, and would touch
# nowhere.
LOOSE = {4: 2e-5, 8: 1e-6}
# In units of the length. An edge is extended by this past an inner (reflex) corner, into the slider, so that what sinks
# into one edge of that corner still projects onto the other.
PAST = 0.05
OUT_OF_REACH = 1e3  # m, out of reach


class FingerPose(NamedTuple):
    """Pose of a finger in the slider's frame.

    Attributes:
        center: Center of the finger, m.
        angle: Angle as the unit vector (cos, sin); None for a finger that never turns.
    """

    center: Vec2
    angle: Vec2 | None


class Candidate(NamedTuple):
    """A place where a finger and the slider may touch, in the slider's frame, or an array of such places.

    Attributes:
        distance: Signed distance, m; negative in penetration.
        point: Point on the slider, m.
        normal: Unit normal that points into the slider.
    """

    distance: Scalar
    point: Vec2
    normal: Vec2


# A tuple of places, or, for a pad, one array of them. With the corners of a pad unrolled, the program for a jaw was
# twice as large and took nearly twice as long to compile.
Candidates = tuple[Candidate, ...] | Candidate


def contact_candidates(
    finger: Finger, outline: Outline, at: FingerPose, path: Vec2, length: Scalar, seen: EdgeSupport | None = None
) -> Candidates:
    """Return every place where a finger and the slider may touch.

    Args:
        finger: The finger.
        outline: The slider's outline.
        at: Pose of the finger in the slider's frame.
        path: Displacement of the finger in the slider's frame, m. It decides which edge is touched where a corner lies
            on a corner.
        length: Characteristic length of the limit surface, m.
        seen: Result of `edge_supports`, if it is known already.
    """
    if isinstance(finger, RoundFinger):
        return tuple(
            Candidate(s.distance - finger.radius, s.point, -s.normal) for s in outline.contact_candidates(at.center)
        )
    pad, angle = finger.shape.outline(), _angle(at)
    if isinstance(outline, DiskOutline):
        near = pad.closest((outline.center - at.center).unrotate(angle))
        normal = near.normal.rotate(angle)
        return (Candidate(near.distance - outline.radius, outline.center - normal.scale(outline.radius), normal),)
    if not isinstance(outline, PolygonOutline):
        if seen is None:
            seen = edge_supports(finger, outline, at)
        return _smooth_candidates(pad, outline, at.center, angle, length, seen)
    mine, next_ = _vertex_edge_candidates(outline, corners(pad).turned(angle, at.center), path, length)
    away, own = Vec2(angle.x, -angle.y), corners(outline)
    near, _ = _vertex_edge_candidates(
        pad, own.turned(away, (-at.center).unrotate(angle)), (-path).unrotate(angle), length
    )
    theirs = Candidate(near.distance, own.point, -near.normal.rotate(angle))
    # in an inner corner of the slider, a corner of the pad touches both edges
    each = (mine, theirs) if outline.convex else (mine, theirs, next_)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *each)


class Corner(NamedTuple):
    """Corners of a polygon, as arrays.

    Attributes:
        point: The corners, m.
        onward: Unit direction in which the next edge leaves each corner.
        back: Unit direction in which the previous edge leaves each corner.
    """

    point: Vec2
    onward: Vec2
    back: Vec2

    def turned(self, angle: Vec2, shift: Vec2) -> "Corner":
        """The corners rotated by `angle`, a unit vector, and then translated by `shift`."""
        return Corner(shift + self.point.rotate(angle), self.onward.rotate(angle), self.back.rotate(angle))


def _vertex_edge_candidates(
    outline: Outline, corner: Corner, path: Vec2, length: Scalar
) -> tuple[Candidate, Candidate]:
    """For each corner, return the nearest edge of a polygon that it can touch, and the next nearest.

    A corner can touch an edge if it projects onto the edge and points toward it. If there is no such edge, the distance
    is `OUT_OF_REACH`. If a corner lies on the common vertex of two edges, the edge that it is pressed against along
    `path` comes first.

    The closest point of the outline would be wrong here. A corner that is slightly inside, next to a vertex of the
    polygon, may be closest to the wrong edge. A corner that is past the end of an edge touches nothing, although it is
    near.
    """
    found: tuple[tuple[Candidate, Scalar, Scalar, Array], tuple[Candidate, Scalar, Scalar, Array]] | None = None
    # an inner (reflex) corner cannot touch a straight edge
    outer = corner.onward.cross(corner.back) >= -roundoff(jnp.ones_like(corner.point.x))
    sides = edges(outline)
    inside = compute_once(_inside(sides, corner.point), corner.point.x)
    for k, edge in enumerate(sides):
        rel = corner.point - edge.start
        along, height = rel.dot(edge.along), edge.normal.dot(rel)
        loose = LOOSE[edge.length.dtype.itemsize] * edge.length
        begin, end = -loose, edge.length + loose
        past = jnp.zeros(along.shape, bool)
        if is_nonconvex_polygon(outline):
            # An edge is extended past an inner corner: a point that is past the edge's end there is inside the slider,
            # behind this edge and the next.
            before, after = sides[k - 1].along, sides[(k + 1) % len(sides)].along
            past = (along < begin) | (along > end)
            begin -= jnp.where(before.cross(edge.along) < 0, PAST * length, 0.0)
            end += jnp.where(edge.along.cross(after) < 0, PAST * length, 0.0)
        points = (corner.onward.dot(edge.normal) >= -BLUNT) & (corner.back.dot(edge.normal) >= -BLUNT) & outer
        # A point that is behind an edge but not inside the polygon is on the far side of another edge. A point that is
        # deeper than twice the limit counts as on the far side, too.
        behind = (height >= -loose) | (inside & (height > -2 * MAX_PENETRATION * length))
        beside = points & (along >= begin) & (along <= end) & behind
        touch = Candidate(
            jnp.where(beside, height, OUT_OF_REACH), corner.point - edge.normal.scale(height), -edge.normal
        )
        away = jnp.maximum(jnp.abs(touch.distance), loose)
        pressed = jnp.broadcast_to(-edge.normal.dot(path), away.shape)
        this = touch, away, pressed, past
        if found is None:
            far = touch._replace(distance=jnp.full_like(away, OUT_OF_REACH))
            found = this, (far, jnp.full_like(away, OUT_OF_REACH), pressed, past)
            continue
        first, second = found
        nearer = (away < first[1]) | ((away == loose) & (first[1] <= loose) & (pressed > first[2]))
        nearer, next_ = compute_once((nearer, away < second[1]), corner.point.x)
        found = tree_where(nearer, this, first), tree_where(nearer, first, tree_where(next_, this, second))
    assert found is not None
    (nearest, *_, past), (next_, *_, beyond) = found
    # next to a convex corner, a point inside is pushed out by the nearest edge alone
    outside = next_.distance >= -LOOSE[length.dtype.itemsize] * length
    both = decide(outside | past | beyond, corner.point.x)
    return nearest, next_._replace(distance=jnp.where(both, next_.distance, OUT_OF_REACH))


def _inside(sides: tuple[Edge, ...], point: Vec2) -> Bool[Array, " points"]:
    """Whether points lie inside a polygon: a ray along x crosses its outline an odd number of times."""
    inside = jnp.zeros(point.x.shape, bool)
    for k, edge in enumerate(sides):
        below, next_below = edge.start.y <= point.y, sides[(k + 1) % len(sides)].start.y <= point.y
        left = edge.normal.dot(point - edge.start) < 0
        inside ^= (below != next_below) & (left == below)
    return inside


def edge_supports(finger: Finger, outline: Outline, at: FingerPose) -> EdgeSupport | None:
    """Return the places of a smooth outline that face a pad's edges; None for round fingers, polygons and disks.

    Several functions need the result, so it can be computed once and passed to them.
    """
    if isinstance(finger, RoundFinger) or isinstance(outline, PolygonOutline | DiskOutline):
        return None
    return pad_on_curve.edge_support_points(edges(finger.shape.outline()), outline, at.center, _angle(at))


def _smooth_candidates(
    pad: PolygonOutline, outline: Outline, center: Vec2, angle: Vec2, length: Scalar, seen: EdgeSupport | None
) -> Candidate:
    """For each corner of a pad, the closest point of a smooth outline; then the places that face the pad's edges."""
    assert seen is not None
    deep, corner = -2 * MAX_PENETRATION * length, corners(pad).turned(angle, center)
    near = jax.vmap(outline.closest)(corner.point)
    points = (corner.onward.dot(near.normal) >= -BLUNT) & (corner.back.dot(near.normal) >= -BLUNT)
    points &= near.distance > deep
    loose = LOOSE[seen.length.dtype.itemsize] * seen.length
    beside = seen.valid & (seen.along >= -loose) & (seen.along <= seen.length + loose) & (seen.height > deep)
    at_corners = Candidate(jnp.where(points, near.distance, OUT_OF_REACH), near.point, -near.normal)
    at_edges = Candidate(jnp.where(beside, seen.height, OUT_OF_REACH), seen.point, seen.normal)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), at_corners, at_edges)


def num_contacts(finger: Finger, outline: Outline) -> int:
    """Number of contacts that a finger may have; it is known before any value is.

    A pad has two (one on a disk). On a polygon that is not convex it has three, since three contacts constrain every
    motion in the plane.
    """
    zero = jnp.zeros(())
    still = Vec2(zero, zero)
    found = jax.eval_shape(lambda: contact_candidates(finger, outline, FingerPose(still, still), still, zero))
    return (3 if is_nonconvex_polygon(outline) else 2) if isinstance(found, Candidate) else len(found)


def is_nonconvex_polygon(outline: Outline) -> bool:
    """Whether an outline is a polygon that is not convex."""
    return isinstance(outline, PolygonOutline) and not outline.convex


def time_of_impact(finger: Finger, outline: Outline, at: FingerPose, path: Vec2, length: Scalar) -> Scalar:
    """Return the fraction of `path` after which a finger first touches the slider, or one if it never does.

    The finger moves along `path` without turning, in the frame of a slider at rest.
    """
    seen = edge_supports(finger, outline, at)
    pressing, touches = jnp.zeros((), bool), contact_candidates(finger, outline, at, path, length, seen)
    for touch in (touches,) if isinstance(touches, Candidate) else touches:
        # in contact and pressing: the push begins at once
        pressing |= jnp.any((touch.distance <= 0) & (touch.normal.dot(path) > touch.distance))
    # Otherwise the first hit along the path counts, also for a finger that touches but moves away.
    hit = _sweep(finger, outline, at, path, seen)
    pressing, hits = compute_once((pressing, hit <= 1), at.center.x)
    return jnp.where(pressing, 0.0, jnp.where(hits, hit, 1.0))


def penetration_depth(finger: Finger, outline: Outline, at: FingerPose) -> Scalar:
    """Penetration depth of a finger in the slider, m; where they are apart, minus their distance.

    For a pad it is the depth of the deepest corner of either body in the other. Where edges cross and no corner is
    inside, it is at least half of how deep an edge of the slider is in the pad. For a pad and a smooth outline it is
    the depth of the deepest corner, or of the deepest place of the outline that faces an edge.
    """
    if isinstance(finger, RoundFinger):
        return finger.radius - outline.closest(at.center).distance
    pad, angle = finger.shape.outline(), _angle(at)
    if isinstance(outline, DiskOutline):
        return outline.radius - pad.closest((outline.center - at.center).unrotate(angle)).distance
    tips = at.center + corners(pad).point.rotate(angle)
    if not isinstance(outline, PolygonOutline):
        seen = edge_supports(finger, outline, at)
        assert seen is not None
        return pad_on_curve.overlap(pad, seen, outline, tips)
    own = (corners(outline).point - at.center).unrotate(angle)
    theirs = pad.closest(own).distance
    mine = outline.closest(tips).distance
    return jnp.maximum(jnp.maximum(jnp.max(-mine), jnp.max(-theirs)), _across(pad, own))


def _across(pad: PolygonOutline, corner: Vec2) -> Scalar:
    """Depth in the pad of the midpoint of the chord that the pad cuts from an edge; negative if it cuts none.

    The edges join consecutive corners of the slider, here in the pad's frame, and the deepest midpoint counts. Depth is
    concave along a chord, so the midpoint is at least half as deep as the deepest point of the chord.
    """
    begins = [-side.normal.dot(corner - side.start) for side in edges(pad)]
    depths = compute_once([(first, jnp.roll(first, -1)) for first in begins], corner.x[0])
    enter, leave = jnp.zeros_like(corner.x), jnp.ones_like(corner.x)
    for first, last in depths:
        crossing = first / jnp.where(first != last, first - last, 1.0)
        enter = jnp.where((first < 0) & (last > first), jnp.maximum(enter, crossing), enter)
        leave = jnp.where((last < 0) & (first > last), jnp.minimum(leave, crossing), leave)
    enter, leave = compute_once((enter, leave), corner.x[0])
    middle = (enter + leave) / 2
    depth = functools.reduce(jnp.minimum, [first + middle * (last - first) for first, last in depths])
    return jnp.max(jnp.where(enter < leave, depth, -jnp.inf))


def _sweep(finger: Finger, outline: Outline, at: FingerPose, path: Vec2, seen: EdgeSupport | None) -> Scalar:
    """Fraction of `path` at which the finger first hits the outline; inf if it does not."""
    if isinstance(finger, RoundFinger):
        return outline.sweep(at.center, path, finger.radius)
    pad, angle, zero = finger.shape.outline(), _angle(at), jnp.zeros_like(path.x)
    back = (-path).unrotate(angle)
    if isinstance(outline, DiskOutline):
        return pad.sweep((outline.center - at.center).unrotate(angle), back, outline.radius)
    tips = at.center + corners(pad).point.rotate(angle)
    if not isinstance(outline, PolygonOutline):
        assert seen is not None
        return pad_on_curve.sweep(pad, seen, outline, tips, path, back)
    mine = outline.sweep(tips, path, zero)
    theirs = pad.sweep((corners(outline).point - at.center).unrotate(angle), back, zero)
    return jnp.minimum(jnp.min(mine), jnp.min(theirs))


def edges(outline: Outline) -> tuple[Edge, ...]:
    """The edges of a polygon with few of them, which pads and the polygons that they touch must be."""
    if not isinstance(outline, PolygonOutline):
        raise TypeError(f"not a polygon's outline: {type(outline).__name__}")
    if isinstance(outline.edges, Edge):
        many = outline.edges.start_x.shape[0]
        raise ValueError(f"hand: pads can touch a Polygon of up to twelve vertices; got {many}")
    return outline.edges


def corners(outline: Outline) -> Corner:
    """The corners of a polygon with few edges, as arrays."""
    sides = edges(outline)
    each = [Corner(edge.start, edge.along, -sides[k - 1].along) for k, edge in enumerate(sides)]
    return jax.tree.map(lambda *entries: jnp.stack(entries), *each)


def _angle(at: FingerPose) -> Vec2:
    """The angle of a pad; raises ValueError if the kinematics give none."""
    if at.angle is None:
        raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centers")
    return at.angle
