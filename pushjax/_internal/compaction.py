"""Conditional computation under `vmap` that runs only for the examples of a batch that need it.

`vmap` turns a condition into a selection: both branches are computed for every example of the batch. Here the examples
that need the computation are gathered into tiles, computed tile by tile, and scattered back. So the cost of a batch
grows with the number of examples that need the computation.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import update_if

TILE = 128  # examples that are computed together on a CPU, so that their data stay in the cache
# The same on an accelerator. There a tile costs the start of its kernels, whatever its size: on an H200, 100 000 grasps
# take 10 s in tiles of 128 and a quarter of a second in tiles of 8192.
ACCELERATOR_TILE = 1 << 17


def tile_size() -> int:
    """Return the number of examples that are computed together on the default backend."""
    return TILE if jax.default_backend() == "cpu" else ACCELERATOR_TILE


def only_where(needed: Bool[Array, ""], work: Callable[..., Any], instead: Any, *args: Any) -> Any:
    """Return `work(*args)` where `needed` holds, else `instead`.

    It handles one example, or a batch under any number of nested `vmap`. It cannot be differentiated.

    Args:
        needed: Whether this example needs the computation.
        work: Function of `args`. It must not close over anything that is batched.
        instead: Result where `needed` is False, of the same structure as the result of `work`.
        *args: Arguments of `work`, pytrees of arrays.
    """

    @jax.custom_batching.custom_vmap
    def chosen(needed, instead, args):
        return update_if(needed, lambda _: work(*args), instead)

    @chosen.def_vmap
    def _(size, batched, needed, instead, args):
        return _of_batch(work, size, batched, needed, instead, args)

    return chosen(needed, instead, args)


def _of_batch(work: Callable[..., Any], size: int, batched: Any, needed, instead, args):
    """Batching rule of `only_where`: return the result for a batch, and which of its leaves are batched (all are).

    Args:
        work: Function of one example's arguments.
        size: Number of examples in the batch.
        batched: For each of `needed`, `instead` and `args`, which of its leaves have a batch axis.
        needed: Which examples need the computation.
        instead: Results of the other examples.
        args: Arguments of `work`.
    """

    def spread(tree, which):
        return jax.tree.map(lambda x, is_own: x if is_own else jnp.broadcast_to(x, (size, *jnp.shape(x))), tree, which)

    own = batched[2]

    @jax.custom_batching.custom_vmap
    def batch(needed, instead, args):
        return _in_tiles(work, own, needed, instead, args)

    @batch.def_vmap
    def _(outer, batched, needed, instead, args):
        # A batch of batches is flattened into one longer batch. `ours` is whether an array has the axis of the inner
        # `vmap`, `theirs` whether it has that of the outer one.
        def joined(x, ours, theirs):
            if not ours:
                return jnp.repeat(x, size, axis=0) if theirs else x
            x = x if theirs else jnp.broadcast_to(x, (outer, *x.shape))
            return x.reshape(outer * size, *x.shape[2:])

        all_ours = jax.tree.map(lambda _: True, instead)
        either = jax.tree.map(lambda ours, theirs: ours or theirs, own, batched[2])
        found, _ = _of_batch(
            work,
            outer * size,
            (True, all_ours, either),
            joined(needed, True, batched[0]),
            jax.tree.map(joined, instead, all_ours, batched[1]),
            jax.tree.map(joined, args, own, batched[2]),
        )
        return jax.tree.map(lambda x: x.reshape(outer, size, *x.shape[1:]), found), all_ours

    found = batch(spread(needed, batched[0]), spread(instead, batched[1]), args)
    return found, jax.tree.map(lambda _: True, found)


def _in_tiles(work: Callable[..., Any], own: Any, needed, instead, args):
    """Return the result for a batch, computed tile by tile for the examples that need it.

    Args:
        work: Function of one example's arguments.
        own: Which leaves of `args` are batched, on axis 0. The other leaves are shared by all examples.
        needed: (batch,), which examples need the computation.
        instead: Results of the other examples, each leaf batched on axis 0.
        args: Arguments of `work`.
    """
    size = needed.shape[0]
    tile = min(tile_size(), size)
    count = jnp.sum(needed.astype(jnp.int32))
    # Indices of the examples that need the computation, then `size` as padding. A padded entry of a tile computes the
    # last example again (`which`), and its result is dropped, because its index (`at`) is out of range.
    order = jnp.nonzero(needed, size=size + tile, fill_value=size)[0].astype(jnp.int32)
    axes = jax.tree.map(lambda is_own: 0 if is_own else None, own)

    def next_tile(state):
        begin, found = state
        at = jax.lax.dynamic_slice(order, (begin,), (tile,))
        which = jnp.minimum(at, size - 1)
        mine = jax.tree.map(lambda x, is_own: x[which] if is_own else x, args, own)
        done = jax.vmap(work, in_axes=axes, axis_size=tile)(*mine)
        found = jax.tree.map(lambda old, new: old.at[at].set(new, mode="drop"), found, done)
        return begin + tile, found

    return jax.lax.while_loop(lambda state: state[0] < count, next_tile, (jnp.zeros((), jnp.int32), instead))[1]
