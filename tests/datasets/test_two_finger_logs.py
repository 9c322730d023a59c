"""Original logs of two fingers, against the curated arrays of the same pushes, and damaged ones."""

import shutil

import numpy as np
import pytest

from pushjax.datasets.push_log import LogError
from pushjax.datasets.two_finger import load_two_finger_npz
from pushjax.datasets.two_finger_logs import load_two_finger_logs

SESSION = "exp_Tue Sep  1 23:18:59 2015"


@pytest.fixture
def session(data, tmp_path):
    """A copy of the two files of one session, in a folder that names the arrangement."""
    folder = tmp_path / "3pts3"
    folder.mkdir()
    for path in (data / "raw/two_finger_push/30_90_30_30_30_90").glob("exp_*"):
        shutil.copy(path, folder / path.name)
    return folder


def files(folder):
    sensor, actions = next(folder.glob("*_sensor*")), next(folder.glob("*_pushaction*"))
    sensor.chmod(0o644)
    actions.chmod(0o644)
    return sensor, actions


def test_a_push_is_that_of_the_curated_arrays(data, session):
    log, curated = load_two_finger_logs(session), load_two_finger_npz(data / "two_finger_push/3pts3.npz")
    assert (log.arrangement, log.surface, len(log), log.problems) == ("3pts3", "unknown", 1, ())
    (row,) = np.flatnonzero(np.abs(curated.time - log.time[0]) < 1e-3)
    # the two take the plate's small tilt into account differently
    for name in ("pose_start", "pose_end", "hand_start", "hand_end", "turn", "center", "gap_start", "gap_end"):
        np.testing.assert_allclose(getattr(log, name)[0], getattr(curated, name)[row], rtol=0, atol=3e-7, err_msg=name)
    assert log.stick_deviation[0] == pytest.approx(curated.stick_deviation[row], abs=1e-6)
    np.testing.assert_allclose(log.support_points, curated.support_points, atol=1e-12)
    np.testing.assert_allclose(log.support_force, curated.support_force, rtol=1e-9)
    assert (log.spacing, log.length) == (curated.spacing, pytest.approx(curated.length))
    assert log.paths(4).shape == (1, 5, 4)


def test_a_straight_push_follows_its_action(session):
    """The hand moves by the closing distance along the approach, and then by the amount along the direction."""
    _, actions = files(session)
    lines = actions.read_text().splitlines()
    contact, approach = (np.array(lines[k].split(), float)[:2] for k in (2, 4))
    unit, closing = approach / np.linalg.norm(approach), float(lines[5].split()[1])
    turned = load_two_finger_logs(session)
    theta = turned.pose_start[0, 2]
    matrix = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    # a straight push that takes the middle of the hand to a place behind that where the rotation takes it
    target = turned.hand_end[0, :2] - 0.003 * matrix @ unit
    moved = 1000 * matrix.T @ (target - turned.hand_start[0, :2]) - closing * unit
    direction = f"{moved[0]:.9f} {moved[1]:.9f} 0"
    last = f"{np.linalg.norm(moved):.9f} {closing}"
    actions.write_text("\n".join([lines[0], "TwoPointTranslation", lines[2], direction, lines[4], last]))
    log = load_two_finger_logs(session)
    assert log.turn[0] == 0
    assert np.isnan(log.center[0]).all()
    np.testing.assert_allclose(log.hand_end[0, :2], target, atol=1e-9)
    first = log.pose_start[0, :2] + matrix @ ((contact - 50) / 1000 - closing / 1000 * unit)
    np.testing.assert_allclose(log.hand_start[0, :2], first, atol=1e-12)
    assert log.hand_end[0, 2] == log.hand_start[0, 2]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda lines: [*lines[:3], "1 2", *lines[4:]],
            "line 2: expected the type of a push and 3, 3, 3 and 2 numbers",
        ),
        (lambda lines: [*lines[:3], "1 2 x", *lines[4:]], "line 2: expected the type of a push"),
        (lambda lines: [*lines[:5], "500 0.5"], "expected usable pushes|from the outline at the end"),
        (lambda lines: lines[:4], "expected"),
        (lambda lines: [*lines[:4], "0 0 0", *lines[5:]], "line 2: expected the type of a push"),
        (lambda lines: [*lines[:3], "1 \0 2", *lines[4:]], "line 2: expected the type of a push"),
    ],
)
def test_damaged_actions_are_named(session, damage, message):
    _, actions = files(session)
    actions.write_text("\n".join(damage(actions.read_text().splitlines())))
    with pytest.raises(LogError, match=message):
        load_two_finger_logs(session)


def test_missing_files_are_named(session, tmp_path):
    with pytest.raises(LogError, match="found none"):
        load_two_finger_logs(tmp_path)
    _, actions = files(session)
    actions.unlink()
    with pytest.raises(LogError, match="cannot read the file"):
        load_two_finger_logs(session)


def test_pushes_keep_their_actions_after_a_damaged_header(session):
    sensor, actions = files(session)
    whole = load_two_finger_logs(session)
    lines = sensor.read_text().splitlines()
    sensor.write_text("\n".join(["x", *lines[1:], *lines[1:]]))
    planned = actions.read_text().splitlines()
    amount, closing = planned[5].split()
    other = [*planned[1:5], f"{float(amount) - 1} {closing}"]
    actions.write_text("\n".join(["2", *planned[1:6], *other]))
    log = load_two_finger_logs(session)
    assert len(log) == 2
    assert len(log.problems) == 1
    np.testing.assert_array_equal(log.hand_end[0], whole.hand_end[0])
    assert np.any(log.hand_end[1] != whole.hand_end[0])


def test_a_damaged_record_is_a_problem(session):
    sensor, _ = files(session)
    lines = sensor.read_text().splitlines()
    lines[1] = " ".join(lines[1].split()[:5])
    sensor.write_text("\n".join(lines))
    with pytest.raises(LogError):
        load_two_finger_logs(session)


def test_a_pose_that_is_none_is_a_problem(session):
    sensor, _ = files(session)
    lines = sensor.read_text().splitlines()
    pose = next(k for k, line in enumerate(lines) if len(line.split()) == 7)
    lines[pose] = " ".join([*lines[pose].split()[:3], "0 0 0 0"])
    sensor.write_text("\n".join(lines))
    with pytest.raises(LogError, match="unit quaternion"):
        load_two_finger_logs(session)
