"""Libraries of pushes: their outcomes, their composition, their files, and the cost to go."""

import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planning_parts import FRICTION, RADIUS, SPEEDS, TABLE, poses_reaching, scene_of

import pushjax as pj
from pushjax import planning
from pushjax.geometry import se2, se2_numpy
from pushjax.planning import FrictionFilter, PositionControl, PushController, PushLibrary, PushPlanner, Workspace
from pushjax.planning.cost_to_go import cost_to_go
from pushjax.planning.push_library import fan
from pushjax.planning.workspace import BoundingBoxTable

GOAL = np.array([0.25, 0.3, 0.7])
FLOAT32 = 2e-6  # of positions around 0.3 m, after a hundred steps
VERTICES = np.asarray(scene_of().slider.shape.vertices, float)
FEW = {"contacts": 12, "angles": 1}


@pytest.fixture(scope="module")
def scene():
    return scene_of()


@pytest.fixture(scope="module")
def library(scene):
    return PushLibrary.build(scene, contacts=60, angles=5)


def test_numpy_poses_agree_with_se2():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 2, (2, 50, 3))
    points = rng.normal(0, 1, (50, 2))
    close = {"atol": 1e-5}
    np.testing.assert_allclose(se2_numpy.compose(a, b), se2.compose(a, b), **close)
    np.testing.assert_allclose(se2_numpy.inverse(a), se2.inverse(a), **close)
    np.testing.assert_allclose(se2_numpy.to_world(a, points), se2.transform(a, points), **close)
    np.testing.assert_allclose(se2_numpy.to_body(a, se2_numpy.to_world(a, points)), points, atol=1e-12)


def test_features_are_a_distance_of_poses(library):
    rng = np.random.default_rng(1)
    center, length = np.array([0.03, -0.01]), 0.05
    features = replace(library, center=center, length=length).features
    a, move = rng.normal(0, 1, (2, 3))
    near = a + 1e-5 * rng.normal(0, 1, 3)

    def apart(p, q):
        return np.linalg.norm(features(p) - features(q))

    shift = se2_numpy.to_world(near, center) - se2_numpy.to_world(a, center)
    wanted = np.sqrt(np.sum(shift**2) + (length * (near[2] - a[2])) ** 2)
    assert apart(a, near) == pytest.approx(wanted, rel=1e-6)
    assert apart(a, a + np.array([0, 0, 2 * np.pi])) < 1e-12
    # a motion of the world changes no distance
    assert apart(se2_numpy.compose(move, a), se2_numpy.compose(move, near)) == pytest.approx(apart(a, near), rel=1e-6)


def test_an_outcome_is_that_of_a_push_anywhere(scene, library):
    """A push of the library, moved with the slider to another pose, ends at the composed pose."""
    rng = np.random.default_rng(2)
    entry = int(rng.choice(np.flatnonzero(library.entries[:, 1] == 60)))
    push, index = library.entries[entry]
    pose = np.array([0.2, -0.1, 2.0])
    path = library.starts[push] + library.travel[: index + 1, None] * library.directions[push]
    moved = pj.rollout(scene.slider, scene.hand, se2.transform(pose, path), pose=pose, friction=FRICTION)
    np.testing.assert_allclose(moved.pose[-1], se2_numpy.compose(pose, library.relative[entry]), atol=1e-5)


def test_every_push_moves_the_slider_away_from_the_finger(library):
    """The work is positive: the displacement of the touched place is along the push."""
    last = library.outcomes[0, :, -1]
    finger = library.starts + library.travel[-1] * library.directions
    assert library.valid[:, -1].mean() > 0.5
    touched = library.valid[:, -1]
    contact = library.starts + RADIUS * library.directions
    displacement = se2_numpy.to_world(last, contact) - contact
    assert ((displacement * library.directions).sum(1)[touched] > 0).mean() > 0.95
    # and the finger does not end in the slider
    body = se2_numpy.to_body(last, finger)
    depth = np.minimum(0.05 + RADIUS - np.abs(body[:, 0]), 0.03 + RADIUS - np.abs(body[:, 1]))
    assert depth.max() < RADIUS + 1e-4


def test_poses_reaching_a_goal(library):
    """From each of them its push leads to the goal, and the tree finds it there."""
    back = poses_reaching(library, GOAL)
    reached = se2_numpy.compose(back, library.relative)
    np.testing.assert_allclose(reached[:, :2], np.broadcast_to(GOAL[:2], reached[:, :2].shape), atol=FLOAT32)
    some = back[::501]
    wanted = se2_numpy.compose(se2_numpy.inverse(some), np.broadcast_to(GOAL, some.shape))
    distance, index = library.nearest(wanted, 3, 0.01)
    assert distance.shape == index.shape == (len(some), 3)
    assert distance[:, 0].max() < 2 * FLOAT32
    # the nearest of all, by brute force
    far = wanted + np.array([0.004, -0.003, 0.05])
    distance, index = library.nearest(far, 1, 0.05)
    features = library.features(library.relative)
    for each, found in zip(far, distance[:, 0], strict=True):
        assert found == pytest.approx(np.linalg.norm(features - library.features(each), axis=1).min(), rel=1e-4)


