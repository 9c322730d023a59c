"""Logs of two fingers: as they were made, against the curated arrays of the same push, and damaged ones."""

import shutil

import numpy as np
import pytest

from pushjax.datasets import LogError, load_recordings, load_two_finger_logs
from pushjax.datasets.planar import rotation
from pushjax.datasets.two_finger_logs import make_push

POSE = "0 0 100 1 0 0 0"
TURN = np.radians(10)
CENTER = np.array([52.0, -168.0])  # of the turn, mm, in the frame of the corner, which is at the world's origin
ACTIONS = ("1", "TwoPointRotation", "75 75 0", "52 -168 0", "-0.7071067811865476 -0.7071067811865476 0", "10 0.5")


def files(folder):
    return next(folder.glob("*_sensor*")), next(folder.glob("*_pushaction*"))


@pytest.fixture
def session(tmp_path):
    """The two files of a session of one push, in which the object turns with the hand."""
    folder = tmp_path / "3pts3"
    folder.mkdir()
    corner = CENTER - rotation(TURN) @ CENTER
    after = f"{corner[0]:.9f} {corner[1]:.9f} 100 {np.cos(TURN / 2):.12f} 0 0 {np.sin(TURN / 2):.12f}"
    samples = ["2", "1e9 0 0", "1000000005 0 0", "1", "1e9 0 0 0 1 0 0 0"]
    (folder / "exp_1_sensor1.txt").write_text("\n".join(["1", POSE, after, *samples]) + "\n")
    (folder / "exp_1_pushaction1.txt").write_text("\n".join(ACTIONS))
    return folder


def test_a_push_is_read_as_it_was_made(session):
    log = load_two_finger_logs(session)
    assert (log.object, log.surface, len(log), log.problems) == ("3pts3", None, 1, ())
    (push,) = log.pushes
    assert push.about["began"] == 1e9
    start = np.array([75, 75]) + 0.5 * np.sqrt([0.5, 0.5])
    end = CENTER + rotation(TURN) @ (start - CENTER)
    np.testing.assert_allclose(1000 * push.hand[[0, -1], :2], [start, end], atol=1e-9)
    np.testing.assert_allclose(push.hand[[0, -1], 2], [-0.75 * np.pi, -0.75 * np.pi + TURN], atol=1e-9)
    middle = 1000 * push.pose[[0, -1], :2]
    np.testing.assert_allclose(middle, [[50, 50], CENTER + rotation(TURN) @ (50 - CENTER)], atol=1e-8)
    np.testing.assert_allclose(push.pose[[0, -1], 2], [0, TURN], atol=1e-9)


def test_a_push_is_that_of_the_curated_arrays(data, converted):
    log = load_two_finger_logs(data / "raw/two_finger_push/30_90_30_30_30_90")
    curated = load_recordings(converted / "two_finger_push/3pts3.npz")
    assert (log.object, log.surface, len(log), log.problems) == ("3pts3", None, 1, ())
    (row,) = np.flatnonzero(np.abs(curated.about("began") - log.about("began")[0]) < 1e-3)
    (push,), same = log.pushes, curated.pushes[row]
    # the two take the plate's small tilt into account differently
    np.testing.assert_allclose(push.hand, same.hand, rtol=0, atol=3e-7)
    np.testing.assert_allclose(push.pose, same.pose, rtol=0, atol=3e-7)
    assert push.tracked[[0, -1]].all()
    assert push.tracked.sum() == 2
    np.testing.assert_allclose(log.support_points, curated.support_points, atol=1e-12)
    np.testing.assert_allclose(log.support_force, curated.support_force, rtol=1e-9)
    np.testing.assert_allclose(log.vertices, curated.vertices, atol=1e-12)
    assert log.length == pytest.approx(curated.length)


def test_paths_turn_rigidly_or_go_straight_to_the_commanded_end(rng):
    for turn in (0.0, 0.1, -0.2):
        start, end, pose = rng.normal(size=(3, 3))
        center = rng.normal(size=2)
        path = make_push(0, (pose, pose), (start, end), turn, center).hand
        np.testing.assert_allclose(path[0], [*start, 0.05], atol=1e-12)
        np.testing.assert_allclose(path[-1, 2], start[2] + turn, atol=1e-12)
        if turn:
            np.testing.assert_allclose(np.ptp(np.linalg.norm(path[:, :2] - center, axis=1)), 0, atol=1e-12)
        else:
            np.testing.assert_allclose(path[-1, :2], end[:2], atol=1e-12)
            np.testing.assert_allclose(np.diff(path[:, :2], n=2, axis=0), 0, atol=1e-12)


