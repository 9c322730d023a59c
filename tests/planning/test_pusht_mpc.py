"""The choice of pushes and the feedback, with this library's own rollouts and with gym-pusht as plants."""

import sys
from typing import NamedTuple

import jax
import numpy as np
import pytest
from planning_parts import ENOUGH, PLUS, SPEEDS, TABLE, L, poses_reaching, scene_of

import pushjax as pj
from pushjax.experiments import pusht_mpc
from pushjax.geometry.polygon_numpy import outline_vertices, signed_distances
from pushjax.geometry.se2_numpy import compose, inverse, to_body, to_world
from pushjax.planning import (
    FrictionFilter,
    Observation,
    PositionControl,
    PushController,
    PushLibrary,
    PushPlanner,
    PushStatus,
    pusht_controller,
    pusht_observation,
)
from pushjax.planning.coverage_table import CoverageTable
from pushjax.planning.finger_control import FingerState
from pushjax.planning.friction_filter import FrictionBelief
from pushjax.planning.push_batch import LEG, simulate_pushes
from pushjax.planning.pusht import PIXEL

GOAL = np.array([0.25, 0.25, 0.8])
SHORT_L = 1e-3 * np.array([(0, 0), (90, 0), (90, 30), (60, 30), (30, 30), (30, 75), (30, 120), (0, 120)])


def made_controller(scene, **settings):
    planner = PushPlanner(scene, PushLibrary.build(scene, **settings), GOAL, TABLE, SPEEDS)
    return PushController(planner, PositionControl())


class Outcome(NamedTuple):
    covered: float
    steps: int
    pushes: int
    belief: FrictionBelief | None


def play(made, seed, steps=150, slider=None, friction=None):
    """Play one episode in a plant of this library's rollouts, from a random start without overlap.

    Limit surface and friction of the plant are those of the model, if they are not given.
    """
    rng, scene = np.random.default_rng(seed), made.scene
    slider, friction = slider or scene.slider, scene.mean_friction if friction is None else friction
    while True:
        pose = np.array([*rng.uniform(0.12, 0.38, 2), rng.uniform(-3, 3)])
        finger = rng.uniform(0.05, 0.45, 2)
        if signed_distances(made.planner.vertices, to_body(pose, finger)) > scene.radius:
            break
    state = made.initial_state()
    for step in range(steps):
        action, state = made(jax.random.key(seed), Observation(finger, pose), state)
        path = finger + np.linspace(0, 1, LEG + 1)[:, None] * (action - finger)
        poses, _ = simulate_pushes(slider, scene.hand, path[None], pose[None], friction)
        pose, finger = poses[0, -1].astype(float), action
        covered = float(made.planner.measure(compose(inverse(GOAL), pose)))
        if covered > ENOUGH:
            return Outcome(covered, step + 1, state.pushes, state.belief)
    return Outcome(covered, steps, state.pushes, state.belief)


@pytest.fixture(scope="module")
def rectangle():
    return made_controller(scene_of(), contacts=120, angles=7)


def test_a_rectangle_gets_to_the_goal(rectangle):
    outcomes = [play(rectangle, seed) for seed in range(8)]
    assert all(each.covered > ENOUGH for each in outcomes), outcomes
    assert np.median([each.steps for each in outcomes]) < 60


@pytest.fixture(scope="module")
def adapting():
    """A controller for the same rectangle that does not know its friction."""
    scene, key = scene_of(friction=pj.FrictionModel(20, (0.05, 0.5))), jax.random.key(5)
    pushes = PushLibrary.build(scene, contacts=60, angles=5, samples=12, key=key)
    planner = PushPlanner(scene, pushes, GOAL, TABLE, SPEEDS)
    learning = FrictionFilter(scene, samples=12, effective=2.0)
    return PushController(planner, PositionControl(), friction_filter=learning, prior=learning.init(key))


@pytest.mark.slow
def test_an_adapting_controller_finds_the_friction_of_the_plant(adapting):
    """The plants have samples of the library; each of them comes to have most of the weight."""
    found = []
    for seed, sample in enumerate((2, 8)):
        surface, mu = jax.tree.map(lambda leaf, k=sample: leaf[k], (adapting.prior.surface, adapting.prior.friction))
        outcome = play(adapting, seed, slider=pj.Slider(adapting.scene.slider.shape, surface), friction=float(mu))
        assert outcome.covered > ENOUGH
        found.append(float(outcome.belief.weight[sample]))
    assert min(found) > 0.4, found


