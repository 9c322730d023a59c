"""Vectors of three, and matrices of three by three, along the first axes of arrays, with any axes after them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._math.sums import repeated, summed

# The products F_i F_j of a vector's components, and so the entries of a symmetric matrix.
ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
FULL = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]], np.int32)  # where the entries of the matrix stand among the six


def dot(a: Float[Array, "3 *rest"], b: Float[Array, "3 *rest"]) -> Float[Array, "*rest"]:
    """Dot products."""
    return summed(a * b, 0)


def cross(a: Float[Array, "3 *rest"], b: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Cross products."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def times(matrix: Float[Array, "3 3 *rest"], v: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Products of symmetric matrices and vectors."""
    return summed(matrix * repeated(v, 1, 3), 0)


def solve(matrix: Float[Array, "3 3 *rest"], v: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Solutions u of matrix u = v for symmetric matrices; zero where |det| <= eps^2 |trace|^3."""
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    return combined(dual(matrix, jnp.finfo(v.dtype).eps ** 2 * jnp.abs(trace) ** 3)[0], v)


def dual(
    vectors: Float[Array, "3 3 *rest"], least: float | Float[Array, "*rest"]
) -> tuple[Float[Array, "3 3 *rest"], Bool[Array, "*rest"]]:
    """The dual bases of three vectors each, (vector, component), and whether |det| > `least`; zero where it is not."""
    v1, v2, v3 = vectors
    crosses = jnp.stack([cross(v2, v3), cross(v3, v1), cross(v1, v2)])
    det = dot(v1, crosses[0])
    regular = jnp.abs(det) > least
    return crosses * jnp.where(regular, 1 / jnp.where(regular, det, 1.0), 0.0)[None, None], regular


def products(vectors: Float[Array, "n 3 *rest"], v: Float[Array, "3 *rest"]) -> Float[Array, "n *rest"]:
    """Dot products of vectors, (vector, component), with v."""
    return summed(vectors * repeated(v, 0, len(vectors)), 1)


def combined(vectors: Float[Array, "n 3 *rest"], weight: Float[Array, "n *rest"]) -> Float[Array, "3 *rest"]:
    """The sum of vectors, (vector, component), times weights."""
    return summed(vectors * repeated(weight, 1, 3), 0)


def unit(v: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Unit vectors; zero stays zero."""
    squared = dot(v, v)
    positive = squared > 0
    return v * jnp.where(positive, 1 / jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)[None]
