"""Contact detection: contact points, normals and gaps between fingers and slider during a step.

The module `impact` does not overestimate the fraction of a step in which the hand moves freely, however long the step.
So a finger can neither tunnel through the slider nor meet the extension of an edge past its corner. From there on,
every place where a finger and the slider may touch is a contact candidate with its own gap, closed or open. The contact
problem finds which of them are closed within the step.

A round finger has one candidate, or two on an outline that is not convex. A pad has one on a disk. Otherwise it has
many, of which `contact_selection` selects two or three. Against a polygon, each corner of the pad and of the slider is
compared with the outline of the other; against a smooth outline, `pad_on_curve` finds the candidates. The selection is
new in each step and stays the same within the step.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._internal.xla import entry_at, largest, smallest, structure_and_shapes
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.disk import DiskOutline
from pushjax.geometry.ellipse import EllipseOutline
from pushjax.geometry.polygon_outline import Edge, PolygonOutline
from pushjax.geometry.shape import Outline, roundoff
from pushjax.simulation import pad_on_curve
from pushjax.simulation.candidate import OUT_OF_REACH, Candidate, Candidates, FingerPose
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Finger, RoundFinger
from pushjax.simulation.pad_on_curve import EdgeSupport
from pushjax.simulation.wall_contact import num_wall_contacts, wall_candidates

# Largest overlap of finger and slider, in units of the limit surface's length, that is pushed out. Up to this it is a
# tracking error, not a finger on the wrong side.
MAX_PENETRATION = 0.2
# A corner can touch an edge only if neither of the two edges at the corner points toward it. A tilt up to this sine is
# allowed, so that where two edges are almost parallel both ends are contacts, and neither end sinks in as the edge
# comes down.
TILT_TOLERANCE = 0.3
# Keyed by the bytes of a float; in units of an edge's length. A corner that is past the end of an edge by up to this
# still projects onto the edge. Otherwise two corners that lie on each other to roundoff (the corner of a pad whose side
# rests on an arm, and the corner at the arm's end) would each be past the end of the other's edge, and would touch
# nowhere.
END_TOLERANCE = {4: 2e-5, 8: 1e-6}
# In units of the length. An edge is extended by this past an inner (reflex) corner, into the slider, so that what sinks
# into one edge of that corner still projects onto the other.
REFLEX_EXTENSION = 0.05

# Called with points of the slider; all in the slider's frame, m.
DisplacementAt = Callable[[Vec2], Vec2]


def contact_candidates(
    finger: Finger | Wall,
    outline: Outline,
    finger_pose: FingerPose,
    displacement_at: DisplacementAt,
    length: Scalar,
) -> Candidates:
    """Return every place where a finger or a wall and the slider may touch, in the slider's frame."""
    if isinstance(finger, Wall):
        return wall_candidates(outline, finger_pose)
    if isinstance(finger, RoundFinger):
        return tuple(
            Candidate(s.distance - finger.radius, s.point, -s.normal)
            for s in outline.contact_candidates(finger_pose.center)
        )
    pad, angle = finger.shape.outline(), _pad_angle(finger_pose)
    if isinstance(outline, DiskOutline):
        closest = pad.closest((outline.center - finger_pose.center).unrotate(angle))
        normal = closest.normal.rotate(angle)
        return (Candidate(closest.distance - outline.radius, outline.center - normal.scale(outline.radius), normal),)
    if not isinstance(outline, PolygonOutline):
        return _smooth_candidates(
            pad, outline, finger_pose.center, angle, length, _edge_supports(pad, outline, finger_pose)
        )
    pad_corners = Corner.of(pad).turned(angle, finger_pose.center)
    pad_on_slider, pad_on_next_edge = _vertex_edge_candidates(
        outline, pad_corners, displacement_at(pad_corners.point), length
    )
    inverse_angle, slider_corners = Vec2(angle.x, -angle.y), Corner.of(outline)
    closest, _ = _vertex_edge_candidates(
        pad,
        slider_corners.turned(inverse_angle, (-finger_pose.center).unrotate(angle)),
        (-displacement_at(slider_corners.point)).unrotate(angle),
        length,
    )
    slider_on_pad = Candidate(closest.distance, slider_corners.point, -closest.normal.rotate(angle))
    # in an inner corner of the slider, a corner of the pad touches both edges
    groups = (pad_on_slider, slider_on_pad) if outline.convex else (pad_on_slider, slider_on_pad, pad_on_next_edge)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *groups)


class Corner(NamedTuple):
    """Corners of a polygon, as arrays."""

    point: Vec2  # m
    onward: Vec2  # unit direction in which the next edge leaves the corner
    back: Vec2  # unit direction in which the previous edge leaves the corner

    @staticmethod
    def of(polygon: PolygonOutline) -> "Corner":
        """Return the corners of a polygon."""
        return Corner(polygon.edges.start, polygon.edges.along, -polygon.edges.previous)

    def turned(self, angle: Vec2, shift: Vec2) -> "Corner":
        """Return the corners rotated by `angle`, a unit vector, and then translated by `shift`, m."""
        return Corner(shift + self.point.rotate(angle), self.onward.rotate(angle), self.back.rotate(angle))


