"""The Gymnasium versions of the tasks, compared with Gymnasium's own vector of single environments."""

import pickle
import subprocess
import sys
import warnings
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", minversion="1.1")

from gymnasium.utils.env_checker import check_env, data_equivalence  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402
from gymnasium.wrappers import RecordEpisodeStatistics  # noqa: E402
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics  # noqa: E402

from pushjax.tasks import Box, Dict, PushT, TaskState  # noqa: E402
from pushjax.tasks.environment import Environment  # noqa: E402
from pushjax.tasks.gym import TaskEnv, TaskVectorEnv  # noqa: E402

NUM_ENVS = 6
MODES = list(AutoresetMode)


@dataclass(frozen=True)
class Walk(Environment):
    """A point that walks along x to the origin, with noise; it compiles in no time. Episodes end in all ways."""

    @property
    def default_params(self):
        return PushT().default_params.replace(max_steps_in_episode=5)

    @property
    def hand_model(self):
        raise NotImplementedError

    def draw_start(self, key, params):
        return jax.random.uniform(key, (3,), minval=-1.0), jnp.zeros(2)

    def walk(self, state, action):
        raise NotImplementedError

    def goal_coverage(self, state, params):
        return jnp.clip(1 - jnp.abs(state.pose[0]), 0, 1)

    def observe(self, key, state, action, params):
        return {"x": state.pose[:1] + 0.01 * jax.random.normal(key, (1,)), "hand": state.hand}

    def step_env(self, key, state, action, params):
        noise_key, observation_key = jax.random.split(key)
        move = jnp.array([action[0], action[1], 0.0]) + 0.1 * jax.random.normal(noise_key, (3,))
        state = state.replace(pose=state.pose + move, hand=action, time=state.time + 1)
        coverage = self.goal_coverage(state, params)
        info = {"coverage": coverage, "is_success": coverage > 0.8, "status": jnp.full(7, state.time)}
        return self.observe(observation_key, state, action, params), state, coverage, coverage > 0.8, info

    def state_of(self, row, params):
        return TaskState(row[:3], row[3:], jnp.zeros(2), jnp.zeros((), jnp.int32))

    def action_space(self, params=None):
        return Box(-1.0, 1.0, (2,), jnp.result_type(float))

    def observation_space(self, params=None):
        box = Box(-10.0, 10.0, (1,), jnp.result_type(float))
        return Dict({"x": box, "hand": self.action_space()})


def sync_of_walks(mode):
    return SyncVectorEnv([lambda: TaskEnv(Walk())] * NUM_ENVS, autoreset_mode=mode)


def reset_by_hand(mode, ended):
    """Return the options with which episodes that have ended are reset, or None."""
    return {"reset_mask": ended} if mode == AutoresetMode.DISABLED and ended.any() else None


def assert_equal(ours, theirs):
    """Compare nested results. The programs of one and of many environments may round differently."""
    assert type(ours) is type(theirs)
    if isinstance(ours, dict):
        assert set(ours) == set(theirs)
        for name in ours:
            assert_equal(ours[name], theirs[name])
    elif isinstance(ours, np.ndarray) and ours.dtype != object:
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    elif isinstance(ours, (np.ndarray, tuple)):
        assert len(ours) == len(theirs)
        for one, other in zip(ours, theirs, strict=True):
            assert_equal(one, other)
    else:
        assert ours == theirs


# --- many environments ---


