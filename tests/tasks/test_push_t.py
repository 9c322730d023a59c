"""PushT: starts, observations and bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.tasks import PushT

BATCH = 64
ENV = PushT()
BOX = pj.Polygon.rectangle(80.0, 60.0)
OPEN = PushT(walls=False)


@pytest.fixture(scope="module")
def box():
    """Return the parameters of a box with random friction."""
    return OPEN.params(block=BOX, model=pj.FrictionModel(dof=20, friction=(0.1, 0.5)))


@pytest.fixture(scope="module")
def box_steps():
    """Return the compiled function that takes the control steps of one episode with a box, without resets."""

    @jax.jit
    def run(state, actions, params):
        def one_step(state, action):
            _, state, reward, _, info = OPEN.step_env(jax.random.key(0), state, action, params)
            return state, (state, reward, info)

        return jax.lax.scan(one_step, state, actions)

    return run


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
    for params in (ENV.default_params, ENV.params(block=BOX, center=(10.0, 20.0))):
        state = ENV.state_of(row, params, velocity=(3.0, 4.0))
        assert np.allclose(ENV.observe(jax.random.key(0), state, None, params), row, atol=1e-3)
        assert np.array_equal(state.velocity, [3, 4])


def test_block_with_a_center_and_a_length_of_its_own():
    params = ENV.params(block=BOX, center=(10.0, 20.0), length=50.0)
    assert float(params.slider.surface.length) == pytest.approx(0.05)
    assert np.allclose(params.slider.shape.vertices, (np.array(BOX.vertices) - [10, 20]) * 1e-3)
    assert np.allclose(params.origin, [-10, -20])
    default = ENV.params(block=BOX)
    assert float(default.slider.surface.length) == pytest.approx(np.hypot(0.08, 0.06) / 12**0.5)
    assert np.allclose(default.origin, 0, atol=1e-5)
    heavy = ENV.params(length=53.39)
    assert np.array_equal(heavy.corners, ENV.default_params.corners)
    assert float(heavy.slider.surface.length) == pytest.approx(0.05339)


# Steps of a box: its programs are small, because a finger touches a convex block in one place


def test_friction_is_drawn_at_the_reset(box, box_steps):
    keys = jax.random.split(jax.random.key(0), 200)
    _, states = jax.vmap(OPEN.reset, in_axes=(0, None))(keys, box)
    friction = np.asarray(states.friction)
    assert friction.min() > 0.1
    assert friction.max() < 0.5
    assert np.ptp(friction) > 0.35
    assert len(np.unique(states.surface.A[:, 0, 0])) == 200
    row = jnp.array([150.0, 240.0, 256.0, 256.0, 0.0])
    actions = jnp.broadcast_to(jnp.array([250.0, 240.0]), (10, 2))
    ends = []
    for mu in (0.1, 0.5):  # the same surface, and a push off the center
        state = OPEN.state_of(row, box).replace(surface=box.slider.surface, friction=jnp.asarray(mu))
        last, _ = box_steps(state, actions, box)
        ends.append(np.asarray(last.pose))
    assert np.abs(ends[0] - ends[1]).max() > 0.05


@pytest.mark.slow
def test_derivatives_are_those_of_differences(box, box_steps):
    """Of the coverage at the end, in the actions: a box is pushed to the goal, off its center."""
    params = box.replace(goal=jnp.array([300.0, 262.0, 0.3]))
    state = OPEN.state_of([150.0, 230.0, 256.0, 256.0, 0.1], params)
    state = state.replace(surface=box.slider.surface, friction=jnp.asarray(0.3))
    actions = jnp.array([[260.0, 240.0]] * 6)

    def coverage(actions):
        return box_steps(state, actions, params)[1][2]["coverage"][-1]

    gradient = jax.jit(jax.grad(coverage))(actions)
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 1e-4
    step = 0.5
    direction = jax.random.normal(jax.random.key(0), (8, 6, 2))
    for d in direction:
        difference = (coverage(actions + step * d) - coverage(actions - step * d)) / (2 * step)
        assert jnp.sum(gradient * d) == pytest.approx(float(difference), abs=0.05 * float(jnp.linalg.norm(gradient)))


# Bad input


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: PushT(observation="image"), "observation must be one of state"),
        (lambda: PushT(substeps=3), "substeps must be 1, 2, 5 or 10; got 3"),
        (lambda: PushT(image_size=0), "image_size must be positive"),
        (lambda: ENV.params("mujoco"), "physics must be one of pymunk, table; got 'mujoco'"),
        (lambda: ENV.params(goal=(1.0, 2.0)), r"goal has shape \(2,\)"),
        (lambda: ENV.params(friction=-0.1), "friction must not be negative"),
        (lambda: ENV.params(length=0.0), "length must be positive; got 0"),
        (lambda: ENV.params(center=(1.0, 2.0, 3.0)), r"center has shape \(3,\)"),
        (lambda: ENV.params("table", length=50.0), "center and length are for physics 'pymunk'"),
        (lambda: ENV.state_of(np.zeros(5), velocity=[1.0]), r"velocity has shape \(1,\)"),
        (lambda: ENV.params(action_noise=np.nan), "action_noise must be finite"),
        (lambda: ENV.params(max_steps_in_episode=0), "max_steps_in_episode must be a whole number, at least 1"),
        (lambda: ENV.state_of([1.0, 2.0]), r"observation has shape \(2,\)"),
        (lambda: ENV.state_of([1.0, 2.0, 3.0, 4.0, np.inf]), "observation must be finite"),
    ],
)
def test_bad_input(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


def test_a_time_limit_is_no_constant_of_a_program():
    """Parameters that differ in it share their compiled programs."""
    limits = ENV.params(max_steps_in_episode=5), ENV.default_params, ENV.default_params.replace(max_steps_in_episode=7)
    assert [int(each.max_steps_in_episode) for each in limits] == [5, 300, 7]
    constants = [eqx.filter(each, eqx.is_array, inverse=True) for each in limits]
    assert eqx.tree_equal(*constants)


def test_wrong_types_and_actions():
    with pytest.raises(TypeError, match="block"):
        ENV.params(block=pj.Disk(20.0))
    foreign = type("Polygon", (), {"__module__": "shapely.geometry"})()
    with pytest.raises(TypeError, match=r"expected a pushjax\.geometry.*\.Polygon; got a shapely\.geometry\.Polygon"):
        ENV.params(block=foreign)
    with pytest.raises(TypeError, match="speed"):
        ENV.default_params.replace(speed=1)
    _, state = ENV.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"action has shape \(3,\)"):
        ENV.step(jax.random.key(0), state, jnp.zeros(3))
