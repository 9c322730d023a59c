"""Sums along axes, and repetitions along a new axis, as linear primitives of JAX that are each other's transposes.

A sum over an axis is one operation of XLA, which its fusions do not compute twice. So two copies of a comparison agree,
and programs stay small. Sums that are written out entry by entry have neither property.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float


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
