"""Outlines of polygons, convex or not: closest points, second contacts (see `Outline.contact_candidates`)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.xla import compute_once, entry_at, tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, FacingPoints, Outline, roundoff


class Edge(NamedTuple):
    """One edge of a polygon, or all of them as arrays (edges,), in m in the body frame."""

    start: Vec2
    along: Vec2  # unit direction from start to end
    length: Scalar
    bisector_a: Vec2  # unit bisector of the two outward normals that meet at the start
    bisector_b: Vec2  # the same at the end
    turn_a: Scalar  # sine of the angle by which the outline turns at the start; negative at a reflex vertex
    turn_b: Scalar  # the same at the end
    previous: Vec2  # unit direction of the edge before this one

    @staticmethod
    def of(vertices: Float[Array, "edges 2"]) -> "Edge":
        """Return all edges of a polygon that runs counterclockwise."""
        x, y = vertices[:, 0], vertices[:, 1]
        step_x, step_y = jnp.roll(x, -1) - x, jnp.roll(y, -1) - y
        length = jnp.sqrt(step_x**2 + step_y**2)
        along = Vec2(step_x / length, step_y / length)
        previous = Vec2(*(jnp.roll(entry, 1) for entry in along))
        bisector = Vec2(along.y + previous.y, -along.x - previous.x)
        bisector = bisector.scale(1 / jnp.sqrt(bisector.dot(bisector)))
        turn = previous.cross(along)
        bisector_b, turn_b = jax.tree.map(lambda entry: jnp.roll(entry, -1), (bisector, turn))
        return Edge(Vec2(x, y), along, length, bisector, bisector_b, turn, turn_b, previous)

    @property
    def normal(self) -> Vec2:
        """Outward unit normal, to the right of the edge because the outline runs counterclockwise."""
        return Vec2(self.along.y, -self.along.x)

    def foot(self, x: Vec2) -> tuple[Scalar, Scalar, Vec2]:
        """Return the arc length at the projection of `x`, m, the same clipped to the edge, and `x` minus that foot."""
        rel = x - self.start
        s = rel.dot(self.along)
        clipped = jnp.clip(s, 0, self.length)
        return s, clipped, rel - self.along.scale(clipped)


class PolygonOutline(Outline):
    """Outline of a polygon that runs counterclockwise."""

    edges: Edge
    convex: bool = eqx.field(static=True)  # False also if convexity is not known
    touched_once: bool = eqx.field(static=True, default=False)  # whether only the nearest place counts

    @property
    def max_touches(self) -> int:
        return 1 if self.touched_once else super().max_touches

    @property
    def is_convex(self) -> bool:
        return self.convex

    def _nearest_edge(self, x: Vec2) -> Int[Array, ""]:
        """Return the index of the edge nearest to `x`."""
        *_, from_edge = self.edges.foot(x)
        return jnp.argmin(from_edge.dot(from_edge))

    def closest(self, x: Vec2) -> ClosestPoint:
        return _closest_on_edge(entry_at(self.edges, self._nearest_edge(x)), x)

    def contact_candidates(self, x: Vec2) -> tuple[ClosestPoint, ...]:
        if self.max_touches == 1:
            return (self.closest(x),)
        nearest = self._nearest_edge(x)
        first = _closest_on_edge(entry_at(self.edges, nearest), x)
        on_edge, on_vertex, squared = _test_second_contacts(self.edges, x, nearest, first.distance)
        on_edge, on_vertex = compute_once((on_edge, on_vertex), x.x)
        second = jnp.argmin(jnp.where(on_edge | on_vertex, squared, jnp.inf))
        other, on_edge, found = entry_at((self.edges, on_edge, on_edge | on_vertex), second)
        # For an edge, also past its end, the distance is that to the edge's line. For a vertex, distance and normal are
        # those of any closest vertex.
        at_vertex = _closest_on_edge(other, x)
        _, clipped, _ = other.foot(x)
        height = other.normal.dot(x - other.start)
        out_of_reach = first.distance + jnp.sum(self.edges.length)
        distance = jnp.where(found, jnp.where(on_edge, height, at_vertex.distance), out_of_reach)
        point = tree_where(found, other.start + other.along.scale(clipped), first.point)
        normal = tree_where(found, tree_where(on_edge, other.normal, at_vertex.normal), first.normal)
        return first, ClosestPoint(distance, point, normal)

    def pieces(self, x: Vec2) -> tuple[Float[Array, "pieces"], Vec2 | None]:
        if self.is_convex:
            return super().pieces(x)
        *_, from_edge = self.edges.foot(x)
        squared = from_edge.dot(from_edge)
        length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        distance = jnp.where(squared > 0, length, 0.0)
        # the nearest edges may be behind `x`, or so near that the vector from them is roundoff
        closest = self.closest(x)
        tolerance = roundoff(jnp.abs(x.x) + jnp.abs(x.y) + self.edges.length)
        is_nearest = distance <= jnp.abs(closest.distance) + tolerance
        normal = tree_where(is_nearest, closest.normal, from_edge.scale(1 / length))
        return jnp.where(is_nearest, closest.distance, distance), normal

    def facing(self, direction: Vec2) -> FacingPoints:
        return FacingPoints(self.edges.start, jnp.ones(self.edges.length.size, bool))


def _closest_on_edge(edge: Edge, x: Vec2) -> ClosestPoint:
    """Return the signed distance, closest point and normal for the query point `x`, from its nearest edge alone."""
    # If `x` projects onto the interior of the edge, the signed distance is linear in `x`, and its sign is right inside
    # and outside. If a vertex is closest, the component along the bisector gives the sign: positive at a convex vertex,
    # because `x` is then outside, and negative at a reflex one. This sign stays right for vertices that are almost
    # straight.
    position, clipped, from_edge = compute_once(edge.foot(x), x.x)
    projects_inside = (position > 0) & (position < edge.length)
    bisector = tree_where(position <= 0, edge.bisector_a, edge.bisector_b)
    squared = from_edge.dot(from_edge)
    on_vertex = squared <= jnp.finfo(squared.dtype).tiny
    length = jnp.sqrt(jnp.where(on_vertex, 1.0, squared))
    sign = jnp.where(bisector.dot(from_edge) >= 0, 1.0, -1.0)
    radial = tree_where(on_vertex, bisector, from_edge.scale(sign / length))
    # On the vertex itself the distance is zero, and its gradient is the bisector.
    vertex_distance = jnp.where(on_vertex, bisector.dot(from_edge), sign * length)
    normal = tree_where(projects_inside, edge.normal, radial)
    distance = jnp.where(projects_inside, edge.normal.dot(x - edge.start), vertex_distance)
    return ClosestPoint(distance, edge.start + edge.along.scale(clipped), normal)


def _test_second_contacts(
    edge: Edge, x: Vec2, nearest: Int[Array, ""], nearest_distance: Scalar
) -> tuple[Bool[Array, " edges"], Bool[Array, " edges"], Float[Array, " edges"]]:
    """Return whether each edge, or its start vertex, is a second contact of `x`, and its squared distance, m^2."""
    position, _, from_edge = edge.foot(x)
    rel = x - edge.start
    tolerance = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + edge.length)
    turn_tolerance = roundoff(jnp.ones_like(nearest_distance))
    reflex_a, reflex_b = edge.turn_a < -turn_tolerance, edge.turn_b < -turn_tolerance
    count = edge.length.size
    index = jnp.arange(count)
    is_nearest, next_is_nearest = index == nearest, (index + 1) % count == nearest
    previous_is_nearest = index == (nearest + 1) % count
    # Two edges that meet at a convex vertex have the same closest point there, so there is only one minimum.
    shares_point = (previous_is_nearest & ~reflex_a) | (next_is_nearest & ~reflex_b)
    # Two edges that meet at a reflex vertex can both be contacts. If `x` is on the outline or behind it, the neighbor
    # is a contact even if `x` projects past its end: the other edge still stops a point pressed slightly into one edge.
    is_wedged = ((previous_is_nearest & reflex_a) | (next_is_nearest & reflex_b)) & (nearest_distance <= tolerance)
    # `x` must lie on the outer side of the edge. An edge that it faces only through the material is no contact.
    is_faced = (position >= -tolerance) & (position <= edge.length + tolerance) & (edge.normal.dot(rel) >= -tolerance)
    on_edge = ~is_nearest & ~shares_point & (is_faced | is_wedged)
    # At a straight vertex the sector is a line, of which one half lies in the material.
    in_vertex_sector = (position <= 0) & (rel.dot(edge.previous) >= 0) & (edge.bisector_a.dot(rel) >= 0) & ~reflex_a
    return on_edge, in_vertex_sector & ~is_nearest & ~previous_is_nearest & ~on_edge, from_edge.dot(from_edge)
