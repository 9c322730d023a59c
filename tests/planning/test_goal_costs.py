"""Goals, costs and risks: by their definitions, and with finite derivatives at the goal itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import pushjax as pj
from pushjax.planning import CVaR, FinalPose, Goal, Missed
from pushjax.planning.costs import HandClearance, Mean
from pushjax.simulation.fixtures import Fixture, Wall

RNG = np.random.default_rng(0)
BLOCK = pj.Polygon.rectangle(0.09, 0.06)


@pytest.fixture(scope="module")
def push():
    """A push of a block with a finger, of two steps that slide or stick."""
    slider = pj.Slider(BLOCK, pj.Ellipsoid(np.eye(3), length=0.03))
    path = pj.line((-0.055, 0.01), (-0.03, 0.02), steps=8)
    return pj.rollout(slider, pj.Hand.finger(0.005), path, pose=np.zeros(3), friction=0.3)


@pytest.mark.parametrize("symmetry", [1, 2, 4, (0.0, 1.0)])
def test_errors_from_the_nearest_equivalent_goal(symmetry):
    goal = Goal((0.1, -0.2, 3.0), symmetry=symmetry, length=0.04, position_tolerance=0.005, angle_tolerance=0.1)
    poses = RNG.normal(size=(200, 3)) * [0.01, 0.01, 9.0] + [0.1, -0.2, 3.0]
    turns = 2 * np.pi * np.arange(symmetry) / symmetry if np.ndim(symmetry) == 0 else np.array(symmetry)
    away = np.abs(np.angle(np.exp(1j * (poses[:, 2:] - 3.0 - turns)))).min(axis=1)
    distance = np.hypot(poses[:, 0] - 0.1, poses[:, 1] + 0.2)
    np.testing.assert_allclose(goal.distance(poses), distance + 0.04 * away, atol=1e-12)
    np.testing.assert_allclose(goal.squared_error(poses), (distance / 0.005) ** 2 + (away / 0.1) ** 2, rtol=1e-9)
    np.testing.assert_array_equal(goal.reached(poses), (distance <= 0.005) & (away <= 0.1))
    assert 0 < np.mean(goal.reached(poses * [1, 1, 0] + [0, 0, 3.0])) < 1
    equivalent = np.min([pj.deviation(poses, [0.1, -0.2, 3.0 + turn], 0.04) for turn in turns], axis=0)
    np.testing.assert_allclose(goal.distance(poses), equivalent, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_derivatives_at_the_goal(dtype):
    """Zero where the goal is met, one where only the angle's tie is; never NaN."""
    goal = Goal(np.array([0.1, -0.2, 3.0], dtype), symmetry=2)
    for function in (goal.distance, goal.squared_error, goal.max_error):
        value, slope = jax.value_and_grad(function)(goal.pose)
        assert value == 0
        assert value.dtype == dtype
        np.testing.assert_array_equal(slope, 0)
        assert np.isfinite(jax.grad(function)(goal.pose + jnp.array([0, 0, np.pi / 2], dtype))).all()


def test_costs_by_their_definitions(push):
    """Of several pushes in a row, with a leading axis, the last one counts."""
    end, goal = np.asarray(push.pose)[-1], Goal((0.02, 0.0, 0.1))
    at_border = Goal(end + np.array([0.005, 0, 0]), position_tolerance=0.005)
    pair = jax.tree.map(lambda leaf: jnp.stack([leaf[::-1], leaf]), push)
    for each in (push, pair):
        np.testing.assert_allclose(FinalPose(goal)(each), goal.squared_error(end))
        assert Missed(Goal(end))(each) == 0
        assert Missed(Goal((1.0, 0.0, 0.1)))(each) == 1
        np.testing.assert_allclose(Missed(at_border, width=0.3)(each), 0.5, atol=1e-9)
        total = FinalPose(goal) + 3.0 * Missed(at_border, 0.3) + Missed(goal) * 2
        np.testing.assert_allclose(total(each), goal.squared_error(end) + 1.5 + 2 * Missed(goal)(each))


