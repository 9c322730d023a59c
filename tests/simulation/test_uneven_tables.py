"""Uneven tables: the same in a step, in a rollout, and under random friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj

TABLE = pj.Table(anisotropy=(0.1, -0.05), log_gradient=(2.0, 1.0), log_hessian=(10.0, 0.0, 5.0))
MODEL = pj.FrictionModel(dof=20, friction=(0.15, 0.35))


@pytest.fixture(scope="module")
def push():
    """Slider, hand, path and start."""
    slider = pj.Slider(pj.Disk(0.045), pj.Ellipsoid(np.diag([1.0, 1.0, 1.1]), 0.035))
    return slider, pj.Hand.finger(0.00475), pj.line((-0.05, 0.01), (-0.03, 0.012), 6), jnp.zeros(3)


def test_a_step_is_that_of_the_rollout(push):
    slider, hand, path, pose = push
    whole = pj.rollout(slider, hand, path, pose=pose, friction=0.25, table=TABLE)
    for k in range(len(path) - 1):
        pose = pj.step(slider, hand, path[k], path[k + 1], pose=pose, friction=0.25, table=TABLE).pose
        np.testing.assert_allclose(pose, whole.pose[k + 1], rtol=0, atol=1e-12)
    even = pj.rollout(slider, hand, path, pose=jnp.zeros(3), friction=0.25)
    assert np.abs(even.pose[-1] - whole.pose[-1]).max() > 1e-4


@pytest.mark.parametrize("every", [None, 2])
def test_random_friction_on_a_table(push, every):
    slider, hand, path, pose = push
    model = pj.FrictionModel(dof=20, friction=(0.15, 0.35), resample_every=every)
    found = pj.random_rollout(jax.random.key(1), slider, hand, path, pose=pose, model=model, table=TABLE)
    steps = len(path) - 1
    for k in range(steps):
        draw = 0 if every is None else k // every
        surface = jax.tree.map(lambda leaf, draw=draw: leaf[draw], found.draws.surface)
        mu, ends = found.draws.friction[draw], path[k : k + 2]
        there = found.push.pose[k]
        one = pj.step(pj.Slider(slider.shape, surface), hand, *ends, pose=there, friction=mu, table=TABLE)
        np.testing.assert_allclose(one.pose, found.push.pose[k + 1], rtol=0, atol=1e-12)


def test_monte_carlo_on_a_table(push, tmp_path):
    slider, hand, path, pose = push
    key, given = jax.random.key(2), {"pose": pose, "model": MODEL, "table": TABLE}
    many = pj.monte_carlo(key, 8, slider, hand, path, checkpoint=tmp_path, **given)
    for k in range(8):
        one = pj.random_rollout(jax.random.fold_in(key, k), slider, hand, path, **given)
        np.testing.assert_allclose(many.pose[k], one.push.pose[-1], rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"holds another run: table differ"):
        pj.monte_carlo(key, 8, slider, hand, path, checkpoint=tmp_path, pose=pose, model=MODEL)


def test_what_is_no_table(push):
    slider, hand, path, pose = push
    with pytest.raises(TypeError, match="table"):
        pj.step(slider, hand, path[0], path[1], pose=pose, friction=0.2, table=3.0)
    with pytest.raises(TypeError, match="table"):
        pj.random_rollout(jax.random.key(0), slider, hand, path, pose=pose, model=MODEL, table=3.0)
    bad = pj.Table(log_gradient=(1.0, 2.0))

    def status(slope):
        table = jax.tree.map(lambda leaf: leaf + slope, bad)
        return pj.step(slider, hand, path[0], path[1], pose=pose, friction=0.2, table=table).status

    assert jax.jit(status)(jnp.nan) == pj.Status.INVALID
