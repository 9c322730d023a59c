"""What a shape must be able to answer."""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

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


class Outline(eqx.Module):
    """A shape prepared for queries: everything that does not depend on the query point is worked out once."""

    @abstractmethod
    def closest(self, x: Vec2) -> Closest:
        """The boundary as seen from the body point `x`."""

    @abstractmethod
    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        """The fraction of `path` after which a disc of `radius` that starts at `x` first touches.

        Starts outside, or touching to rounding (then 0, if it approaches). Infinite where it does not touch within
        the path. Exact for any length of path, so nothing tunnels.
        """


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
