"""The tasks on a table: starts, episodes, success, derivatives, and Gymnasium's checks."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.tasks import PushAlongWall, PushBox, PushT, PushTwoFingers, Squeeze

BATCH, STEPS = 32, 25
TASKS = (PushBox, PushAlongWall, PushTwoFingers, Squeeze)
# the programs of two fingers and of a jaw take much longer to compile than those of one finger
EPISODES = (*TASKS[:2], *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS[2:]))
MODEL = pj.FrictionModel(dof=None, friction=(0.1, 0.5))
# A state of which the actions lead to success: configuration of the hand, pose of the block; actions.
REACHED = {
    PushBox: ([-0.157, 0.004, -0.1, 0.004, np.pi], [[1, 0]] * 5),
    PushAlongWall: ([-0.115, -0.117, -0.05, -0.12, 0.0], [[1, 0]] * 8),
    PushTwoFingers: ([-0.16, 0.0, 0.0, -0.1, 0.0, 0.05], [[1, 0, 0]] * 5),
    Squeeze: ([-0.06, 0.0, 0.0, 0.14, -0.05, 0.0, 0.3], [[0, 0, 0, -1]] * 5 + [[0.8, 0, 0, -1]] * 3),
}


@pytest.fixture(scope="module")
def episodes():
    """Return the compiled function that takes the control steps of many episodes, one episode after another."""

    def run(env, starts, actions, params):
        def step(state, inputs):
            observation, state, reward, _, info = env.step_env(inputs[0], state, inputs[1], params)
            return state, (state, observation, reward, info)

        def one(episode):
            key, start, actions = episode
            return jax.lax.scan(step, start, (jax.random.split(key, STEPS), actions))[1]

        return jax.lax.map(one, (jax.random.split(jax.random.key(1), BATCH), starts, actions))

    compiled = jax.jit(run, static_argnums=0)
    return lambda *args: jax.tree.map(np.asarray, compiled(*args))


def starts(env, params):
    return jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(jax.random.split(jax.random.key(0), 200), params)


@functools.cache
def drawn(task):
    """Return the task, its parameters with random friction, 200 observations and 200 states at the start."""
    env = task()
    params = env.params(model=MODEL, position_noise=0.002, angle_noise=0.05, action_noise=0.1)
    return env, params, *starts(env, params)


def without_noise(params):
    zero = jnp.zeros_like(params.position_noise)
    return params.replace(position_noise=zero, angle_noise=zero, action_noise=zero)


def at(env, row, params):
    """Return the state of a row, with the mean friction, and with all fields of those of a reset."""
    state = env.state_of(row, params).replace(surface=params.slider.surface, friction=params.friction)
    return state.replace(next_start=jnp.zeros(2, jnp.uint32))


def everywhere(state):
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (BATCH, *leaf.shape)), state)


def random_actions(env, seed=0):
    """Return actions that last for some steps, so that the hand goes somewhere, (BATCH, STEPS, actions)."""
    rng = np.random.default_rng(seed)
    held = rng.uniform(-1.5, 1.5, (BATCH, 5, env.num_actions))
    return jnp.asarray(np.repeat(held, STEPS // 5, axis=1))


def fingers_and_block(env, state, params):
    """Return shapely's fingers and block of one state."""
    shapely = pytest.importorskip("shapely")
    hand = env.hand_model
    poses = np.asarray(hand.poses(state.hand[None])[0])
    bodies = []
    for finger, pose in zip(hand.fingers, poses, strict=True):
        if hasattr(finger, "radius"):
            bodies.append(shapely.Point(pose[:2]).buffer(float(finger.radius), 64))
        else:
            bodies.append(moved(finger.shape.vertices, pose))
    return bodies, moved(params.corners, np.asarray(state.pose))


def moved(vertices, pose):
    shapely = pytest.importorskip("shapely")
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return shapely.Polygon(np.asarray(vertices) @ np.array([[c, s], [-s, c]]) + pose[:2])