@pytest.mark.parametrize("mode", MODES)
def test_vector_is_a_vector_of_single_environments(mode, rng):
    ours, theirs = TaskVectorEnv(Walk(), NUM_ENVS, autoreset_mode=mode), sync_of_walks(mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_equal(ours.reset(seed=3), theirs.reset(seed=3))
    terminated, truncated = 0, 0
    for _ in range(30):
        actions = 0.3 * rng.uniform(-1, 1, (NUM_ENVS, 2))
        results, expected = ours.step(actions), theirs.step(actions)
        assert_equal(results, expected)
        terminated, truncated = terminated + results[2].sum(), truncated + results[3].sum()
        options = reset_by_hand(mode, results[2] | results[3])
        if options is not None:
            assert_equal(ours.reset(options=options), theirs.reset(options=dict(options)))
    assert terminated > 5
    assert truncated > 5
    assert_equal(ours.reset(), theirs.reset())  # goes on with the random numbers
    seeds = [7, None, 9, 10, 11, 12]
    assert_equal(ours.reset(seed=seeds), theirs.reset(seed=seeds))


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_starts_do_not_depend_on_the_actions(mode):
    """The third episode starts alike however long those before took, also with a seed of NumPy."""
    starts = []
    for actions, seed in ((0.0, 3), (0.2, np.int64(3))):
        env = TaskVectorEnv(Walk(), NUM_ENVS, autoreset_mode=mode)
        env.reset(seed=seed)
        episodes, found, ended = np.zeros(NUM_ENVS, int), np.full(NUM_ENVS, np.nan), np.zeros(NUM_ENVS, bool)
        for _ in range(20):
            observations, _, terminated, truncated, _ = env.step(np.full((NUM_ENVS, 2), actions))
            ended_now = terminated | truncated
            fresh = ended_now if mode == AutoresetMode.SAME_STEP else ended
            episodes, ended = episodes + fresh, ended_now
            found = np.where(fresh & (episodes == 2), observations["x"][:, 0], found)
        starts.append(found)
    assert np.isfinite(starts[0]).all()
    np.testing.assert_array_equal(*starts)


def test_starts_of_the_functional_interface_do_not_depend_on_the_actions():
    env, starts = Walk(), []
    for action, seed in ((0.0, 0), (0.2, 1)):
        _, state = env.reset(jax.random.key(7))
        found = [state.pose]
        for key in jax.random.split(jax.random.key(seed), 20):
            _, state, _, terminated, truncated, _ = env.step(key, state, jnp.full(2, action))
            found += [state.pose] if terminated | truncated else []
        starts.append(np.array(found[:3]))
    assert starts[0].shape == (3, 3)
    np.testing.assert_array_equal(*starts)
    assert len(np.unique(starts[0])) == 9


def test_seeds_of_numpy():
    env, many = TaskEnv(Walk()), TaskVectorEnv(Walk(), NUM_ENVS)
    assert_equal(env.reset(seed=np.int32(3)), env.reset(seed=3))
    assert_equal(many.reset(seed=list(np.arange(NUM_ENVS))), many.reset(seed=0))


IN_PROCESSES = """
import gymnasium, pushjax.tasks.gym
if __name__ == "__main__":
    for context in ("fork", "spawn"):
        made = gymnasium.make_vec(
            "pushjax/PushBox-v0", num_envs=2, vectorization_mode="async", vector_kwargs=dict(context=context)
        )
        try:
            print("observed", made.reset(seed=0)[0].shape)
        except RuntimeError as error:
            print("refused:", error)
        made.close(terminate=True)
"""


def test_environments_in_processes(tmp_path):
    """A forked process says that JAX does not work there, and does not wait forever; a spawned one works."""
    (tmp_path / "script.py").write_text(IN_PROCESSES)
    done = subprocess.run([sys.executable, tmp_path / "script.py"], capture_output=True, text=True, timeout=300)
    assert "refused: JAX cannot be" in done.stdout, done.stdout + done.stderr
    assert "observed (2, 6)" in done.stdout, done.stdout + done.stderr


def test_final_observation_is_that_before_the_reset():
    env = TaskVectorEnv(Walk(), NUM_ENVS, autoreset_mode="SameStep")
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros((NUM_ENVS, 2)))
    observations, _, terminated, truncated, info = env.step(np.zeros((NUM_ENVS, 2)))
    ended = terminated | truncated
    assert ended.any()
    for i in np.flatnonzero(ended):
        assert info["final_obs"][i]["x"] != observations["x"][i]
        assert info["final_info"]["is_success"][i] == terminated[i]


def test_an_ended_episode_without_reset_is_an_error():
    env = TaskVectorEnv(Walk(), NUM_ENVS, autoreset_mode="Disabled", max_episode_steps=1)
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        env.step(np.zeros((NUM_ENVS, 2)))
    env.reset(seed=0)
    env.step(np.zeros((NUM_ENVS, 2)))
    with pytest.raises(gymnasium.error.ResetNeeded, match="ended and need a reset: 0, 1"):
        env.step(np.zeros((NUM_ENVS, 2)))


def test_starts_at_given_states():
    env = TaskVectorEnv(Walk(), NUM_ENVS)
    rows = np.arange(5.0 * NUM_ENVS).reshape(NUM_ENVS, 5)
    observations, _ = env.reset(seed=0, options={"reset_to_state": rows})
    np.testing.assert_array_equal(observations["hand"], rows[:, 3:])
    observations, _ = env.reset(seed=0, options={"reset_to_state": rows[2].tolist()})
    np.testing.assert_array_equal(observations["hand"], np.tile(rows[2, 3:], (NUM_ENVS, 1)))


def test_vector_goes_on_from_a_pickle(rng):
    env = TaskVectorEnv(Walk(), NUM_ENVS)
    env.reset(seed=1)
    actions = 0.3 * rng.uniform(-1, 1, (12, NUM_ENVS, 2))
    for action in actions[:6]:
        env.step(action)
    copy = pickle.loads(pickle.dumps(env))
    for action in actions[6:]:
        assert data_equivalence(env.step(action), copy.step(action), exact=True)


# --- PushT ---

QUICK = {"walls": False, "substeps": 1}  # compiles in half of the time


@pytest.fixture(scope="module")
def push_t():
    return gymnasium.make("pushjax/PushT-v0", render_mode="rgb_array", render_size=96, **QUICK)


def test_gymnasiums_checks(push_t):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized space.*")  # pixels, as in gym-pusht
        check_env(push_t.unwrapped)


