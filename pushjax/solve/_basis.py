"""Three vectors as a basis: solving with them as rows or as columns, by cross products."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec3, select, settle, weighted


class Basis(NamedTuple):
    """Three vectors, and their cross products, which over the determinant are the dual basis.

    regular: whether the determinant's size is above `least` (as given to `of`); where not, every solution is zero.
    """

    vectors: tuple[Vec3, Vec3, Vec3]
    crosses: tuple[Vec3, Vec3, Vec3]
    det: Scalar
    inverse: Scalar
    regular: Bool[Array, ""]

    @staticmethod
    def of(v1: Vec3, v2: Vec3, v3: Vec3, least: Scalar | float) -> "Basis":
        x1, x2, x3 = v2.cross(v3), v3.cross(v1), v1.cross(v2)
        det = v1.dot(x1)
        regular = jnp.abs(det) > least
        inverse = jnp.where(regular, 1.0 / jnp.where(regular, det, 1.0), 0.0)
        return Basis((v1, v2, v3), (x1, x2, x3), det, inverse, regular)

    def products(self, v: Vec3) -> Vec3:
        """vector_i . v."""
        return Vec3(*(vector.dot(v) for vector in self.vectors))

    def with_products(self, b: Vec3) -> Vec3:
        """v with vector_i . v = b_i."""
        return weighted(self.crosses, b).scale(self.inverse)

    def total(self, weight: Vec3) -> Vec3:
        """sum of weight_i vector_i."""
        return weighted(self.vectors, weight)

    def weights(self, v: Vec3) -> Vec3:
        """The weights with sum of weight_i vector_i = v."""
        return Vec3(*(cross.dot(v) for cross in self.crosses)).scale(self.inverse)


def completed(v1: Vec3, v2: Vec3, v3: Vec3, used2: Bool[Array, ""], used3: Bool[Array, ""], relative: float) -> Basis:
    """A basis of the vectors in use, v1 among them and none used after one that is not; at right angles to them, so
    that nothing goes that way, directions in place of the others. Regular where |det| is above `relative` times the
    three lengths."""
    zero = jnp.zeros_like(v1.x)
    aside = select(jnp.abs(v1.x) > jnp.abs(v1.y), Vec3(-v1.y, v1.x, zero), Vec3(zero, -v1.z, v1.y))
    v2 = select(used2, v2, aside)
    v3 = select(used3, v3, v1.cross(v2))
    v1, v2, v3 = settle((v1, v2, v3), v1.x)
    return Basis.of(v1, v2, v3, relative * jnp.sqrt(v1.dot(v1) * v2.dot(v2) * v3.dot(v3)))
