"""The command that plans pushes: its way points are replayed, and compared with the slider by shapely."""

import csv
import json

import matplotlib.image
import numpy as np
import pytest

import pushjax as pj
from pushjax.cli import main as cli
from pushjax.experiments import plan as experiment
from pushjax.experiments.plan import Options
from pushjax.geometry.se2_numpy import to_world
from pushjax.planning import PlanStatus, PushPlan
from pushjax.planning.between_pushes import transits_between
from pushjax.planning.push_problem import Outcomes

RADIUS, FRICTION = 0.005, 0.25
BLOCK = 0.03 * np.array([(-1.5, -1), (1.5, -1), (1.5, 1), (-1.5, 1)])
L = 0.03 * np.array([(-1, -1.5), (2, -1.5), (2, -0.5), (0, -0.5), (0, 2.5), (-1, 2.5)])  # with a reflex corner
# one push under known friction; and three under random friction
SIMPLE = ["--no-robust", "--pushes", "1", "--goal", "0.03", "0", "0", "--finger", "0.1", "-0.05", "--dof", "None"]
SIMPLE += ["--friction", str(FRICTION), str(FRICTION)]
ROBUST = ["--goal", "0.03", "0.02", "-0.4", "--symmetry", "2", "--finger", "-0.1", "0"]
NOT_CONVEX = ["--goal", "0.04", "0.03", "0.6", "--finger", "-0.1", "0", "--attempts", "1"]


def plan_of(status, path, pose, transits=(), samples=None, success=0.0):
    """A plan that needs no search."""
    samples, nothing = pose[None] if samples is None else samples, np.zeros(0)
    outcomes = Outcomes(samples, np.zeros(len(samples), bool))
    return PushPlan(status, path, pose, transits, nothing, outcomes, np.zeros(len(path), int), success, 0.0, nothing)


def push_through_the_middle(*_, pushes, finger, **__):
    """Plan a push through the center of a symmetric block, which then only translates."""
    path = np.linspace((-0.06, 0.0), (-0.02, 0.0), 13)[None]
    poses = np.array([(0.0, 0.0, 0.0), (0.03, 0.0, 0.0)])
    samples = poses + np.array([0.0, 1.0])[:, None] * np.linspace(-1e-3, 1e-3, 20)[:, None, None]
    between = transits_between(
        [BLOCK], RADIUS, float(pushes.clearance), path, poses[:, None], samples[:, :, None], np.array(finger)
    )
    return plan_of(PlanStatus.FOUND, path, poses, between.transits, samples, 1.0)


@pytest.fixture(
    scope="module",
    params=[
        ("without search", BLOCK),
        *(pytest.param(each, marks=pytest.mark.slow) for each in ((SIMPLE, BLOCK), (ROBUST, BLOCK), (NOT_CONVEX, L))),
    ],
    ids=["without search", "simple", "robust", "not convex"],
)
def planned(request, tmp_path_factory):
    """Folder, record and way points of a plan, and the vertices of the block."""
    folder = tmp_path_factory.mktemp("plan")
    options, block = request.param
    np.savetxt(folder / "block.csv", block, delimiter=",")
    with pytest.MonkeyPatch.context() as patch:
        if options == "without search":
            options = SIMPLE
            patch.setattr(experiment, "plan_pushes", push_through_the_middle)
        cli.main(["plan", *options, "--shape", str(folder / "block.csv"), "--out", str(folder)])
    rows = list(csv.DictReader((folder / "way_points.csv").open()))
    points = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    return folder, json.loads((folder / "plan.json").read_text()), points, block


def test_a_plan_is_found(planned):
    folder, record, *_ = planned
    assert record["experiment"] == "plan"
    assert record["success"] > 0.7
    assert record["status"] == ("FOUND" if record["success"] >= 0.9 else "UNLIKELY")
    assert matplotlib.image.imread(folder / "plan.png")[..., :3].std() > 0.02
    assert (folder / "plan.html").read_text().count("data:image/png;base64,") == 1


