"""Helpers that make XLA compile programs that are small, fast and consistent.

The results are those of plain JAX. The helpers only decide what is computed once, in a loop, or not at all.
"""

from collections.abc import Callable
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Scalar = Float[Array, ""]


def compute_once(values, runtime_scalar: Scalar):
    """Return a pytree of floating and boolean scalars unchanged, but force XLA to compute each of them exactly once."""
    # XLA may recompute a value inside every fusion that uses it, and round it differently there (with or without fused
    # multiply-add). At a tie, two copies of one comparison may then give different results. For example, a finger that
    # is nearest to a corner is equally near to both of its edges. Two copies of the comparison selected fields of
    # different edges, and the slider jumped (observed on the CPU with JAX 0.8 to 0.10). Recomputation is also slow.
    #
    # On the CPU, an optimization barrier does not prevent recomputation. A division does, because XLA never duplicates
    # divisions. So each value is divided by a one that is computed at run time, which the compiler cannot simplify.
    # Where `runtime_scalar` is not finite, floats become NaN and booleans become False.
    #
    # In reverse mode, cotangents that pass through `compute_once` are also computed once. Without it, they are computed
    # once for every input. With it, `grad` of two contacts takes an eighth of the time to run and three fifths of the
    # time to compile. Under `jacrev` there is no such gain, because the cotangents are batched and `runtime_scalar` is
    # not.
    # the barrier keeps a scalar that is a constant of the program from being simplified away with its divisions
    one = jax.lax.optimization_barrier(jax.lax.stop_gradient(runtime_scalar)) * 0 + 1

    def divided_by_one(value):
        if jnp.issubdtype(value.dtype, jnp.floating):
            return value / one
        if value.dtype != bool:
            raise TypeError(f"compute_once takes floats and booleans, not {value.dtype}")
        return value.astype(one.dtype) / one > 0.5

    return jax.tree.map(divided_by_one, values)


def update_if(condition: Bool[Array, ""], update: Callable, state):
    """Return `update(state)` if `condition` holds, else `state`; it has no derivatives in reverse mode."""
    # Under `vmap`, `lax.cond` always runs both branches. This loop of at most one iteration skips `update` if the
    # condition is False for the whole batch.

    def run_update(loop_state):
        return loop_state[0] & False, update(loop_state[1])

    return jax.lax.while_loop(lambda loop_state: loop_state[0], run_update, (condition, state))[1]


def skippable(
    is_needed: Callable[..., Bool[Array, ""]],
    body: Callable,
    state: Any,  # an example of the body's state
    x: Any,  # an example of its input
) -> Callable:
    """Return the body of a scan, which leaves the state and gives zeros where none of a batch needs it."""
    traced_once = jax.jit(body)  # for the shapes and for the loop
    shapes = jax.eval_shape(traced_once, state, x)[1]
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def body_or_blank(state: Any, x: Any) -> Any:
        any_needs_it = eqxi.unvmap_any(is_needed(state, x))
        return jax.lax.cond(any_needs_it, traced_once, lambda state, _: (state, blank), state, x)

    return body_or_blank


def tree_where(condition, yes, no):
    """Apply `where` to each leaf of two pytrees of scalars with the same structure."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def entry_at(tree, index: Int[Array, "..."] | int):
    """Return the entry, or the entries, with this index of every array of a pytree."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def largest(values: Float[Array, " values"]) -> Scalar:
    """Return the largest entry."""
    # The derivative of `max` compares the maximum with each entry, and finds none equal where the compiler rounds the
    # entries twice. An index is found once. A masked sum is differentiated without a scatter.
    is_largest = jnp.arange(values.size) == jnp.argmax(values)
    return jnp.sum(jnp.where(is_largest, values, 0.0))


def smallest(values: Float[Array, " values"]) -> Scalar:
    """Return the smallest entry, like `largest`."""
    return -largest(-values)


def map_items(function: Callable, items: tuple) -> tuple:
    """Return `(function(item), ...)` for pytrees, in a loop over those of the same structure, shapes and dtypes."""
    # A loop compiles `function` once. Compilation takes most of the time of a first call.
    kinds: dict[Any, list[int]] = {}
    for k, item in enumerate(items):
        leaves, structure = jax.tree.flatten(item)
        kind = structure, *((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        kinds.setdefault(kind, []).append(k)
    results: dict[int, Any] = {}
    for members in kinds.values():
        if len(members) == 1:
            results[members[0]] = function(items[members[0]])
            continue
        stacked = jax.lax.map(function, jax.tree.map(lambda *leaves: jnp.stack(leaves), *(items[k] for k in members)))
        results |= {k: entry_at(stacked, i) for i, k in enumerate(members)}
    return tuple(results[k] for k in range(len(items)))
