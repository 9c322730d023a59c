"""Pushes among fixtures: which ones the planner allows, and whole episodes in this library's simulation.

Shapely judges whether slider and finger stay out of the fixtures.

    python -m pytest -m slow -s tests/planning/test_among_fixtures.py

prints the figures of docs/planning.md.
"""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from planning_parts import ENOUGH, FRICTION, RADIUS, SPEEDS, TABLE, scene_of

import pushjax as pj
from pushjax.geometry.se2_numpy import compose, inverse, to_world
from pushjax.planning import Observation, PositionControl, PushController, PushLibrary, PushPlanner, PushStatus
from pushjax.planning.roadmap import TransitStatus

shapely = pytest.importorskip("shapely")

GOAL = np.array([0.40, 0.25, 0.8])
BAR, TRIANGLE = pj.Polygon.rectangle(0.04, 0.20), pj.Polygon([(-0.04, -0.03), (0.04, -0.03), (0.0, 0.04)])
FIXTURES = (  # a bar in front of the goal, a post in the way around it on one side, and a wedge near the starts
    pj.Fixture(BAR, (0.27, 0.25, 0.0)),
    pj.Fixture(pj.Disk(0.03), (0.33, 0.45, 0.0)),
    pj.Fixture(TRIANGLE, (0.12, 0.08, 0.3)),
)
WORLD = shapely.union_all(
    [shapely.Polygon(to_world(np.asarray(each.pose), np.asarray(each.shape.vertices))) for each in FIXTURES[::2]]
    + [shapely.Point(0.33, 0.45).buffer(0.03, quad_segs=64)]
)
STEPS = 32  # of the simulation of a control step
VERTICES = np.asarray(scene_of().slider.shape.vertices, float)


def placed(pose):
    return shapely.Polygon(to_world(np.asarray(pose, float), VERTICES))


def starts(count, low=0.06, high=0.20):
    """Return random poses of slider and finger that touch nothing, before the bar if not told otherwise."""
    rng, found = np.random.default_rng(0), []
    while len(found) < count:
        pose = np.array([rng.uniform(low, high), rng.uniform(0.06, 0.44), rng.uniform(-3, 3)])
        finger, block = rng.uniform(0.03, 0.47, 2), placed(pose)
        apart = min(WORLD.distance(shapely.Point(finger)), block.distance(shapely.Point(finger))) - RADIUS
        if block.distance(WORLD) > 0.005 and apart > 0.001 and block.within(shapely.box(0, 0, 0.5, 0.5)):
            found.append((pose, finger))
    return found


@pytest.fixture(scope="module")
def sparse():
    """A planner with few pushes."""
    scene = scene_of(fixtures=FIXTURES)
    return PushPlanner(scene, PushLibrary.build(scene, contacts=32, angles=3), GOAL, TABLE, SPEEDS)


def clearances(planner, pose, entry):
    """Return the distances of the slider, the finger, and the finger before its run-up from the fixtures in a push.

    The last is negative outside of the workspace.
    """
    library = planner.mean_library
    push, index = library.entries[entry]
    block = [placed(each) for each in compose(pose, library.outcomes[0][push, : index + 1])]
    end = library.starts[push] + library.travel[index] * library.directions[push]
    begin, end = to_world(pose, np.stack([planner.roadmap.goals[push], end]))
    apart = WORLD.distance(shapely.Point(begin)) - RADIUS if 0 <= begin.min() and begin.max() <= 0.5 else -1.0
    return min(map(WORLD.distance, block)), WORLD.distance(shapely.LineString([begin, end])) - RADIUS, apart


def test_pushes_that_are_allowed_run_into_no_fixture(sparse):
    rng, space, allowed = np.random.default_rng(1), sparse.space, 0
    before_run_up = sparse.roadmap.min_obstacle_distance - RADIUS
    wanted = np.array([sparse.clearance, sparse.clearance, before_run_up])
    assert space.slider_clearance == pytest.approx(sparse.clearance)  # the goal is farther away
    for pose, _ in starts(8, high=0.44):
        before = placed(pose).distance(WORLD)
        entries = rng.choice(len(sparse.push), 60, replace=False)
        free = space.free(sparse.mean_library, np.broadcast_to(pose, (60, 3)), entries)
        for entry, good in zip(entries, free, strict=True):
            beyond = clearances(sparse, pose, entry) - wanted
            if good:
                # between the poses that are checked
                assert beyond[0] >= min(before - space.slider_clearance, 0) - 4e-4
                assert beyond[1:].min() >= -1e-5
            elif before > space.slider_clearance:
                assert beyond.min() < 1e-4
            allowed += good
    assert 80 < allowed < 400


def test_the_grid_of_distances(sparse):
    """Where the slider is near, the grid is off by less than three quarters of the spacing of its positions."""
    rng, grid = np.random.default_rng(2), sparse.space.distances
    poses = np.column_stack([rng.uniform(0.1, 0.4, (800, 2)), rng.uniform(-9, 9, 800)])
    apart = np.array([placed(pose).distance(WORLD) for pose in poses])
    near = (apart > 0) & (apart < sparse.clearance)
    assert near.sum() > 10
    assert np.abs(grid(poses) - apart)[near].max() < 0.75 * grid.spacing
    assert (grid(poses)[apart > 3 * sparse.clearance] > sparse.clearance).all()
    overlap = np.array([placed(pose).intersection(WORLD).area for pose in poses]) > 3e-4
    assert (grid(poses)[overlap] < 0).all()