def _vertex_edge_candidates(
    outline: PolygonOutline, corner: Corner, displacement: Vec2, length: Scalar
) -> tuple[Candidate, Candidate]:
    """Return the nearest edge of a polygon that each corner can touch, and the next nearest."""
    # A corner can touch an edge if it projects onto the edge and points toward it. The closest point of the outline
    # would be wrong here. A corner slightly inside, next to a vertex of the polygon, may be closest to the wrong edge.
    # A corner past the end of an edge touches nothing, although it is near.
    edge = outline.edges
    own_displacement = jax.tree.map(lambda entry: jnp.broadcast_to(entry, corner.point.x.shape), displacement)

    def two_nearest(corner: Corner, displacement: Vec2) -> tuple[Candidate, Candidate]:
        # a reflex corner cannot touch a straight edge
        is_convex_corner = corner.onward.cross(corner.back) >= -roundoff(jnp.ones_like(corner.point.x))
        relative = corner.point - edge.start
        along, height = relative.dot(edge.along), edge.normal.dot(relative)
        tolerance = END_TOLERANCE[edge.length.dtype.itemsize] * edge.length
        begin, end, past = -tolerance, edge.length + tolerance, jnp.zeros(along.shape, bool)
        if not outline.convex:
            # An edge is extended past an inner corner: a point that is past the edge's end there is inside the slider,
            # behind this edge and the next.
            past = (along < begin) | (along > end)
            begin -= jnp.where(edge.turn_a < 0, REFLEX_EXTENSION * length, 0.0)
            end += jnp.where(edge.turn_b < 0, REFLEX_EXTENSION * length, 0.0)
        faces = (
            (corner.onward.dot(edge.normal) >= -TILT_TOLERANCE)
            & (corner.back.dot(edge.normal) >= -TILT_TOLERANCE)
            & is_convex_corner
        )
        # A point that is behind an edge but not inside the polygon is on the far side of another edge. A point that is
        # deeper than twice the limit counts as on the far side, too.
        behind = (height >= -tolerance) | (_is_inside(edge, corner.point) & (height > -2 * MAX_PENETRATION * length))
        touches = faces & (along >= begin) & (along <= end) & behind
        gap = jnp.maximum(jnp.where(touches, jnp.abs(height), OUT_OF_REACH), tolerance)
        lies_on = touches & (gap <= tolerance)
        # a corner on the common vertex of two edges touches the one that its displacement presses it against
        most_pressed = jnp.argmax(jnp.where(lies_on, -edge.normal.dot(displacement), -jnp.inf))
        first = jnp.where(jnp.any(lies_on), most_pressed, jnp.argmin(gap))
        second = jnp.argmin(jnp.where(jnp.arange(gap.size) == first, jnp.inf, gap))
        distance = jnp.where(touches, height, OUT_OF_REACH)
        candidates = Candidate(distance, corner.point - edge.normal.scale(height), -edge.normal)
        nearest, other = (entry_at(candidates, k) for k in (first, second))
        # next to a convex corner, a point inside is pushed out by the nearest edge alone
        outside = other.distance >= -END_TOLERANCE[length.dtype.itemsize] * length
        keeps_other = outside | past[first] | past[second]
        return nearest, other._replace(distance=jnp.where(keeps_other, other.distance, OUT_OF_REACH))

    return jax.vmap(two_nearest)(corner, own_displacement)


def _is_inside(edge: Edge, point: Vec2) -> Bool[Array, ""]:
    """Return whether a point lies inside a polygon: a ray along x crosses its outline an odd number of times."""
    below = edge.start.y <= point.y
    left = edge.normal.dot(point - edge.start) < 0
    return jnp.sum((below != jnp.roll(below, -1)) & (left == below)) % 2 == 1


def _edge_supports(pad: PolygonOutline, outline: Outline, finger_pose: FingerPose) -> EdgeSupport:
    """Return the points of a smooth outline that face a pad's edges."""
    return pad_on_curve.edge_support_points(pad.edges, outline, finger_pose.center, _pad_angle(finger_pose))


