"""PushT: starts, observations and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.tasks import PushT

BATCH = 64
ENV = PushT()


def starts(count=BATCH, seed=0, env=ENV):
    return jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(jax.random.key(seed), count), env.default_params)


# Resets and spaces


def test_starts_are_those_of_gym_pusht():
    observation, state = starts(4000)
    agent, angle = np.asarray(state.hand), np.asarray(state.pose[:, 2])
    assert np.array_equal(agent, np.round(agent))
    assert (agent.min(), agent.max()) == (50, 449)
    # the block's position is set before its angle, which turns it about the center of gravity
    block = np.asarray(state.pose[:, :2]) - [0, 45]
    assert np.array_equal(block, np.round(block))
    assert (block.min(), block.max()) == (100, 399)
    assert abs(angle.mean()) < 0.15
    assert np.allclose([angle.min(), angle.max()], [-np.pi, np.pi], atol=0.02)
    turned = np.stack([np.sin(angle), -np.cos(angle)], axis=1) * 45
    assert np.allclose(observation[:, 2:4], state.pose[:, :2] + turned, atol=1e-3)
    assert np.allclose(observation[:, 4], np.mod(angle, 2 * np.pi), atol=1e-5)


@pytest.mark.parametrize("kind", ["state", "environment_state_agent_pos", "pixels", "pixels_agent_pos"])
def test_observations_lie_in_their_space(kind):
    env = PushT(observation=kind)
    observation, _ = env.reset(jax.random.key(1))
    space = env.observation_space(env.default_params)
    assert bool(space.contains(observation))
    sample = space.sample(jax.random.key(0))
    assert bool(space.contains(sample))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), sample) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), observation
    )


def test_corners_are_those_of_gym_pusht():
    """Of a T at (200, 200) with the angle zero, as gym-pusht's own `environment_state`."""
    env = PushT(observation="environment_state_agent_pos")
    state = env.state_of([100, 100, 200, 200, 0.0])
    corners = env.observe(jax.random.key(0), state, None, env.default_params)["environment_state"]
    wanted = [140, 200, 260, 200, 260, 230, 140, 230, 185, 230, 215, 230, 215, 320, 185, 320]
    assert np.allclose(corners, wanted, atol=1e-3)


def test_state_of_a_row():
    row = np.array([100.0, 120.0, 200.0, 210.0, 2.5])
    state = ENV.state_of(row, position_first=False)
    assert np.allclose(ENV.observe(jax.random.key(0), state, None, ENV.default_params), row, atol=1e-3)
    # gym-pusht's own documentation: its reset to this state gives this observation
    state = ENV.state_of([0.0, 10.0, 20.0, 30.0, 1.0])
    observed = ENV.observe(jax.random.key(0), state, None, ENV.default_params)
    assert np.allclose(observed, [0.0, 10.0, 57.866196, 50.686398, 1.0], atol=1e-4)


# Bad input


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: PushT(observation="image"), "observation must be of state"),
        (lambda: PushT(substeps=3), "substeps must be 1, 2, 5 or 10; got 3"),
        (lambda: PushT(image_size=0), "image_size must be positive"),
        (lambda: ENV.params("mujoco"), "physics must be of pymunk, table; got 'mujoco'"),
        (lambda: ENV.params(goal=(1.0, 2.0)), r"goal has shape \(2,\)"),
        (lambda: ENV.params(friction=-0.1), "friction must not be negative"),
        (lambda: ENV.params(action_noise=np.nan), "action_noise must be finite"),
        (lambda: ENV.params(max_steps_in_episode=0), "max_steps_in_episode must be at least 1"),
        (lambda: ENV.state_of([1.0, 2.0]), r"observation has shape \(2,\)"),
        (lambda: ENV.state_of([1.0, 2.0, 3.0, 4.0, np.inf]), "observation must be finite"),
    ],
)
def test_bad_input(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


def test_wrong_types_and_actions():
    with pytest.raises(TypeError, match="block"):
        ENV.params(block=pj.Disk(20.0))
    with pytest.raises(TypeError, match="has no field speed"):
        ENV.default_params.replace(speed=1)
    _, state = ENV.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"action has shape \(3,\)"):
        ENV.step(jax.random.key(0), state, jnp.zeros(3))