@pytest.mark.slow
def test_weights_choose_among_the_samples_of_a_library(adapting):
    """With all weight on one sample, pushes are chosen as from a library of that sample alone."""
    planner, pose, finger = adapting.planner, np.array([0.38, 0.12, -2.0]), np.array([0.1, 0.4])
    one = planner.reweighted(np.eye(12)[3])
    samples = planner.library_samples
    np.testing.assert_allclose(one.mean_library.relative, samples.outcomes[3][samples.valid], atol=1e-6)
    assert one.value is planner.value
    targets = [each.choose(pose, finger).target for each in (one, planner.reweighted(np.eye(12)[4]))]
    assert not np.allclose(*targets)


def test_no_control_step_both_corrects_a_push_and_plans_one(rectangle, monkeypatch):
    """Both take long, and a push whose end is corrected when the finger is there goes on and on."""
    done, steps = [], []
    for name in ("_plan", "_corrected"):
        whole = getattr(rectangle, name)
        monkeypatch.setattr(rectangle, name, lambda *given, whole=whole, name=name: done.append(name) or whole(*given))
    whole_step = PushController.__call__

    def step(made, *given):
        done.clear()
        found = whole_step(made, *given)
        steps.append(tuple(done))
        return found

    monkeypatch.setattr(PushController, "__call__", step)
    assert play(rectangle, 3).covered > ENOUGH
    assert set(steps) == {(), ("_plan",), ("_corrected",)}


def test_a_filter_needs_a_prior(rectangle):
    learning = FrictionFilter(scene_of(friction=pj.FrictionModel(20, (0.05, 0.5))), samples=12)
    with pytest.raises(ValueError, match="prior"):
        PushController(rectangle.planner, PositionControl(), friction_filter=learning)


def test_one_push_where_one_is_enough(rectangle):
    """A start from which an entry of the library leads to the goal: that is what is chosen, and it arrives."""
    planner = rectangle.planner
    index = np.flatnonzero((planner.mean_library.entries[:, 1] == 50) & planner.usable[planner.push])[40]
    pose = poses_reaching(planner.mean_library, GOAL)[index].astype(float)
    finger = to_world(pose, planner.roadmap.goals[planner.push[index]])
    push = planner.choose(pose, finger)
    assert push.status == PushStatus.ONE_PUSH
    assert push.cost < 15
    path = np.linspace(push.start, push.end, LEG + 1)
    reached, _ = simulate_pushes(
        planner.scene.slider, planner.scene.hand, path[None], pose[None], planner.scene.mean_friction
    )
    assert planner.measure(compose(inverse(GOAL), reached[0, -1].astype(float))) > ENOUGH


def test_same_key_same_actions(rectangle):
    seen = Observation(np.array([0.1, 0.4]), np.array([0.3, 0.2, 1.0]))
    state = rectangle.initial_state()._replace(pushes=9)  # costs are random after some pushes
    first, second = (rectangle(jax.random.key(3), seen, state)[0] for _ in range(2))
    assert np.array_equal(first, second)


def test_the_goal_is_where_the_slider_covers_it(rectangle):
    """A rectangle of 0.1 m that is shifted along its length by d covers all but d / 0.1 of the goal."""
    for shift in (0.0, 0.004, 0.0045, 0.0055, 0.02):
        pose = compose(GOAL, np.array([shift, 0.0, 0.0]))
        assert rectangle.planner.is_at_goal(pose) == (1 - shift / 0.1 > ENOUGH)


def test_why_there_is_no_push(rectangle):
    planner, pose = rectangle.planner, np.array([0.25, 0.25, 0.0])
    inside = planner.choose(pose, pose[:2])
    assert inside.status == PushStatus.NO_TRANSIT
    assert inside.status.failed
    outside = planner.choose(np.array([2.0, 2.0, 0.0]), np.array([0.1, 0.1]))
    assert outside.status.failed
    action, state = rectangle(jax.random.key(0), Observation(pose[:2], pose), rectangle.initial_state())
    np.testing.assert_array_equal(action, pose[:2])  # the finger waits
    assert state.status == PushStatus.NO_TRANSIT
    assert state.waited == 1