def test_plans_run_into_no_fixture(sparse):
    kinds = set()
    for pose, finger in starts(16, high=0.44):
        plan = sparse.choose(pose, finger)
        kinds.add(plan.status)
        if plan.status.failed:
            continue
        transit = shapely.LineString([*plan.transit.points, plan.start, plan.end])
        first = min(RADIUS + sparse.clearance, WORLD.distance(shapely.Point(finger)))
        assert WORLD.distance(transit) >= first - 1e-5
        if plan.status != PushStatus.ONE_PUSH:
            assert placed(plan.target).distance(WORLD) >= 0.9 * sparse.clearance
    assert {PushStatus.COST_TO_GO, PushStatus.TWO_PUSHES} <= kinds


def test_cost_to_go_knows_the_fixtures(sparse):
    """Behind the bar it costs more than without the bar."""
    free = PushPlanner(scene_of(), sparse.mean_library, GOAL, TABLE, SPEEDS)
    behind = np.array([[0.17, 0.25, angle] for angle in np.linspace(0, 2 * np.pi, 12)])
    assert sparse.value is not None
    assert free.value is not None
    more = sparse.value(behind) - free.value(behind)
    assert np.median(more) > 5
    assert (more > -2).all()


def test_poses_in_fixtures(sparse):
    with pytest.raises(ValueError, match=r"goal must be a pose at which the slider overlaps no fixture; got \[0.27"):
        PushPlanner(sparse.scene, sparse.mean_library, np.array([0.27, 0.3, 0]), TABLE, SPEEDS)
    inside = sparse.choose(np.array([0.26, 0.25, 0.0]), np.array([0.1, 0.4]))
    assert inside.status == PushStatus.START_IN_FIXTURE
    assert inside.status.failed
    finger = sparse.choose(np.array([0.12, 0.25, 0.0]), np.array([0.27, 0.3]))
    assert (finger.status, finger.transit.status) == (PushStatus.NO_TRANSIT, TransitStatus.START_IN_FIXTURE)


class Episode(NamedTuple):
    """Whether the goal was reached, in how many control steps, and the smallest distances from the fixtures, m."""

    success: bool
    steps: int
    slider: float
    finger: float


def play(made, pose, finger, fixtures, steps=150):
    """Play one episode in a plant with these fixtures."""
    state, scene = made.initial_state(), made.scene
    apart, success = [], False
    while not success and len(apart) < steps:
        action, state = made(jax.random.key(0), Observation(finger, pose), state)
        path = finger + np.linspace(0, 1, STEPS + 1)[:, None] * (action - finger)
        done = pj.rollout(scene.slider, scene.hand, path, pose=pose, friction=FRICTION, fixtures=fixtures)
        block = min(placed(each).distance(WORLD) for each in np.asarray(done.pose))
        hand_at = np.asarray(done.configuration, float)  # it stops at a jam
        apart.append((block, WORLD.distance(shapely.LineString(hand_at)) - RADIUS))
        pose, finger = np.asarray(done.pose[-1], float), hand_at[-1]
        if np.any(done.failed):  # the box is wedged between finger and fixture; such an episode is lost
            break
        success = float(made.planner.measure(compose(inverse(GOAL), pose))) > ENOUGH
    return Episode(success, len(apart), *np.min(apart, axis=0))


@pytest.mark.slow
def test_a_box_gets_around_fixtures():
    """The same controller and settings: that knows of the fixtures, that does not, and on a table without them."""
    pushes = PushLibrary.build(scene_of(), contacts=120, angles=7)
    episodes = {}
    for name, known, there in (
        ("fixtures that it knows", FIXTURES, FIXTURES),
        ("fixtures that it does not know", (), FIXTURES),
        ("no fixtures", (), ()),
    ):
        planner = PushPlanner(scene_of(fixtures=known), pushes, GOAL, TABLE, SPEEDS)
        made = PushController(planner, PositionControl())
        found = episodes[name] = [play(made, *start, there) for start in starts(12)]
        reached = [each.steps for each in found if each.success]
        print(
            f"{name}: {len(reached)} of {len(found)} in {np.mean(reached):.1f} steps; slider at places of fixtures "
            f"{sum(each.slider == 0 for each in found)}, finger {sum(each.finger < 0 for each in found)}; nearest "
            f"{1e3 * min(each.slider for each in found):.1f} and {1e3 * min(each.finger for each in found):.1f} mm"
        )
    knows, ignores, _ = episodes.values()
    assert sum(each.success for each in knows) >= 11
    assert all(each.slider > 0 and each.finger >= 0 for each in knows)
    assert sum(each.success and each.slider > 0 and each.finger >= 0 for each in ignores) < 6
