"""Functions of arrays with the batch last, which can be differentiated.

`vmap` puts the batch first. The small axes of vectors and matrices then come last, and the compiler cannot vectorize.
`with_batch_last` calls a function that takes more axes than those of one example, and appends an axis to its arrays for
each surrounding `vmap`. The same holds for its derivatives, forward and reverse, of any order. Reverse mode keeps only
the arguments of the function, and computes the rest again.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Function = Callable[..., list[Array]]  # of the leaves

primitive = Primitive("with_batch_last")
primitive.multiple_results = True


def with_batch_last(function: Callable[..., Any], *args: Any) -> Any:
    """Return `function(*args)`, a pytree of floats, for pytrees of arrays of one example.

    `function` must also take arrays with more axes at the end, of which some have length one, and must not close over
    traced arrays.
    """
    arrays, others = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def results_of(*leaves: Array) -> Any:
        return function(*eqx.combine(jax.tree.unflatten(structure, leaves), others))

    result_structure = jax.tree.structure(jax.eval_shape(results_of, *leaves))
    results = _bind(lambda *leaves: jax.tree.leaves(results_of(*leaves)), leaves, [leaf.ndim for leaf in leaves])
    return jax.tree.unflatten(result_structure, results)


def _bind(function: Function, leaves: Sequence[Array], ranks: Sequence[int]) -> list[Array]:
    """Bind the primitive to a function of arrays that have these ranks in one example."""

    @jax.jit  # traced once, for the shapes and for the program
    def broadcast(*leaves: Array) -> list[Array]:
        batch = _batch_shape(leaves, ranks)
        return [jnp.broadcast_to(x, (*x.shape[: x.ndim - len(batch)], *batch)) for x in function(*leaves)]

    return primitive.bind(*leaves, function=broadcast, ranks=tuple(ranks))


def _batch_shape(leaves: Sequence[Array], ranks: Sequence[int]) -> tuple[int, ...]:
    """Return the shape of the batch, of which each array may have axes of length one."""
    return jnp.broadcast_shapes(*(leaf.shape[rank:] for leaf, rank in zip(leaves, ranks, strict=True)))


def _merged(chosen: Sequence[bool], yes: Iterable[Any], no: Iterable[Any]) -> list[Any]:
    """Return one list of the leaves that are chosen, and of the others."""
    yes, no = iter(yes), iter(no)
    return [next(yes) if is_chosen else next(no) for is_chosen in chosen]


def _chosen(chosen: Sequence[bool], leaves: Iterable[Any]) -> list[Any]:
    """Return the leaves that are chosen."""
    return [leaf for leaf, is_chosen in zip(leaves, chosen, strict=True) if is_chosen]


def _batching_rule(leaves, axes, *, function, ranks):
    moved = [
        jnp.expand_dims(leaf, -1) if axis is None else jnp.moveaxis(leaf, axis, -1)
        for leaf, axis in zip(leaves, axes, strict=True)
    ]
    results = primitive.bind(*moved, function=function, ranks=ranks)
    return results, [x.ndim - 1 for x in results]


def _jvp_rule(primals, tangents, *, function, ranks):
    varies = [type(tangent) is not ad.Zero and tangent.dtype != jax.dtypes.float0 for tangent in tangents]
    fixed = [not v for v in varies]
    count = len(primals)

    def change(*leaves: Array) -> list[Array]:
        # an axis of the batch may have length one in the argument, but not in its tangent
        pairs = [
            jnp.broadcast_arrays(*pair) for pair in zip(_chosen(varies, leaves[:count]), leaves[count:], strict=True)
        ]
        constants = _chosen(fixed, leaves[:count])
        at, along = zip(*pairs, strict=True)
        return jax.jvp(lambda *varied: function(*_merged(varies, varied, constants)), at, along)[1]

    results = primitive.bind(*primals, function=function, ranks=ranks)
    return results, _bind(change, [*primals, *_chosen(varies, tangents)], [*ranks, *_chosen(varies, ranks)])


def _transpose_rule(cotangents, *leaves, function, ranks):
    is_linear = [ad.is_undefined_primal(leaf) for leaf in leaves]
    shapes = [leaf.aval for leaf in _chosen(is_linear, leaves)]
    known = _chosen([not linear for linear in is_linear], leaves)
    cotangents = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    all_leaves = [*known, *cotangents]
    ranks_now = [leaf.ndim for leaf in all_leaves]  # axes that are there now belong to one example of what follows

    def backward(*leaves: Array) -> list[Array]:
        batch = _batch_shape(leaves, ranks_now)
        constants, cotangents = leaves[: len(known)], leaves[len(known) :]
        linear = [jax.ShapeDtypeStruct((*aval.shape, *batch), aval.dtype) for aval in shapes]
        transposed = jax.linear_transpose(lambda *linear: function(*_merged(is_linear, linear, constants)), *linear)
        return list(transposed([jnp.broadcast_to(x, (*x.shape[: x.ndim - len(batch)], *batch)) for x in cotangents]))

    results = _bind(backward, all_leaves, ranks_now)
    return _merged(is_linear, results, [None] * len(known))


def _call(*leaves, function, ranks):
    return function(*leaves)


primitive.def_impl(_call)
primitive.def_abstract_eval(
    lambda *leaves, function, ranks: [ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(function, *leaves)]
)
batching.primitive_batchers[primitive] = _batching_rule
ad.primitive_jvps[primitive] = _jvp_rule
ad.primitive_transposes[primitive] = _transpose_rule
mlir.register_lowering(primitive, mlir.lower_fun(_call, multiple_results=True))
