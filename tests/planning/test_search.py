"""Searches on functions whose minimum is known, and plans of pushes against simulations of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.planning import (
    CrossEntropy,
    Goal,
    PlanStatus,
    PushScene,
    PushSequence,
    Selection,
    plan_pushes,
    push_outcomes,
)
from pushjax.planning.search import Candidates, Objective

KEY = jax.random.key(0)
RADIUS, BLOCK = 0.005, pj.Polygon.rectangle(0.09, 0.06)
HAND = pj.Hand.finger(RADIUS)
MODEL = pj.FrictionModel(dof=50, friction=(0.2, 0.3))
MINIMA = np.array([[1.0, -2.0, 0.5], [-3.0, 1.0, 2.0]])
DEPTHS = np.array([1.0, 0.0])  # the second well is deeper
TOLERANCES = {"position_tolerance": 0.008, "angle_tolerance": 0.3}  # m and rad


def wells(parameters):
    return np.min(((parameters[:, None] - MINIMA) ** 2).sum(axis=2) + DEPTHS, axis=1)


OBJECTIVE = Objective(wells, np.ones(3))


def test_both_minima_are_found():
    """Each candidate is improved by itself, so the shallow well is not lost."""
    start, search = Candidates.sorted(MINIMA + 0.7, wells(MINIMA + 0.7)), CrossEntropy(iterations=25, width=1.0)
    found, history = search(KEY, OBJECTIVE, start)
    np.testing.assert_allclose(found.parameters, MINIMA[::-1], atol=0.05)
    np.testing.assert_allclose(found.cost, wells(found.parameters))
    assert np.all(np.diff(history) <= 0)
    assert history[-1] == found.cost[0]
    again, _ = search(KEY, OBJECTIVE, start)
    np.testing.assert_array_equal(found.parameters, again.parameters)


def test_selection_keeps_the_best():
    parameters = np.random.default_rng(0).normal(size=(50, 3)) * 3
    found, _ = Selection(5)(KEY, OBJECTIVE, Candidates(parameters, np.full(50, np.inf)))
    np.testing.assert_array_equal(found.cost, np.sort(wells(parameters))[:5])


@pytest.fixture(scope="module")
def slider():
    return pj.Slider.uniform(BLOCK, degree=2)


@pytest.fixture(scope="module")
def scene(slider):
    return PushScene(slider, HAND, MODEL)


@pytest.mark.parametrize("hand", [HAND, pj.Hand.two_fingers(RADIUS)], ids=["finger", "two fingers"])
def test_a_push_starts_before_its_first_contact(slider, hand):
    """Shapely: disks touch the block where the path is as long as the clearance, and not before."""
    shapely = pytest.importorskip("shapely")
    opening = (0.03,) if hand.dof == 4 else ()
    pushes = PushSequence(length=0.05, steps=30, clearance=0.01, opening=opening)
    numbers = pushes.sample(KEY, 40)
    pose = jnp.array([0.3, -0.1, 2.0])
    paths = np.asarray(jax.jit(jax.vmap(lambda n: pushes.path(n, (slider,), hand, pose[None])))(jnp.asarray(numbers)))
    block = shapely.Polygon(np.asarray(pj.se2.transform(pose, BLOCK.vertices)))
    travelled = np.linalg.norm(paths[:, -1] - paths[:, 0], axis=1)
    np.testing.assert_allclose(travelled, 0.01 + 0.05 * numbers[:, 2], rtol=1e-9)
    at = np.array([*np.linspace(-0.2, 0.2, 81), 0.0, 0.0099, 0.01])  # m from the start, all along the line
    along = (paths[:, -1:] - paths[:, :1]) / travelled[:, None, None]
    placed = np.asarray(hand.poses(jnp.asarray(paths[:, :1] + at[:, None] * along)))[..., :2]
    apart = shapely.distance(block, shapely.points(placed)).min(axis=-1) - RADIUS
    touches = apart.min(axis=1) < -1e-3  # the other lines miss the block, or only graze it
    assert touches.sum() > 25
    assert np.all(apart[touches, -3:-1] > 0)
    np.testing.assert_allclose(apart[touches, -1], 0, atol=1e-7)


def test_a_bent_push_ends_where_a_straight_one_does(slider):
    straight, bent = PushSequence(length=0.05, steps=10), PushSequence(length=0.05, steps=10, bends=2)
    numbers = np.array([0.3, 0.1, 0.7])
    pose = jnp.zeros(3)
    line = np.asarray(straight.path(jnp.asarray(numbers), (slider,), HAND, pose[None]))
    level = np.asarray(bent.path(jnp.asarray([*numbers, 0.0, 0.0]), (slider,), HAND, pose[None]))
    curve = np.asarray(bent.path(jnp.asarray([*numbers, 0.4, -0.2]), (slider,), HAND, pose[None]))
    np.testing.assert_allclose(level, line, atol=1e-12)
    np.testing.assert_allclose(curve[[0, -1]], line[[0, -1]], atol=1e-12)
    # a cubic Bezier curve with its inner control points 0.4 and -0.2 of 35 mm aside, by de Casteljau
    aside = np.cos(0.3) * (curve - line)[:, 1] - np.sin(0.3) * (curve - line)[:, 0]
    t = np.linspace(0, 1, 11)
    np.testing.assert_allclose(aside, 0.035 * (3 * t * (1 - t) ** 2 * 0.4 - 3 * t**2 * (1 - t) * 0.2), atol=1e-9)


SETTINGS = {
    "pushes": PushSequence(1, length=0.08, steps=8),
    "samples": 16,
    "candidates": 256,
    "nominal_search": (Selection(8), CrossEntropy(iterations=6, population=32)),
    "search": (CrossEntropy(iterations=4, population=32),),
}


@pytest.fixture(scope="module")
def easy(slider, scene):
    """A goal that one push reaches: the mean of where such a push ends."""
    path = pj.line((-0.06, 0.0), (-0.03, 0.0), steps=8)[None]
    done = push_outcomes(KEY, scene, np.zeros(3), path)
    return Goal(
        np.asarray(done.pose).mean(axis=0), length=slider.surface.length, position_tolerance=0.008, angle_tolerance=0.3
    )


@pytest.fixture(scope="module")
def plan(scene, easy):
    return plan_pushes(KEY, scene, np.zeros(3), easy, **SETTINGS)


@pytest.mark.slow
def test_a_plan_knows_how_surely_it_succeeds(slider, scene, easy, plan):
    assert plan.status is PlanStatus.FOUND
    assert plan.success >= 0.9
    assert np.all(np.diff(plan.history) <= 1e-9)
    other = jax.random.key(7)
    done = push_outcomes(other, scene, np.zeros(3), plan.path)
    assert not np.any(done.failed)
    error = np.sqrt(0.25 / 256)  # largest standard error of a frequency
    np.testing.assert_allclose(done.success(easy), plan.success, atol=4 * np.sqrt(2) * error)
    approach, retreat = plan.transits
    np.testing.assert_allclose(approach.points[-1], plan.path[0, 0], atol=1e-9)
    np.testing.assert_allclose(retreat.points[0], plan.path[0, -1], atol=1e-9)
    np.testing.assert_allclose(plan.pose[-1], np.mean(plan.outcomes.pose, axis=0), atol=0.01)


def test_outcomes_are_those_of_random_rollouts(slider, plan):
    """`monte_carlo` of the same push, with its own keys: same mean and spread within their standard errors."""
    done = pj.monte_carlo(jax.random.key(3), 1024, slider, HAND, plan.path[0], pose=np.zeros(3), model=MODEL)
    ours = np.asarray(plan.outcomes.pose)
    spread = done.pose.std(axis=0)
    np.testing.assert_array_less(np.abs(ours.mean(axis=0) - done.pose.mean(axis=0)), 5 * spread / 16)
    np.testing.assert_allclose(ours.std(axis=0), spread, rtol=0.35)


def test_same_key_same_bits(slider, scene, easy, plan):
    again = plan_pushes(KEY, scene, np.zeros(3), easy, **SETTINGS)
    np.testing.assert_array_equal(again.parameters, plan.parameters)
    np.testing.assert_array_equal(again.outcomes.pose, plan.outcomes.pose)
    np.testing.assert_array_equal(again.history, plan.history)


def test_a_belief_over_the_start(slider, scene, easy, plan):
    """The spread of the start is added to that of friction."""
    belief = np.random.default_rng(0).normal(size=(16, 3)) * [0.0, 0.02, 0.0]
    done = push_outcomes(KEY, scene, belief, plan.path)
    assert done.success(easy) < plan.success - 0.1


def test_a_belief_around_half_a_turn(slider, scene, easy):
    """Pushes are laid out from the mean direction: the belief and the goal of an easy plan, turned by half a turn."""
    start = np.array([[0, 0, np.pi - 0.05], [0, 0, 0.05 - np.pi]])
    turned = easy.pose * np.array([-1, -1, 1]) + np.array([0, 0, np.pi])
    goal = Goal(turned, length=slider.surface.length, **TOLERANCES)
    plan = plan_pushes(KEY, scene, start, goal, **SETTINGS)
    assert np.cos(plan.pose[0, 2]) == pytest.approx(-1, abs=1e-6)
    assert plan.success > 0.9


def test_pushes_that_move_nothing_are_left_out(slider, scene):
    """At the goal already, the best push is one that misses the block: the plan has none."""
    here = Goal((0, 0, 0), length=slider.surface.length, **TOLERANCES)
    plan = plan_pushes(KEY, scene, np.zeros(3), here, **SETTINGS)
    assert plan.status is PlanStatus.FOUND
    assert plan.success == 1
    assert plan.path.shape[0] == len(plan.transits) == 0
    np.testing.assert_array_equal(plan.pose, np.zeros((1, 3)))
    assert plan.outcomes.poses.shape == (256, 1, 3)


class One(PushSequence):
    """The same push for every candidate."""

    def sample(self, key, candidates):
        return np.repeat(np.array([[np.pi, 0.0, 0.5]]), candidates, axis=0)


def test_poses_in_fixtures_are_refused(slider, easy):
    fixture = pj.Fixture(pj.Disk(0.01), (0.0, -0.2, 0.0))

    def plan(start=(0, 0, 0), goal=easy, **settings):
        return plan_pushes(KEY, PushScene(slider, HAND, MODEL, (fixture,)), start, goal, **SETTINGS | settings)

    with pytest.raises(ValueError, match="goal must be a pose at which the slider overlaps no fixture; got an overlap"):
        plan(goal=Goal((0, -0.2, 0)))
    with pytest.raises(ValueError, match="start must be a pose at which the slider overlaps no fixture; got an over"):
        plan(start=(0, -0.22, 0))
    with pytest.raises(ValueError, match=r"finger must not overlap a fixture at the start; got an overlap of 0.013 m"):
        plan(finger=(0.0, -0.202))


@pytest.mark.slow
def test_the_hand_stays_out_of_fixtures(slider, scene, easy, plan):
    shapely = pytest.importorskip("shapely")
    start, after = plan.path[0, :2]
    aside = 0.012 * np.array([start[1] - after[1], after[0] - start[0]]) / np.linalg.norm(after - start)
    fixture = pj.Fixture(pj.Disk(0.01), (*(start + aside), 0.0))  # 3 mm too near to where the push of the plan begins
    body = shapely.Point(*fixture.pose[:2]).buffer(0.01, quad_segs=64)
    assert body.distance(shapely.LineString(plan.path[0])) < RADIUS
    around = plan_pushes(KEY, PushScene(slider, HAND, MODEL, (fixture,)), np.zeros(3), easy, **SETTINGS)
    assert around.status is PlanStatus.FOUND
    for line in (*around.path, *(transit.points for transit in around.transits if len(transit.points) > 1)):
        assert body.distance(shapely.LineString(line)) >= RADIUS - 1e-6
    # and if there is no other push, the status says so
    here = pj.Fixture(fixture.shape, (0.062, 0.0, 0.0))
    only = {"pushes": One(1, length=0.08, steps=8), "candidates": 1, "nominal_search": (), "search": ()}
    stuck = plan_pushes(
        KEY, PushScene(slider, HAND, MODEL, (here,)), np.zeros(3), Goal((-0.04, 0, 0)), **SETTINGS | only
    )
    assert stuck.status is PlanStatus.HAND_IN_FIXTURE
    assert stuck.success == 0


def test_an_unreachable_goal_has_a_status(slider, scene):
    goal = Goal((1.0, 0.0, 0.0), length=slider.surface.length, **TOLERANCES)
    plan = plan_pushes(KEY, scene, np.zeros(3), goal, **SETTINGS)
    assert plan.status is PlanStatus.UNLIKELY
    assert plan.success == 0


def test_bad_input(slider, easy):
    def plan(hand=HAND, start=(0, 0, 0), **settings):
        return plan_pushes(KEY, PushScene(slider, hand, MODEL), start, easy, **SETTINGS | settings)

    with pytest.raises(ValueError, match="candidates must be a whole number, at least 1; got 0"):
        plan(candidates=0)
    with pytest.raises(ValueError, match="samples must be a whole number, at least 1; got 0"):
        plan(samples=0)
    with pytest.raises(ValueError, match=r"start has shape \(2,\); expected \(3,\) or \(poses, 3\)"):
        plan(start=(0, 0))
    with pytest.raises(ValueError, match="success must be a probability; got 2"):
        plan(success=2)
    with pytest.raises(ValueError, match=r"finger must not overlap the slider .*; got an overlap of 0\.015 m"):
        plan(finger=(0.035, 0))
    with pytest.raises(ValueError, match=r"finger has shape \(3,\); expected \(2,\)"):
        plan(finger=(0, 0, 0))
    with pytest.raises(TypeError, match="hand: plans of pushes need round fingers; got a pad"):
        plan(hand=pj.Hand.parallel_jaw(0.02, 0.01))
    with pytest.raises(ValueError, match=r"opening has 0 number\(s\), which does not fit a hand of 4 coordinates"):
        plan(hand=pj.Hand.two_fingers(RADIUS))
    with pytest.raises(ValueError, match="elites must be at most the population of 4; got 5"):
        CrossEntropy(population=4, elites=5)
    with pytest.raises(ValueError, match="width must be positive; got 0"):
        CrossEntropy(width=0)
    with pytest.raises(ValueError, match="length must be positive"):
        PushSequence(length=0.0)
