"""Polygons, convex or not."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, positive, shaped
from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.shapes._base import Closest, Outline, Shape, first_hit, rounding

# Up to this many edges the search over edges is written out, edge by edge, so that a batch vectorises across its
# examples; beyond it, an array over the edges keeps the compiled program small.
UNROLLED_EDGES = 12


class Edge(NamedTuple):
    """One edge, or an array of them: start, unit direction, length, and the bisecting normals at both ends."""

    start_x: Scalar
    start_y: Scalar
    along_x: Scalar
    along_y: Scalar
    length: Scalar
    bisector_a_x: Scalar
    bisector_a_y: Scalar
    bisector_b_x: Scalar
    bisector_b_y: Scalar

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

    def _nearest_edge(self, x: Vec2) -> Edge:
        if isinstance(self.edges, Edge):
            *_, diff = self.edges.foot(x)
            nearest = jnp.argmin(diff.dot(diff))
            return jax.tree.map(lambda field: field[nearest], self.edges)
        best, best_squared = self.edges[0], None
        for edge in self.edges:
            *_, diff = edge.foot(x)
            squared = diff.dot(diff)
            if best_squared is None:
                best_squared = squared
                continue
            nearer = settle(squared < best_squared, x.x)
            best = select(nearer, edge, best)
            best_squared = jnp.where(nearer, squared, best_squared)
        return best

    def closest(self, x: Vec2) -> Closest:
        """The search only chooses the edge; distance and normal then come from that edge alone.

        Over an edge's interior the signed distance is linear and its sign is right inside and outside. At a
        vertex the sign follows the bisector (outside a convex vertex, inside a reflex one), which stays right
        for vertices that are almost straight.
        """
        edge = self._nearest_edge(x)
        s, clipped, diff = edge.foot(x)
        over_edge = (s > 0) & (s < edge.length)
        bisector = select(
            s <= 0, Vec2(edge.bisector_a_x, edge.bisector_a_y), Vec2(edge.bisector_b_x, edge.bisector_b_y)
        )
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


class Polygon(Shape):
    """A simple polygon, convex or not, in the body frame.

    `vertices`: (vertices, 2), m, in either orientation, the first not repeated at the end. Stored
    counter-clockwise; the first vertex stays first. While the vertices are traced (under `jit`, `grad` or
    `vmap`) they are taken as they are and must be counter-clockwise already.

    Raises ValueError for fewer than three vertices, NaN, repeated vertices, crossing edges or no area.
    """

    vertices: Float[Array, "vertices 2"]

    def __init__(self, vertices: Numeric):
        array = as_float(vertices)
        shaped("vertices", array, ("vertices", 2))
        if array.shape[0] < 3:
            raise ValueError(f"vertices: a polygon needs at least three; got {array.shape[0]}")
        finite("vertices", array)
        known = concrete(array)
        if known is not None:
            _check_simple(known.astype(np.float64))
            if _signed_area(known.astype(np.float64)) < 0:
                array = jnp.roll(array[::-1], 1, axis=0)
        self.vertices = array

    @staticmethod
    def rectangle(width: Numeric, height: Numeric) -> "Polygon":
        """A rectangle about the body origin: `width` along x, `height` along y, m."""
        dtype = common_dtype(width, height)
        w, h = as_float(width, dtype), as_float(height, dtype)
        for name, value in (("width", w), ("height", h)):
            shaped(name, value, ())
            finite(name, value)
            positive(name, value)
        signs = jnp.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype)
        return Polygon(signs * jnp.stack([w / 2, h / 2])[None])

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
        return Polygon(radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1))

    @property
    def area(self) -> Float[Array, ""]:
        # relative to the first vertex, so that a polygon far from the origin does not lose its digits
        a = self.vertices - self.vertices[:1]
        b = jnp.roll(a, -1, axis=0)
        return jnp.sum(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]) / 2

    @property
    def centroid(self) -> Float[Array, "2"]:
        a = self.vertices - self.vertices[:1]  # as for the area
        b = jnp.roll(a, -1, axis=0)
        twice = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
        return self.vertices[0] + jnp.sum((a + b) * twice[:, None], axis=0) / (3 * jnp.sum(twice))

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        return jnp.min(self.vertices, axis=0), jnp.max(self.vertices, axis=0)

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

    def outline(self) -> PolygonOutline:
        v = self.vertices
        edge = jnp.roll(v, -1, axis=0) - v
        length = jnp.sqrt(jnp.sum(edge**2, axis=1))
        along = edge / length[:, None]
        normal = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
        bisector = normal + jnp.roll(normal, 1, axis=0)  # at each edge's start
        bisector = bisector / jnp.sqrt(jnp.sum(bisector**2, axis=1, keepdims=True))
        after = jnp.roll(bisector, -1, axis=0)
        edges = Edge(
            v[:, 0], v[:, 1], along[:, 0], along[:, 1], length, bisector[:, 0], bisector[:, 1], after[:, 0], after[:, 1]
        )
        if len(v) > UNROLLED_EDGES:
            return PolygonOutline(edges)
        return PolygonOutline(tuple(jax.tree.map(lambda field, i=i: field[i], edges) for i in range(len(v))))


def _signed_area(v: np.ndarray) -> float:
    rel = v - v[0]
    after = np.roll(rel, -1, axis=0)
    return float(np.sum(rel[:, 0] * after[:, 1] - after[:, 0] * rel[:, 1]) / 2)


def _check_simple(v: np.ndarray) -> None:
    """Raise unless the closed polyline `v` encloses an area without touching itself."""
    n, size = len(v), float(np.max(np.ptp(v, axis=0)))
    gap = np.linalg.norm(v[:, None] - v[None], axis=-1) + size * np.eye(n)
    if size == 0 or gap.min() <= 1e-9 * size:
        i, j = np.unravel_index(np.argmin(gap), gap.shape)
        raise ValueError(
            f"vertices: {int(min(i, j))} and {int(max(i, j))} are the same point; each corner is given once, and the "
            "first is not repeated at the end"
        )
    a, b = v, np.roll(v, -1, axis=0)

    def side(p, q, r):
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    p, q, r, s = a[:, None], b[:, None], a[None], b[None]
    crossing = (side(p, q, r) * side(p, q, s) < 0) & (side(r, s, p) * side(r, s, q) < 0)
    on_edge = _touches(p, q, r, 1e-9 * size)  # a vertex lying on an edge that is not its own
    index = np.arange(n)
    own = (index[None] == index[:, None]) | (index[None] == (index[:, None] + 1) % n)
    bad = crossing | (on_edge & ~own)
    if abs(_signed_area(v)) <= 1e-12 * size**2:
        raise ValueError(f"vertices enclose no area ({abs(_signed_area(v)):.3g} m^2)")
    if bad.any():
        i, j = np.argwhere(bad)[0]
        raise ValueError(f"vertices: the outline crosses or touches itself (edges {i} and {j}, counted from 0)")


def _touches(p: np.ndarray, q: np.ndarray, r: np.ndarray, tolerance: float) -> np.ndarray:
    edge = q - p
    s = np.clip(np.sum((r - p) * edge, axis=-1) / np.sum(edge**2, axis=-1), 0, 1)
    return np.linalg.norm(r - p - s[..., None] * edge, axis=-1) <= tolerance
