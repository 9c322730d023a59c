"""Outlines of polygons, convex or not: closest points, second contacts and sweep."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, Outline, ray_circle_intersection, roundoff


class Edge(NamedTuple):
    """One edge of a polygon, or an array of edges; end a is the start, end b the end. Body frame.

    Attributes:
        start_x: x of the start, m.
        start_y: y of the start, m.
        along_x: x of the unit direction.
        along_y: y of the unit direction.
        length: Length, m.
        bisector_a_x: x of the unit bisector of the two outward normals that meet at the start.
        bisector_a_y: y of that bisector.
        bisector_b_x: x of the unit bisector of the two outward normals that meet at the end.
        bisector_b_y: y of that bisector.
        turn_a: Sine of the turn of the outline at the start; negative at a reflex corner.
        turn_b: Sine of the turn of the outline at the end; negative at a reflex corner.
    """

    start_x: Scalar
    start_y: Scalar
    along_x: Scalar
    along_y: Scalar
    length: Scalar
    bisector_a_x: Scalar
    bisector_a_y: Scalar
    bisector_b_x: Scalar
    bisector_b_y: Scalar
    turn_a: Scalar
    turn_b: Scalar

    @property
    def start(self) -> Vec2:
        """Start of the edge, m."""
        return Vec2(self.start_x, self.start_y)

    @property
    def along(self) -> Vec2:
        """Unit direction from start to end."""
        return Vec2(self.along_x, self.along_y)

    @property
    def normal(self) -> Vec2:
        """Outward unit normal; it lies to the right of the edge, because the outline runs counterclockwise."""
        return Vec2(self.along_y, -self.along_x)

    def foot(self, x: Vec2) -> tuple[Scalar, Scalar, Vec2]:
        """Project a point on the edge.

        Args:
            x: Query point, m, body frame.

        Returns:
            A tuple of the arc length of the projection from the start, m, the same clipped to the edge, and the vector
            from the clipped projection to `x`.
        """
        rel = x - self.start
        s = rel.dot(self.along)
        clipped = jnp.clip(s, 0, self.length)
        return s, clipped, rel - self.along.scale(clipped)


# One boolean per edge; a list or an array, like the edges.
EdgeMask = list[Bool[Array, ""]] | Bool[Array, "edges"]


class PolygonOutline(Outline):
    """Outline of a polygon that runs counterclockwise.

    Attributes:
        edges: The edges: a tuple (few edges, unrolled search), or one `Edge` of arrays (many edges).
        convex: Whether the polygon is known to be convex, so that a finger touches it in one place only.
    """

    edges: tuple[Edge, ...] | Edge
    convex: bool = eqx.field(static=True, default=False)

    def _nearest_edge(self, x: Vec2) -> tuple[Edge, EdgeMask]:
        """Return the edge nearest to `x`, and for each edge whether it is that one."""
        if isinstance(self.edges, Edge):
            *_, diff = self.edges.foot(x)
            nearest = jnp.argmin(diff.dot(diff))
            return jax.tree.map(lambda field: field[nearest], self.edges), jnp.arange(diff.x.size) == nearest
        best, best_squared, is_nearest = self.edges[0], None, []
        for edge in self.edges:
            *_, diff = edge.foot(x)
            squared = compute_once(diff.dot(diff), x.x)
            if best_squared is None:
                best_squared = squared
                is_nearest = [jnp.ones_like(squared, bool)]
                continue
            nearer = decide(squared < best_squared, x.x)
            best = tree_where(nearer, edge, best)
            best_squared = jnp.where(nearer, squared, best_squared)
            is_nearest = [was & ~nearer for was in is_nearest] + [nearer]
        return best, is_nearest

    def closest(self, x: Vec2) -> ClosestPoint:
        return _closest_on_edge(self._nearest_edge(x)[0], x)

    def contact_candidates(self, x: Vec2) -> tuple[ClosestPoint, ...]:
        if self.convex:
            return (self.closest(x),)
        edge, is_nearest = self._nearest_edge(x)
        first = _closest_on_edge(edge, x)
        other, on_edge, found = self._second_edge(x, is_nearest, first.distance)
        # For an edge, also past its end, the distance is that to the edge's line. For a vertex, distance and normal are
        # those of any closest vertex.
        at_vertex = _closest_on_edge(other, x)
        _, clipped, _ = other.foot(x)
        height = other.normal.dot(x - other.start)
        perimeter = jnp.sum(self.edges.length) if isinstance(self.edges, Edge) else sum(e.length for e in self.edges)
        distance = jnp.where(found, jnp.where(on_edge, height, at_vertex.distance), first.distance + perimeter)
        point = tree_where(found, other.start + other.along.scale(clipped), first.point)
        normal = tree_where(found, tree_where(on_edge, other.normal, at_vertex.normal), first.normal)
        return first, ClosestPoint(distance, point, normal)

    def _second_edge(self, x: Vec2, is_nearest: EdgeMask, gap: Scalar) -> tuple[Edge, Bool[Array, ""], Bool[Array, ""]]:
        """Find the second contact.

        Args:
            x: Query point, m, body frame.
            is_nearest: For each edge, whether it is the nearest one.
            gap: Signed distance to the nearest edge, m.

        Returns:
            A tuple of the edge of the second contact, whether the contact is with the edge itself (else with its start
            vertex), and whether there is a second contact.
        """
        if isinstance(self.edges, Edge):
            is_nearest = jnp.asarray(is_nearest)
            before = jax.tree.map(lambda field: jnp.roll(field, 1), self.edges)
            neighbors = (jnp.roll(is_nearest, 1), is_nearest, jnp.roll(is_nearest, -1))
            on_edge, on_vertex, squared = _is_second_contact(self.edges, before, x, neighbors, gap)
            chosen = jnp.argmin(jnp.where(on_edge | on_vertex, squared, jnp.inf))
            return jax.tree.map(lambda field: field[chosen], (self.edges, on_edge, on_edge | on_vertex))
        count = len(self.edges)
        best, best_squared = self.edges[0], jnp.full_like(gap, jnp.inf)
        found_on_edge, found = jnp.zeros_like(gap, bool), jnp.zeros_like(gap, bool)
        for k, edge in enumerate(self.edges):
            neighbors = (is_nearest[k - 1], is_nearest[k], is_nearest[(k + 1) % count])
            on_edge, on_vertex, squared = _is_second_contact(edge, self.edges[k - 1], x, neighbors, gap)
            on_edge, nearer = compute_once((on_edge, (on_edge | on_vertex) & (squared < best_squared)), x.x)
            best = tree_where(nearer, edge, best)
            found_on_edge, best_squared = (
                jnp.where(nearer, on_edge, found_on_edge),
                jnp.where(nearer, squared, best_squared),
            )
            found = found | nearer
        return best, found_on_edge, found

    def _sweep_edge(self, edge: Edge, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        """Fraction of `path` after which a disk first touches `edge` or its start vertex."""
        rel = x - edge.start
        approach = -edge.normal.dot(path)
        gap = edge.normal.dot(rel) - radius
        fraction = gap / jnp.where(approach > 0, approach, 1.0)
        foot = rel.dot(edge.along) + fraction * path.dot(edge.along)
        # The tolerance is for two cases that would be missed by roundoff: a disk that starts in contact, and a point
        # that aims at a vertex.
        tolerance = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + radius + edge.length)
        on_edge = (foot >= -tolerance) & (foot <= edge.length + tolerance)
        hits = (approach > 0) & (gap >= -tolerance) & (fraction <= 1) & on_edge
        return jnp.minimum(
            jnp.where(hits, jnp.maximum(fraction, 0), jnp.inf), ray_circle_intersection(rel, path, radius)
        )

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        if isinstance(self.edges, Edge):
            return jnp.min(self._sweep_edge(self.edges, x, path, radius))
        fraction = self._sweep_edge(self.edges[0], x, path, radius)
        for edge in self.edges[1:]:
            fraction = jnp.minimum(fraction, self._sweep_edge(edge, x, path, radius))
        return fraction


def _closest_on_edge(edge: Edge, x: Vec2) -> ClosestPoint:
    """Return distance, point and normal for the query point `x` from its nearest edge alone.

    If `x` projects onto the interior of the edge, the signed distance is linear in `x`, and its sign is right inside
    and outside. If a vertex is the closest point, the sign is that of the component along the bisector: outside a
    convex vertex, inside a reflex one. This sign stays right for vertices that are almost straight.
    """
    s, clipped, diff = compute_once(edge.foot(x), x.x)
    over_edge = (s > 0) & (s < edge.length)
    bisector = tree_where(
        s <= 0, Vec2(edge.bisector_a_x, edge.bisector_a_y), Vec2(edge.bisector_b_x, edge.bisector_b_y)
    )
    squared = diff.dot(diff)
    on_vertex = squared <= jnp.finfo(squared.dtype).tiny
    length = jnp.sqrt(jnp.where(on_vertex, 1.0, squared))
    sign = jnp.where(bisector.dot(diff) >= 0, 1.0, -1.0)
    radial = tree_where(on_vertex, bisector, diff.scale(sign / length))
    # On the vertex itself the distance is zero, and its gradient is the bisector.
    vertex_distance = jnp.where(on_vertex, bisector.dot(diff), sign * length)
    normal = tree_where(over_edge, edge.normal, radial)
    distance = jnp.where(over_edge, edge.normal.dot(x - edge.start), vertex_distance)
    return ClosestPoint(distance, edge.start + edge.along.scale(clipped), normal)


def _is_second_contact(edge: Edge, before: Edge, x: Vec2, nearest: tuple, gap: Scalar):
    """Test whether an edge, or its start vertex, is another local minimum of the distance from `x`.

    An edge is a second contact if `x` projects onto it and lies on its outer side. An edge that `x` faces only through
    the material is no contact.

    A neighbor of the nearest edge needs care. If they meet at a convex vertex, both have the same closest point, and
    there is only one minimum. If they meet at a reflex vertex, both can be contacts. There, if `x` is on the outline or
    behind it, the neighbor is a contact even if `x` projects past its end: a point pressed slightly into one edge is
    still stopped by the other.

    Args:
        edge: The edge to test.
        before: The edge before it.
        x: Query point, m, body frame.
        nearest: Whether the nearest edge is the edge before `edge`, `edge` itself, or the edge after it.
        gap: Signed distance to the nearest edge, m.

    Returns:
        A tuple of whether the edge is a second contact, whether its start vertex is one, and the squared distance, m^2.
    """
    s, _, diff = edge.foot(x)
    rel = x - edge.start
    tolerance = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + edge.length)
    straight = roundoff(jnp.ones_like(gap))
    reflex_a, reflex_b = edge.turn_a < -straight, edge.turn_b < -straight
    is_before, is_this, is_after = nearest
    same_point = (is_before & ~reflex_a) | (is_after & ~reflex_b)
    wedged = ((is_before & reflex_a) | (is_after & reflex_b)) & (gap <= tolerance)
    faces = (s >= -tolerance) & (s <= edge.length + tolerance) & (edge.normal.dot(rel) >= -tolerance)
    on_edge = ~is_this & ~same_point & (faces | wedged)
    in_sector = (s <= 0) & (rel.dot(before.along) >= 0) & ~reflex_a
    return on_edge, in_sector & ~is_this & ~is_before & ~on_edge, diff.dot(diff)
