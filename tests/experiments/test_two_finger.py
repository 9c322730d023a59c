"""Two-finger pushes: the loader, the measure of sticking, and the experiment on the real pushes."""

import matplotlib as mpl

mpl.use("Agg")

import json
import shutil

import matplotlib.image
import numpy as np
import pytest

from pushjax.datasets import LogError
from pushjax.datasets.two_finger import TwoFingerLog, load_two_finger_npz, stick_deviation
from pushjax.experiments import two_finger
from pushjax.experiments._record import write_json
from pushjax.experiments.two_finger import predictions

EXACT = 1e-12
# Upper limit of the experiment's error for each object, as a fraction of the motion.
RATIO = 0.25
OBJECTS = {"3pts1": 3, "3pts3": 3, "patch": 0}


def archive(count=4, **changes):
    """Return the arrays of a small archive: turns about a point, and one straight push."""
    rng = np.random.default_rng(5)
    hand, turn = rng.normal(size=(count, 3)), rng.uniform(0.1, 0.3, count)
    center, travel = rng.normal(size=(count, 2)), rng.normal(size=(count, 2))
    turn[0], center[0] = 0.0, np.nan
    c, s = np.cos(turn), np.sin(turn)
    x, y = (hand[:, :2] - center).T
    end = np.stack([c * x - s * y, s * x + c * y], axis=1) + center
    end[0] = hand[0, :2] + travel[0]
    data = {
        "push_index": np.arange(count) * 3,
        "valid": np.ones(count, bool),
        "action_group": np.arange(count) // 2,
        "t0_unix": 1.44e9 + np.arange(count),
        "object_pose_start": rng.normal(size=(count, 3)),
        "object_pose_end": rng.normal(size=(count, 3)),
        "pusher_pose_start": hand,
        "pusher_pose_end": np.column_stack([end, hand[:, 2] + turn]),
        "rotation_angle": turn,
        "cor_world": center,
        "gap_start": np.zeros((count, 2)),
        "gap_end": np.zeros((count, 2)),
        "stick_deviation": np.zeros(count),
        "vertices_body": np.array([[-0.05, -0.05], [-0.05, 0.1], [0.1, -0.05]]),
        "rho": np.float64(0.0707),
        "finger_half_spacing": np.float64(0.025),
        "support_points_body": np.empty((0, 2)),
        "support_normal_force": np.empty(0),
        "surface": np.str_("unknown"),
        "arrangement": np.str_("patch"),
    }
    return data | changes


def written(folder, data):
    path = folder / "pushes.npz"
    np.savez(path, **{name: value for name, value in data.items() if value is not None})
    return path


@pytest.fixture(params=OBJECTS)
def log(request, data) -> TwoFingerLog:
    path = data / "two_finger_push" / f"{request.param}.npz"
    if not path.exists():
        pytest.skip(f"no {path}")
    return load_two_finger_npz(path)


def test_loader_keeps_rows_and_shapes(tmp_path):
    log = load_two_finger_npz(written(tmp_path, archive()))
    assert (len(log), log.index.tolist(), log.group.tolist()) == (4, [0, 3, 6, 9], [0, 0, 1, 1])
    assert log.spacing == pytest.approx(0.05)
    assert log.problems == ()
    assert (log.support_points.shape, log.support_force.shape) == ((0, 2), (0,))
    assert np.all(np.abs(log.pose_end[:, 2] - log.pose_start[:, 2]) <= np.pi)


def test_paths_turn_rigidly_or_go_straight_to_the_commanded_end(tmp_path):
    log = load_two_finger_npz(written(tmp_path, archive()))
    paths = log.paths(7)
    assert paths.shape == (4, 8, 4)
    assert np.isfinite(paths).all()
    np.testing.assert_allclose(paths[:, 0, :3], log.hand_start, atol=EXACT)
    np.testing.assert_allclose(paths[:, -1, :3], log.hand_end, atol=EXACT)
    np.testing.assert_allclose(paths[..., 3], log.spacing)
    np.testing.assert_allclose(np.diff(paths[0, :, :2], n=2, axis=0), 0, atol=EXACT)
    away = np.linalg.norm(paths[1:, :, :2] - log.center[1:, None], axis=-1)
    np.testing.assert_allclose(away, np.broadcast_to(away[:, :1], away.shape), atol=EXACT)
    with pytest.raises(ValueError, match="steps"):
        log.paths(0)


def test_unusable_rows_become_problems(tmp_path):
    data = archive()
    data["valid"][1] = False
    data["object_pose_end"][2, 1] = np.nan
    log = load_two_finger_npz(written(tmp_path, data))
    assert log.index.tolist() == [0, 9]
    assert [problem.push for problem in log.problems] == [3, 6]
    assert "object_pose_end" in log.problems[1].message


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"cor_world": None}, "found no cor_world"),
        ({"gap_end": np.zeros((4, 3))}, "gap_end"),
        ({"vertices_body": np.zeros((4, 2))}, "vertices_body"),
        ({"support_normal_force": np.ones(3)}, "support point"),
        ({"push_index": np.float64(3)}, "push_index"),
        ({"gap_start": np.full((4, 2), "x")}, "gap_start"),
        ({"valid": np.zeros(4, bool)}, "usable pushes"),
        ({"cor_world": np.full((4, 2), np.nan), "valid": np.array([0, 1, 1, 1], bool)}, "usable"),
    ],
)
def test_damaged_archives_are_refused(tmp_path, changes, what):
    with pytest.raises(LogError, match=what) as raised:
        load_two_finger_npz(written(tmp_path, archive(**changes)))
    assert raised.value.path.endswith("pushes.npz")


