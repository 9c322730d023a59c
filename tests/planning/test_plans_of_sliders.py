"""Plans of pushes on several sliders, judged by rollouts and shapely."""

import jax
import numpy as np
import pytest

import pushjax as pj
from pushjax.planning import CrossEntropy, Goal, PlanStatus, PushScene, PushSequence, Selection, plan_pushes
from pushjax.planning import push_outcomes as outcomes_of

shapely = pytest.importorskip("shapely")

KEY = jax.random.key(0)
RADIUS = 0.005
DISK = pj.Slider(pj.Disk(0.02), pj.Ellipsoid(np.diag([1.0, 1.0, 1.3]), 0.02))
BOX = pj.Slider(pj.Polygon.rectangle(0.06, 0.03), pj.Ellipsoid(np.diag([1.0, 1.0, 0.8]), 0.03))
START = np.array([[0.0, 0.0, 0.0], [-0.05, 0.0, np.pi / 2]])  # the box is before the disk
GOAL = Goal((0.03, 0.0, 0.0), position_tolerance=0.004, symmetry=np.linspace(0, 2 * np.pi, 60, endpoint=False))
MODEL = pj.FrictionModel(None, (0.1, 0.3))
SEARCH = {
    "samples": 8,
    "candidates": 256,
    "nominal_search": [Selection(8)],
    "search": [CrossEntropy(iterations=3, population=8, elites=3), Selection(8)],
}


def scene_of(fixtures=()):
    return PushScene((DISK, BOX), pj.Hand.finger(RADIUS), MODEL, fixtures, between=(0.1, 0.2))


def pushes_on(*sliders):
    return PushSequence(count=2, length=0.06, steps=12, clearance=0.006, sliders=sliders)


@pytest.fixture(scope="module")
def planned():
    scene, pushes = scene_of(), pushes_on(0, 1)
    return scene, pushes, plan_pushes(KEY, scene, START, GOAL, pushes=pushes, finger=(-0.1, 0.05), **SEARCH)


@pytest.mark.slow
def test_the_first_slider_reaches_the_goal(planned):
    scene, pushes, plan = planned
    assert plan.status == PlanStatus.FOUND, plan.status
    assert set(plan.pushed) <= set(pushes.sliders)
    assert plan.outcomes.poses.shape == (256, len(plan.path) + 1, 2, 3)
    found = outcomes_of(jax.random.key(7), scene, START, plan.path, samples=200)
    assert abs(found.success(GOAL) - plan.success) < 0.1
    # by a rollout with the mean of all friction
    poses = [START]
    for path in plan.path:
        push = pj.rollout((DISK, BOX), scene.hand, path, pose=poses[-1], friction=0.2, between=0.15)
        assert not np.any(push.failed)
        poses.append(np.asarray(push.pose[-1]))
    np.testing.assert_allclose(plan.pose, np.array(poses), atol=1e-6)
    assert GOAL.reached(plan.pose[-1, 0])


@pytest.mark.slow
def test_the_finger_touches_no_slider_between_pushes(planned):
    _, _, plan = planned
    box = shapely.box(-0.03, -0.015, 0.03, 0.015)
    for k, transit in enumerate(plan.transits):
        way = shapely.LineString(transit.points) if len(transit.points) > 1 else shapely.Point(transit.points[0])
        x, y, angle = plan.pose[k, 1]
        placed = shapely.affinity.translate(shapely.affinity.rotate(box, angle, (0, 0), use_radians=True), x, y)
        # where a push ends, the finger touches what it has pushed
        assert shapely.distance(way, placed) > RADIUS - 1e-4
        assert shapely.distance(way, shapely.Point(plan.pose[k, 0, :2])) > 0.02 + RADIUS - 1e-4


def test_bad_input():
    with pytest.raises(ValueError, match=r"pushes.sliders is \(0, 2\); the scene has 2"):
        plan_pushes(KEY, scene_of(), START, GOAL, pushes=pushes_on(0, 2))
    with pytest.raises(ValueError, match=r"start has shape \(3,\); expected \(2, 3\) or \(poses, 2, 3\)"):
        plan_pushes(KEY, scene_of(), START[0], GOAL, pushes=pushes_on(0))
    with pytest.raises(ValueError, match="sliders must be indices"):
        pushes_on(-1)
    with pytest.raises(ValueError, match="sliders must be indices"):
        pushes_on()
    with pytest.raises(ValueError, match="between: several sliders need"):
        PushScene((DISK, BOX), pj.Hand.finger(RADIUS))
    with pytest.raises(ValueError, match="between is for several"):
        PushScene(DISK, pj.Hand.finger(RADIUS), between=0.1)
    with pytest.raises(ValueError, match="only `plan_pushes` takes several sliders; got 2"):
        pj.planning.PushLibrary.build(scene_of(), cache=None)
    with pytest.raises(ValueError, match=r"between must be \(lowest, highest\)"):
        PushScene((DISK, BOX), pj.Hand.finger(RADIUS), between=(0.3, 0.1))
    with pytest.raises(ValueError, match="start: sliders 0 and 1 start inside each other, by"):
        plan_pushes(KEY, scene_of(), START + np.array([[-0.03, 0, 0], [0, 0, 0]]), GOAL, pushes=pushes_on(0))
    wall = pj.Wall((0.0, 0.01), (0.0, 1.0))
    with pytest.raises(ValueError, match="start must be a pose at which the slider overlaps no fixture"):
        plan_pushes(KEY, scene_of((wall,)), START, GOAL, pushes=pushes_on(0))
    with pytest.raises(ValueError, match="finger must not overlap the slider"):
        plan_pushes(KEY, scene_of(), START, GOAL, pushes=pushes_on(0), finger=(-0.05, 0.02))
