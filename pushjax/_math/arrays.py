"""Vectors of three, and matrices of three by three, along the first axes of arrays, with any axes after them.

A sum over an axis is one operation of XLA, which its fusions do not compute twice. So two copies of a comparison agree,
and programs stay small. Sums that are written out entry by entry have neither property.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float

# The products F_i F_j of a vector's components, and so the entries of a symmetric matrix.
ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
FULL = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # where the entries of the matrix stand among the six


def summed(terms: Float[Array, "..."], axis: int | tuple[int, ...]) -> Float[Array, "..."]:
    """The sum of terms along axes."""
    return _sum_p.bind(terms, axes=tuple(a % terms.ndim for a in np.atleast_1d(axis).tolist()))


# XLA of JAX 0.11 and 0.12 hands small sums of float32 to a library that takes up to twenty times as long, with which a
# jaw's step takes three times as long. It does not know the form of a sum that `_sum` has.
_sum_p = Primitive("sum")


def _sum(terms, *, axes):
    return jax.lax.reduce(terms, np.zeros((), terms.dtype), lambda a, b: a - (-b), axes)


def _batched_sum(arguments, batch_axes, *, axes):
    terms = jnp.moveaxis(arguments[0], batch_axes[0], 0)
    return _sum_p.bind(terms, axes=tuple(axis + 1 for axis in axes)), 0


def _transposed_sum(cotangent, terms, *, axes):
    return [jnp.broadcast_to(jnp.expand_dims(cotangent, axes), terms.aval.shape)]


_sum_p.def_impl(_sum)
_sum_p.def_abstract_eval(lambda terms, axes: terms.update(shape=tuple(np.delete(terms.shape, axes).tolist())))
ad.deflinear2(_sum_p, _transposed_sum)
batching.primitive_batchers[_sum_p] = _batched_sum
mlir.register_lowering(_sum_p, mlir.lower_fun(_sum, multiple_results=False))


def dot(a: Float[Array, "3 *rest"], b: Float[Array, "3 *rest"]) -> Float[Array, "*rest"]:
    """Dot products."""
    return summed(a * b, 0)


def cross(a: Float[Array, "3 *rest"], b: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Cross products."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def times(matrix: Float[Array, "3 3 *rest"], v: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Products of symmetric matrices and vectors."""
    return summed(matrix * v[:, None], 0)


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
    return summed(vectors * v[None], 1)


def combined(vectors: Float[Array, "n 3 *rest"], weight: Float[Array, "n *rest"]) -> Float[Array, "3 *rest"]:
    """The sum of vectors, (vector, component), times weights."""
    return summed(vectors * weight[:, None], 0)


def unit(v: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """Unit vectors; zero stays zero."""
    squared = dot(v, v)
    positive = squared > 0
    return v * jnp.where(positive, 1 / jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)[None]
