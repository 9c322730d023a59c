"""Conditional computation under `vmap` that runs only for the examples of a batch that need it.

`vmap` turns a condition into a selection: both branches are computed for every example of the batch. Here the examples
that need the computation are gathered into tiles, computed tile by tile, and scattered back. So the cost of a batch
grows with the number of examples that need the computation.

A tile takes as long as its slowest example. Where examples take different numbers of rounds (`Rounds`), an example that
has ended gives its place in the tile to the next one, so the cost grows with the number of rounds of all examples.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.one_batch import in_one_batch, queued, tile_size, written
from pushjax._internal.xla import tree_where, update_if

TILE = 128  # examples that are computed together on a CPU, so that their data stay in the cache
# Examples that advance together in `Rounds` on a CPU. They are more than in a tile, because every round, and not only
# every tile, takes the time to start its kernels.
PLACES = 256


class Rounds(NamedTuple):
    """A computation of a number of rounds that differs between examples."""

    # It is `state = begin(*args)`, then `state = advance(state, *args)` while `is_ongoing(state, *args)`, and then
    # `finish(state, *args)`. In a batch `advance` is also called where the computation is over at once. There it must
    # not change the result.

    begin: Callable[..., Any]
    advance: Callable[..., Any]
    is_ongoing: Callable[..., Bool[Array, ""]]
    finish: Callable[..., Any]

    def __call__(self, *args: Any) -> Any:
        """Compute one example."""
        state = jax.lax.while_loop(
            lambda state: self.is_ongoing(state, *args), lambda state: self.advance(state, *args), self.begin(*args)
        )
        return self.finish(state, *args)


def where_needed(
    needed: Bool[Array, ""],
    compute: Callable[..., Any],
    otherwise: Any,
    *args: Any,
    rounds: Rounds | None = None,  # takes the place of `compute` where no derivatives are taken
) -> Any:
    """Return `compute(*args)` where `needed` holds, else `otherwise`; it can be differentiated."""
    # It handles one example, or a batch under any number of nested `vmap`. In a batch, `compute` runs only for the
    # examples that need it. Where derivatives are taken, it runs for all of them. It must not close over anything that
    # is batched or differentiated.

    def single(own, args):
        needed, otherwise = own
        return update_if(needed, lambda _: (rounds or compute)(*args), otherwise)

    def of_batch(batched, own, args):
        needed, otherwise = own
        if rounds is not None:
            return _compute_in_rounds(rounds, batched, needed, otherwise, args)
        return _compute_in_tiles(compute, batched, needed, otherwise, args)

    @eqx.filter_custom_jvp
    def chosen(needed, otherwise, args):
        return in_one_batch(single, of_batch, (needed, otherwise), args)

    @chosen.def_jvp
    def _(primals, tangents):
        return eqx.filter_jvp(
            lambda needed, otherwise, args: tree_where(needed, compute(*args), otherwise), primals, tangents
        )

    return chosen(needed, otherwise, args)


def _compute_in_tiles(compute: Callable[..., Any], args_batched: Any, needed, otherwise, args):
    """Return the results of a batch: computed by tiles for the examples that need it, `otherwise` for the others."""
    # Leaves of `args` without a batch axis (`args_batched`) are shared by all examples. All batch axes are axis 0.
    tile = min(tile_size(TILE), needed.shape[0])
    needed_count = jnp.sum(needed.astype(jnp.int32))
    indices, args_at, axes = _gathering(needed, tile, args, args_batched)

    def next_tile(state):
        begin, results = state
        positions = jax.lax.dynamic_slice(indices, (begin,), (tile,))
        tile_results = jax.vmap(compute, in_axes=axes, axis_size=tile)(*args_at(positions))
        return begin + tile, written(results, positions, tile_results)

    initial = jnp.zeros((), jnp.int32), otherwise
    return jax.lax.while_loop(lambda state: state[0] < needed_count, next_tile, initial)[1]


def _compute_in_rounds(rounds: Rounds, args_batched: Any, needed, otherwise, args):
    """Return the results of a batch, in which examples that have ended give their places to the next ones."""
    batch = needed.shape[0]
    places = min(tile_size(PLACES), batch)
    indices, args_at, axes = _gathering(needed, places, args, args_batched)
    example_shapes = jax.eval_shape(rounds.begin, *jax.tree.map(lambda x, b: x[0] if b else x, args, args_batched))
    blank = jax.tree.map(lambda leaf: jnp.zeros((batch, *leaf.shape), leaf.dtype), example_shapes)
    first_states = _compute_in_tiles(rounds.begin, args_batched, needed, blank, args)

    def states_at(positions):
        return jax.tree.map(lambda leaf: leaf[jnp.minimum(positions, batch - 1)], first_states)

    def vmapped(function):
        return jax.vmap(function, in_axes=(0, *axes), axis_size=places)

    def next_round(carry):
        positions, begun, states, results = carry
        place_args = args_at(positions)
        states = vmapped(rounds.advance)(states, *place_args)
        ended = ~vmapped(rounds.is_ongoing)(states, *place_args)
        finished = vmapped(rounds.finish)(states, *place_args)
        results = written(results, jnp.where(ended, positions, batch), finished)
        following = begun + jnp.cumsum(ended, dtype=jnp.int32) - 1
        positions = jnp.where(ended, indices[jnp.minimum(following, len(indices) - 1)], positions)
        states = jax.vmap(tree_where)(ended, states_at(positions), states)
        return positions, begun + jnp.sum(ended, dtype=jnp.int32), states, results

    positions = indices[:places]
    initial = positions, jnp.asarray(places, jnp.int32), states_at(positions), otherwise
    return jax.lax.while_loop(lambda carry: jnp.any(carry[0] < batch), next_round, initial)[3]


def _gathering(needed: Bool[Array, " batch"], tile: int, args: Any, args_batched: Any):
    """Prepare to gather the examples that need a computation: their indices, their arguments, and axes for `vmap`."""
    # For padding, `args_at` takes the arguments of the last example.

    def args_at(positions):
        rows = jnp.minimum(positions, needed.shape[0] - 1)
        return jax.tree.map(lambda x, batched_leaf: x[rows] if batched_leaf else x, args, args_batched)

    axes = jax.tree.map(lambda batched_leaf: 0 if batched_leaf else None, args_batched)
    return queued(needed, tile), args_at, axes
