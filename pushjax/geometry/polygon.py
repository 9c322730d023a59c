"""Polygons, convex or not: closest points, second contacts and sweep."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_positive,
    check_shape,
    common_dtype,
    concrete,
    in_numpy,
    on_device,
)
from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import (
    ClosestPoint,
    Outline,
    Shape,
    check_simple_polygon,
    ray_circle_intersection,
    roundoff,
    signed_area,
)

# Up to this many edges, the search over the edges is unrolled, so that a batch is vectorized across its examples. For
# more edges, arrays over the edges keep the compiled program small.
UNROLLED_EDGES = 12


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
        """Outward unit normal; it lies to the right of the edge, because the outline runs counter-clockwise."""
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


class PolygonOutline(Outline):
    """Outline of a polygon that runs counter-clockwise.

    Attributes:
        edges: The edges: a tuple (few edges, unrolled search), or one `Edge` of arrays (many edges).
        convex: Whether the polygon is known to be convex, so that a finger touches it in one place only.
    """

    edges: tuple[Edge, ...] | Edge
    convex: bool = eqx.field(static=True, default=False)

    def _nearest_edge(self, x: Vec2) -> tuple[Edge, "Marks"]:
        """Return the edge nearest to `x`, and for each edge whether it is that one."""
        if isinstance(self.edges, Edge):
            *_, diff = self.edges.foot(x)
            nearest = jnp.argmin(diff.dot(diff))
            return jax.tree.map(lambda field: field[nearest], self.edges), jnp.arange(diff.x.size) == nearest
        best, best_squared, marks = self.edges[0], None, []
        for edge in self.edges:
            *_, diff = edge.foot(x)
            squared = compute_once(diff.dot(diff), x.x)
            if best_squared is None:
                best_squared = squared
                marks = [jnp.ones_like(squared, bool)]
                continue
            nearer = decide(squared < best_squared, x.x)
            best = tree_where(nearer, edge, best)
            best_squared = jnp.where(nearer, squared, best_squared)
            marks = [mark & ~nearer for mark in marks] + [nearer]
        return best, marks

    def closest(self, x: Vec2) -> ClosestPoint:
        return _seen_over(self._nearest_edge(x)[0], x)

    def touches(self, x: Vec2) -> tuple[ClosestPoint, ...]:
        if self.convex:
            return (self.closest(x),)
        edge, marks = self._nearest_edge(x)
        first = _seen_over(edge, x)
        other, wall, found = self._next_edge(x, marks, first.distance)
        # For an edge, also past its end, the distance is that to the edge's line. For a vertex, distance and normal are
        # those of any closest vertex.
        at_corner = _seen_over(other, x)
        _, clipped, _ = other.foot(x)
        height = other.normal.dot(x - other.start)
        perimeter = jnp.sum(self.edges.length) if isinstance(self.edges, Edge) else sum(e.length for e in self.edges)
        distance = jnp.where(found, jnp.where(wall, height, at_corner.distance), first.distance + perimeter)
        point = tree_where(found, other.start + other.along.scale(clipped), first.point)
        normal = tree_where(found, tree_where(wall, other.normal, at_corner.normal), first.normal)
        return first, ClosestPoint(distance, point, normal)

    def _next_edge(self, x: Vec2, marks: "Marks", gap: Scalar) -> tuple[Edge, Bool[Array, ""], Bool[Array, ""]]:
        """Find the second contact.

        Args:
            x: Query point, m, body frame.
            marks: For each edge, whether it is the nearest one.
            gap: Signed distance to the nearest edge, m.

        Returns:
            A tuple of the edge of the second contact, whether the contact is with the edge itself (else with its start
            vertex), and whether there is a second contact.
        """
        if isinstance(self.edges, Edge):
            marks = jnp.asarray(marks)
            before = jax.tree.map(lambda field: jnp.roll(field, 1), self.edges)
            near = (jnp.roll(marks, 1), marks, jnp.roll(marks, -1))
            wall, corner, squared = _second_touch(self.edges, before, x, near, gap)
            chosen = jnp.argmin(jnp.where(wall | corner, squared, jnp.inf))
            return jax.tree.map(lambda field: field[chosen], (self.edges, wall, wall | corner))
        count = len(self.edges)
        best, best_squared = self.edges[0], jnp.full_like(gap, jnp.inf)
        over, found = jnp.zeros_like(gap, bool), jnp.zeros_like(gap, bool)
        for k, edge in enumerate(self.edges):
            near = (marks[k - 1], marks[k], marks[(k + 1) % count])
            wall, corner, squared = _second_touch(edge, self.edges[k - 1], x, near, gap)
            wall, nearer = compute_once((wall, (wall | corner) & (squared < best_squared)), x.x)
            best = tree_where(nearer, edge, best)
            over, best_squared = jnp.where(nearer, wall, over), jnp.where(nearer, squared, best_squared)
            found = found | nearer
        return best, over, found

    def _sweep_edge(self, edge: Edge, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        """Fraction of `path` after which a disk first touches `edge` or its start vertex."""
        rel = x - edge.start
        approach = -edge.normal.dot(path)
        gap = edge.normal.dot(rel) - radius
        fraction = gap / jnp.where(approach > 0, approach, 1.0)
        foot = rel.dot(edge.along) + fraction * path.dot(edge.along)
        # The tolerance is for two cases that would be missed by roundoff: a disk that starts in contact, and a point
        # that aims at a vertex.
        loose = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + radius + edge.length)
        on_edge = (foot >= -loose) & (foot <= edge.length + loose)
        hits = (approach > 0) & (gap >= -loose) & (fraction <= 1) & on_edge
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


Marks = list[Bool[Array, ""]] | Bool[Array, "vertices"]  # one mark per edge; a list or an array, like the edges


def _seen_over(edge: Edge, x: Vec2) -> ClosestPoint:
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


def _second_touch(edge: Edge, before: Edge, x: Vec2, first: tuple, gap: Scalar):
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
        first: Whether the nearest edge is the edge before `edge`, `edge` itself, or the edge after it.
        gap: Signed distance to the nearest edge, m.

    Returns:
        A tuple of whether the edge is a second contact, whether its start vertex is one, and the squared distance, m^2.
    """
    s, _, diff = edge.foot(x)
    rel = x - edge.start
    loose = roundoff(jnp.abs(rel.x) + jnp.abs(rel.y) + edge.length)
    straight = roundoff(jnp.ones_like(gap))
    reflex_a, reflex_b = edge.turn_a < -straight, edge.turn_b < -straight
    is_before, is_this, is_after = first
    shares = (is_before & ~reflex_a) | (is_after & ~reflex_b)
    wedged = ((is_before & reflex_a) | (is_after & reflex_b)) & (gap <= loose)
    over = (s >= -loose) & (s <= edge.length + loose) & (edge.normal.dot(rel) >= -loose)
    wall = ~is_this & ~shares & (over | wedged)
    sector = (s <= 0) & (rel.dot(before.along) >= 0) & ~reflex_a
    return wall, sector & ~is_this & ~is_before & ~wall, diff.dot(diff)


