"""Outlines of polygons, convex or not: closest points, second contacts and sweep.

A second contact is another local minimum of the distance to the query point; see `Outline.contact_candidates`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, Outline, ray_circle_intersection, roundoff


class Edge(NamedTuple):
    """One edge of a polygon, or an array of edges, in the body frame. Suffix a is its start, suffix b its end.

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
        turn_a: Sine of the angle by which the outline turns at the start; negative at a reflex vertex.
        turn_b: Sine of the angle by which the outline turns at the end; negative at a reflex vertex.
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
        """Project a point onto the edge.

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


# One boolean per edge: a list for unrolled edges, an array for an `Edge` of arrays.
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
            *_, from_edge = self.edges.foot(x)
            nearest = jnp.argmin(from_edge.dot(from_edge))
            return jax.tree.map(lambda field: field[nearest], self.edges), jnp.arange(from_edge.x.size) == nearest
        best, best_squared, is_nearest = self.edges[0], None, []
        for edge in self.edges:
            *_, from_edge = edge.foot(x)
            squared = compute_once(from_edge.dot(from_edge), x.x)
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

    def _second_edge(
        self, x: Vec2, is_nearest: EdgeMask, nearest_distance: Scalar
    ) -> tuple[Edge, Bool[Array, ""], Bool[Array, ""]]:
        """Find the second contact.

        Args:
            x: Query point, m, body frame.
            is_nearest: For each edge, whether it is the nearest one.
            nearest_distance: Signed distance to the nearest edge, m.

        Returns:
            A tuple of the edge of the second contact, whether the contact is with the edge itself (else with its start
            vertex), and whether there is a second contact.
        """
        if isinstance(self.edges, Edge):
            is_nearest = jnp.asarray(is_nearest)
            previous = jax.tree.map(lambda field: jnp.roll(field, 1), self.edges)
            neighbors = (jnp.roll(is_nearest, 1), is_nearest, jnp.roll(is_nearest, -1))
            on_edge, on_vertex, squared = _test_second_contact(self.edges, previous, x, neighbors, nearest_distance)
            chosen = jnp.argmin(jnp.where(on_edge | on_vertex, squared, jnp.inf))
            return jax.tree.map(lambda field: field[chosen], (self.edges, on_edge, on_edge | on_vertex))
        count = len(self.edges)
        best, best_squared = self.edges[0], jnp.full_like(nearest_distance, jnp.inf)
        found_on_edge, found = jnp.zeros_like(nearest_distance, bool), jnp.zeros_like(nearest_distance, bool)
        for k, edge in enumerate(self.edges):
            neighbors = (is_nearest[k - 1], is_nearest[k], is_nearest[(k + 1) % count])
            on_edge, on_vertex, squared = _test_second_contact(edge, self.edges[k - 1], x, neighbors, nearest_distance)
            on_edge, nearer = compute_once((on_edge, (on_edge | on_vertex) & (squared < best_squared)), x.x)
            best = tree_where(nearer, edge, best)
            found_on_edge, best_squared = (
                jnp.where(nearer, on_edge, found_on_edge),
                jnp.where(nearer, squared, best_squared),
            )
            found = found | nearer
        return best, found_on_edge, found

    def _sweep_edge(self, edge: Edge, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        """Return the fraction of `path` of first contact with `edge` or its start vertex, or inf."""
        rel = x - edge.start
        approach = -edge.normal.dot(path)
        gap = edge.normal.dot(rel) - radius
        fraction = gap / jnp.where(approach > 0, approach, 1.0)
        contact_position = rel.dot(edge.along) + fraction * path.dot(edge.along)
        # The tolerance is for two cases that would be missed by roundoff: a disk that starts in contact, and a point
        # that aims at a vertex.
        tolerance = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + radius + edge.length)
        on_edge = (contact_position >= -tolerance) & (contact_position <= edge.length + tolerance)
        hits = (approach > 0) & (gap >= -tolerance) & (fraction <= 1) & on_edge
        return jnp.minimum(
            jnp.where(hits, jnp.maximum(fraction, 0), jnp.inf), ray_circle_intersection(rel, path, radius)
        )

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        if isinstance(self.edges, Edge):
            # computed once, because the derivative of a minimum compares it with each value
            return jnp.min(compute_once(self._sweep_edge(self.edges, x, path, radius), x.x))
        fraction = self._sweep_edge(self.edges[0], x, path, radius)
        for edge in self.edges[1:]:
            fraction = jnp.minimum(fraction, self._sweep_edge(edge, x, path, radius))
        return fraction


def _closest_on_edge(edge: Edge, x: Vec2) -> ClosestPoint:
    """Return the signed distance, closest point and normal for the query point `x`, from its nearest edge alone.

    If `x` projects onto the interior of the edge, the signed distance is linear in `x`, and its sign is right inside
    and outside. If a vertex is the closest point, the sign is that of the component along the bisector: positive at a
    convex vertex, because `x` is then outside, and negative at a reflex one. This sign stays right for vertices that
    are almost straight.
    """
    position, clipped, from_edge = compute_once(edge.foot(x), x.x)
    projects_inside = (position > 0) & (position < edge.length)
    bisector = tree_where(
        position <= 0, Vec2(edge.bisector_a_x, edge.bisector_a_y), Vec2(edge.bisector_b_x, edge.bisector_b_y)
    )
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


def _test_second_contact(edge: Edge, previous: Edge, x: Vec2, is_nearest: tuple, nearest_distance: Scalar):
    """Test whether an edge, or its start vertex, is another local minimum of the distance from `x`.

    An edge is a second contact if `x` projects onto it and lies on its outer side. An edge that `x` faces only through
    the material is no contact.

    A neighbor of the nearest edge needs care. If they meet at a convex vertex, both have the same closest point, and
    there is only one minimum. If they meet at a reflex vertex, both can be contacts. There, if `x` is on the outline or
    behind it, the neighbor is a contact even if `x` projects past its end: a point pressed slightly into one edge is
    still stopped by the other.

    Args:
        edge: The edge to test.
        previous: The edge before it.
        x: Query point, m, body frame.
        is_nearest: Three booleans: whether the nearest edge is the edge before `edge`, `edge` itself, or the edge after
            it.
        nearest_distance: Signed distance to the nearest edge, m.

    Returns:
        A tuple of whether the edge is a second contact, whether its start vertex is one, and the squared distance from
        `x` to the edge, m^2.
    """
    position, _, from_edge = edge.foot(x)
    rel = x - edge.start
    tolerance = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + edge.length)
    turn_tolerance = roundoff(jnp.ones_like(nearest_distance))
    reflex_a, reflex_b = edge.turn_a < -turn_tolerance, edge.turn_b < -turn_tolerance
    previous_is_nearest, this_is_nearest, next_is_nearest = is_nearest
    shares_point = (previous_is_nearest & ~reflex_a) | (next_is_nearest & ~reflex_b)
    is_wedged = ((previous_is_nearest & reflex_a) | (next_is_nearest & reflex_b)) & (nearest_distance <= tolerance)
    is_faced = (position >= -tolerance) & (position <= edge.length + tolerance) & (edge.normal.dot(rel) >= -tolerance)
    on_edge = ~this_is_nearest & ~shares_point & (is_faced | is_wedged)
    in_vertex_sector = (position <= 0) & (rel.dot(previous.along) >= 0) & ~reflex_a
    return on_edge, in_vertex_sector & ~this_is_nearest & ~previous_is_nearest & ~on_edge, from_edge.dot(from_edge)
