"""Base classes of shapes and of their outlines, and helpers that several shapes share."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, checked_array, common_dtype
from pushjax._math.vec import Scalar, Vec2

PAIRS_AT_ONCE = 2**20  # pairs of edges that are compared together


class ClosestPoint(NamedTuple):
    """Signed distance, closest boundary point and outward normal for one query point, in the body frame."""

    distance: Scalar  # m, negative inside
    point: Vec2  # m
    # At a corner, the normal lies along the line from the corner to the query point: toward the query point if that is
    # outside, away from it if that is inside. If the query point lies on the boundary, the normal is orthogonal to the
    # edge, or at a corner along the bisector.
    normal: Vec2


class FacingPoints(NamedTuple):
    """Points of an outline whose outward normal is a given direction, as arrays of static length with a mask."""

    point: Vec2  # m, body frame; the coordinates have shape (points,)
    valid: Bool[Array, "points"]  # the other entries are padding


class Outline(eqx.Module):
    """The boundary of a shape, prepared for the distance queries of contact detection."""

    # Its methods take and return `Vec2` instead of arrays; `pushjax._math.vec` gives the reason. Whatever does not
    # depend on the query point is computed once, when `Shape.outline` creates the outline.

    max_rests: ClassVar[int] = 2  # number of places in which a straight edge may touch at the same time

    @property
    @abstractmethod
    def is_convex(self) -> bool:
        """Whether the outline is known to be convex."""

    @property
    def max_touches(self) -> int:
        """Number of places in which a round finger may touch at the same time, as `contact_candidates` finds them."""
        return 1 if self.is_convex else 2

    @abstractmethod
    def closest(self, x: Vec2) -> ClosestPoint:
        """Return the signed distance, closest point and outward normal for the query point `x`, m, body frame."""

    def contact_candidates(self, x: Vec2) -> tuple[ClosestPoint, ...]:
        """Return all points at which a round finger centered at `x` can touch at the same time, nearest first."""
        # The first is `closest(x)`. An outline that may not be convex returns a second one, for a finger wedged in a
        # concave corner: the nearest of the other boundary points that face `x` and are local minima of the distance
        # to `x`. Its distance is negative if `x` is behind the edge on which the point lies. If there is no such point,
        # the second candidate repeats the point and normal of the first. Its distance is then the first distance plus
        # the perimeter, which is out of reach of any finger.
        return (self.closest(x),)

    def pieces(self, x: Vec2) -> tuple[Float[Array, "pieces"], Vec2 | None]:
        """Return the distances of `x` from convex pieces of the shape, m, and the unit vectors to `x` from there."""
        # The pieces together have the boundary of the shape. If none are known, there is one, and no unit vectors.
        found = self.closest(x)
        return found.distance[None], jax.tree.map(lambda n: n[None], found.normal) if self.is_convex else None

    @abstractmethod
    def facing(self, direction: Vec2) -> FacingPoints:
        """Return the corners, or the locally convex points whose outward normal is the unit vector `direction`."""
        # A straight edge that is orthogonal to `direction` and lies outside the outline can rest on these points.


class OvalOutline(Outline):
    """A smooth convex outline, which faces each direction in one point."""

    max_rests: ClassVar[int] = 1

    @property
    def is_convex(self) -> bool:
        return True


class Shape(eqx.Module):
    """Base class for the shape of a rigid planar slider, in its body frame, in m."""

    @abstractmethod
    def outline(self) -> Outline:
        """Return the boundary, prepared for distance queries."""

    def is_valid(self) -> Bool[Array, ""]:
        """Return whether the numbers of the shape describe a shape, also if they were traced at its creation."""
        return jnp.ones((), bool)

    @property
    @abstractmethod
    def area(self) -> Float[Array, ""]:
        """Enclosed area, m^2."""

    @property
    @abstractmethod
    def centroid(self) -> Float[Array, "2"]:
        """Centroid of the area in the body frame, m."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Lower and upper corner of the axis-aligned box around the shape, m."""

    @abstractmethod
    def boundary(self, points: int) -> Float[Array, "points 2"]:
        """Sample points equally spaced along the outline.

        Args:
            points: Number of points.

        Returns:
            The points in counterclockwise order, shape (points, 2), m, body frame.
        """

    def closest(self, point: ArrayLike) -> tuple[Float[Array, ""], Float[Array, "2"], Float[Array, "2"]]:
        """Find the signed distance, closest boundary point and outward unit normal for a body point.

        Use `vmap` for batches of points. The distance is differentiable in the point and in the parameters of the
        shape. The exceptions are the medial axis and the corners themselves: there the gradient belongs to one
        neighboring feature, and is finite.

        Args:
            point: Query point, shape (2,), m, body frame.

        Returns:
            A tuple of the signed distance (m, negative inside), the closest boundary point, shape (2,), m, and the
            outward unit normal, shape (2,). Both vectors are in the body frame.

        Raises:
            ValueError: If `point` has another shape, or is NaN or infinite.
        """
        query = checked_array("point", point, (2,), common_dtype(self, point))
        found = self.outline().closest(Vec2.of(query))
        return found.distance, found.point.array(), found.normal.array()

    def signed_distance(self, point: ArrayLike) -> Float[Array, ""]:
        """Compute the signed distance from a body point to the outline.

        Args:
            point: Query point, shape (2,), m, body frame.

        Returns:
            Distance, m, negative inside.

        Raises:
            ValueError: If `point` has another shape, or is NaN or infinite.
        """
        return self.closest(point)[0]

    def contains(self, point: ArrayLike) -> Array:
        """Test whether a body point lies inside or on the outline.

        Args:
            point: Query point, shape (2,), m, body frame.

        Returns:
            Boolean scalar.

        Raises:
            ValueError: If `point` has another shape, or is NaN or infinite.
        """
        return self.signed_distance(point) <= 0


