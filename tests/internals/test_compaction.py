"""Compaction: work only on the examples of a batch that need it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax._internal.compaction import TILE, only_where


def work(x, shared):
    return {"square": x * x + shared, "sign": jnp.sign(x).astype(jnp.int32)}


def chosen(needed, x, shared):
    return only_where(needed, work, {"square": x, "sign": jnp.zeros((), jnp.int32)}, x, shared)


def expected(needed, x, shared):
    return {"square": np.where(needed, x * x + shared, x), "sign": np.where(needed, np.sign(x), 0)}


def same(found, wanted):
    for name in wanted:
        np.testing.assert_array_equal(found[name], wanted[name])


@pytest.mark.parametrize("size", [1, 3, TILE, TILE + 1, 5 * TILE + 7])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_only_those_in_need_are_changed(size, share):
    rng = np.random.default_rng(size)
    x, needed = rng.integers(-9, 10, size).astype(np.float32), rng.random(size) < share
    found = jax.jit(jax.vmap(chosen, in_axes=(0, 0, None)))(needed, x, np.float32(2))
    same(found, expected(needed, x, 2))


@pytest.mark.parametrize("axes", [(None, 0, 0), (0, None, 0), (0, 0, None), (0, None, None), (None, None, 0)])
@pytest.mark.parametrize("inner", [(0, 0, None), (0, 0, 0), (None, 0, None), (0, None, None)])
def test_a_batch_of_batches(axes, inner):
    """With two batch axes, every argument may or may not have either axis."""
    rng = np.random.default_rng(0)

    def draw(kind):
        sizes = [n for n, axis in ((4, axes[kind]), (50, inner[kind])) if axis == 0]
        return rng.random(sizes) < 0.4 if kind == 0 else rng.integers(-9, 10, sizes).astype(np.float32)

    args = [draw(kind) for kind in range(3)]
    found = jax.vmap(jax.vmap(chosen, in_axes=inner), in_axes=axes)(*args)
    wide = []
    for kind, value in enumerate(args):
        shape = [n if axis == 0 else 1 for n, axis in ((4, axes[kind]), (50, inner[kind]))]
        wide.append(np.broadcast_to(np.reshape(value, shape), (4, 50)))
    same(found, expected(*wide))


def test_one_alone():
    same(chosen(jnp.asarray(True), jnp.float32(3), jnp.float32(1)), {"square": 10, "sign": 1})
    same(chosen(jnp.asarray(False), jnp.float32(3), jnp.float32(1)), {"square": 3, "sign": 0})
