"""Contacts and distance of a pad and a polygon: each corner of one is compared with the edges of the other.

A contact is a corner on the line of an edge. The first number of its features is that of the edge, the second that of
the corner: first those of the slider's edges and the pad's corners, then those of the pad's edges and the slider's
corners.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import entry_at, largest, smallest
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import Edge, PolygonOutline
from pushjax.geometry.shape import roundoff
from pushjax.simulation.candidate import Candidates, Touches, joined, pick
from pushjax.simulation.pair import MAX_PENETRATION, Pair

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


class PadOnPolygon(Pair):
    """A pad and a polygon."""

    def count(self, finger, outline):
        # three contacts constrain every motion in the plane
        return 2 if self.are_convex(finger, outline) else 3

    def are_convex(self, finger, outline):
        return outline.is_convex and finger.shape.convex

    def distance(self, finger, outline, pose):
        pad = finger.shape.outline()
        slider_corners = (outline.edges.start - pose.center).unrotate(pose.angle)
        in_pad = jax.vmap(pad.closest)(slider_corners)
        in_slider = jax.vmap(outline.closest)(pose.center + pad.edges.start.rotate(pose.angle))
        # the corners of each body in the other; where edges cross and no corner is inside, the chords
        chords = -_chord_depths(pad, slider_corners)
        distance = jnp.concatenate([in_pad.distance, in_slider.distance, chords])
        normal = joined(-in_pad.normal.rotate(pose.angle), in_slider.normal, Vec2(0 * chords, 0 * chords))
        return pick((distance, normal), jnp.argmin(distance))

    def candidates(self, finger, outline, pose, displacement_at, length):
        pad, angle = finger.shape.outline(), pose.angle
        pad_corners, slider_corners = Corner.of(pad).turned(angle, pose.center), Corner.of(outline)
        displacement = displacement_at(pad_corners.point)
        on_slider, on_next_edge = _vertex_edge_candidates(outline, pad_corners, displacement, length)
        inverse_angle = Vec2(angle.x, -angle.y)
        local = slider_corners.turned(inverse_angle, (-pose.center).unrotate(angle))
        displacement = (-displacement_at(slider_corners.point)).unrotate(angle)
        on_pad, on_next_of_pad = (
            Candidates(
                place._replace(point=slider_corners.point, normal=-place.normal.rotate(angle)),
                edge + outline.edges.length.size,
                corner + pad.edges.length.size,
            )
            for place, edge, corner in _vertex_edge_candidates(pad, local, displacement, length)
        )
        # in an inner corner of one body, a corner of the other touches both edges
        more = [] if outline.is_convex else [on_next_edge]
        more += [] if pad.is_convex else [on_next_of_pad]
        return joined(on_slider, on_pad, *more)

    def touches(self, finger, outline, pose, features):
        pad, own = finger.shape.outline(), outline.edges
        starts = pose.center + pad.edges.start.rotate(pose.angle)
        edges = joined((own.start, own.normal), (starts, pad.edges.normal.rotate(pose.angle)))
        (start, normal), (begin, end) = pick((edges, joined(_ends(own), _ends(pad.edges))), features.first)
        relative = pick(joined(starts, own.start), features.second) - start
        corner, height, along = start + relative, normal.dot(relative), normal.cross(relative)
        on_slider = features.first < own.length.size
        foot = corner - normal.scale(height)
        point = Vec2(jnp.where(on_slider, foot.x, corner.x), jnp.where(on_slider, foot.y, corner.y))
        exists = features.present & (along >= begin) & (along <= end)
        return Touches(height, point, normal.scale(jnp.where(on_slider, -1.0, 1.0)), exists)


def _ends(edge: Edge) -> tuple[Scalar, Scalar]:
    """Return between which coordinates along its edge a corner that touched it still does, m."""
    # somewhat wider than in `_vertex_edge_candidates`; what is past an inner corner is inside the slider
    slack = 2 * END_TOLERANCE[edge.length.dtype.itemsize] * edge.length
    begin, end = jnp.where(edge.turn_a < 0, jnp.inf, slack), jnp.where(edge.turn_b < 0, jnp.inf, slack)
    return jax.lax.stop_gradient((-begin, edge.length + end))


def _vertex_edge_candidates(
    outline: PolygonOutline, corner: Corner, displacement: Vec2, length: Scalar
) -> tuple[Candidates, Candidates]:
    """Return the nearest edge of a polygon that each corner can touch, and the next nearest."""
    # A corner can touch an edge if it projects onto the edge and points toward it. The closest point of the outline
    # would be wrong here. A corner slightly inside, next to a vertex of the polygon, may be closest to the wrong edge.
    # A corner past the end of an edge touches nothing, although it is near.
    edge, count = outline.edges, corner.point.x.size
    own_displacement = jax.tree.map(lambda entry: jnp.broadcast_to(entry, (count,)), displacement)
    numbers = jnp.arange(edge.length.size, dtype=jnp.int32)

    def two_nearest(corner: Corner, displacement: Vec2, number: Int[Array, ""]) -> tuple[Candidates, Candidates]:
        # a reflex corner cannot touch a straight edge
        is_convex_corner = corner.onward.cross(corner.back) >= -roundoff(jnp.ones_like(corner.point.x))
        relative = corner.point - edge.start
        along, height = relative.dot(edge.along), edge.normal.dot(relative)
        tolerance = END_TOLERANCE[edge.length.dtype.itemsize] * edge.length
        begin, end, past = -tolerance, edge.length + tolerance, jnp.zeros(along.shape, bool)
        if not outline.is_convex:
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
        behind = (height >= -tolerance) | (is_inside(edge, corner.point) & (height > -2 * MAX_PENETRATION * length))
        touches = faces & (along >= begin) & (along <= end) & behind
        gap = jnp.maximum(jnp.where(touches, jnp.abs(height), jnp.inf), tolerance)
        lies_on = touches & (gap <= tolerance)
        # a corner on the common vertex of two edges touches the one that its displacement presses it against
        most_pressed = jnp.argmax(jnp.where(lies_on, -edge.normal.dot(displacement), -jnp.inf))
        first = jnp.where(jnp.any(lies_on), most_pressed, jnp.argmin(gap))
        second = jnp.argmin(jnp.where(numbers == first, jnp.inf, gap))
        all_edges = Touches(height, corner.point - edge.normal.scale(height), -edge.normal, touches)
        (nearest, own), (other, next_own) = (entry_at((all_edges, numbers), k) for k in (first, second))
        # next to a convex corner, a point inside is pushed out by the nearest edge alone
        outside = other.distance >= -END_TOLERANCE[length.dtype.itemsize] * length
        other = other._replace(exists=other.exists & (outside | past[first] | past[second]))
        return Candidates(nearest, own, number), Candidates(other, next_own, number)

    return jax.vmap(two_nearest)(corner, own_displacement, jnp.arange(count, dtype=jnp.int32))


def is_inside(edge: Edge, point: Vec2) -> Bool[Array, ""]:
    """Return whether a point lies inside a polygon: a ray along x crosses its outline an odd number of times."""
    below = edge.start.y <= point.y
    left = edge.normal.dot(point - edge.start) < 0
    return jnp.sum((below != jnp.roll(below, -1)) & (left == below)) % 2 == 1


def _chord_depths(pad: PolygonOutline, slider_corners: Vec2) -> Scalar:
    """Return the depth in the pad of the middle of the chord that it cuts from each of a slider's edges, m."""
    # The corners are in the pad's frame. The depth may be -inf where there is no chord. In a convex pad, depth is
    # concave along a chord, so the midpoint of a chord is at least half as deep as its deepest point.
    side = pad.edges

    def depth_in_pieces(start: Vec2, end: Vec2) -> Scalar:
        """Return the depth of the deepest midpoint of all pieces into which the pad's outline cuts an edge."""
        edge, offset = end - start, side.start - start
        area = edge.cross(side.along)
        area = jnp.where(area == 0, jnp.inf, area)
        position, along = offset.cross(side.along) / area, offset.cross(edge) / area
        cuts = (along >= 0) & (along <= side.length)
        position = jnp.sort(jnp.where(cuts, jnp.clip(position, 0.0, 1.0), 1.0))
        ends = jnp.pad(position, 1, constant_values=(0, 1))
        middle = (ends[1:] + ends[:-1]) / 2
        return -smallest(jax.vmap(pad.closest)(start + Vec2(edge.x * middle, edge.y * middle)).distance)

    def depth_of_chord(start: Vec2, end: Vec2) -> Scalar:
        first, last = (-side.normal.dot(corner - side.start) for corner in (start, end))
        crossing = first / jnp.where(first != last, first - last, 1.0)
        enter = largest(jnp.where((first < 0) & (last > first), jnp.maximum(crossing, 0), 0.0))
        leave = smallest(jnp.where((last < 0) & (first > last), jnp.minimum(crossing, 1), 1.0))
        depth = smallest(first + (enter + leave) / 2 * (last - first))
        return jnp.where(enter < leave, depth, -jnp.inf)

    next_corners = jax.tree.map(lambda entry: jnp.roll(entry, -1), slider_corners)
    return jax.vmap(depth_of_chord if pad.is_convex else depth_in_pieces)(slider_corners, next_corners)