def _smooth_candidates(
    pad: PolygonOutline, outline: Outline, center: Vec2, angle: Vec2, length: Scalar, supports: EdgeSupport
) -> Candidate:
    """Return the candidates of a pad and a smooth outline: at the pad's corners, and then at its edges."""
    too_deep, corner = -2 * MAX_PENETRATION * length, Corner.of(pad).turned(angle, center)
    closest = jax.vmap(outline.closest)(corner.point)
    faces = (corner.onward.dot(closest.normal) >= -TILT_TOLERANCE) & (
        corner.back.dot(closest.normal) >= -TILT_TOLERANCE
    )
    faces &= closest.distance > too_deep
    tolerance = END_TOLERANCE[supports.length.dtype.itemsize] * supports.length
    touches = (
        supports.valid
        & (supports.along >= -tolerance)
        & (supports.along <= supports.length + tolerance)
        & (supports.height > too_deep)
    )
    at_corners = Candidate(jnp.where(faces, closest.distance, OUT_OF_REACH), closest.point, -closest.normal)
    at_edges = Candidate(jnp.where(touches, supports.height, OUT_OF_REACH), supports.point, supports.normal)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), at_corners, at_edges)


def num_contacts(finger: Finger | Wall, outline: Outline) -> int:
    """Return the number of contacts that a finger or a wall may have, which is static."""
    if isinstance(finger, Wall):
        return num_wall_contacts(outline)
    return _num_contacts(*structure_and_shapes((finger, outline)))


@functools.lru_cache(maxsize=256)  # a trace of a step asks for it dozens of times
def _num_contacts(structure: Any, shapes: tuple[jax.ShapeDtypeStruct, ...]) -> int:
    """Return the number of contacts of a finger on an outline, whose arrays have the given shapes and dtypes."""

    def candidates_of(finger: Finger, outline: Outline) -> Candidates:
        zero = jnp.zeros(())
        still = Vec2(zero, zero)
        return contact_candidates(finger, outline, FingerPose(still, still), lambda point: still, zero)

    finger, outline = jax.tree.unflatten(structure, shapes)
    candidates = jax.eval_shape(candidates_of, finger, outline)
    # three contacts constrain every motion in the plane
    return (3 if is_nonconvex_polygon(outline) else 2) if isinstance(candidates, Candidate) else len(candidates)


def is_convex(outline: Outline) -> bool:
    """Return whether an outline is known to be convex."""
    return outline.convex if isinstance(outline, PolygonOutline) else isinstance(outline, DiskOutline | EllipseOutline)


def is_nonconvex_polygon(outline: Outline) -> bool:
    """Return whether an outline is a polygon that is not convex."""
    return isinstance(outline, PolygonOutline) and not outline.convex


def penetration_depth(finger: Finger | Wall, outline: Outline, finger_pose: FingerPose) -> Scalar:
    """Return how deep a finger or a wall is in the slider, m; where they are apart, minus their exact distance."""
    if isinstance(finger, Wall):
        return -jnp.min(wall_candidates(outline, finger_pose).distance)
    if isinstance(finger, RoundFinger):
        return finger.radius - outline.closest(finger_pose.center).distance
    pad, angle = finger.shape.outline(), _pad_angle(finger_pose)
    if isinstance(outline, DiskOutline):
        return outline.radius - pad.closest((outline.center - finger_pose.center).unrotate(angle)).distance
    pad_corners = finger_pose.center + pad.edges.start.rotate(angle)
    if not isinstance(outline, PolygonOutline):
        return pad_on_curve.penetration_depth(pad, _edge_supports(pad, outline, finger_pose), outline, pad_corners)
    slider_corners = (outline.edges.start - finger_pose.center).unrotate(angle)
    # the corners of each body in the other; where edges cross and no corner is inside, the chords
    depths = (
        -jax.vmap(pad.closest)(slider_corners).distance,
        -jax.vmap(outline.closest)(pad_corners).distance,
        _chord_depths(pad, slider_corners),
    )
    return largest(jnp.concatenate(depths))


def _chord_depths(pad: PolygonOutline, slider_corners: Vec2) -> Float[Array, " edges"]:
    """Return the depth in the pad of the middle of the chord that it cuts from each of a slider's edges, m, or -inf."""
    # The corners are in the pad's frame. Depth is concave along a chord, so the midpoint of a chord is at least half as
    # deep as its deepest point.
    side = pad.edges

    def depth_of_chord(start: Vec2, end: Vec2) -> Scalar:
        first, last = (-side.normal.dot(corner - side.start) for corner in (start, end))
        crossing = first / jnp.where(first != last, first - last, 1.0)
        enter = largest(jnp.where((first < 0) & (last > first), jnp.maximum(crossing, 0), 0.0))
        leave = smallest(jnp.where((last < 0) & (first > last), jnp.minimum(crossing, 1), 1.0))
        depth = smallest(first + (enter + leave) / 2 * (last - first))
        return jnp.where(enter < leave, depth, -jnp.inf)

    return jax.vmap(depth_of_chord)(slider_corners, jax.tree.map(lambda entry: jnp.roll(entry, -1), slider_corners))


def _pad_angle(finger_pose: FingerPose) -> Vec2:
    """Return the angle of a pad as a unit vector; raise ValueError if the kinematics give none."""
    if finger_pose.angle is None:
        raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centers")
    return finger_pose.angle
