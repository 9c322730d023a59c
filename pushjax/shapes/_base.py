"""What a shape must be able to answer."""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, shaped
from pushjax._vec import Scalar, Vec2


class Closest(NamedTuple):
    """The boundary as seen from a point: signed distance (negative inside), closest point, outward unit normal.

    At a corner the normal points from the corner to the query point; at the query point's own place on the
    boundary it is the edge's normal, at a corner the bisector.
    """

    distance: Scalar
    point: Vec2
    normal: Vec2


class Facing(NamedTuple):
    """Places of an outline, as arrays, and which of them there are."""

    point: Vec2
    real: Bool[Array, "places"]


class Outline(eqx.Module):
    """A shape prepared for queries: everything that does not depend on the query point is worked out once."""

    @abstractmethod
    def closest(self, x: Vec2) -> Closest:
        """The boundary as seen from the body point `x`."""

    def touches(self, x: Vec2) -> tuple[Closest, ...]:
        """All places where a round finger about the body point `x` may rest at once; how many there are is static.

        The first is `closest(x)`. Outlines that may not be convex have a second: the next nearest local minimum of the
        distance that faces `x`, as of a finger wedged in a concave corner. Its sign is that of its own side: negative
        where `x` is behind it. Where there is none, its distance is the first's plus the perimeter, out of any
        finger's reach, and its point and normal are the first's.
        """
        return (self.closest(x),)

    @abstractmethod
    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        """The fraction of `path` after which a disc of `radius` that starts at `x` first touches.

        Starts outside, or touching to rounding (then 0, if it approaches). Infinite where it does not touch within
        the path. Exact for any length of path, so nothing tunnels.
        """

    def facing(self, direction: Vec2) -> Facing:
        """Where the outward normal of a smooth outline is the unit vector `direction` and it curves away from there:
        what a straight edge on that side may rest on."""
        raise NotImplementedError(f"{type(self).__name__} has corners")


class Shape(eqx.Module):
    """A rigid planar slider's outline, in its body frame, in m."""

    @abstractmethod
    def outline(self) -> Outline:
        """The form that queries run on."""

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
        """`points` points equally spaced along the outline, counter-clockwise, m."""

    def closest(self, point: Numeric) -> tuple[Float[Array, ""], Float[Array, "2"], Float[Array, "2"]]:
        """Signed distance (m, negative inside), closest boundary point and outward unit normal of a body point.

        `point` has shape (2,); batches come from `vmap`. The distance is differentiable in the point and in the
        shape's own parameters, everywhere but on the medial axis and at a corner itself, where the gradient is
        that of one neighbouring feature, and finite.

        Raises ValueError for a point of another shape, or one that is NaN or infinite.
        """
        query = as_float(point, common_dtype(self, point))
        shaped("point", query, (2,))
        finite("point", query)
        found = self.outline().closest(Vec2.of(query))
        return found.distance, found.point.array(), found.normal.array()

    def signed_distance(self, point: Numeric) -> Float[Array, ""]:
        """Distance of a body point (2,) to the outline in m, negative inside."""
        return self.closest(point)[0]

    def contains(self, point: Numeric) -> Array:
        """Whether a body point (2,) lies inside or on the outline."""
        return self.signed_distance(point) <= 0


def first_hit(x: Vec2, path: Vec2, reach: Scalar) -> Scalar:
    """Fraction of `path` at which a point moving from `x` comes within `reach` of the origin; inf if it does not.

    The smaller root of |x + t path|^2 = reach^2, written so that it does not cancel; only for an approaching
    start outside, or as little inside as rounding puts it.
    """
    a = path.dot(path)
    b = x.dot(path)
    squared = x.dot(x)
    c = squared - reach * reach
    # b^2 - a c, which far away is a small difference of large numbers
    side = x.cross(path)
    disc = a * reach * reach - side * side
    hits = (b < 0) & (c >= -rounding(16 * squared)) & (disc > 0)
    root = jnp.sqrt(jnp.where(hits, disc, 1.0))
    fraction = jnp.maximum(c / jnp.where(hits, root - b, 1.0), 0)
    return jnp.where(hits & (fraction <= 1), fraction, jnp.inf)


