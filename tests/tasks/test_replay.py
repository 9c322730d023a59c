"""Recorded episodes of pymunk, in rows of five numbers, replayed by `PushT`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import pusht
from pushjax.tasks import PushT

ENV, STEPS = PushT(walls=False), 12
LENGTHS = (2850**0.5, 1912.5**0.5)  # px, of the T in a public data set, whose parts differ; gym-pusht's has 3000**0.5


@pytest.fixture(scope="module", params=LENGTHS)
def record(request):
    """The length, rows before and after each control step, (steps + 1, 5), and actions. The agent starts at rest."""
    pytest.importorskip("gym_pusht")
    gym = pusht.make_gym()
    gym.reset(seed=0)
    gym.block.moment = request.param**2 * gym.block.mass
    gym.agent.position, gym.agent.velocity = (180.0, 330.0), (0.0, 0.0)
    gym.block.angle = 0.4
    gym.block.position, gym.block.velocity, gym.block.angular_velocity = (270.0, 250.0), (0.0, 0.0), 0.0
    rows, actions = [gym.get_obs()], [np.array([190.0 + 12 * k, 328.0 - 2 * k]) for k in range(STEPS)]
    for action in actions:
        rows.append(gym.step(action)[0])
    return request.param, np.array(rows), np.array(actions)


@pytest.fixture(scope="module")
def step():
    def step(state, action, params):
        observation, state, *_ = ENV.step_env(jax.random.key(0), state, action, params)
        return observation, state

    return jax.jit(step)


def replayed(step, record, params, from_rows):
    """Return the rows that are observed, each step from the recorded row or from where the one before ended."""
    _, rows, actions = record
    state, found = ENV.state_of(rows[0], params), []
    for row, action in zip(rows, actions, strict=False):
        if from_rows:  # the agent's velocity is not recorded
            state = ENV.state_of(row, params, velocity=state.velocity)
        observation, state = step(state, jnp.asarray(action), params)
        found.append(np.asarray(observation))
    return np.array(found)


@pytest.mark.parametrize(("from_rows", "pixels", "degrees"), [(True, 0.5, 0.5), (False, 1.0, 0.6)])
def test_a_record_is_repeated(step, record, from_rows, pixels, degrees):
    """Each control step from its row, and the whole episode open loop."""
    length, rows, _ = record
    found, wanted = replayed(step, record, ENV.params(length=length), from_rows), rows[1:]
    assert np.abs(found[:, :2] - wanted[:, :2]).max() < 1e-3  # the agent
    assert np.linalg.norm(found[:, 2:4] - wanted[:, 2:4], axis=1).max() < pixels
    assert np.degrees(np.abs(found[:, 4] - wanted[:, 4])).max() < degrees
    assert np.linalg.norm(wanted[-1, 2:4] - rows[0, 2:4]) > 20
    assert np.degrees(np.abs(wanted[-1, 4] - rows[0, 4])) > 5


def test_another_length_is_another_body(step, record):
    found = replayed(step, record, ENV.params(length=1.3 * record[0]), False)
    assert np.linalg.norm(found[-1, 2:4] - record[1][-1, 2:4]) > 1.5