def test_files_that_are_no_archives_are_refused(tmp_path):
    with pytest.raises(LogError, match="cannot read"):
        load_two_finger_npz(tmp_path / "nothing.npz")
    other = tmp_path / "other.npz"
    other.write_bytes(b"not an archive")
    with pytest.raises(LogError, match="something else"):
        load_two_finger_npz(other)
    single = tmp_path / "single.npz"
    with single.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(LogError, match="single array"):
        load_two_finger_npz(single)


def test_stuck_objects_do_not_move_in_the_hand(rng):
    hands, angle, shift = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5)), rng.normal(size=(5, 2))
    hands[..., 2] += 2 * np.pi * np.array([[0], [1]])  # a full turn is not a motion
    c, s = np.cos(hands[..., 2]), np.sin(hands[..., 2])
    x, y = shift.T
    where = hands[..., :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    poses = np.concatenate([where, hands[..., 2:] + angle[:1, :, None]], axis=-1)
    np.testing.assert_allclose(stick_deviation(*hands, *poses, 0.07), 0, atol=EXACT)
    poses[1, :, 2] += 0.1
    np.testing.assert_allclose(stick_deviation(*hands, *poses, 0.07), 0.007, atol=EXACT)


def test_real_archives_fit_together(log):
    """The stored measure equals ours, the commanded path ends where stated, and the fingers start at the given gaps."""
    found = stick_deviation(log.hand_start, log.hand_end, log.pose_start, log.pose_end, log.length)
    np.testing.assert_allclose(found, log.stick_deviation, atol=EXACT)
    paths = log.paths(3)
    np.testing.assert_allclose(paths[:, -1, :2], log.hand_end[:, :2], atol=EXACT)
    assert log.support_points.shape == (OBJECTS[log.arrangement], 2)
    assert np.all(np.abs(log.gap_start) < 0.0011)


def test_repeats_of_an_action_stay_on_one_side_of_a_split(tmp_path):
    log = load_two_finger_npz(written(tmp_path, archive(count=10)))
    errors = np.random.default_rng(0).uniform(size=(2, 3, 10))
    tested = predictions.splits(log, errors, np.random.default_rng(0))
    assert len(tested.test) == predictions.SPLITS
    for pushes in tested.test:
        assert 0 < len(pushes) < 10
        assert not set(log.group[pushes]) & set(np.delete(log.group, pushes))
    mean = predictions.per_push(errors, tested)
    seen = np.isfinite(mean)
    assert np.all(mean[seen] < 1)


@pytest.fixture(scope="module")
def record(data, tmp_path_factory):
    if not (data / "two_finger_push").is_dir():
        pytest.skip("no two_finger_push folder")
    folder = tmp_path_factory.mktemp("two_finger")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(predictions, "FRICTIONS", np.linspace(0.2, 0.5, 4))
        patch.setattr(predictions, "RADII", (0.0, 0.001))
        found = two_finger.run(data, out=folder, steps=30)
    write_json(found, folder / "record.json")
    return json.loads((folder / "record.json").read_text())


@pytest.mark.slow
def test_predicts_the_real_pushes(record):
    assert [cell["object"] for cell in record["cells"]] == list(OBJECTS)
    for cell in record["cells"]:
        assert cell["mean_mm"] < RATIO * cell["no_motion_mm"], cell["object"]
        assert cell["ratio"] == pytest.approx(cell["mean_mm"] / cell["no_motion_mm"])
        assert cell["median_mm"] < cell["mean_mm"]
        assert cell["stick_agreement"] > cell["stick_by_chance"] + 0.05
        assert 0.2 <= cell["friction"] <= 0.5
        assert sum(cell["stuck"].values()) == pytest.approx(1)
        assert cell["failed_steps"] == 0  # of 30 steps times 8 settings, in float64
        assert cell["jammed_pushes"] == 0
        assert cell["pushes"] == {"3pts1": 95, "3pts3": 298, "patch": 138}[cell["object"]]


@pytest.mark.slow
def test_repeats_bound_what_can_be_predicted(record):
    for cell in record["cells"]:
        repeats = cell["repeats"]
        assert 0 < repeats["floor_mm"] < repeats["model_mm"]
        assert repeats["pushes"] >= 50
        assert 0.8 < repeats["floor_agreement"] <= 1


def test_draws_and_sums_up(record):
    (picture,) = record["pictures"]
    image = matplotlib.image.imread(picture)
    assert image.shape[0] > 300
    assert image[..., :3].std() > 0.02  # not blank
    text = two_finger.summary(record)
    assert all(name in text for name in OBJECTS)


def test_refuses_another_model(tmp_path):
    with pytest.raises(ValueError, match="model"):
        two_finger.run(tmp_path, model="cubic")
    with pytest.raises(LogError, match=r"expected 3pts1\.npz, or a folder 3pts1 of published logs"):
        two_finger.run(tmp_path)


def test_published_logs_take_the_place_of_an_archive(data, tmp_path):
    """Without an archive, a folder with the name of the arrangement is read, as `pushjax data triangle` leaves it."""
    from pushjax.experiments.two_finger.experiment import load

    session = data / "raw/two_finger_push/30_90_30_30_30_90"
    shutil.copytree(session, tmp_path / "3pts3")
    log = load(tmp_path, "3pts3")
    assert (len(log), log.arrangement) == (1, "3pts3")
    assert len(load(data / "two_finger_push", "3pts3")) > 100
