"""Work for those of a batch that need it, and contact problems of which one contact mostly does all the work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax._internal.compaction import TILE, only_where
from pushjax._vec import entries
from pushjax.problems import random_contacts_problem
from pushjax.solve.contacts import _in_scalars, ground, motion_under


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
    """Every argument may or may not have either axis."""
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


def test_one_alone_takes_no_detour():
    same(chosen(jnp.asarray(True), jnp.float32(3), jnp.float32(1)), {"square": 10, "sign": 1})
    same(chosen(jnp.asarray(False), jnp.float32(3), jnp.float32(1)), {"square": 3, "sign": 0})


def solved(problem, solver, displacement):
    """What a rollout solves: without a margin, and by default one contact first."""
    given = problem.contacts
    contacts = pj.Contacts(given.point, given.normal, displacement, given.friction, given.gap, given.active)
    form, mu = ground(problem.surface, contacts.friction)
    found = motion_under(form, _in_scalars(contacts, mu), entries(contacts.active), solver, margin=False)
    return found.twist.array(), found.status, found.unique


def test_the_same_motion_or_a_second_one():
    """Of random problems: the answer and its derivative are those of `Exhaustive`, which says so where another motion
    is one too."""
    count = 400
    keys = jax.random.split(jax.random.key(4), count)
    problems = jax.jit(jax.vmap(lambda key: random_contacts_problem(key, contacts=4, degree=4)))(keys)

    def both(problem, solver):
        twist, status, unique = solved(problem, solver, problem.contacts.displacement)
        slope = jax.jacfwd(lambda displacement: solved(problem, solver, displacement)[0])
        return twist, status, unique, slope(problem.contacts.displacement)

    quick = jax.jit(jax.vmap(lambda problem: both(problem, None)))(problems)
    exact = jax.jit(jax.vmap(lambda problem: both(problem, pj.Exhaustive())))(problems)
    twist, status, _, slope = map(np.asarray, quick)
    wanted, exact_status, unique, wanted_slope = map(np.asarray, exact)
    moves = exact_status == pj.Status.MOVING
    np.testing.assert_array_equal(status[unique], exact_status[unique])
    size = np.linalg.norm(wanted, axis=1)
    apart = np.linalg.norm(twist - wanted, axis=1) > 1e-3 * size
    assert not np.any(apart & unique & moves)
    assert 0 < np.sum(moves & ~apart) < count
    alike = moves & ~apart & (status == pj.Status.MOVING)
    assert np.all(np.isfinite(slope))
    error = np.abs(slope - wanted_slope).max(axis=(1, 2, 3)) / np.maximum(np.abs(wanted_slope).max(axis=(1, 2, 3)), 1)
    assert np.mean(error[alike] < 1e-2) > 0.99


def test_a_coarse_grasp_goes_on_as_a_fine_one():
    """Two fingers in steps of 3 mm, one of which pushes before the other arrives. By the motion of largest power, which
    an explicit `Exhaustive` takes, the slider ends up to 2 degrees from where fine steps lead."""
    slider = pj.Slider(pj.Polygon.rectangle(0.09, 0.06), pj.Ellipsoid(np.diag([1.0, 1.0, 1.2]), length=0.03))
    hand = pj.Hand.two_fingers(0.008)
    keys = jax.random.split(jax.random.key(1), 2)
    friction = jax.random.uniform(keys[0], (200,), minval=0.05, maxval=0.6)
    pose = jax.random.uniform(keys[1], (200, 3), minval=-1, maxval=1) * jnp.array([[0.02, 0.02, np.pi]])

    def final(steps, solver):
        path = pj.line((0, 0, 0, 0.32), (0, 0, 0, 0.02), steps)
        push = jax.vmap(lambda p, mu: pj.rollout(slider, hand, path, pose=p, friction=mu, solver=solver).pose[-1])
        return np.asarray(jax.jit(push)(pose, friction))

    one_first, largest, fine = final(100, None), final(100, pj.Exhaustive()), final(1600, None)
    differs = np.abs(one_first - largest).max(axis=1) > 1e-4
    assert 2 <= np.sum(differs) <= 40
    error, other = (np.abs(end - fine)[differs].max(axis=1) for end in (one_first, largest))
    assert np.median(error) < np.median(other) / 4