def roundoff(size: Scalar) -> Scalar:
    """Return a bound on the roundoff of a few operations on numbers of magnitude up to `size`."""
    return 16 * jnp.finfo(size.dtype).eps * size


def gauss_legendre(dtype: Any) -> tuple[Float[Array, "5"], Float[Array, "5"]]:
    """Return nodes and weights on the unit interval that integrate polynomials up to degree nine exactly."""
    nodes, weights = (jnp.asarray(part / 2, dtype) for part in np.polynomial.legendre.leggauss(5))
    return nodes + 0.5, weights


def equally_spaced(
    speed: Callable[[Array], Array], nodes: Float[Array, "nodes"], points: int
) -> tuple[Float[Array, "points"], Float[Array, ""]]:
    """Return parameters of points equally spaced in arc length along a closed smooth outline, and its length, m."""
    # `speed` maps parameters to the derivative of the arc length. The nodes increase from start to end, so densely that
    # the speed is smooth between two of them.
    nodes_in_unit, weights = gauss_legendre(nodes.dtype)

    def arc_length(start, width):
        """Return the lengths from `start` to `start + width`."""
        return width * jnp.sum(weights[None] * speed(start[:, None] + width[:, None] * nodes_in_unit[None]), axis=1)

    width = jnp.diff(nodes)
    arc_at_node = jnp.concatenate([jnp.zeros(1, nodes.dtype), jnp.cumsum(arc_length(nodes[:-1], width))])
    # The first point is half a spacing from the start.
    wanted = (jnp.arange(points, dtype=nodes.dtype) + 0.5) / points * arc_at_node[-1]
    node = jnp.clip(jnp.searchsorted(arc_at_node, wanted, side="right") - 1, 0, width.size - 1)
    start, remaining, full_width = nodes[node], wanted - arc_at_node[node], width[node]
    offset = full_width * remaining / (arc_at_node[node + 1] - arc_at_node[node])
    for _ in range(4):  # Newton's method; the speed hardly changes between two nodes
        offset = jnp.clip(offset + (remaining - arc_length(start, offset)) / speed(start + offset), 0, full_width)
    return start + offset, arc_at_node[-1]


def is_outline(vertices: Float[Array, "vertices 2"], convex: bool) -> Bool[Array, ""]:
    """Return whether a closed polyline runs once around an area, counterclockwise, and is convex if that is claimed."""
    # Only the check of convexity excludes that edges cross that are not neighbors.
    vertices = jax.lax.stop_gradient(vertices)
    before = vertices - jnp.roll(vertices, 1, axis=0)
    after = jnp.roll(before, -1, axis=0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    size = jnp.max(jnp.abs(vertices - vertices[:1]))
    turn = jnp.sum(jnp.arctan2(cross, jnp.sum(before * after, axis=1)))
    has_area = signed_area(jnp, vertices) > roundoff(size * size)
    valid = jnp.all(jnp.sum(before**2, axis=1) > 0) & has_area & (jnp.abs(turn - 2 * jnp.pi) < 1)
    return valid & jnp.all(cross >= -roundoff(size * jnp.hypot(after[:, 0], after[:, 1]))) if convex else valid


def signed_area(xp: Any, vertices: Any) -> Any:
    """Return the signed area of a closed polyline (vertices, 2), m^2, positive if it runs counterclockwise."""
    # Vertices are relative to the first one, so that a polygon far from the origin does not lose digits.
    start = vertices - vertices[:1]
    end = xp.roll(start, -1, axis=0)
    return xp.sum(start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1]) / 2


