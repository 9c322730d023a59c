"""Discs."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, positive, shaped
from pushjax._vec import Scalar, Vec2, select
from pushjax.shapes._base import Closest, Outline, Shape, first_hit


class DiskOutline(Outline):
    center: Vec2
    radius: Scalar

    def closest(self, x: Vec2) -> Closest:
        rel = x - self.center
        squared = rel.dot(rel)
        at_center = squared <= jnp.finfo(squared.dtype).tiny
        length = jnp.sqrt(jnp.where(at_center, 1.0, squared))
        # every boundary point is closest to the centre; +x is as good as any, and finite
        aside = Vec2(jnp.ones_like(length), jnp.zeros_like(length))
        normal = select(at_center, aside, rel.scale(1 / length))
        distance = jnp.where(at_center, normal.dot(rel), length) - self.radius
        return Closest(distance, self.center + normal.scale(self.radius), normal)

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        return first_hit(x - self.center, path, self.radius + radius)


class Disk(Shape):
    """A disc of `radius` m about `center` (2,) m in the body frame.

    Raises ValueError for a radius that is not positive and finite, or a centre of another shape.
    """

    radius: Float[Array, ""]
    center: Float[Array, "2"]

    def __init__(self, radius: Numeric, center: Numeric = (0.0, 0.0)):
        dtype = common_dtype(radius, center)
        self.radius, self.center = as_float(radius, dtype), as_float(center, dtype)
        shaped("radius", self.radius, ())
        shaped("center", self.center, (2,))
        for name, value in (("radius", self.radius), ("center", self.center)):
            finite(name, value)
        positive("radius", self.radius)

    @property
    def area(self) -> Float[Array, ""]:
        return jnp.pi * self.radius**2

    @property
    def centroid(self) -> Float[Array, "2"]:
        return self.center

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        return self.center - self.radius, self.center + self.radius

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        angle = 2 * jnp.pi * (jnp.arange(points, dtype=self.radius.dtype) + 0.5) / points
        return self.center[None] + self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)

    def outline(self) -> DiskOutline:
        return DiskOutline(Vec2.of(self.center), self.radius)