class Polygon(Shape):
    """A simple polygon in the body frame, convex or not.

    The vertices are stored counter-clockwise, and the first vertex stays first. While they are traced (under `jit`,
    `grad` or `vmap`), they are taken as they are and must be counter-clockwise already.

    Args:
        vertices: Vertices, shape (vertices, 2), m, at least three, in either orientation. The first vertex is not
            repeated at the end.
        convex: Whether a finger touches the polygon in one place only. None: determined from the vertices; if they are
            traced, convexity is not assumed. False for a convex polygon costs time but does not change results.

    Raises:
        ValueError: If there are fewer than three vertices, or NaN or repeated vertices among them; if edges cross; if
            the polygon has no area; or if the vertices are known and not convex although `convex` is True.
    """

    vertices: Float[Array, "vertices 2"]
    convex: bool = eqx.field(static=True)

    def __init__(self, vertices: ArrayLike, *, convex: bool | None = None):
        array = as_float(vertices)
        check_shape("vertices", array, ("vertices", 2))
        if array.shape[0] < 3:
            raise ValueError(f"vertices: a polygon needs at least three; got {array.shape[0]}")
        check_finite("vertices", array)
        known = concrete(array)
        if known is not None:
            check_simple_polygon("vertices", known.astype(np.float64))
            if signed_area(known.astype(np.float64)) < 0:
                array = on_device(np.roll(known[::-1], 1, axis=0))
        self.vertices = array
        self.convex = _is_convex(array, convex)

    @staticmethod
    def rectangle(width: ArrayLike, height: ArrayLike) -> "Polygon":
        """Create a rectangle centered at the body origin, with sides along the body axes.

        Args:
            width: Side along x, m.
            height: Side along y, m.

        Returns:
            The rectangle.

        Raises:
            ValueError: If a side is not a positive finite scalar.
        """
        dtype = common_dtype(width, height)
        w, h = as_float(width, dtype), as_float(height, dtype)
        for name, value in (("width", w), ("height", h)):
            check_shape(name, value, ())
            check_finite(name, value)
            check_positive(name, value)
        return Polygon(_rectangle(w, h), convex=True)

    @staticmethod
    def regular(sides: int, circumradius: ArrayLike) -> "Polygon":
        """Create a regular polygon centered at the body origin, with the first vertex on the +x axis.

        Args:
            sides: Number of sides, at least three.
            circumradius: Distance of the vertices from the origin, m.

        Returns:
            The polygon.

        Raises:
            ValueError: If there are fewer than three sides, or the radius is not a positive finite scalar.
        """
        if sides < 3:
            raise ValueError(f"sides must be at least 3; got {sides}")
        radius = as_float(circumradius)
        check_shape("circumradius", radius, ())
        check_finite("circumradius", radius)
        check_positive("circumradius", radius)
        angle = 2 * jnp.pi * jnp.arange(sides, dtype=radius.dtype) / sides
        return Polygon(radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1), convex=True)

    @property
    def area(self) -> Float[Array, ""]:
        return _area(self.vertices)

    @property
    def centroid(self) -> Float[Array, "2"]:
        return _centroid(self.vertices)

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        return _bounds(self.vertices)

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outline, m."""
        edge = jnp.roll(self.vertices, -1, axis=0) - self.vertices
        return jnp.sum(jnp.hypot(edge[:, 0], edge[:, 1]))

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        closed = jnp.concatenate([self.vertices, self.vertices[:1]])
        edge = jnp.diff(closed, axis=0)
        arc = jnp.concatenate([jnp.zeros(1, edge.dtype), jnp.cumsum(jnp.hypot(edge[:, 0], edge[:, 1]))])
        at = (jnp.arange(points, dtype=edge.dtype) + 0.5) / points * arc[-1]
        return jnp.stack([jnp.interp(at, arc, closed[:, 0]), jnp.interp(at, arc, closed[:, 1])], axis=1)

    def inset(self, depth: ArrayLike) -> "Polygon":
        """Move every edge of the polygon inwards.

        Args:
            depth: Distance by which each edge moves inwards, m; negative moves it outwards. It must be small enough
                that no edge vanishes.

        Returns:
            The polygon between the moved edges.
        """
        by = as_float(depth, self.vertices.dtype)
        edge = jnp.roll(self.vertices, -1, axis=0) - self.vertices
        normal = jnp.stack([edge[:, 1], -edge[:, 0]], axis=1) / jnp.linalg.norm(edge, axis=1, keepdims=True)
        before = jnp.roll(normal, 1, axis=0)
        # A corner's shift s satisfies n . s = -depth for the normals n of both of its edges.
        corner = (before + normal) / (1 + jnp.sum(before * normal, axis=1, keepdims=True))
        return Polygon(self.vertices - by * corner, convex=self.convex)

    def outline(self) -> PolygonOutline:
        v = self.vertices
        edge = jnp.roll(v, -1, axis=0) - v
        length = jnp.sqrt(jnp.sum(edge**2, axis=1))
        along = edge / length[:, None]
        normal = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
        bisector = normal + jnp.roll(normal, 1, axis=0)  # at the start of each edge
        bisector = bisector / jnp.sqrt(jnp.sum(bisector**2, axis=1, keepdims=True))
        back = jnp.roll(along, 1, axis=0)
        turn = back[:, 0] * along[:, 1] - back[:, 1] * along[:, 0]
        starts = (bisector[:, 0], bisector[:, 1]), turn
        (a_x, a_y), turn_a = starts
        (b_x, b_y), turn_b = jax.tree.map(lambda field: jnp.roll(field, -1), starts)
        edges = Edge(v[:, 0], v[:, 1], along[:, 0], along[:, 1], length, a_x, a_y, b_x, b_y, turn_a, turn_b)
        if len(v) > UNROLLED_EDGES:
            return PolygonOutline(edges, self.convex)
        each = tuple(jax.tree.map(lambda field, i=i: field[i], edges) for i in range(len(v)))
        return PolygonOutline(each, self.convex)


@in_numpy
def _rectangle(xp, width, height):
    """Vertices of a rectangle about the origin, counter-clockwise."""
    signs = xp.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]], width.dtype)
    return signs * xp.stack([width / 2, height / 2])[None]


@in_numpy
def _area(xp, vertices):
    """Area of the polygon, positive if the vertices run counter-clockwise."""
    # Vertices are relative to the first one, so that a polygon far from the origin does not lose digits.
    a = vertices - vertices[:1]
    b = xp.roll(a, -1, axis=0)
    return xp.sum(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]) / 2


@in_numpy
def _centroid(xp, vertices):
    """Centroid of the area."""
    a = vertices - vertices[:1]  # relative, as for the area
    b = xp.roll(a, -1, axis=0)
    twice = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    return vertices[0] + xp.sum((a + b) * twice[:, None], axis=0) / (3 * xp.sum(twice))


@in_numpy
def _bounds(xp, vertices):
    """Lower and upper corner of the box around the vertices."""
    return xp.min(vertices, axis=0), xp.max(vertices, axis=0)


def _is_convex(vertices: Array, claimed: bool | None) -> bool:
    """Whether no vertex lies inside the line between its neighbors by more than roundoff; if traced, as claimed."""
    known = concrete(vertices)
    if known is None:
        return bool(claimed)
    v = known.astype(np.float64)
    chord = np.roll(v, -1, axis=0) - np.roll(v, 1, axis=0)
    arm = v - np.roll(v, 1, axis=0)
    # How far each vertex lies outside that line. Where the chord has length zero, the outline turns back on itself.
    length = np.maximum(np.linalg.norm(chord, axis=1), np.finfo(np.float64).tiny)
    bulge = (arm[:, 0] * chord[:, 1] - arm[:, 1] * chord[:, 0]) / length
    inner = int(np.argmin(bulge))
    convex = bool(bulge[inner] >= -16 * float(jnp.finfo(vertices.dtype).eps) * np.max(np.abs(v)))
    if claimed and not convex:
        raise ValueError(f"convex is True, but the vertices are not: vertex {inner} is a reflex corner")
    return convex if claimed is None else bool(claimed)
