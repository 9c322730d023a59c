"""Batches in tiles, by functions whose arrays have the batch last."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.one_batch import in_one_batch, queued, tile_size, written
from pushjax._internal.xla import entry_at

# Examples that are computed together on a CPU by a program of many small kernels, most of whose time is that of their
# start, and examples that are searched together, whose data are many times as large.
TILE, SEARCH_TILE = 256, 128

# Function of the number of examples of a second attempt, or zero in the first, and of pytrees of arrays with a last
# axis for the batch; of an array that all examples share it has length one. It returns the results, and which examples
# want a second attempt. The examples of a second attempt come first in the batch; the rest is padding.
Attempt = Callable[..., tuple[Any, Bool[Array, " batch"]]]


def in_tiles(
    attempt: Attempt, needed: Bool[Array, ""], has_first: Bool[Array, ""], *args: Any, tile: int = TILE
) -> Any:
    """Return results of `attempt` for one example or a batch, under any nesting of `vmap`; zeros if not needed."""
    # The examples that need it are gathered into tiles, so that their data stay in the cache. Those that want a second
    # attempt, or have no first one, are gathered into tiles of their own, which follow. One program serves both. It
    # cannot be differentiated.

    def of_batch(batched: Any, wanted: Array, args: Any) -> Any:
        return _tile_by_tile(attempt, wanted, batched, args, tile)

    @jax.jit
    def single(wanted: Array, args: Any) -> Any:
        return entry_at(of_batch(jax.tree.map(lambda _: False, args), wanted[None], args), 0)

    return in_one_batch(single, of_batch, jnp.stack([needed & has_first, needed & ~has_first]), args)


def _tile_by_tile(attempt: Attempt, wanted: Bool[Array, "size 2"], batched: Any, args: Any, tile: int) -> Any:
    """The results of a batch, with the batch first, tile by tile; `wanted` has the first and the second attempt."""
    size = wanted.shape[0]
    if not size:
        one = jax.tree.map(lambda x, b: jnp.zeros((1, *x.shape[1:]), x.dtype) if b else x, args, batched)
        return jax.tree.map(lambda x: x[:0], _tile_by_tile(attempt, jnp.zeros((1, 2), bool), batched, one, tile))
    tile = min(tile_size(tile), size)

    @jax.jit  # traced once, for the shapes and for the loop
    def attempt_at(again: Int[Array, ""], rows: Array) -> tuple[Any, Array]:
        last = jax.tree.map(lambda x, b: jnp.moveaxis(x[rows], 0, -1) if b else x[..., None], args, batched)
        results, unfinished = attempt(again, *last)
        broadcast = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], tile)), (results, unfinished))
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), broadcast)

    shapes = jax.eval_shape(attempt_at, jnp.zeros((), jnp.int32), jnp.zeros(tile, jnp.int32))[0]
    blank = jax.tree.map(lambda x: jnp.zeros((size, *x.shape[1:]), x.dtype), shapes)

    def next_tile(state):
        k, end, again, queue, unfinished, results = state
        rows = jax.lax.dynamic_slice(queue, (k * tile,), (tile,))
        count = jnp.where(again, jnp.sum(rows < size, dtype=jnp.int32), 0)
        new, left = attempt_at(count, jnp.minimum(rows, size - 1))
        results, unfinished = written((results, unfinished), rows, (new, left))
        # after the last tile of the first attempt, queue the examples that want a second one
        starts_again = (k + 1 == end) & ~again
        end, queue = jax.lax.cond(starts_again, lambda: _queued(unfinished, tile), lambda: (end, queue))
        return jnp.where(starts_again, 0, k + 1), end, again | starts_again, queue, unfinished, results

    first, unfinished = wanted[:, 0], wanted[:, 1]
    again = ~jnp.any(first)
    end, queue = _queued(jnp.where(again, unfinished, first), tile)
    initial = jnp.zeros((), jnp.int32), end, again, queue, unfinished, blank
    return jax.lax.while_loop(lambda state: state[0] < state[1], next_tile, initial)[-1]


def _queued(wanted: Bool[Array, " size"], tile: int) -> tuple[Array, Array]:
    """The number of tiles, and the indices of the examples in them, then padding."""
    return -(-jnp.sum(wanted, dtype=jnp.int32) // tile), queued(wanted, tile)


def in_search_tiles(search: Callable[[Any], Any], count: Int[Array, ""], problem: Any, blank: Any) -> Any:
    """Return `search(problem)` for the first `count` examples of a batch; those after their last tile are `blank`."""
    # all arrays have the batch last, of length one in an array that all examples share
    size = jax.tree.leaves(blank)[0].shape[-1]
    tile = min(tile_size(SEARCH_TILE), size)
    if tile == size:  # without a loop, which takes as long as the search of a small batch
        return jax.lax.cond(count > 0, search, lambda _: blank, problem)

    def next_tile(state: tuple[Array, Any]) -> tuple[Array, Any]:
        k, results = state  # slices that would end beyond the batch begin earlier
        part = jax.tree.map(
            lambda x: x if x.shape[-1] == 1 else jax.lax.dynamic_slice_in_dim(x, k * tile, tile, axis=-1), problem
        )
        new = jax.tree.map(
            lambda old, x: jax.lax.dynamic_update_slice_in_dim(old, x, k * tile, axis=-1), results, search(part)
        )
        return k + 1, new

    return jax.lax.while_loop(lambda state: state[0] * tile < count, next_tile, (jnp.zeros((), jnp.int32), blank))[1]