def rounding(size: Scalar) -> Scalar:
    """What a handful of operations on numbers up to `size` may be wrong by."""
    return 16 * jnp.finfo(size.dtype).eps * size


def equally_spaced(
    speed: Callable[[Array], Array], nodes: Float[Array, "nodes"], points: int
) -> tuple[Float[Array, "points"], Float[Array, ""]]:
    """Parameters of `points` points equally spaced in arc length along a closed smooth outline, and its length.

    speed: arc length per parameter, of an array of parameters; nodes: increasing parameters from start to end, so
    dense that the speed is smooth between two. The first point is half a spacing from the start.
    """
    at, weights = (jnp.asarray(part / 2, nodes.dtype) for part in np.polynomial.legendre.leggauss(5))
    at = at + 0.5

    def along(start, width):
        """Arc length from each start over its width."""
        return width * jnp.sum(weights[None] * speed(start[:, None] + width[:, None] * at[None]), axis=1)

    width = jnp.diff(nodes)
    arc = jnp.concatenate([jnp.zeros(1, nodes.dtype), jnp.cumsum(along(nodes[:-1], width))])
    wanted = (jnp.arange(points, dtype=nodes.dtype) + 0.5) / points * arc[-1]
    node = jnp.clip(jnp.searchsorted(arc, wanted, side="right") - 1, 0, width.size - 1)
    start, rest, most = nodes[node], wanted - arc[node], width[node]
    offset = most * rest / (arc[node + 1] - arc[node])
    for _ in range(4):  # Newton; the speed hardly changes between two nodes
        offset = jnp.clip(offset + (rest - along(start, offset)) / speed(start + offset), 0, most)
    return start + offset, arc[-1]


def signed_area(v: np.ndarray) -> float:
    rel = v - v[0]
    after = np.roll(rel, -1, axis=0)
    return float(np.sum(rel[:, 0] * after[:, 1] - after[:, 0] * rel[:, 1]) / 2)


def check_simple(name: str, v: np.ndarray) -> None:
    """Raise unless the closed polyline `v`, the argument `name`, encloses an area without touching itself."""
    n, size = len(v), float(np.max(np.ptp(v, axis=0)))
    gap = np.linalg.norm(v[:, None] - v[None], axis=-1) + size * np.eye(n)
    if size == 0 or gap.min() <= 1e-9 * size:
        i, j = np.unravel_index(np.argmin(gap), gap.shape)
        raise ValueError(
            f"{name}: {int(min(i, j))} and {int(max(i, j))} are the same point; each corner is given once, and the "
            "first is not repeated at the end"
        )
    if abs(signed_area(v)) <= 1e-12 * size**2:
        raise ValueError(f"{name} enclose no area ({abs(signed_area(v)):.3g} m^2)")
    crossed = crossing(v, 1e-9 * size)
    if crossed is not None:
        i, j = crossed
        raise ValueError(f"{name}: the outline crosses or touches itself (edges {i} and {j}, counted from 0)")


def crossing(v: np.ndarray, tolerance: float) -> tuple[int, int] | None:
    """Two edges of a closed polyline that cross or touch, other than at the vertex they share; None if there are none.

    tolerance: the distance, m, within which a vertex touches an edge.
    """
    n = len(v)
    a, b = v, np.roll(v, -1, axis=0)

    def side(p, q, r):
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    p, q, r, s = a[:, None], b[:, None], a[None], b[None]
    crossing = (side(p, q, r) * side(p, q, s) < 0) & (side(r, s, p) * side(r, s, q) < 0)
    on_edge = _touches(p, q, r, tolerance)  # a vertex lying on an edge that is not its own
    index = np.arange(n)
    own = (index[None] == index[:, None]) | (index[None] == (index[:, None] + 1) % n)
    bad = crossing | (on_edge & ~own)
    if not bad.any():
        return None
    i, j = np.argwhere(bad)[0]
    return int(i), int(j)


def _touches(p: np.ndarray, q: np.ndarray, r: np.ndarray, tolerance: float) -> np.ndarray:
    edge = q - p
    s = np.clip(np.sum((r - p) * edge, axis=-1) / np.sum(edge**2, axis=-1), 0, 1)
    return np.linalg.norm(r - p - s[..., None] * edge, axis=-1) <= tolerance