def check_simple_polygon(name: str, v: np.ndarray) -> None:
    """Raise ValueError unless a closed polyline (vertices, 2) encloses an area and does not touch itself."""
    size = float(np.max(np.ptp(v, axis=0)))
    near = 1e-9 * size
    pairs = np.concatenate(list(_edges_that_may_meet(v, near)))
    gap = np.linalg.norm(v[pairs[:, 0]] - v[pairs[:, 1]], axis=1)
    if gap.min() <= near:
        i, j = pairs[np.argmin(gap)]
        raise ValueError(
            f"{name}: {i} and {j} are the same point; each corner is given once, and the first is not repeated at the "
            "end"
        )
    if np.linalg.svd(v - v.mean(axis=0), full_matrices=False, compute_uv=False)[1] <= 1e-12 * size:
        raise ValueError(f"{name} lie on one line and enclose no area")
    crossed = find_self_intersection(v, near)
    if crossed is not None:
        first, second = (f"the edge from vertex {k} to vertex {(k + 1) % len(v)}" for k in crossed)
        raise ValueError(f"{name}: the outline crosses or touches itself: {first}, and {second}, counted from 0")


def find_self_intersection(v: np.ndarray, tolerance: float) -> tuple[int, int] | None:
    """Return the indices of two edges of a closed polyline that cross or touch off a shared vertex, or None."""
    n, end = len(v), np.roll(v, -1, axis=0)

    def orientation(p, q, r):
        """Return twice the signed area of the triangle (p, q, r), positive if r lies to the left of p q."""
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    for pairs in _edges_that_may_meet(v, tolerance):
        i, j = pairs.T
        p, q, r, s = v[i], end[i], v[j], end[j]
        touching = (orientation(p, q, r) * orientation(p, q, s) < 0) & (orientation(r, s, p) * orientation(r, s, q) < 0)
        for k, other in ((i, j), (j, i)):  # a vertex within `tolerance`, m, of an edge not its own
            on_edge = _is_near_segment(v[k], end[k], v[other], tolerance)
            touching |= on_edge & (other != (k + 1) % n)
        if touching.any():
            first, second = pairs[np.argmax(touching)]
            return int(first), int(second)
    return None


def _edges_that_may_meet(v: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """Yield the pairs of edges of a closed polyline that overlap along x, or along y if fewer do, as rows (i, j)."""
    end, n = np.roll(v, -1, axis=0), len(v)
    low, high = np.minimum(v, end), np.maximum(v, end) + tolerance
    orders = np.argsort(low, axis=0, kind="stable")
    lasts = [np.searchsorted(low[orders[:, k], k], high[orders[:, k], k], side="right") for k in range(2)]
    axis = int(np.argmin([last.sum() for last in lasts]))
    order, partners = orders[:, axis], lasts[axis] - np.arange(n) - 1
    ends = np.cumsum(partners)
    for first in range(0, n, PAIRS_AT_ONCE // n + 1):  # as many edges as have no more pairs than fit
        rows = np.arange(first, min(first + PAIRS_AT_ONCE // n + 1, n))
        count = partners[rows]
        i = np.repeat(rows, count)
        j = i + 1 + np.arange(len(i)) - np.repeat(ends[rows] - count - (ends[rows[0]] - count[0]), count)
        yield np.sort(np.stack([order[i], order[j]], axis=1), axis=1)


def _is_near_segment(p: np.ndarray, q: np.ndarray, r: np.ndarray, tolerance: float) -> np.ndarray:
    """Return whether each point `r` lies within `tolerance` of the segment from `p` to `q`; arrays broadcast."""
    edge = q - p
    fraction = np.clip(np.sum((r - p) * edge, axis=-1) / np.sum(edge**2, axis=-1), 0, 1)
    return np.linalg.norm(r - p - fraction[..., None] * edge, axis=-1) <= tolerance