# Starts


@pytest.mark.parametrize("task", TASKS)
def test_starts_are_free_of_overlaps(task):
    env, params, observations, states = drawn(task)
    space = env.observation_space(params)
    assert observations.shape == (200, *space.shape)
    assert ((observations >= space.low) & (observations <= space.high)).all()
    low, high = np.array(env.LOWEST), np.array(env.HIGHEST)
    hand = np.asarray(states.hand)
    assert ((hand >= low) & (hand <= high)).all()
    assert np.ptp(states.pose, axis=0).min() > 0.04
    for k in range(200):
        state = jax.tree.map(lambda leaf, k=k: leaf[k], states)
        bodies, block = fingers_and_block(env, state, params)
        assert not any(body.intersects(block) for body in bodies)
        if task is PushAlongWall:
            assert block.bounds[1] > -0.15


@pytest.mark.slow
def test_friction_and_surface_are_drawn_at_the_reset():
    env = PushTwoFingers()
    _, states = starts(env, env.params(model=pj.FrictionModel(dof=20, friction=(0.1, 0.5))))
    assert 0.1 < states.friction.min() < states.friction.max() < 0.5
    assert len(np.unique(np.asarray(states.friction))) == 200
    assert states.surface.coefficients.shape[0] == 200


# Steps, by one program for each task


@pytest.mark.parametrize("task", EPISODES)
def test_random_episodes(task, episodes):
    env, params, _, states = drawn(task)
    start = jax.tree.map(lambda leaf: leaf[:BATCH], states)
    states, observations, reward, info = episodes(env, start, random_actions(env), params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((states, observations, reward, info)))
    steps = env.substeps * (2 if task is Squeeze else 1)
    assert np.array_equal(info["status"].sum(-1), np.full((BATCH, STEPS), steps))
    failed = [status.failed for status in pj.Status]
    assert info["status"][..., failed].sum() <= 0.01 * BATCH * STEPS * steps
    moved_by = np.abs(np.diff(states.hand, axis=1))
    assert (moved_by <= np.array(env.MOTION) * (1 + 1e-6)).all()
    assert (states.pose[:, -1] != states.pose[:, 0]).any(axis=1).mean() > 0.1
    goal = moved(params.corners, np.asarray(params.goal))
    assert (reward < 0).all()
    for k in range(BATCH):
        state = jax.tree.map(lambda leaf, k=k: leaf[k, -1], states)
        bodies, block = fingers_and_block(env, state, params)
        assert info["coverage"][k, -1] == pytest.approx(block.intersection(goal).area / block.area, abs=1e-9)
        assert max(body.intersection(block).area for body in bodies) < 0.02 * block.area
        # modulo half a turn, after which the rectangle looks the same
        off = (float(state.pose[2] - params.goal[2]) + np.pi / 2) % np.pi - np.pi / 2
        assert info["angle_error"][k, -1] == pytest.approx(abs(off), abs=1e-9)


@pytest.mark.parametrize("task", EPISODES)
def test_success_can_be_reached(task, episodes):
    """With the mean friction and no noise, in the same program as the random episodes."""
    env, params, _, _ = drawn(task)
    params = without_noise(params)
    row, actions = REACHED[task]
    state = everywhere(at(env, row, params))
    waits = np.zeros((STEPS - len(actions), env.num_actions))
    actions = jnp.broadcast_to(jnp.asarray(np.concatenate([actions, waits])), (BATCH, STEPS, env.num_actions))
    states, observations, reward, info = episodes(env, state, actions, params)
    assert bool(info["is_success"][0, -1])
    assert info["coverage"][0, -1] > 0.9
    assert reward[0, -1] > reward[0, 0] + 0.4
    if task is Squeeze:
        assert list(np.asarray(info["is_held"])[0, [0, -1]]) == [False, True]
        assert abs(states.pose[0, -1, 2]) < 1e-3  # the jaw has turned the block
    if task is PushBox:  # this block is turned by half a turn, which is not observed
        assert abs(states.pose[0, -1, 2] - np.pi) < 0.01
        assert abs(observations[0, -1, 4] - 1) < 0.01


