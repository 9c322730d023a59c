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
    return _sum_p.bind(terms, axes=tuple(sorted(a % terms.ndim for a in np.atleast_1d(axis).tolist())))


def repeated(values: Float[Array, "..."], axis: int, count: int) -> Float[Array, "..."]:
    """Values with another axis, along which they are the same; in reverse mode this is `summed`."""
    return _repeat_p.bind(values, axis=axis, count=count)


# XLA of JAX 0.11 and 0.12 hands small sums of float32 to a library that takes up to twenty times as long, with which a
# jaw's step takes three times as long. It does not know the form of a sum that `_sum` has.
_sum_p, _repeat_p = Primitive("sum"), Primitive("repeat")


def _sum(terms, *, axes):
    return jax.lax.reduce(terms, np.zeros((), terms.dtype), lambda a, b: a - (-b), axes)


def _repeat(values, *, axis, count):
    return jnp.broadcast_to(jnp.expand_dims(values, axis), (*values.shape[:axis], count, *values.shape[axis:]))


def _transposed_sum(cotangent, terms, *, axes):
    for axis in axes:
        cotangent = repeated(cotangent, axis, terms.aval.shape[axis])
    return [cotangent]


def _with_rules(primitive, function, shape_of, transposed, batched):
    """Give a linear primitive its rules; `batched` returns its parameters where the batch is the first axis."""

    def batching_rule(arguments, batch_axes, **parameters):
        return primitive.bind(jnp.moveaxis(arguments[0], batch_axes[0], 0), **batched(**parameters)), 0

    primitive.def_impl(function)
    primitive.def_abstract_eval(lambda x, **parameters: x.update(shape=shape_of(x.shape, **parameters)))
    ad.deflinear2(primitive, transposed)
    batching.primitive_batchers[primitive] = batching_rule
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=False))


_with_rules(
    _sum_p,
    _sum,
    lambda shape, axes: tuple(size for axis, size in enumerate(shape) if axis not in axes),
    _transposed_sum,
    lambda axes: {"axes": tuple(axis + 1 for axis in axes)},
)
_with_rules(
    _repeat_p,
    _repeat,
    lambda shape, axis, count: (*shape[:axis], count, *shape[axis:]),
    lambda cotangent, _, axis, count: [summed(cotangent, axis)],
    lambda axis, count: {"axis": axis + 1, "count": count},
)


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