def test_clearance_of_a_hand_is_that_of_its_nearest_finger(push):
    shapely = pytest.importorskip("shapely")
    hand, triangle = pj.Hand.two_fingers(0.005), np.array([(0, 0), (0.05, 0), (0, 0.04)])
    body = Fixture(pj.Polygon(triangle), (0.02, 0.03, 0.0))
    judge = shapely.Polygon(triangle + np.array([0.02, 0.03]))
    rng = np.random.default_rng(5)
    configuration = rng.uniform(-0.1, 0.1, (3, 4)) + np.array([0.0, -0.1, 0.0, 0.15])
    at = pj.Trajectory(**{**vars(push), "configuration": jnp.asarray(configuration)})
    centers = np.asarray(hand.poses(at.configuration))[..., :2].reshape(-1, 2)
    outline = [
        judge.exterior.distance(point) * (-1 if judge.contains(point) else 1) for point in map(shapely.Point, centers)
    ]
    apart = min(*outline, *(centers[:, 1] + 0.3)) - 0.005
    cost = HandClearance(hand, (body, Wall((0.0, -0.3), (0.0, 1.0))), 0.2)(at)
    np.testing.assert_allclose(cost, max(1 - apart / 0.2, 0) ** 2, rtol=1e-9)
    inside = HandClearance(hand, (Wall((0.0, 1.0), (0.0, 1.0)),), 0.01)
    assert inside(at) > 1
    slope = jax.grad(lambda q: inside(pj.Trajectory(**{**vars(push), "configuration": q})))(at.configuration)
    assert np.all(np.isfinite(slope))


def test_derivatives_of_costs_are_finite(push):
    """Also at the goal."""
    total = FinalPose(Goal(push.pose[-1])) + Missed(Goal(push.pose[-1]), 0.2)
    slope = jax.grad(lambda pose: total(pj.Trajectory(**{**vars(push), "pose": pose})))(push.pose)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("fraction", [0.05, 0.25, 0.33, 1.0])
def test_cvar_is_the_least_of_its_dual(fraction):
    """Rockafellar and Uryasev: the minimum over t of t + mean(max(cost - t, 0)) / fraction."""
    costs = RNG.normal(size=37)

    def dual(t):
        return t + np.maximum(costs - t, 0).mean() / fraction

    least = minimize_scalar(dual, bounds=(-5, 5), method="bounded", options={"xatol": 1e-9})
    np.testing.assert_allclose(CVaR(fraction)(jnp.asarray(costs)), least.fun, atol=1e-6)


def test_risks_of_few_and_of_infinite_costs():
    costs = jnp.array([1.0, 5.0, 3.0])
    assert (Mean()(costs), CVaR(0.1)(costs), CVaR(1.0)(costs)) == (3.0, 5.0, 3.0)
    assert CVaR(0.1)(jnp.array([1.0, jnp.inf])) == jnp.inf


def test_bad_input():
    with pytest.raises(ValueError, match=r"pose has shape \(2,\); expected \(3,\)"):
        Goal((0, 0))
    with pytest.raises(ValueError, match="position_tolerance must be positive; got 0"):
        Goal((0, 0, 0), position_tolerance=0)
    with pytest.raises(ValueError, match="symmetry must be a whole number, at least 1; got 0"):
        Goal((0, 0, 0), symmetry=0)
    with pytest.raises(ValueError, match="symmetry must have at least one turn"):
        Goal((0, 0, 0), symmetry=())
    with pytest.raises(ValueError, match=r"pose has shape \(4,\); expected \(..., 3\)"):
        Goal((0, 0, 0)).reached(np.zeros(4))
    with pytest.raises(ValueError, match="fraction must be above 0 and at most 1; got 0"):
        CVaR(0)
    with pytest.raises(ValueError, match="width must not be negative"):
        Missed(Goal((0, 0, 0)), -1.0)