def test_reward_has_a_derivative_at_the_goal():
    env = PushBox()
    params = env.default_params
    state = env.state_of([0.0, 0.0, 0.0, 0.0, 0.0], params)

    def reward(pose):
        at = state.replace(pose=pose)
        return env.reward(at, env.measures(at, params), params)

    value, gradient = jax.jit(jax.value_and_grad(reward))(params.goal)
    assert value == 0
    assert np.isfinite(gradient).all()


# Gymnasium


def test_registered():
    gymnasium = pytest.importorskip("gymnasium", minversion="1.1")
    import pushjax.tasks.gym

    for task in TASKS:
        assert gymnasium.spec(f"pushjax/{task.__name__}-v0").max_episode_steps is None  # the parameters have a limit
        env = pushjax.tasks.gym.TaskEnv(task.__name__, substeps=1)
        assert env.params.max_steps_in_episode == 100
        assert env.task == task(substeps=1)


@pytest.mark.slow  # those of PushT see the same code
@pytest.mark.parametrize("task", TASKS)
def test_gymnasiums_checks_and_pictures(task):
    gymnasium = pytest.importorskip("gymnasium", minversion="1.1")
    from gymnasium.utils.env_checker import check_env

    import pushjax.tasks.gym  # noqa: F401

    env = gymnasium.make(f"pushjax/{task.__name__}-v0", render_mode="rgb_array", render_size=120)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    row, actions = REACHED[task]
    _, info = env.reset(seed=0, options={"reset_to_state": row})
    before = env.render()
    for action in actions:
        *_, terminated, _, info = env.step(np.array(action))
    assert terminated
    assert info["is_success"]
    assert info["coverage"] > 0.9
    green = (144, 238, 144)
    assert np.all(before == green, axis=-1).sum() > 100  # the goal, which the block then covers
    assert np.all(env.render() == green, axis=-1).sum() < 60


# Bad input


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (lambda: PushBox(substeps=0), ValueError, "substeps must be a whole number, at least 1; got 0"),
        (lambda: PushBox().params(block=pj.Disk(0.02)), TypeError, "block: expected a Polygon; got a Disk"),
        (
            lambda: Squeeze().params(block=pj.Polygon.rectangle(0.2, 0.02)),
            ValueError,
            "block: a corner may be 0.065 m from the center; got 0.1 m",
        ),
        (lambda: PushBox().params(goal=(0, 0)), ValueError, r"goal has shape \(2,\)"),
        (lambda: PushBox().params(wall_friction=-1), ValueError, "wall_friction must not be negative"),
        (lambda: PushBox().params(success_coverage=np.nan), ValueError, "success_coverage must be finite"),
        (lambda: PushBox().state_of([0.0, 1.0]), ValueError, r"row has shape \(2,\); expected \(5,\)"),
    ],
)
def test_bad_input(wrong, error, message):
    with pytest.raises(error, match=message):
        wrong()


@pytest.mark.parametrize("task", [PushAlongWall, PushT])
def test_the_parameters_decide_the_dtype(task):
    """Parameters in float32 give states, observations and rewards in float32 where float64 is enabled."""
    env = task()
    params = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, np.float32) if jnp.issubdtype(jnp.result_type(leaf), np.floating) else leaf,
        env.params(model=MODEL),
    )

    def episode(key):
        _, state = env.reset_env(key, params)
        return env.step_env(key, state, jnp.zeros(env.num_actions, np.float32), params)

    assert jnp.result_type(float) == np.float64
    found = {leaf.dtype for leaf in jax.tree.leaves(jax.eval_shape(episode, jax.random.key(0)))}
    assert np.dtype(np.float64) not in found
    assert np.dtype(np.float32) in found
