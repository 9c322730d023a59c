"""Conditional computation under `vmap` that runs only for the examples of a batch that need it.

`vmap` turns a condition into a selection: both branches are computed for every example of the batch. Here the examples
that need the computation are gathered into tiles, computed tile by tile, and scattered back. So the cost of a batch
grows with the number of examples that need the computation.

A tile takes as long as its slowest example. Where examples take different numbers of rounds (`Rounds`), an example that
has ended gives its place in the tile to the next one, so the cost grows with the number of rounds of all examples.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import tree_where, update_if

TILE = 128  # examples that are computed together on a CPU, so that their data stay in the cache
# The same on an accelerator, also for `Rounds`. There a tile takes the time to start its kernels, whatever its size: on
# an H200, 100 000 grasps take 10 s in tiles of 128 and a quarter of a second in tiles of 8192. So most batches are one
# tile.
ACCELERATOR_TILE = 1 << 17
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


def tile_size(on_cpu: int = TILE) -> int:
    """Return the number of examples that are computed together on the default backend."""
    return on_cpu if jax.default_backend() == "cpu" else ACCELERATOR_TILE


def flat_batch(size: int, outer_size: int, x: Array, has_inner: bool, has_outer: bool) -> Array:
    """Return an array of a batch of batches as one longer batch, given which of the two axes it has."""
    if not has_inner:
        return jnp.repeat(x, size, axis=0) if has_outer else x
    x = x if has_outer else jnp.broadcast_to(x, (outer_size, *x.shape))
    return x.reshape(outer_size * size, *x.shape[2:])


def where_needed_without_derivatives(
    needed: Bool[Array, ""], compute: Callable[..., Any], otherwise: Any, *args: Any
) -> Any:
    """Return `compute(*args)` where `needed` holds, else `otherwise`; it cannot be differentiated."""
    # It handles one example, or a batch under any number of nested `vmap`. In a batch, `compute` (which may be
    # `Rounds`) runs only for the examples that need it. It must not close over anything that is batched.
    structure = jax.tree.structure(args)

    # `vmap` asks for a batch several times. As a function of its own, it is traced for the first time only.
    @partial(jax.jit, static_argnums=0)
    def in_tiles(args_batched: tuple[bool, ...], needed, otherwise, args):
        batched = jax.tree.unflatten(structure, args_batched)
        if isinstance(compute, Rounds):
            return _compute_in_rounds(compute, batched, needed, otherwise, args)
        return _compute_in_tiles(compute, batched, needed, otherwise, args)

    @jax.custom_batching.custom_vmap
    def chosen(needed, otherwise, args):
        return update_if(needed, lambda _: compute(*args), otherwise)

    @chosen.def_vmap
    def _(size, batched, needed, otherwise, args):
        return _batching_rule(in_tiles, size, batched, needed, otherwise, args)

    return chosen(needed, otherwise, args)


def where_needed(
    needed: Bool[Array, ""],
    compute: Callable[..., Any],
    otherwise: Any,
    *args: Any,
    rounds: Rounds | None = None,  # takes the place of `compute` where no derivatives are taken
) -> Any:
    """Return `compute(*args)` where `needed` holds, else `otherwise`; it can be differentiated."""
    # In a batch, `compute` runs only for the examples that need it. Where derivatives are taken, it runs for all of
    # them. It must not close over anything that is batched or differentiated.

    @eqx.filter_custom_jvp
    def chosen(needed, otherwise, args):
        return where_needed_without_derivatives(needed, rounds or compute, otherwise, *args)

    @chosen.def_jvp
    def _(primals, tangents):
        return eqx.filter_jvp(
            lambda needed, otherwise, args: tree_where(needed, compute(*args), otherwise), primals, tangents
        )

    return chosen(needed, otherwise, args)


def _batching_rule(in_tiles: Callable[..., Any], size: int, batched: Any, needed, otherwise, args):
    """Batching rule of `where_needed_without_derivatives`: the results, and which leaves are batched (all)."""
    # `batched` has, for each of `needed`, `otherwise` and `args`, which leaves have a batch axis.

    def broadcast_unbatched(tree, is_batched):
        """Give each leaf a batch axis, because the loop over tiles writes the results of single examples."""

        def with_axis(x, has_axis):
            return x if has_axis else jnp.broadcast_to(x, (size, *jnp.shape(x)))

        return jax.tree.map(with_axis, tree, is_batched)

    args_batched = batched[2]

    @jax.custom_batching.custom_vmap
    def batch(needed, otherwise, args):
        return in_tiles(tuple(jax.tree.leaves(args_batched)), needed, otherwise, args)

    @batch.def_vmap
    def _(outer_size, batched, needed, otherwise, args):
        flattened = partial(flat_batch, size, outer_size)
        all_inner = jax.tree.map(lambda _: True, otherwise)
        flat_args_batched = jax.tree.map(lambda has_inner, has_outer: has_inner or has_outer, args_batched, batched[2])
        results, _ = _batching_rule(
            in_tiles,
            outer_size * size,
            (True, all_inner, flat_args_batched),
            flattened(needed, True, batched[0]),
            jax.tree.map(flattened, otherwise, all_inner, batched[1]),
            jax.tree.map(flattened, args, args_batched, batched[2]),
        )
        return jax.tree.map(lambda x: x.reshape(outer_size, size, *x.shape[1:]), results), all_inner

    results = batch(broadcast_unbatched(needed, batched[0]), broadcast_unbatched(otherwise, batched[1]), args)
    return results, jax.tree.map(lambda _: True, results)


def _compute_in_tiles(compute: Callable[..., Any], args_batched: Any, needed, otherwise, args):
    """Return the results of a batch: computed by tiles for the examples that need it, `otherwise` for the others."""
    # Leaves of `args` without a batch axis (`args_batched`) are shared by all examples. All batch axes are axis 0.
    tile = min(tile_size(), needed.shape[0])
    needed_count = jnp.sum(needed.astype(jnp.int32))
    indices, args_at, axes = _gathering(needed, tile, args, args_batched)

    def next_tile(state):
        begin, results = state
        positions = jax.lax.dynamic_slice(indices, (begin,), (tile,))
        tile_results = jax.vmap(compute, in_axes=axes, axis_size=tile)(*args_at(positions))
        return begin + tile, _written(results, positions, tile_results)

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
        results = _written(results, jnp.where(ended, positions, batch), finished)
        following = begun + jnp.cumsum(ended, dtype=jnp.int32) - 1
        positions = jnp.where(ended, indices[jnp.minimum(following, len(indices) - 1)], positions)
        states = jax.vmap(tree_where)(ended, states_at(positions), states)
        return positions, begun + jnp.sum(ended, dtype=jnp.int32), states, results

    positions = indices[:places]
    initial = positions, jnp.asarray(places, jnp.int32), states_at(positions), otherwise
    return jax.lax.while_loop(lambda carry: jnp.any(carry[0] < batch), next_round, initial)[3]


def _gathering(needed: Bool[Array, " batch"], tile: int, args: Any, args_batched: Any):
    """Prepare to gather the examples that need a computation: their indices, their arguments, and axes for `vmap`."""
    # The indices, (batch + tile,), end with padding, which is `batch` and so out of range. For padding, `args_at` takes
    # the arguments of the last example.
    batch = needed.shape[0]
    indices = jnp.nonzero(needed, size=batch + tile, fill_value=batch)[0].astype(jnp.int32)

    def args_at(positions):
        rows = jnp.minimum(positions, batch - 1)
        return jax.tree.map(lambda x, batched_leaf: x[rows] if batched_leaf else x, args, args_batched)

    return indices, args_at, jax.tree.map(lambda batched_leaf: 0 if batched_leaf else None, args_batched)


def _written(results: Any, positions: Int[Array, " tile"], rows: Any) -> Any:
    """Return the results with the rows of a tile at these indices of the batch; rows of padding are dropped."""
    return jax.tree.map(lambda all_rows, new: all_rows.at[positions].set(new, mode="drop"), results, rows)
