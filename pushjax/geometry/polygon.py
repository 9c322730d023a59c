"""Polygons, convex or not."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, checked_array, common_dtype, concrete, in_numpy, on_device
from pushjax.geometry.polygon_outline import Edge, PolygonOutline
from pushjax.geometry.shape import Shape, check_simple_polygon, is_outline, signed_area


class Polygon(Shape):
    """A simple polygon in the body frame, convex or not.

    The vertices are stored counterclockwise, and the first vertex stays first. While they are traced (under `jit`,
    `grad` or `vmap`), they are taken as they are and must be counterclockwise already.

    Args:
        vertices: Vertices, shape (vertices, 2), m, at least three, in either orientation. The first vertex is not
            repeated at the end.
        convex: Whether the polygon is convex, so that a finger touches it in one place only. None: determined from the
            vertices; if they are traced, convexity is not assumed. False for a convex polygon costs time, and
            gives a finger room for two contacts, but does not change the motion.

    Raises:
        ValueError: If there are fewer than three vertices, or NaN or repeated vertices among them; if edges cross; if
            the polygon has no area; or if the vertices are known and not convex although `convex` is True.
    """

    vertices: Float[Array, "vertices 2"]
    convex: bool = eqx.field(static=True)

    def __init__(self, vertices: ArrayLike, *, convex: bool | None = None):
        array = checked_array("vertices", vertices, ("vertices", 2))
        if array.shape[0] < 3:
            raise ValueError(f"vertices: a polygon needs at least three; got {array.shape[0]}")
        known = concrete(array)
        if known is not None:
            check_simple_polygon("vertices", known.astype(np.float64))
            if signed_area(np, known.astype(np.float64)) < 0:
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
        w = checked_array("width", width, (), dtype, positive=True)
        h = checked_array("height", height, (), dtype, positive=True)
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
        radius = checked_array("circumradius", circumradius, (), positive=True)
        angle = 2 * jnp.pi * jnp.arange(sides, dtype=radius.dtype) / sides
        return Polygon(radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1), convex=True)

    def is_valid(self) -> Bool[Array, ""]:
        return is_outline(self.vertices, self.convex)

    @property
    def area(self) -> Float[Array, ""]:
        return in_numpy(signed_area)(self.vertices)

    @property
    def centroid(self) -> Float[Array, "2"]:
        return _centroid(self.vertices)

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        return in_numpy(lambda xp, vertices: (xp.min(vertices, axis=0), xp.max(vertices, axis=0)))(self.vertices)

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outline, m."""
        edge = jnp.roll(self.vertices, -1, axis=0) - self.vertices
        return jnp.sum(jnp.hypot(edge[:, 0], edge[:, 1]))

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        closed = jnp.concatenate([self.vertices, self.vertices[:1]])
        edge = jnp.diff(closed, axis=0)
        arc_length = jnp.concatenate([jnp.zeros(1, edge.dtype), jnp.cumsum(jnp.hypot(edge[:, 0], edge[:, 1]))])
        wanted = (jnp.arange(points, dtype=edge.dtype) + 0.5) / points * arc_length[-1]
        return jnp.stack([jnp.interp(wanted, arc_length, coordinate) for coordinate in closed.T], axis=1)

    def inset(self, depth: ArrayLike) -> "Polygon":
        """Move every edge of the polygon inward.

        Args:
            depth: Distance by which each edge moves inward, m; negative moves it outward. It must be small enough
                that no edge vanishes.

        Returns:
            The polygon between the moved edges.

        Raises:
            ValueError: If `depth` is not a finite scalar, or so large that an edge vanishes or the moved edges cross.
                Not checked for traced values.
        """
        distance = checked_array("depth", depth, (), self.vertices.dtype)
        edge = jnp.roll(self.vertices, -1, axis=0) - self.vertices
        normal = jnp.stack([edge[:, 1], -edge[:, 0]], axis=1) / jnp.linalg.norm(edge, axis=1, keepdims=True)
        previous_normal = jnp.roll(normal, 1, axis=0)
        # The shift of a corner for an outward distance of one: n . corner_shift = 1 for the normals n of both edges.
        corner_shift = (previous_normal + normal) / (1 + jnp.sum(previous_normal * normal, axis=1, keepdims=True))
        vertices = self.vertices - distance * corner_shift
        remaining = concrete(jnp.sum((jnp.roll(vertices, -1, axis=0) - vertices) * edge, axis=1))
        if remaining is not None and not np.all(remaining > 0):
            raise ValueError(f"depth: {float(distance):g} m is too much, edge {int(np.argmin(remaining))} vanishes")
        return Polygon(vertices, convex=self.convex)

    def outline(self) -> PolygonOutline:
        return PolygonOutline(Edge.of(self.vertices), self.convex)


@in_numpy
def _rectangle(xp, width, height):
    """Return the vertices of a rectangle about the origin, counterclockwise, shape (4, 2), m."""
    signs = xp.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]], width.dtype)
    return signs * xp.stack([width / 2, height / 2])[None]


@in_numpy
def _centroid(xp, vertices):
    """Return the centroid of the area, shape (2,), m."""
    start = vertices - vertices[:1]  # relative, as in `signed_area`
    end = xp.roll(start, -1, axis=0)
    double_area = start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1]
    return vertices[0] + xp.sum((start + end) * double_area[:, None], axis=0) / (3 * xp.sum(double_area))


def _is_convex(vertices: Array, claimed: bool | None) -> bool:
    """Return whether no vertex lies inside the line between its neighbors, up to roundoff; if traced, `claimed`."""
    known = concrete(vertices)
    if known is None:
        return bool(claimed)
    points = known.astype(np.float64)
    chord = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    from_previous = points - np.roll(points, 1, axis=0)
    # How far each vertex lies outside the line between its neighbors, m. If these coincide, the chord has length
    # zero, because the outline turns back on itself.
    length = np.maximum(np.linalg.norm(chord, axis=1), np.finfo(np.float64).tiny)
    bulge = (from_previous[:, 0] * chord[:, 1] - from_previous[:, 1] * chord[:, 0]) / length
    innermost = int(np.argmin(bulge))
    convex = bool(bulge[innermost] >= -16 * float(jnp.finfo(vertices.dtype).eps) * np.max(np.abs(points)))
    if claimed and not convex:
        raise ValueError(
            f"convex is True, but the vertices are not: vertex {innermost}, counted counterclockwise from 0, "
            "is a reflex corner"
        )
    return convex if claimed is None else bool(claimed)