def test_a_straight_push_follows_its_action(session):
    """The hand moves by the closing distance along the approach, and then by the amount along the direction."""
    _, actions = files(session)
    lines = actions.read_text().splitlines()
    contact, approach = (np.array(lines[k].split(), float)[:2] for k in (2, 4))
    unit, closing = approach / np.linalg.norm(approach), float(lines[5].split()[1])
    (turned,) = load_two_finger_logs(session).pushes
    theta = turned.pose[0, 2]
    matrix = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    # a straight push that takes the middle of the hand to a place behind that where the rotation takes it
    target = turned.hand[-1, :2] - 0.003 * matrix @ unit
    moved = 1000 * matrix.T @ (target - turned.hand[0, :2]) - closing * unit
    direction = f"{moved[0]:.9f} {moved[1]:.9f} 0"
    last = f"{np.linalg.norm(moved):.9f} {closing}"
    actions.write_text("\n".join([lines[0], "TwoPointTranslation", lines[2], direction, lines[4], last]))
    (push,) = load_two_finger_logs(session).pushes
    np.testing.assert_allclose(push.hand[-1, :2], target, atol=1e-9)
    first = push.pose[0, :2] + matrix @ ((contact - 50) / 1000 - closing / 1000 * unit)
    np.testing.assert_allclose(push.hand[0, :2], first, atol=1e-12)
    assert np.ptp(push.hand[:, 2]) == 0


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda lines: [*lines[:3], "1 2", *lines[4:]], "line 2: .*the type of a push and 3, 3, 3 and 2 numbers"),
        (lambda lines: [*lines[:3], "1 2 x", *lines[4:]], "line 2: .*expected the type of a push"),
        (lambda lines: [*lines[:5], "500 0.5"], "from the outline at the end"),
        (lambda lines: lines[:4], "expected at least one push, found none"),
        (lambda lines: [*lines[:4], "0 0 0", *lines[5:]], "line 2: .*expected the type of a push"),
        (lambda lines: [*lines[:3], "1 \0 2", *lines[4:]], "line 2: .*expected the type of a push"),
    ],
)
def test_damaged_actions_are_named(session, damage, message):
    _, actions = files(session)
    actions.write_text("\n".join(damage(actions.read_text().splitlines())))
    with pytest.raises(LogError, match=message):
        load_two_finger_logs(session)


def test_missing_and_binary_files_are_named(session, tmp_path):
    with pytest.raises(LogError, match="found none"):
        load_two_finger_logs(tmp_path)
    _, actions = files(session)
    actions.write_bytes(bytes(range(256)) * 3)
    with pytest.raises(LogError, match=r"expected at least one push|expected the type of a push"):
        load_two_finger_logs(session)
    actions.unlink()
    with pytest.raises(LogError, match="cannot read the file"):
        load_two_finger_logs(session)


def test_a_damaged_session_costs_itself_only(session):
    whole = load_two_finger_logs(session)
    sensor, _ = files(session)
    shutil.copy(sensor, session / "exp_0_sensor1.txt")
    (session / "exp_0_pushaction1.txt").write_text("\n".join(["1", "Rotation", "1 2 3", "0 0 0", "0 0 0", "1 1"]))
    log = load_two_finger_logs(session)
    assert [problem.line for problem in log.problems] == [2]
    np.testing.assert_array_equal(log.pushes[0].hand, whole.pushes[0].hand)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([POSE, POSE, "0", "1", "0 0 0 0 1 0 0 0"], "expected force samples, found none"),
        ([POSE, "0 0 100 0 0 0 0", "1", "0 0 0", "0"], "expected a unit quaternion"),
        (["0 0 100 1 0", POSE, "1", "0 0 0", "0"], "expected 7 numbers"),
    ],
)
def test_records_without_samples_and_poses_that_are_none(tmp_path, lines, message):
    folder = tmp_path / "3pts1"
    folder.mkdir()
    (folder / "exp_1_sensor1.txt").write_text("\n".join(["1", *lines]) + "\n")
    (folder / "exp_1_pushaction1.txt").write_text("1\nRotation\n-1 75 0\n1 0 0\n1 0 0\n1 0\n")
    with pytest.raises(LogError, match=message):
        load_two_finger_logs(folder)
