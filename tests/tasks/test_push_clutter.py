"""PushClutter: starts, episodes, blocks that push each other, and both ends of an episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.tasks import PushClutter
from pushjax.tasks.push_clutter import CLEARANCE

pytestmark = pytest.mark.slow
MODEL = pj.FrictionModel(dof=40.0, friction=(0.1, 0.5))


@pytest.fixture(scope="module")
def env():
    return PushClutter(blocks=3)


def run(env, state, actions, params):
    """Return states, rewards and infos of the control steps of an episode."""

    def step(state, inputs):
        observation, state, reward, terminated, info = env.step_env(inputs[0], state, inputs[1], params)
        return state, (state, observation, reward, terminated, info)

    keys = jax.random.split(jax.random.key(1), len(actions))
    return jax.jit(lambda state: jax.lax.scan(step, state, (keys, jnp.asarray(actions, state.hand.dtype)))[1])(state)


def test_starts_are_apart_and_random(env):
    params = env.params(model=MODEL)
    observation, state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(jax.random.key(0), 200), params)
    clearance = jax.vmap(lambda one: env.measures(one, params)["clearance"])(state)
    assert float(clearance.min()) > 0
    assert observation.shape == (200, 14) == (200, *env.observation_space(params).shape)
    distance = jnp.linalg.norm(state.pose[..., :2] - state.hand[:, None], axis=-1)
    assert float(distance.min()) > float(params.radius) + 0.01
    # each block has friction of its own
    entries = np.asarray(state.surface.coefficients[:, :, 0])
    assert np.all(np.ptp(entries, axis=1) > 0)


def test_a_block_pushes_another_one_to_the_goal(env):
    """The finger pushes the second block, which pushes the first one; the third one rests bit for bit."""
    params = env.default_params
    row = [-0.055, 0.0, 0.07, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.15, 0.4]
    actions = [[1, 0]] * 5 + [[0.25, 0]]
    states, observation, reward, terminated, info = run(env, env.state_of(row, params), actions, params)
    assert bool(terminated[-1])
    assert float(info["coverage"][-1]) > 0.9
    assert np.all(np.diff(reward) > 0)
    np.testing.assert_array_equal(states.pose[:, 2], np.broadcast_to(np.asarray(row[-3:]), (6, 3)))
    np.testing.assert_allclose(observation[:, 2:4], states.pose[:, 0, :2])
    assert float(info["clearance"].min()) > -1e-3
    # the same bits again
    again = run(env, env.state_of(row, params), actions, params)[0]
    np.testing.assert_array_equal(again.pose, states.pose)


def test_blocks_that_are_apart_are_singulated():
    env = PushClutter(blocks=2, singulate=True)
    params = env.params(between=0.1)
    row = [0.0, 0.08, -0.035, 0.0, 0.0, 0.035, 0.0, 0.0]
    state = env.state_of(row, params)
    np.testing.assert_allclose(env.measures(state, params)["clearance"], 0.01, rtol=1e-5)
    # the finger comes between the two
    states, _, reward, terminated, info = run(env, state, [[0, -0.5]] * 10, params)
    assert not bool(terminated[0])
    assert bool(terminated[-1]) == (float(info["clearance"][-1]) > CLEARANCE)
    assert float(info["clearance"][-1]) > 0.018
    assert bool(env.is_terminated(env.state_of([0.0, 0.08, -0.045, 0.0, 0.0, 0.045, 0.0, 0.0], params), params))
    assert float(reward[-1]) > float(reward[0])
    assert np.all(np.asarray(states.pose)[:, 0, 0] <= -0.035 + 1e-6)


def test_batches_in_gymnasium():
    gymnasium = pytest.importorskip("gymnasium")
    import pushjax.tasks.gym  # noqa: F401

    envs = gymnasium.make_vec("pushjax/PushClutter-v0", num_envs=4, blocks=2)
    first, _ = envs.reset(seed=3)
    assert first.shape == (4, 10)
    for _ in range(3):
        observation, reward, *_, info = envs.step(np.ones((4, 2), np.float32))
    assert observation.shape == (4, 10)
    assert np.all(np.isfinite(reward))
    assert np.all(info["status"].sum(axis=1) == 2)


def test_bad_arguments(env):
    for build, message in (
        (lambda: PushClutter(blocks=0), "blocks must be"),
        (lambda: PushClutter(blocks=9), "blocks must be at most 8; got 9"),
        (lambda: env.params(between=-0.1), "between must not be negative"),
        (lambda: env.params(block=pj.Polygon.rectangle(0.2, 0.1)), "a corner may be 0.045 m"),
    ):
        with pytest.raises(ValueError, match=message):
            build()