def test_the_finger_touches_nothing_between_pushes(planned):
    shapely = pytest.importorskip("shapely")
    _, record, points, corners = planned
    position = np.column_stack([points["finger_x"], points["finger_y"]])
    pushes = len(record["path"])
    ends = [0, *(np.flatnonzero(points["push"] == k + 1)[-1] for k in range(pushes))]
    for k, pose in enumerate(record["pose"]):
        stop = np.flatnonzero(points["push"] == k + 1)[0] if k < pushes else len(position)
        transit = shapely.LineString(position[ends[k] : stop])
        block = shapely.Polygon(to_world(np.array(pose), corners))
        assert block.distance(transit) > RADIUS - 2e-6  # way points are written in micrometers
        assert block.distance(shapely.Point(transit.coords[-1])) > RADIUS + 1e-3
    np.testing.assert_allclose(position[0], record["settings"]["finger"], atol=1e-6)


@pytest.mark.slow
def test_way_points_do_what_the_plan_says(planned):
    """A rollout along all of them, transits included, ends where the plan does under the mean friction."""
    _, record, points, corners = planned
    steps = 400 * len(record["path"])
    slider = pj.Slider.uniform(pj.Polygon(corners), degree=2)
    path = pj.resample(np.column_stack([points["finger_x"], points["finger_y"]]), steps)
    done = pj.rollout(slider, pj.Hand.finger(RADIUS), path, pose=np.array(record["pose"][0]), friction=FRICTION)
    assert not np.any(done.failed)
    np.testing.assert_allclose(done.pose[-1, :2], record["pose"][-1][:2], atol=2e-3)
    np.testing.assert_allclose(done.pose[-1, 2], record["pose"][-1][2], atol=0.04)


def test_time_is_that_of_the_speeds(planned):
    _, record, points, _ = planned
    length = np.hypot(np.diff(points["finger_x"]), np.diff(points["finger_y"]))
    speed = np.where(points["push"][1:] > 0, *reversed(record["settings"]["speed"]))
    np.testing.assert_allclose(np.diff(points["time"]), length / speed, atol=2e-3)


def test_without_a_transit_there_are_no_way_points(tmp_path, monkeypatch, capsys):
    """Those of an earlier plan are deleted."""
    (tmp_path / "way_points.csv").write_text("old")
    notched = 0.04 * np.array([(-1, -1), (1, -1), (1, 1), (0.1, 1), (0.1, 0), (-0.1, 0), (-0.1, 1), (-1, 1)])

    def into_the_notch(*_, pushes, **__):
        path, still = np.array([[(0.0, 0.02), (0.0, 0.0)]]), np.zeros((2, 3))
        between = transits_between(
            [notched], RADIUS, float(pushes.clearance), path, still[:, None], still[None, :, None]
        )
        return plan_of(PlanStatus.NO_TRANSIT, path, still, between.transits)

    monkeypatch.setattr(experiment, "plan_pushes", into_the_notch)
    cli.main(["plan", *SIMPLE, "--out", str(tmp_path)])
    assert "no plan: the finger does not get to push 1 (GOAL_BLOCKED)" in capsys.readouterr().out
    assert not (tmp_path / "way_points.csv").exists()
    assert json.loads((tmp_path / "plan.json").read_text())["status"] == "NO_TRANSIT"


def test_fixtures_of_a_plan(tmp_path, monkeypatch, capsys):
    """Walls and bodies get to the planner; a finger that would run into one makes no way points."""
    given = []

    def into_the_disk(_, scene, *__, **___):
        given[:] = scene.fixtures
        return plan_of(PlanStatus.HAND_IN_FIXTURE, np.array([[(-0.06, 0.0), (0.0, 0.0)]]), np.zeros((2, 3)))

    monkeypatch.setattr(experiment, "plan_pushes", into_the_disk)
    fixtures = ["wall@0,-0.1,1.5707963267948966", "disk:0.02@0.1,0.05,0", "rectangle:0.1x0.02@0,0.2,0.5"]
    options = ["--fixtures", *fixtures, "--fixture-friction", "0.3"]
    cli.main(["plan", *SIMPLE, *options, "--out", str(tmp_path)])
    wall, disk, bar = given
    np.testing.assert_allclose(np.concatenate([wall.point, wall.normal]), (0, -0.1, 0, 1), atol=1e-7)
    assert (float(disk.shape.radius), disk.pose.tolist()) == (pytest.approx(0.02), pytest.approx([0.1, 0.05, 0]))
    assert (float(bar.shape.area), bar.pose.tolist()) == (pytest.approx(0.002), pytest.approx([0, 0.2, 0.5]))
    assert [float(each.friction) for each in given] == pytest.approx([0.3] * 3)
    assert "runs into a fixture" in capsys.readouterr().out
    assert not (tmp_path / "way_points.csv").exists()


