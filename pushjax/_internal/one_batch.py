"""The door to batches: a function of whole batches, under any nesting of `vmap`, and tiles of the examples in need."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

# Examples that are computed together on an accelerator. There a tile takes the time to start its kernels, whatever its
# size: on an H200, 100 000 grasps take 10 s in tiles of 128 and a quarter of a second in tiles of 8192. So most batches
# are one tile.
ACCELERATOR_TILE = 1 << 17


def in_one_batch(single: Callable[[Any, Any], Any], of_batch: Callable[..., Any], own: Any, args: Any) -> Any:
    """Return `single(own, args)`, or of a batch `of_batch(batched, own, args)`, with all `vmap` around it as one."""
    # All leaves of `own` and of the results have the batch as their first axis. Of the leaves of `args`, those for
    # which `batched` is True have it; the others are shared by all examples. It cannot be differentiated.
    structure = jax.tree.structure(args)

    # `vmap` asks for a batch several times. As a function of its own, it is traced for the first time only.
    @partial(jax.jit, static_argnums=0)
    def traced_once(batched: tuple[bool, ...], own: Any, args: Any) -> Any:
        return of_batch(jax.tree.unflatten(structure, batched), own, args)

    @jax.custom_batching.custom_vmap
    def alone(own, args):
        return single(own, args)

    @alone.def_vmap
    def _(size, batched, own, args):
        def with_axis(x, has_axis):
            return x if has_axis else jnp.broadcast_to(x, (size, *jnp.shape(x)))

        return _batching_rule(traced_once, size, batched[1], jax.tree.map(with_axis, own, batched[0]), args)

    return alone(own, args)


def _batching_rule(of_batch: Callable[..., Any], size: int, batched: Any, own: Any, args: Any) -> tuple[Any, Any]:
    """Batching rule of `in_one_batch`: the results, and which leaves are batched (all)."""

    @jax.custom_batching.custom_vmap
    def batch(own, args):
        return of_batch(tuple(jax.tree.leaves(batched)), own, args)

    @batch.def_vmap
    def _(outer_size, outer_batched, own, args):
        flat = partial(_flat_batch, size, outer_size)
        own_has_outer, args_have_outer = outer_batched
        flat_own = jax.tree.map(lambda x, has_outer: flat(x, True, has_outer), own, own_has_outer)
        flat_args = jax.tree.map(flat, args, batched, args_have_outer)
        either = jax.tree.map(lambda inner, outer: inner or outer, batched, args_have_outer)
        results, all_batched = _batching_rule(of_batch, outer_size * size, either, flat_own, flat_args)
        return jax.tree.map(lambda x: x.reshape(outer_size, size, *x.shape[1:]), results), all_batched

    results = batch(own, args)
    return results, jax.tree.map(lambda _: True, results)


def _flat_batch(size: int, outer_size: int, x: Array, has_inner: bool, has_outer: bool) -> Array:
    """Return an array of a batch of batches as one longer batch, given which of the two axes it has."""
    if not has_inner:
        return jnp.repeat(x, size, axis=0) if has_outer else x
    x = x if has_outer else jnp.broadcast_to(x, (outer_size, *x.shape))
    return x.reshape(outer_size * size, *x.shape[2:])


def tile_size(on_cpu: int) -> int:
    """Return the number of examples that are computed together on the default backend."""
    return on_cpu if jax.default_backend() == "cpu" else ACCELERATOR_TILE


def queued(needed: Bool[Array, " batch"], tile: int) -> Int[Array, " batch+tile"]:
    """Return the indices of the examples in need, then padding, which is out of range."""
    batch = needed.shape[0]
    return jnp.nonzero(needed, size=batch + tile, fill_value=batch)[0].astype(jnp.int32)


def written(results: Any, indices: Int[Array, " tile"], rows: Any) -> Any:
    """Return the results with the rows of a tile at these indices of the batch; rows of padding are dropped."""
    return jax.tree.map(lambda all_rows, new: all_rows.at[indices].set(new, mode="drop"), results, rows)
