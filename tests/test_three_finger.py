"""Grasps with three fingers: the archive, and the authors' simulation against ours."""

from pathlib import Path

import numpy as np
import pytest

from pushjax.datasets import LogError
from pushjax.datasets.three_finger import load_three_finger_npz
from pushjax.experiments import three_finger
from pushjax.experiments.three_finger import causes, experiment, law, runs

STEPS, LIMIT = 100, 80


@pytest.fixture(scope="module")
def log(data):
    return load_three_finger_npz(data / "three_finger_sim" / "triangle.npz")


def test_archives(data, log):
    for name, corners, degree in (("triangle", 3, 2), ("hex", 6, 4), ("hex_small", 6, 4)):
        each = load_three_finger_npz(data / "three_finger_sim" / f"{name}.npz")
        assert each.vertices.shape == (corners, 2)
        assert each.degree == degree
        assert each.pose.shape == (each.runs, len(each.time), 3)
        assert each.pose.dtype == np.float64
        # no finger ever goes in by more than a tenth of a millimetre
        assert law.touching(each, each.pose, each.distance).gap.min() > -1e-4
    assert log.hand == pytest.approx([0, 0, np.pi / 3])


def damaged(log, change):
    with np.load(log.source) as archive:
        arrays = dict(archive)
    change(arrays)
    return arrays


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("hand_pose"), "found no hand_pose"),
        (lambda a: a.update(ls_type=np.array("cubic")), "ls_type to be one of quadratic, poly4"),
        (lambda a: a.update(ls_coeffs=np.ones(15)), r"ls_coeffs of shape \(3, 3\)"),
        (lambda a: a["object_pose"].__setitem__((3, 7, 1), np.nan), "finite numbers, found others in object_pose"),
        (lambda a: a["stop_index"].__setitem__(0, 999), "stop_index from 0 to 200"),
        (lambda a: a["finger_distance"].__setitem__((0, 100), 1.0), "never to grow"),
        (lambda a: a.update(finger_distance=a["finger_distance"][:, 1:]), "finger_distance of shape"),
    ],
)
def test_a_damaged_archive_is_named(log, tmp_path, change, message):
    path = tmp_path / "grasps.npz"
    np.savez(path, **damaged(log, change))
    with pytest.raises(LogError, match=message):
        load_three_finger_npz(path)


def test_no_archive(tmp_path):
    with pytest.raises(LogError, match="cannot read the file"):
        load_three_finger_npz(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("1 2 3")
    with pytest.raises(LogError, match="found something else"):
        load_three_finger_npz(tmp_path / "text.npz")


def test_fingers_against_a_triangle(log):
    """Above the origin: the finger over the top corner touches it, and is seen from there."""
    top = log.vertices[np.argmax(log.vertices[:, 1])]
    straight = log._replace(hand=np.zeros(3))
    seen = law.touching(straight, np.zeros((1, 3)), np.array([top[1] + log.radius]))
    assert seen.gap[0, 0] == pytest.approx(0, abs=1e-12)
    assert seen.point[0, 0] == pytest.approx(top)
    assert seen.normal[0, 0] == pytest.approx([0, -1])
    assert seen.closing[0, 0] == pytest.approx([0, -1])
    inside = law.touching(straight, np.zeros((1, 3)), np.array([1e-3]))
    assert np.all(inside.gap < -log.radius)
    assert inside.normal[0, 0] @ inside.closing[0, 0] > 0  # still inwards


@pytest.mark.long
def test_simulated_again(data, tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "OBJECTS", ("triangle",))
    monkeypatch.setattr(runs, "GRID", np.array([0.0, 0.05, 0.1, 0.2]))
    record = three_finger.run(data, out=tmp_path, steps=STEPS, limit=LIMIT)
    (cell,) = record["cells"]
    # the value in the authors' script, which the fit has no part in
    assert cell["friction"] == pytest.approx(0.1, abs=0.01)
    assert cell["runs"] == LIMIT // 2
    assert cell["median"][0] < 0.05
    assert cell["median"][1] < 0.1
    assert sum(sum(row.values()) for row in cell["states"].values()) == cell["runs"]
    assert cell["near"] + sum(cell["classes"].values()) == cell["runs"]
    assert set(cell["classes"]) <= set(causes.CLASSES)
    assert (tmp_path / "three_finger.png").exists()
    assert "triangle: final states" in three_finger.summary(record)


def test_a_motion_that_breaks_the_law_is_seen(log):
    """Ours satisfies it; the same with another spin does not."""
    run = int(np.flatnonzero(log.stop == len(log.time) - 1)[-1])
    gap = law.touching(log, log.pose[run], log.distance[run]).gap
    sample = int(np.flatnonzero((np.abs(gap) < law.TOUCHING).any(axis=1))[-1])
    state = log.pose[run, sample][None], log.distance[run, sample][None]
    with runs.float64():
        answers = law.motions_at(log, *state, np.array([1e-4]), 0.1)
        assert answers.clean[0]
        assert law.law_residual(log, answers.problem, answers.twist)[0] < 1e-6
        wrong = answers.twist + np.array([0.0, 0.0, 0.02])
        assert law.law_residual(log, answers.problem, wrong)[0] > law.BROKEN


def test_half_of_one_run_is_nothing_to_fit():
    with pytest.raises(ValueError, match="limit must be at least 2"):
        three_finger.run(Path("nowhere"), limit=1)
