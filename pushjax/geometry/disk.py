"""Disks."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, checked_array, common_dtype
from pushjax._internal.xla import tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, FacingPoints, OvalOutline, Shape


class DiskOutline(OvalOutline):
    """Outline of a disk, in m in the body frame."""

    center: Vec2
    radius: Scalar

    def closest(self, x: Vec2) -> ClosestPoint:
        offset = x - self.center
        squared = offset.dot(offset)
        at_center = squared <= jnp.finfo(squared.dtype).tiny
        length = jnp.sqrt(jnp.where(at_center, 1.0, squared))
        # At the center all boundary points are equally close. The choice of +x keeps the result finite.
        plus_x = Vec2(jnp.ones_like(length), jnp.zeros_like(length))
        normal = tree_where(at_center, plus_x, offset.scale(1 / length))
        distance = jnp.where(at_center, normal.dot(offset), length) - self.radius
        return ClosestPoint(distance, self.center + normal.scale(self.radius), normal)

    def facing(self, direction: Vec2) -> FacingPoints:
        point = self.center + direction.scale(self.radius)
        return FacingPoints(jax.tree.map(lambda entry: entry[None], point), jnp.ones(1, bool))


class Disk(Shape):
    """A disk.

    Attributes:
        radius: Radius, m, positive.
        center: Center in the body frame, shape (2,), m. Default: the body origin.

    Raises:
        ValueError: If the radius is not a positive finite scalar, or the center has another shape or is not finite.
    """

    radius: Float[Array, ""]
    center: Float[Array, "2"]

    def __init__(self, radius: ArrayLike, center: ArrayLike = (0.0, 0.0)):
        dtype = common_dtype(radius, center)
        self.radius = checked_array("radius", radius, (), dtype, positive=True)
        self.center = checked_array("center", center, (2,), dtype)

    def is_valid(self) -> Bool[Array, ""]:
        return jax.lax.stop_gradient(self.radius) > 0

    @property
    def area(self) -> Float[Array, ""]:
        return jnp.pi * self.radius**2

    @property
    def centroid(self) -> Float[Array, "2"]:
        return self.center

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        return self.center - self.radius, self.center + self.radius

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outline, m."""
        return 2 * jnp.pi * self.radius

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        angle = 2 * jnp.pi * (jnp.arange(points, dtype=self.radius.dtype) + 0.5) / points
        return self.center[None] + self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)

    def outline(self) -> DiskOutline:
        return DiskOutline(Vec2.of(self.center), self.radius)
