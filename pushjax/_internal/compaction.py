"""Work that only some examples of a batch need, done for those alone.

`vmap` turns a condition into a selection: every example of a batch pays for both branches. Here the examples that need
the work are gathered into tiles, worked on, and scattered back, so that a batch pays for what it needs.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import wherever

TILE = 128  # examples that are worked on together


def only_where(needed: Bool[Array, ""], work: Callable[..., Any], instead: Any, *args: Any) -> Any:
    """`work(*args)` where it is needed, else `instead`, of the same structure.

    Of one example, or under `vmap`, however nested, of a batch. Not for derivatives. `work` must not close over
    anything that is batched.
    """

    @jax.custom_batching.custom_vmap
    def chosen(needed, instead, args):
        return wherever(needed, lambda _: work(*args), instead)

    @chosen.def_vmap
    def _(size, batched, needed, instead, args):
        return _of_batch(work, size, batched, needed, instead, args)

    return chosen(needed, instead, args)


def _of_batch(work: Callable[..., Any], size: int, batched: Any, needed, instead, args):
    """What `custom_vmap` asks for: the outcome of a batch, and which of its leaves are batched."""

    def spread(tree, which):
        return jax.tree.map(lambda x, is_own: x if is_own else jnp.broadcast_to(x, (size, *jnp.shape(x))), tree, which)

    own = batched[2]

    @jax.custom_batching.custom_vmap
    def batch(needed, instead, args):
        return _in_tiles(work, own, needed, instead, args)

    @batch.def_vmap
    def _(outer, batched, needed, instead, args):
        # a batch of batches is one longer batch
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
    """own: which leaves of the arguments have an axis of examples, in front."""
    size = needed.shape[0]
    tile = min(TILE, size)
    count = jnp.sum(needed.astype(jnp.int32))
    # those in need first; past them out of range, where nothing is written
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