@pytest.mark.parametrize(
    ("fixture", "message"),
    [
        ("wall", "--fixtures: expected wall@X,Y,ANGLE"),
        ("wall@0,1", "--fixtures: expected wall@X,Y,ANGLE"),
        ("disc:0.02@0,1,0", "--fixtures: expected rectangle:"),
        ("ellipse:0.02x0.01@0,1,0", "a body is a disk or a polygon; got 'ellipse:0.02x0.01@0,1,0'"),
        ("disk:0.02@0,0,0", "start must be a pose at which the slider overlaps no fixture"),
    ],
)
def test_fixtures_that_cannot_be(fixture, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["plan", *SIMPLE, "--fixtures", fixture, "--out", str(tmp_path)])
    assert stop.value.code == 1
    assert message in capsys.readouterr().err


def test_attempts_end_with_the_first_that_is_sure_enough(monkeypatch):
    plans, counted = iter([(2, 0.0), (1, 0.4), (1, 0.7), (0, 0.95), (1, 0.4), (1, 0.7), (2, 0.8)]), []

    def planned(*_, **__):
        status, success = next(plans)
        return plan_of(PlanStatus(status), np.zeros((0, 2, 2)), np.zeros((1, 3)), success=success)

    monkeypatch.setattr(experiment, "plan_pushes", planned)
    goal = 0.03, 0.0, 0.0
    found = experiment.run(Options(goal, attempts=5), progress=lambda done, total: counted.append((done, total)))
    assert found["success"] == 0.95
    assert counted == [(1, 5), (2, 5), (3, 5), (4, 5)]
    assert experiment.run(Options(goal, attempts=3))["success"] == 0.7


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--goal", "0", "0", "90"], "--goal: the angle is in rad"),
        (["--goal", "0", "nan", "0"], "--goal must be finite"),
        (["--goal", "0", "0", "0", "--pushes", "0"], "--pushes must be a whole number, at least 1; got 0"),
        (["--goal", "0", "0", "0", "--friction", "0.3", "0.2"], "friction must be (lowest, highest); got (0.3, 0.2)"),
        (["--goal", "0", "0", "0", "--dof", "2"], "dof must be at least 3"),
        (["--goal", "0", "0", "0", "--radius", "0"], "--radius must be positive; got 0"),
        (["--goal", "0", "0", "0", "--speed", "0.1", "-1"], "--speed must be positive; got"),
        (["--goal", "0", "0", "0", "--tolerance", "0", "1"], "--tolerance must be positive; got"),
        (["--goal", "0", "0", "0", "--success", "2"], "--success must be a probability; got 2"),
        (["--goal", "0", "0", "0", "--shape", "cube:1"], "--shape: expected rectangle:"),
        (["--goal", "0", "0", "0", "--shape", "rectangle:90x60"], "--shape: 90 m across; expected at most 2 m"),
        (["--goal", "0", "0", "0", "--radius", "5"], "--radius: 10 m across; expected at most 2 m"),
        (["--goal", "0", "0", "0", "--finger", "0", "0"], "--finger overlaps the block at its start, by 35 mm"),
        (
            ["--goal", "30", "20", "0"],
            "--goal is 36.1 m away, and --pushes 3 of at most 0.0777 m (--longest) do not reach",
        ),
    ],
)
def test_bad_options_are_refused_in_one_line(options, message, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["plan", *options])
    assert end.value.code == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"pushjax: {message}")