def test_files(library, tmp_path):
    """They have exactly the name that was given."""
    library.save(str(tmp_path / "x"))
    assert os.listdir(tmp_path) == ["x"]
    read = PushLibrary.load(str(tmp_path / "x"))
    for name in PushLibrary.__dataclass_fields__:
        assert np.array_equal(getattr(read, name), getattr(library, name)), name
    arrays = {name: getattr(library, name) for name in PushLibrary.__dataclass_fields__}
    np.savez(tmp_path / "old.npz", **arrays, format_version=1)
    with pytest.raises(ValueError, match="does not hold a library of pushes: its format is 1; this program reads"):
        PushLibrary.load(tmp_path / "old.npz")
    (tmp_path / "text.npz").write_text("no library")
    with pytest.raises(ValueError, match="does not hold a library"):
        PushLibrary.load(tmp_path / "text.npz")


def test_a_file_is_written_as_a_whole_or_not_at_all(library, tmp_path, monkeypatch):
    library.save(tmp_path / "x")
    before = (tmp_path / "x").read_bytes()

    def interrupted(file, **arrays):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        library.save(tmp_path / "x")
    assert os.listdir(tmp_path) == ["x"]
    assert (tmp_path / "x").read_bytes() == before


def test_a_cache_has_one_file_for_each_library(scene, tmp_path):
    """It is read again, unless it is damaged."""
    built = PushLibrary.build(scene, **FEW, cache=tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    np.testing.assert_array_equal(PushLibrary.build(scene, **FEW, cache=tmp_path).outcomes, built.outcomes)
    written = file.stat().st_mtime_ns
    assert PushLibrary.build(scene, **FEW, cache=tmp_path).digest == built.digest
    assert file.stat().st_mtime_ns == written
    thin = pj.Polygon.rectangle(0.1, 0.05)
    for other, pushes in ((scene_of(thin), FEW), (scene_of(friction=0.3), FEW), (scene, FEW | {"angles": 2})):
        PushLibrary.build(other, **pushes, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


def test_a_planner_takes_the_library_of_its_scene(scene, library):
    planner = PushPlanner(scene, library, GOAL, TABLE, SPEEDS)
    slider, model = scene.slider, pj.FrictionModel(20, (0.1, 0.5))
    for name, other in (
        ("slider", scene_of(pj.Polygon.rectangle(0.1, 0.05))),
        ("slider", planning.PushScene(pj.Slider(slider.shape, pj.Ellipsoid(np.eye(3), 0.04)), scene.hand, FRICTION)),
        ("radius", planning.PushScene(slider, pj.Hand.finger(0.02), FRICTION)),
        ("friction", scene_of(friction=0.2)),
        ("friction", scene_of(friction=model)),
    ):
        with pytest.raises(ValueError, match=f"library was made for another {name} than the scene's"):
            PushPlanner(other, library, GOAL, TABLE, SPEEDS)
    learning = FrictionFilter(scene_of(friction=model), samples=8)
    with pytest.raises(ValueError, match="library was made for another friction"):
        PushController(planner, PositionControl(), friction_filter=learning, prior=learning.init(jax.random.key(0)))


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ((0.04, 0.3, 0.0), "goal must be a pose at which the slider is within the workspace.* 10 mm out of it"),
        ((0.2, 0.3), r"goal has shape \(2,\)"),
        ((0.2, np.nan, 0.0), "goal must be finite"),
    ],
)
def test_goals_out_of_the_workspace(scene, library, goal, message):
    with pytest.raises(ValueError, match=message):
        PushPlanner(scene, library, np.array(goal), TABLE, SPEEDS)


def test_random_friction(scene):
    """Outcomes under drawn friction scatter, less with a better known surface; without noise they do not."""
    key = jax.random.key(0)

    def simulated(dof, friction):
        many = PushLibrary.build(scene_of(friction=pj.FrictionModel(dof, friction)), **FEW, samples=12, key=key)
        assert many.outcomes.shape == (12, 12, len(many.travel), 3)
        return many, many.features(many.outcomes.astype(float)).std(axis=0).max(-1)

    known = PushLibrary.build(scene, **FEW)
    loose, wide = simulated(10, (0.05, 0.4))
    tight, narrow = simulated(1000, (0.09, 0.11))
    at_end = loose.valid[:, -1]
    assert at_end.sum() >= 4
    assert (wide[at_end, -1] > 3 * narrow[at_end, -1]).all()
    np.testing.assert_allclose(tight.averaged().relative[:, :2].mean(0), known.relative[:, :2].mean(0), atol=0.002)
    weight = np.random.default_rng(4).dirichlet(np.ones(12))
    mean = np.average(loose.outcomes.astype(float), axis=0, weights=weight)
    np.testing.assert_allclose(loose.averaged(weight).outcomes[0], mean, atol=1e-5)
    with pytest.raises(ValueError, match="weight"):
        loose.averaged(np.ones(3) / 3)
    with pytest.raises(ValueError, match="key"):
        PushLibrary.build(scene_of(friction=pj.FrictionModel(10, 0.2)), samples=2)
    with pytest.raises(ValueError, match="samples must be 1, because the scene's friction is known; got 2"):
        PushLibrary.build(scene, samples=2, key=key)


