"""Goals, costs and risks: by their definitions, and with finite derivatives at the goal itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import pushjax as pj
from pushjax.planning import (
    Clearance,
    CVaR,
    FinalPose,
    Goal,
    Mean,
    Missed,
    Travel,
    WayPoints,
    Work,
    Worst,
)
from pushjax.planning.costs import HandClearance
from pushjax.simulation.fixtures import Fixture, Wall

RNG = np.random.default_rng(0)
BLOCK = pj.Polygon.rectangle(0.09, 0.06)


@pytest.fixture(scope="module")
def push():
    """A push of a block with a finger, of two steps that slide or stick."""
    slider = pj.Slider(BLOCK, pj.Ellipsoid(np.eye(3), length=0.03))
    path = pj.line((-0.055, 0.01), (-0.03, 0.02), steps=8)
    return pj.rollout(slider, pj.Hand.finger(0.005), path, pose=np.zeros(3), friction=0.3)


def moved(push, poses):
    """A push whose poses are replaced."""
    return pj.Trajectory(**{**vars(push), "pose": jnp.asarray(poses)})


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
    pose, q = np.asarray(push.pose), np.asarray(push.configuration)
    goal, elsewhere = Goal((0.02, 0.0, 0.1)), Goal((1.0, 0.0, 0.1))
    on_the_way = Goal(pose[4])
    np.testing.assert_allclose(FinalPose(goal)(push), goal.squared_error(pose[-1]))
    np.testing.assert_allclose(WayPoints((on_the_way, goal))(push), np.min(goal.squared_error(pose)), atol=1e-12)
    np.testing.assert_allclose(Travel()(push), np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    assert Missed(Goal(pose[-1]))(push) == 0
    assert Missed(elsewhere)(push) == 1
    at_border = Goal(pose[-1] + np.array([0.005, 0, 0]), position_tolerance=0.005)
    np.testing.assert_allclose(Missed(at_border, width=0.3)(push), 0.5, atol=1e-9)
    total = FinalPose(goal) + 3.0 * Travel() + Work() * 2
    np.testing.assert_allclose(total(push), FinalPose(goal)(push) + 3 * Travel()(push) + 2 * Work()(push))


def test_work_is_that_of_the_forces(push):
    """Power of the contact forces on the contact point's motion, by the virtual work of a rigid body."""
    point, normal, force = (np.asarray(getattr(push, name)) for name in ("contact_point", "contact_normal", "force"))
    twist = np.asarray(push.twist)[:, None]
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    velocity = twist[..., :2] + twist[..., 2:] * np.stack([-point[..., 1], point[..., 0]], axis=-1)
    pushed = force[..., :1] * normal + force[..., 1:] * tangent
    np.testing.assert_allclose(Work()(push), np.sum(pushed * velocity), rtol=1e-9)
    assert Work()(push) > 0


def test_costs_of_several_pushes(push):
    """A leading axis of pushes: costs on the way add up, those of the end are of the last."""
    pair = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), push)
    goal = Goal((0.02, 0.0, 0.1))
    for cost in (Travel(), Work()):
        np.testing.assert_allclose(cost(pair), 2 * cost(push), rtol=1e-12)
    np.testing.assert_allclose(FinalPose(goal)(pair), FinalPose(goal)(push))


def test_clearance_is_the_distance_of_the_bodies():
    shapely = pytest.importorskip("shapely")
    affinity = pytest.importorskip("shapely.affinity")
    triangle = pj.Polygon([(0, 0), (0.05, 0), (0, 0.04)])
    wall, body = Wall((0.0, -0.2), (0.0, 2.0)), Fixture(triangle, (0.15, 0.02, 0.5))
    cost = Clearance(BLOCK, (wall, body), 0.05)

    def placed(shape, pose):
        turned = affinity.rotate(shapely.Polygon(np.asarray(shape.vertices)), pose[2], (0, 0), use_radians=True)
        return affinity.translate(turned, pose[0], pose[1])

    poses = RNG.uniform(-1, 1, (60, 3)) * [0.06, 0.12, np.pi]
    found = jax.jit(jax.vmap(cost.nearest))(jnp.asarray(poses))
    for pose, distance in zip(poses, np.asarray(found), strict=True):
        block = placed(BLOCK, pose)
        lowest = np.asarray(block.exterior.coords)[:, 1].min() + 0.2
        apart = min(lowest, block.distance(placed(triangle, body.pose)))
        if apart > 0:
            np.testing.assert_allclose(distance, apart, atol=1e-9)
        else:
            assert distance < 0


def test_clearance_costs_nothing_far_away(push):
    wall = Wall((0.0, 0.2), (0.0, -1.0))
    assert Clearance(BLOCK, (wall,), 0.05)(push) == 0
    poses = np.tile([0.0, 0.13, 0.0], (3, 1))  # 40 mm from the wall
    np.testing.assert_allclose(Clearance(BLOCK, (wall,), 0.05)(moved(push, poses)), 0.2**2, rtol=1e-9)


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
    """Also at the goal, for a hand that stands still, and for a slider that touches."""
    wall = Wall((0.0, 0.03), (0.0, -1.0))
    total = FinalPose(Goal(push.pose[-1])) + Missed(Goal(push.pose[-1]), 0.2) + WayPoints((Goal(push.pose[2]),))
    total = total + Travel() + Work() + Clearance(BLOCK, (wall, Fixture(pj.Disk(0.02), (0.0, 0.05, 0.0))), 0.01)

    def of(pose, configuration):
        return total(pj.Trajectory(**{**vars(push), "pose": pose, "configuration": configuration}))

    derivative = jax.jit(jax.grad(of, (0, 1)))
    still = jnp.broadcast_to(push.configuration[:1], push.configuration.shape)
    for configuration in (push.configuration, still):
        slopes = derivative(push.pose, configuration)
        assert all(np.isfinite(slope).all() for slope in slopes)


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
    assert (Mean()(costs), Worst()(costs), CVaR(0.1)(costs), CVaR(1.0)(costs)) == (3.0, 5.0, 5.0, 3.0)
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
    with pytest.raises(ValueError, match="distance must be positive"):
        Clearance(BLOCK, (), 0.0)
