"""Compaction: work only on the examples of a batch that need it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax._internal.compaction import PLACES, TILE, Rounds, where_needed


def work(x, shared):
    return {"square": x * x + shared, "sign": jnp.sign(x).astype(jnp.int32)}


def chosen(needed, x, shared):
    otherwise = {"square": x, "sign": jnp.zeros((), jnp.int32)}
    return where_needed(needed, work, otherwise, x, shared)


each_chosen = jax.jit(jax.vmap(chosen, in_axes=(0, 0, None)))


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
    same(each_chosen(needed, x, np.float32(2)), expected(needed, x, 2))


# of `needed`, `x` and `shared`; over the rows, each of them has neither, either and both axes
@pytest.mark.parametrize(
    ("axes", "inner"),
    [
        ((None, 0, 0), (0, 0, None)),
        ((0, None, 0), (0, 0, 0)),
        ((0, 0, None), (None, 0, None)),
        ((0, None, None), (0, None, None)),
        ((None, None, 0), (None, 0, None)),
        ((None, 0, None), (0, None, 0)),
    ],
)
def test_a_batch_of_batches(axes, inner):
    """With two batch axes, every argument may or may not have either axis."""
    rng = np.random.default_rng(0)

    def draw(kind):
        sizes = [n for n, axis in ((4, axes[kind]), (50, inner[kind])) if axis == 0]
        return rng.random(sizes) < 0.4 if kind == 0 else rng.integers(-9, 10, sizes).astype(np.float32)

    args = [draw(kind) for kind in range(3)]
    found = jax.jit(jax.vmap(jax.vmap(chosen, in_axes=inner), in_axes=axes))(*args)
    wide = []
    for kind, value in enumerate(args):
        shape = [n if axis == 0 else 1 for n, axis in ((4, axes[kind]), (50, inner[kind]))]
        wide.append(np.broadcast_to(np.reshape(value, shape), (4, 50)))
    same(found, expected(*wide))


def test_one_alone():
    same(chosen(jnp.asarray(True), jnp.float32(3), jnp.float32(1)), {"square": 10, "sign": 1})
    same(chosen(jnp.asarray(False), jnp.float32(3), jnp.float32(1)), {"square": 3, "sign": 0})


# Collatz sequences: their lengths differ widely between neighbors.
collatz = Rounds(
    begin=lambda start, limit: (start, jnp.zeros((), jnp.int32)),
    advance=lambda state, start, limit: (jnp.where(state[0] % 2 == 0, state[0] // 2, 3 * state[0] + 1), state[1] + 1),
    is_ongoing=lambda state, start, limit: (state[0] != 1) & (state[1] < limit),
    finish=lambda state, start, limit: {"rounds": state[1], "last": state[0] + 0 * start},
)


def collatz_of(start, limit):
    rounds = 0
    while True:
        start, rounds = (start // 2 if start % 2 == 0 else 3 * start + 1), rounds + 1
        if start == 1 or rounds >= limit:
            return rounds, start


def rounds_of(needed, start, limit):
    otherwise = {"rounds": jnp.zeros((), jnp.int32), "last": start}
    return where_needed(needed, collatz, otherwise, start, limit, rounds=collatz)


each_of_rounds = jax.jit(jax.vmap(rounds_of, in_axes=(0, 0, None)))


@pytest.mark.parametrize("size", [1, 3, PLACES, PLACES + 1, 3 * PLACES + 7])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_rounds_of_different_numbers(size, share):
    rng = np.random.default_rng(size)
    start, needed = rng.integers(2, 1000, size).astype(np.int32), rng.random(size) < share
    found = each_of_rounds(needed, start, np.int32(90))
    wanted = [collatz_of(int(x), 90) if n else (0, x) for x, n in zip(start, needed, strict=True)]
    same(found, {"rounds": [w[0] for w in wanted], "last": [w[1] for w in wanted]})


def test_rounds_in_batches_of_batches_and_alone():
    rng = np.random.default_rng(1)
    start, needed, limit = rng.integers(2, 1000, (5, 70)), rng.random((5, 70)) < 0.5, np.array([3, 9, 20, 40, 90])
    found = jax.jit(jax.vmap(jax.vmap(rounds_of, in_axes=(0, 0, None))))(needed, start, limit)
    for k in (0, 4):
        one = rounds_of(needed[k, 7], jnp.asarray(start[k, 7]), limit[k])
        same(one, {name: found[name][k, 7] for name in one})
    wanted = [[collatz_of(x, n)[0] for x in row] for row, n in zip(start, limit, strict=True)]
    np.testing.assert_array_equal(found["rounds"], np.where(needed, wanted, 0))


def test_rounds_do_not_change_derivatives():
    """Derivatives are those of the plain function; the value is that of the rounds."""
    halve = Rounds(
        begin=lambda x: x,
        advance=lambda state, x: state / 2,
        is_ongoing=lambda state, x: jnp.abs(state) > 1,
        finish=lambda state, x: state,
    )

    def plain(x):
        return x / 2 ** jax.lax.stop_gradient(jnp.ceil(jnp.log2(jnp.abs(x))))

    def chosen_of(x):
        return where_needed(jnp.abs(x) > 1, plain, x, x, rounds=halve)

    x = jnp.array([0.3, 3.0, -5.0, 40.0])
    np.testing.assert_allclose(jax.vmap(chosen_of)(x), jax.vmap(lambda x: jnp.where(jnp.abs(x) > 1, plain(x), x))(x))
    np.testing.assert_allclose(jax.vmap(jax.grad(chosen_of))(x), [1, 1 / 4, 1 / 8, 1 / 64])
