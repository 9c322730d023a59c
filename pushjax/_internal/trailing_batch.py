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
from jaxtyping import Array, Bool

Function = Callable[..., list[Array]]  # of the leaves

_with_batch_last_p = Primitive("with_batch_last")
_with_batch_last_p.multiple_results = True


def with_batch_last(function: Callable[..., Any], *args: Any) -> Any:
    """Return `function(*args)`, a pytree of arrays of floats, for pytrees of arrays of one example."""
    # `function` must also take arrays with more axes at the end, of which some have length one, and must not close over
    # traced arrays. It is traced in each call, so this is for programs that are compiled as a whole.
    arrays, others = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def results_of(*leaves: Array) -> Any:
        return function(*eqx.combine(jax.tree.unflatten(structure, leaves), others))

    shapes, result_structure = jax.tree.flatten(jax.eval_shape(results_of, *leaves))
    ranks, result_ranks = [leaf.ndim for leaf in leaves], [shape.ndim for shape in shapes]
    results = _bind(lambda *leaves: jax.tree.leaves(results_of(*leaves)), leaves, ranks, result_ranks)
    return jax.tree.unflatten(result_structure, results)


def _bind(
    function: Function, leaves: Sequence[Array], ranks: Sequence[int], result_ranks: Sequence[int]
) -> list[Array]:
    """Bind the primitive to a function whose arrays and results have these ranks in one example."""

    @jax.jit  # traced once, for the shapes and for the program
    def broadcast(*leaves: Array) -> list[Array]:
        batch = _batch_shape(leaves, ranks)

        def of_batch(x: Array, rank: int) -> Array:
            missing = (1,) * (rank + len(batch) - x.ndim)  # axes of a result that does not depend on the batch
            return jnp.broadcast_to(x.reshape(*x.shape, *missing), (*x.shape[:rank], *batch))

        return [of_batch(x, rank) for x, rank in zip(function(*leaves), result_ranks, strict=True)]

    return _with_batch_last_p.bind(*leaves, function=broadcast, ranks=tuple(ranks), result_ranks=tuple(result_ranks))


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


def _batching_rule(leaves, axes, **parameters):
    moved = [
        jnp.expand_dims(leaf, -1) if axis is None else jnp.moveaxis(leaf, axis, -1)
        for leaf, axis in zip(leaves, axes, strict=True)
    ]
    results = _with_batch_last_p.bind(*moved, **parameters)
    return results, [x.ndim - 1 for x in results]


def _jvp_rule(primals, tangents, *, function, ranks, result_ranks):
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

    results = _with_batch_last_p.bind(*primals, function=function, ranks=ranks, result_ranks=result_ranks)
    arguments, all_ranks = [*primals, *_chosen(varies, tangents)], [*ranks, *_chosen(varies, ranks)]
    return results, _bind(change, arguments, all_ranks, result_ranks)


def _transpose_rule(cotangents, *leaves, function, ranks, result_ranks):
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

    results = _bind(backward, all_leaves, ranks_now, [len(aval.shape) for aval in shapes])
    return _merged(is_linear, results, [None] * len(known))


def _call(*leaves, function, **_):
    return function(*leaves)


_with_batch_last_p.def_impl(_call)
_with_batch_last_p.def_abstract_eval(
    lambda *leaves, function, **_: [ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(function, *leaves)]
)
batching.primitive_batchers[_with_batch_last_p] = _batching_rule
ad.primitive_jvps[_with_batch_last_p] = _jvp_rule
ad.primitive_transposes[_with_batch_last_p] = _transpose_rule
mlir.register_lowering(_with_batch_last_p, mlir.lower_fun(_call, multiple_results=True))


def tree_where_last(condition: Bool[Array, " batch"], a: Any, b: Any) -> Any:
    """Return `a` where the condition holds, else `b`, for pytrees of arrays with the batch last."""
    return jax.tree.map(lambda x, y: jnp.where(condition.reshape(*(1,) * (x.ndim - 1), -1), x, y), a, b)
