"""PushT in batches, with walls: parity with gym-pusht, finite steps, automatic resets, rewards, jams and overlaps.

All tests run one program.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from benchmarks import pusht
from pushjax.tasks import PushT, TaskState
from pushjax.tasks.push_t import T_VERTICES

BATCH, STEPS = pusht.AT_ONCE, 30
ENV = PushT()
PARAMS = ENV.default_params


@pytest.mark.slow
def test_steps_are_finite_and_episodes_follow_one_another():
    keys = jax.random.split(jax.random.key(0), BATCH)
    _, states = jax.vmap(ENV.reset, in_axes=(0, None))(keys, PARAMS)
    space, finite = ENV.action_space(), True
    for k in range(12):
        actions = jax.vmap(space.sample)(jax.random.split(jax.random.key(k), STEPS * BATCH)).reshape(STEPS, BATCH, 2)
        after, (observation, _, reward, terminated, truncated, info) = pusht.replayed(ENV, states, actions, PARAMS)
        finite &= all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, observation, reward, info)))
        assert np.array_equal(info["status"].sum(-1), np.full((STEPS, BATCH), ENV.substeps))
        done = np.asarray(terminated | truncated)
        assert np.array_equal(done, np.asarray(after.time) == 0)
        kept = np.asarray(observation == info["final_observation"]).all(-1)
        assert np.array_equal(kept, ~done)
        assert np.asarray(truncated)[~done].sum() == 0
        if k == 9:  # 300 control steps
            assert done[-1].mean() > 0.9
        states = jax.tree.map(lambda leaf: leaf[-1], after)
    assert finite


def test_reward_of_a_block_at_the_goal():
    states = jax.vmap(lambda shift: ENV.state_of([50, 50, 256 + shift, 256, np.pi / 4]))(jnp.linspace(0.0, 40.0, BATCH))
    actions = jnp.full((STEPS, BATCH, 2), 50.0, float)
    _, (_, _, reward, terminated, _, info) = pusht.replayed(ENV, states, actions, PARAMS)
    coverage = np.asarray(info["coverage"][0])
    assert coverage[0] == pytest.approx(1, abs=1e-5)
    assert (np.diff(coverage) < 0).all()
    assert np.array_equal(terminated[0], coverage > 0.95)
    assert np.allclose(reward[0], np.minimum(coverage / 0.95, 1), atol=1e-6)


def test_a_block_at_a_wall_holds_the_agent_back():
    """The bar of the T lies on the left wall, and the agent pushes the stem toward the wall."""
    row = [200.0, 256.0, 7.0, 256.0, -np.pi / 2]
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (BATCH, *leaf.shape)), ENV.state_of(row))
    actions = jnp.broadcast_to(jnp.array([20.0, 256.0]), (STEPS, BATCH, 2))
    after, (*_, info) = pusht.replayed(ENV, states, actions, PARAMS)
    assert np.allclose(after.pose[-1], states.pose, atol=0.5)
    assert np.allclose(after.hand[-1], [7 + 120 + 15, 256], atol=1.0)
    assert np.asarray(info["status"])[-1, :, pj.Status.JAMMED].min() > 0


# Block wedged between agent and walls: x, y and angle of the block, agent, and where it went in a control step.
WEDGED = (
    (76.607, 447.912, 0.945, 121.683, 407.964, 116.700, 411.147),
    (431.460, 453.647, -1.050, 384.270, 415.476, 390.175, 415.156),
    (62.819, 76.787, 2.522, 102.822, 121.818, 101.611, 116.030),
    (54.296, 444.466, -1.532, 55.462, 414.489, 49.841, 412.651),
    (66.390, 456.766, 3.104, 101.240, 455.449, 107.080, 460.878),
    (444.602, 74.331, -2.450, 391.871, 112.075, 394.067, 106.642),
    (60.674, 77.943, 2.561, 108.240, 119.549, 107.926, 115.714),
    (68.278, 438.180, 0.732, 109.323, 394.255, 113.237, 398.688),
)


def test_a_wedged_block_stays_between_agent_and_walls():
    """It neither flies off nor lets anything in, whatever the agent does; shapely judges."""
    shapely = pytest.importorskip("shapely")
    rows = np.repeat(np.array(WEDGED), BATCH // len(WEDGED), axis=0)
    pose, hand, ahead = rows[:, :3], rows[:, 3:5], rows[:, 5:]
    states = TaskState(jnp.asarray(pose), jnp.asarray(hand), jnp.zeros((BATCH, 2)), jnp.zeros(BATCH, jnp.int32))
    rng = np.random.default_rng(0)
    actions = hand + 3 * (ahead - hand) + rng.normal(0, 8, (STEPS, BATCH, 2))
    after, (*_, info) = pusht.replayed(ENV, states, jnp.asarray(actions), PARAMS)
    assert np.asarray(info["status"])[..., pj.Status.OVERLAPPING].sum() == 0
    moved = np.diff(np.concatenate([pose[None], after.pose]), axis=0)
    assert np.hypot(moved[..., 0], moved[..., 1]).max() < 30
    for k in range(0, STEPS, 3):
        now = jax.tree.map(lambda leaf, k=k: leaf[k], after)
        corners = np.asarray(jax.vmap(ENV.vertices, in_axes=(0, None))(now, PARAMS))
        assert corners.min() > 7 - 0.5
        assert corners.max() < 504 + 0.5
        for block, agent in zip(corners, np.asarray(now.hand), strict=True):
            assert shapely.Polygon(block).distance(shapely.Point(agent)) > 15 - 0.5


def test_overlapping_starts_come_apart():
    """Agent inside the T, and T inside the walls, from the starts of gym-pusht and deeper."""
    rows = np.random.default_rng(0).uniform([250, 250, 200, 200, -3], [262, 262, 312, 312, 3], (BATCH, 5))
    rows[::2, 2] = -30
    states = jax.vmap(ENV.state_of)(jnp.asarray(rows))
    actions = jnp.full((STEPS, BATCH, 2), 256.0, float)
    after, _ = pusht.replayed(ENV, states, actions, PARAMS)
    shapely = pytest.importorskip("shapely")
    last = jax.tree.map(lambda leaf: leaf[-1], after)
    corners = np.asarray(jax.vmap(ENV.vertices, in_axes=(0, None))(last, PARAMS))
    assert corners.min() > 6
    for block, agent in zip(corners, np.asarray(last.hand), strict=True):
        assert shapely.Polygon(block).distance(shapely.Point(agent)) > 13.5


def test_parity_with_gym_pusht():
    pytest.importorskip("gym_pusht")
    pytest.importorskip("pymunk")
    found = pusht.compared(ENV, pusht.recorded(BATCH, STEPS))
    assert found["free"]["episodes"] > 40
    assert found["free"]["within"] >= 0.9  # 1.5 px and 1 degree
    assert found["free"]["coverage"][1] < 0.02
    assert found["walls"]["within"] >= 0.7  # 3 px; few episodes meet a wall


def test_a_deep_overlap_at_the_start_opens_as_in_pymunk():
    """The agent starts 5 to 12 px inside the T, and leaves: the T is not thrown out, and does not stay."""
    pytest.importorskip("gym_pusht")
    shapely = pytest.importorskip("shapely")
    gym, rng, rows, actions, ends = pusht.make_gym(), np.random.default_rng(0), [], [], []
    gym.reset(seed=0)
    while len(rows) < BATCH:
        row = rng.uniform([150, 150, 200, 200, 0], [362, 362, 312, 312, 2 * np.pi])
        c, s = np.cos(row[4]), np.sin(row[4])
        block = shapely.Polygon(np.array(T_VERTICES) @ [[c, s], [-s, c]] + row[2:4])
        nearest = np.array(shapely.shortest_line(block, shapely.Point(row[:2])).coords)[0]
        away = row[:2] - nearest
        if not 3 < np.linalg.norm(away) < 10:  # the agent's radius is 15
            continue
        rows.append(row)
        actions.append(row[:2] + rng.uniform(5, 60) * away / np.linalg.norm(away))
        gym.agent.position, gym.agent.velocity = tuple(row[:2]), (0, 0)
        gym.block.angle = row[4]
        gym.block.position, gym.block.velocity, gym.block.angular_velocity = tuple(row[2:4]), (0, 0), 0
        ends.append(gym.step(actions[-1])[0])
    states = pusht.states_at(ENV, PARAMS, np.array(rows))
    shared = jnp.broadcast_to(jnp.asarray(np.array(actions)), (STEPS, BATCH, 2))
    _, (*_, info) = pusht.replayed(ENV, states, shared, PARAMS)
    found = np.asarray(info["final_observation"])[0]
    moved, off = (np.linalg.norm((np.array(ends) - each)[:, 2:4], axis=1) for each in (rows, found))
    assert np.median(moved) > 1
    assert (off < 0.5).mean() > 0.9, np.sort(off)