def test_bad_numbers(scene):
    for name, bad in {"contacts": 0, "angles": 2.5, "max_angle": 2.0}.items():
        with pytest.raises(ValueError, match=name):
            fan(scene, **{name: bad})
    with pytest.raises(ValueError, match="hand must be one round finger"):
        PushLibrary.build(planning.PushScene(scene.slider, pj.Hand.two_fingers(RADIUS)))
    with pytest.raises(TypeError, match="fixtures: expected a sequence of Wall and Fixture; got one Wall"):
        scene_of(fixtures=pj.Wall(jnp.zeros(2), jnp.array([1.0, 0.0])))
    with pytest.raises(ValueError, match="resample_every must be None for a plan"):
        scene_of(friction=pj.FrictionModel(50, 0.3, resample_every=2))


LIMITS = Workspace.rectangle((0.0, 0.0), (0.5, 0.6))
BETWEEN = 5.0  # control steps


@pytest.fixture(scope="module")
def time(library):
    return SPEEDS.push_time(library.travel[library.entries[:, 1]])


@pytest.fixture(scope="module")
def value(scene, library, time):
    low, high = np.array([0.04, 0.04]), np.array([0.46, 0.56])
    settings = {"low": low, "high": high, "tolerance": 0.006, "between": BETWEEN, "vertices": VERTICES}
    return cost_to_go(library, GOAL, LIMITS, time, usable=np.ones(len(library.starts), bool), **settings)


def test_cost_to_go_of_pushes(library, time, value):
    """From where one push reaches the goal the cost is about that of the push, and it grows with the distance."""
    back = poses_reaching(library, GOAL)
    within = BoundingBoxTable(VERTICES).outside(back, LIMITS) == 0
    within &= LIMITS.allows_finger(se2_numpy.to_world(back, library.starts[library.entries[:, 0]]))
    excess = value.nearest(back[within]) - (time[within] + BETWEEN)
    assert np.median(excess) < 5
    at_goal, beside, far = (value(GOAL + np.array([x, 0, 0.0])) for x in (0.0, -0.06, -0.16))
    assert at_goal < far
    assert beside < far + 5
    assert value(GOAL + np.array([0, 0, np.pi])) > at_goal + 5  # half a turn takes more than one push
    np.testing.assert_allclose(value(GOAL + np.array([0, 0, 2 * np.pi])), at_goal, rtol=1e-4)


def test_cost_to_go_is_a_fixed_point(library, time, value):
    """No push of the library leads to a cell from which the goal is nearer by more than the push costs."""
    rng = np.random.default_rng(4)
    gains = []
    for _ in range(40):
        cell = np.array([*rng.integers(6, 30, 2), rng.integers(36)])
        here = np.array([*(value.origin + value.spacing * cell[:2]), cell[2] * np.pi / 18])
        reached = se2_numpy.compose(here, library.relative)
        good = BoundingBoxTable(VERTICES).outside(reached, LIMITS) == 0
        good &= LIMITS.allows_finger(se2_numpy.to_world(here, library.starts[library.entries[:, 0]]))
        best = np.min((time + BETWEEN + value(reached))[good])
        gains.append(float(value(here)) - best)
    # pushes are rounded to cells, so single cells differ by about a step across one cell
    assert abs(np.median(gains)) < 4
    assert max(gains) < 20


def test_bounding_boxes_are_those_of_the_corners():
    rng = np.random.default_rng(5)
    where = np.column_stack([rng.uniform(0, 0.5, (200, 2)), rng.uniform(-9, 9, 200)])
    limits = Workspace.rectangle((0.1, 0.05), (0.4, 0.5))
    corners = se2_numpy.to_world(where[:, None], VERTICES)
    over = np.maximum(limits.slider_low - corners, corners - limits.slider_high).max((1, 2))
    found = BoundingBoxTable(VERTICES).outside(where, limits)
    assert (found >= np.maximum(over, 0) - 1e-6).all()  # never too small
    assert (found - np.maximum(over, 0)).max() < 0.001