def test_time_limit_is_that_of_make(push_t):
    assert push_t.get_wrapper_attr("_max_episode_steps") == 300
    short = gymnasium.make("pushjax/PushT-v0", max_episode_steps=2, **QUICK)
    short.reset(seed=0)
    assert [short.step(np.array([20.0, 20.0]))[3] for _ in range(2)] == [False, True]
    many = gymnasium.make_vec("pushjax/PushT-v0", num_envs=2, max_episode_steps=7)
    assert many.params.max_steps_in_episode == 7
    assert gymnasium.make_vec("pushjax/PushT-v0", num_envs=2).params.max_steps_in_episode == 300


@pytest.mark.parametrize("steps", [2, 400])
def test_time_limit_may_be_that_of_the_parameters(steps):
    made = {"task": Walk(), "params": Walk().default_params.replace(max_steps_in_episode=steps)}
    single = gymnasium.make("pushjax/PushT-v0", **made)
    single.reset(seed=0)
    assert [single.step(np.zeros(2))[3] for _ in range(steps)] == [False] * (steps - 1) + [True]
    many = gymnasium.make_vec("pushjax/PushT-v0", num_envs=2, **made)
    assert many.params.max_steps_in_episode == steps


def test_push_t_in_a_vector(push_t):
    """One wrapper on a single environment, the same one on a vector; the second environment starts at the goal."""
    goal = [400.0, 100.0, 256.0, 256.0, np.pi / 4]
    row = np.array([[100.0, 100.0, 250.0, 300.0, 1.0], [0.0] * 5])
    row[1] = goal
    many = RecordVectorStatistics(gymnasium.make_vec("pushjax/PushT-v0", num_envs=2, **QUICK))
    single = RecordEpisodeStatistics(push_t)
    first, _ = many.reset(seed=0, options={"reset_to_state": row})
    alone, _ = single.reset(seed=0, options={"reset_to_state": row[0]})
    np.testing.assert_allclose(first[0], alone)
    for k in range(6):
        action = np.array([130.0 + 20 * k, 150.0 + 20 * k])
        observations, rewards, terminated, _, info = many.step(np.stack([action, [400.0, 100.0]]))
        observation, reward, *_ = single.step(action)
        np.testing.assert_allclose(observations[0], observation, atol=1e-9)
        np.testing.assert_allclose(rewards[0], reward, atol=1e-9)
        if k == 0:
            assert list(terminated) == [False, True]
            assert list(info["is_success"]) == [False, True]
            assert info["coverage"][1] > 0.999
            assert info["episode"]["l"][1] == 1
    assert observations[0, 0] > 180  # the agent has followed


def test_pictures_show_the_state(push_t):
    push_t.reset(seed=0, options={"reset_to_state": [100.0, 400.0, 256.0, 100.0, 0.0]})
    before = push_t.render()
    push_t.step(np.array([300.0, 400.0]))
    after = push_t.render()
    assert before.shape == after.shape == (96, 96, 3)
    assert tuple(before[75, 18]) == (78, 126, 255)  # the agent, at (100, 400)
    assert tuple(after[75, 18]) == (255, 255, 255)
    assert tuple(after[75, 56]) == (255, 0, 0)  # the action
    assert TaskEnv(Walk()).render() is None


def test_goes_on_from_a_pickle(push_t):
    push_t.reset(seed=4)
    for k in range(3):
        push_t.step(np.array([200.0 + 20 * k, 300.0]))
    copy = pickle.loads(pickle.dumps(push_t))
    for k in range(3):
        action = np.array([300.0, 300.0 - 30 * k])
        assert data_equivalence(push_t.step(action), copy.step(action), exact=True)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"task": "PushP"},
            ValueError,
            "task must be one of PushT, PushBox, PushAlongWall, PushTwoFingers, Squeeze, PushClutter; got 'PushP'",
        ),
        ({"task": 3}, TypeError, "task: expected a Environment; got a int"),
        ({"task": Walk(), "substeps": 2}, TypeError, "substeps: options go with the name of a task"),
        ({"observation": "pixel"}, ValueError, "observation must be one of state"),
        ({"render_mode": "human"}, ValueError, "render_mode must be 'rgb_array' or None; got 'human'"),
        ({"render_size": 0}, ValueError, "render_size must be a whole number, at least 1; got 0"),
    ],
)
def test_invalid_arguments(arguments, error, message):
    for kind in (TaskEnv, TaskVectorEnv):
        with pytest.raises(error, match=message):
            kind(**arguments)


def test_invalid_resets_and_actions():
    env = TaskVectorEnv(Walk(), NUM_ENVS)
    with pytest.raises(ValueError, match="num_envs must be a whole number"):
        TaskVectorEnv(Walk(), 0)
    with pytest.raises(ValueError, match="seed: expected one for each of 6 environments; got 2"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match=r"reset_to_state has shape \(2, 5\)"):
        env.reset(options={"reset_to_state": np.zeros((2, 5))})
    with pytest.raises(ValueError, match="reset_to_state must be finite"):
        env.reset(options={"reset_to_state": np.full(5, np.nan)})
    with pytest.raises(ValueError, match="reset_mask must be boolean of shape"):
        env.reset(options={"reset_mask": np.zeros(NUM_ENVS, bool)})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(2,\); expected \(6, 2\)"):
        env.step(np.zeros(2))