def test_coverage_is_that_of_shapely():
    shapely = pytest.importorskip("shapely")
    shape = pj.Polygon(L)
    vertices, center, length = outline_vertices(shape), np.asarray(shape.centroid), 0.055
    measure = CoverageTable(vertices, center, length, ENOUGH)
    rng = np.random.default_rng(0)
    errors = rng.uniform(-1, 1, (200, 3)) * np.array([0.006, 0.006, 0.1])
    polygon = shapely.Polygon(vertices)
    wanted = [shapely.Polygon(to_world(error, vertices)).intersection(polygon).area / polygon.area for error in errors]
    found = measure(errors)
    inside = found > 0
    assert inside.mean() > 0.9
    assert np.abs(found - wanted)[inside].max() < 0.02
    assert np.abs(found - wanted)[inside].mean() < 0.004
    features = np.linalg.norm(np.column_stack([to_world(errors, center) - center, length * errors[:, 2]]), axis=1)
    assert features[np.array(wanted) > ENOUGH].max() <= measure.reach
    assert measure(np.array([0.0, 0.0, 2 * np.pi])) == pytest.approx(1, abs=1e-6)


def test_the_finger_moves_as_in_gym_pusht(monkeypatch, tmp_path):
    pytest.importorskip("gym_pusht")
    few = PushLibrary.build
    monkeypatch.setattr(PushLibrary, "build", lambda scene, **settings: few(scene, contacts=12, angles=1, **settings))
    made = pusht_controller(use_cost_to_go=False, feedback=False, cache=tmp_path)
    plant, control = pusht_mpc.make_plant(), made.control
    seen, info = plant.reset(seed=0)
    rng = np.random.default_rng(0)
    state = FingerState(PIXEL * info["pos_agent"], PIXEL * np.array(info["vel_agent"]))
    for _ in range(10):
        target = rng.uniform(0.1, 0.4, 2)
        action = control.action(state, target)
        state = control.after(state, action)
        motion = control.motion(state, action)
        seen, _, _, _, info = plant.step(action / PIXEL)
        np.testing.assert_allclose(state.position, pusht_observation(seen).finger, atol=1e-9)
        np.testing.assert_allclose(state.velocity, PIXEL * np.array(info["vel_agent"]), atol=1e-8)
        assert motion.shape == (10, 2)
        if ((action > 0) & (action < 0.512)).all():
            np.testing.assert_allclose(state.position, target, atol=1e-9)


def test_without_gym_pusht_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    with pytest.raises(ValueError, match="pip install gym-pusht"):
        pusht_mpc.run(episodes=1)


def test_bad_options():
    for name, bad in {"episodes": 0, "friction_in_model": -0.1, "actuation_noise": np.nan}.items():
        with pytest.raises(ValueError, match=name):
            pusht_mpc.run(**{name: bad})


@pytest.mark.slow
def test_pusht(monkeypatch, tmp_path):
    pytest.importorskip("gym_pusht")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    record = pusht_mpc.run(seed=70000, episodes=5)
    assert record["success"] == 1
    assert record["steps_of_successes"]["largest"] < 120
    assert "success in 5 of 5" in pusht_mpc.summary(record)[0]
    again = pusht_controller()  # from the file of the first
    assert len(list(tmp_path.rglob("*.npz"))) == 1
    assert pusht_mpc.play(pusht_mpc.make_plant(), again, 70000).steps == record["rows"][0]["steps"]


@pytest.mark.slow
@pytest.mark.parametrize("vertices", [SHORT_L, 0.6 * PLUS], ids=["L", "plus"])
def test_other_blocks(vertices):
    """The same code and settings for two other blocks; L and plus have reflex corners as the T has."""
    centered = vertices - np.asarray(pj.Polygon(vertices).centroid)
    made = made_controller(scene_of(pj.Polygon(centered), friction=0.0))
    outcomes = [play(made, seed) for seed in range(20)]
    print([each.steps for each in outcomes])
    assert sum(each.covered > ENOUGH for each in outcomes) >= 19
