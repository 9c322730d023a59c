"""Polygons, convex or not."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, in_numpy, on_device, positive, shaped
from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.shapes._base import Closest, Outline, Shape, check_simple, first_hit, rounding, signed_area

# Up to this many edges the search over edges is written out, edge by edge, so that a batch vectorises across its
# examples; beyond it, an array over the edges keeps the compiled program small.
UNROLLED_EDGES = 12


class Edge(NamedTuple):
    """One edge, or an array of them: start, unit direction, length, and for both ends the bisecting normal and the
    turn of the outline there, as its sine (negative at a reflex corner)."""

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
        return Vec2(self.start_x, self.start_y)

    @property
    def along(self) -> Vec2:
        return Vec2(self.along_x, self.along_y)

    @property
    def normal(self) -> Vec2:
        """Outward: the outline runs counter-clockwise."""
        return Vec2(self.along_y, -self.along_x)

    def foot(self, x: Vec2) -> tuple[Scalar, Scalar, Vec2]:
        """Arc length of the projection of `x` before and after clipping to the edge, and `x` minus that foot."""
        rel = x - self.start
        s = rel.dot(self.along)
        clipped = jnp.clip(s, 0, self.length)
        return s, clipped, rel - self.along.scale(clipped)


class PolygonOutline(Outline):
    """Edges of a polygon: a tuple of them (written out), or one `Edge` of arrays (many edges)."""

    edges: tuple[Edge, ...] | Edge
    convex: bool = eqx.field(static=True, default=False)

    def _nearest_edge(self, x: Vec2) -> tuple[Edge, "Marks"]:
        """The nearest edge, and for each edge whether it is that one."""
        if isinstance(self.edges, Edge):
            *_, diff = self.edges.foot(x)
            nearest = jnp.argmin(diff.dot(diff))
            return jax.tree.map(lambda field: field[nearest], self.edges), jnp.arange(diff.x.size) == nearest
        best, best_squared, marks = self.edges[0], None, []
        for edge in self.edges:
            *_, diff = edge.foot(x)
            squared = settle(diff.dot(diff), x.x)
            if best_squared is None:
                best_squared = squared
                marks = [jnp.ones_like(squared, bool)]
                continue
            nearer = settle(squared < best_squared, x.x)
            best = select(nearer, edge, best)
            best_squared = jnp.where(nearer, squared, best_squared)
            marks = [mark & ~nearer for mark in marks] + [nearer]
        return best, marks

    def closest(self, x: Vec2) -> Closest:
        return _seen_over(self._nearest_edge(x)[0], x)

    def touches(self, x: Vec2) -> tuple[Closest, ...]:
        if self.convex:
            return (self.closest(x),)
        edge, marks = self._nearest_edge(x)
        first = _seen_over(edge, x)
        other, wall, found = self._next_edge(x, marks, first.distance)
        # over a wall, also past its end, the distance is that to its line; a corner is seen as any corner
        at_corner = _seen_over(other, x)
        _, clipped, _ = other.foot(x)
        height = other.normal.dot(x - other.start)
        perimeter = jnp.sum(self.edges.length) if isinstance(self.edges, Edge) else sum(e.length for e in self.edges)
        distance = jnp.where(found, jnp.where(wall, height, at_corner.distance), first.distance + perimeter)
        point = select(found, other.start + other.along.scale(clipped), first.point)
        normal = select(found, select(wall, other.normal, at_corner.normal), first.normal)
        return first, Closest(distance, point, normal)

    def _next_edge(self, x: Vec2, marks: "Marks", gap: Scalar) -> tuple[Edge, Bool[Array, ""], Bool[Array, ""]]:
        """The edge of the second touch, whether over the edge or at its start, and whether there is one at all."""
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
            wall, nearer = settle((wall, (wall | corner) & (squared < best_squared)), x.x)
            best = select(nearer, edge, best)
            over, best_squared = jnp.where(nearer, wall, over), jnp.where(nearer, squared, best_squared)
            found = found | nearer
        return best, over, found

    def _sweep_edge(self, edge: Edge, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        rel = x - edge.start
        approach = -edge.normal.dot(path)
        gap = edge.normal.dot(rel) - radius
        fraction = gap / jnp.where(approach > 0, approach, 1.0)
        foot = rel.dot(edge.along) + fraction * path.dot(edge.along)
        # To rounding a disc may start touching, and a point may aim at a vertex: neither slips through
        loose = rounding(jnp.abs(rel.x) + jnp.abs(rel.y) + radius + edge.length)
        on_edge = (foot >= -loose) & (foot <= edge.length + loose)
        hits = (approach > 0) & (gap >= -loose) & (fraction <= 1) & on_edge
        return jnp.minimum(jnp.where(hits, jnp.maximum(fraction, 0), jnp.inf), first_hit(rel, path, radius))

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        if isinstance(self.edges, Edge):
            return jnp.min(self._sweep_edge(self.edges, x, path, radius))
        fraction = self._sweep_edge(self.edges[0], x, path, radius)
        for edge in self.edges[1:]:
            fraction = jnp.minimum(fraction, self._sweep_edge(edge, x, path, radius))
        return fraction


Marks = list[Bool[Array, ""]] | Bool[Array, "vertices"]  # one per edge, as the edges themselves


def _seen_over(edge: Edge, x: Vec2) -> Closest:
    """The boundary as seen from `x`, which `edge` is nearest to; distance and normal come from that edge alone.

    Over an edge's interior the signed distance is linear and its sign is right inside and outside. At a vertex the
    sign follows the bisector (outside a convex vertex, inside a reflex one), which stays right for vertices that are
    almost straight.
    """
    s, clipped, diff = settle(edge.foot(x), x.x)
    over_edge = (s > 0) & (s < edge.length)
    bisector = select(s <= 0, Vec2(edge.bisector_a_x, edge.bisector_a_y), Vec2(edge.bisector_b_x, edge.bisector_b_y))
    squared = diff.dot(diff)
    on_vertex = squared <= jnp.finfo(squared.dtype).tiny
    length = jnp.sqrt(jnp.where(on_vertex, 1.0, squared))
    sign = jnp.where(bisector.dot(diff) >= 0, 1.0, -1.0)
    radial = select(on_vertex, bisector, diff.scale(sign / length))
    # on the vertex itself the distance is zero and, as gradient, gets the bisector
    vertex_distance = jnp.where(on_vertex, bisector.dot(diff), sign * length)
    normal = select(over_edge, edge.normal, radial)
    distance = jnp.where(over_edge, edge.normal.dot(x - edge.start), vertex_distance)
    return Closest(distance, edge.start + edge.along.scale(clipped), normal)


def _second_touch(edge: Edge, before: Edge, x: Vec2, first: tuple, gap: Scalar):
    """Whether an edge, or its start vertex, is another local minimum of the distance; and its squared distance.

    first: whether the nearest is the edge before, this one, the edge after; gap: the signed distance to it.

    A wall counts if `x` is over it and in front of it; one seen through the material is no place to rest at. A
    neighbour of the nearest edge meets it at a convex vertex, where they share the foot and there is but one
    minimum, or at a reflex one. In there, once `x` is on the outline or behind it, the neighbour counts also past its
    end: a point pressed a little into one wall is still stopped by the other.
    """
    s, _, diff = edge.foot(x)
    rel = x - edge.start
    loose = rounding(jnp.abs(rel.x) + jnp.abs(rel.y) + edge.length)
    straight = rounding(jnp.ones_like(gap))
    reflex_a, reflex_b = edge.turn_a < -straight, edge.turn_b < -straight
    is_before, is_this, is_after = first
    shares = (is_before & ~reflex_a) | (is_after & ~reflex_b)
    wedged = ((is_before & reflex_a) | (is_after & reflex_b)) & (gap <= loose)
    over = (s >= -loose) & (s <= edge.length + loose) & (edge.normal.dot(rel) >= -loose)
    wall = ~is_this & ~shares & (over | wedged)
    sector = (s <= 0) & (rel.dot(before.along) >= 0) & ~reflex_a
    return wall, sector & ~is_this & ~is_before & ~wall, diff.dot(diff)


class Polygon(Shape):
    """A simple polygon, convex or not, in the body frame.

    `vertices`: (vertices, 2), m, in either orientation, the first not repeated at the end. Stored
    counter-clockwise; the first vertex stays first. While the vertices are traced (under `jit`, `grad` or
    `vmap`) they are taken as they are and must be counter-clockwise already.

    `convex`: whether a finger touches it in one place only. None: determined from the vertices; where they are
    traced, not assumed. False for a convex polygon costs time and changes nothing.

    Raises ValueError for fewer than three vertices, NaN, repeated vertices, crossing edges, no area, or known vertices
    that are not convex, as `convex` says they are.
    """

    vertices: Float[Array, "vertices 2"]
    convex: bool = eqx.field(static=True)

    def __init__(self, vertices: Numeric, *, convex: bool | None = None):
        array = as_float(vertices)
        shaped("vertices", array, ("vertices", 2))
        if array.shape[0] < 3:
            raise ValueError(f"vertices: a polygon needs at least three; got {array.shape[0]}")
        finite("vertices", array)
        known = concrete(array)
        if known is not None:
            check_simple("vertices", known.astype(np.float64))
            if signed_area(known.astype(np.float64)) < 0:
                array = on_device(np.roll(known[::-1], 1, axis=0))
        self.vertices = array
        self.convex = _is_convex(array, convex)

    @staticmethod
    def rectangle(width: Numeric, height: Numeric) -> "Polygon":
        """A rectangle about the body origin: `width` along x, `height` along y, m."""
        dtype = common_dtype(width, height)
        w, h = as_float(width, dtype), as_float(height, dtype)
        for name, value in (("width", w), ("height", h)):
            shaped(name, value, ())
            finite(name, value)
            positive(name, value)
        return Polygon(_rectangle(w, h), convex=True)

    @staticmethod
    def regular(sides: int, circumradius: Numeric) -> "Polygon":
        """A regular polygon about the body origin, its first vertex on the +x axis, at `circumradius` m."""
        if sides < 3:
            raise ValueError(f"sides must be at least 3; got {sides}")
        radius = as_float(circumradius)
        shaped("circumradius", radius, ())
        finite("circumradius", radius)
        positive("circumradius", radius)
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
        edge = jnp.roll(self.vertices, -1, axis=0) - self.vertices
        return jnp.sum(jnp.hypot(edge[:, 0], edge[:, 1]))

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        closed = jnp.concatenate([self.vertices, self.vertices[:1]])
        edge = jnp.diff(closed, axis=0)
        arc = jnp.concatenate([jnp.zeros(1, edge.dtype), jnp.cumsum(jnp.hypot(edge[:, 0], edge[:, 1]))])
        at = (jnp.arange(points, dtype=edge.dtype) + 0.5) / points * arc[-1]
        return jnp.stack([jnp.interp(at, arc, closed[:, 0]), jnp.interp(at, arc, closed[:, 1])], axis=1)

    def inset(self, depth: Numeric) -> "Polygon":
        """The polygon with every edge moved inwards by `depth` m (negative: outwards). The edges must stay edges."""
        by = as_float(depth, self.vertices.dtype)
        edge = jnp.roll(self.vertices, -1, axis=0) - self.vertices
        normal = jnp.stack([edge[:, 1], -edge[:, 0]], axis=1) / jnp.linalg.norm(edge, axis=1, keepdims=True)
        before = jnp.roll(normal, 1, axis=0)
        # the corner's shift s has n.s = -depth for both of its edges' normals
        corner = (before + normal) / (1 + jnp.sum(before * normal, axis=1, keepdims=True))
        return Polygon(self.vertices - by * corner, convex=self.convex)

    def outline(self) -> PolygonOutline:
        v = self.vertices
        edge = jnp.roll(v, -1, axis=0) - v
        length = jnp.sqrt(jnp.sum(edge**2, axis=1))
        along = edge / length[:, None]
        normal = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
        bisector = normal + jnp.roll(normal, 1, axis=0)  # at each edge's start
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
    signs = xp.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]], width.dtype)
    return signs * xp.stack([width / 2, height / 2])[None]


@in_numpy
def _area(xp, vertices):
    # relative to the first vertex, so that a polygon far from the origin does not lose its digits
    a = vertices - vertices[:1]
    b = xp.roll(a, -1, axis=0)
    return xp.sum(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]) / 2


@in_numpy
def _centroid(xp, vertices):
    a = vertices - vertices[:1]  # as for the area
    b = xp.roll(a, -1, axis=0)
    twice = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    return vertices[0] + xp.sum((a + b) * twice[:, None], axis=0) / (3 * xp.sum(twice))


@in_numpy
def _bounds(xp, vertices):
    return xp.min(vertices, axis=0), xp.max(vertices, axis=0)


def _is_convex(vertices: Array, claimed: bool | None) -> bool:
    """Whether no vertex lies more than a rounding inside the line between its neighbours; as claimed, if traced."""
    known = concrete(vertices)
    if known is None:
        return bool(claimed)
    v = known.astype(np.float64)
    chord = np.roll(v, -1, axis=0) - np.roll(v, 1, axis=0)
    arm = v - np.roll(v, 1, axis=0)
    # how far each vertex lies outside that line; where there is none, the outline turns back on itself
    length = np.maximum(np.linalg.norm(chord, axis=1), np.finfo(np.float64).tiny)
    bulge = (arm[:, 0] * chord[:, 1] - arm[:, 1] * chord[:, 0]) / length
    inner = int(np.argmin(bulge))
    convex = bool(bulge[inner] >= -16 * float(jnp.finfo(vertices.dtype).eps) * np.max(np.abs(v)))
    if claimed and not convex:
        raise ValueError(f"convex is True, but the vertices are not: vertex {inner} is a reflex corner")
    return convex if claimed is None else bool(claimed)
