"""Loaders of the triangle logs: compared with the curated arrays where these exist, and on damaged synthetic logs."""

import gzip
import math
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pushjax.datasets import (
    LogError,
    Push,
    PushLog,
    contact_onset,
    find_data,
    force_filter,
    load_push_npz,
    load_triangle_log,
)
from pushjax.datasets import triangle_setup as setup
from pushjax.datasets.records import MAX_SAMPLES

# --- compared with the curated arrays ---

CONDITIONS = [f"{s}_{a}" for s in ("hardboard", "plywood") for a in ("3pts1", "3pts2", "3pts3", "3pts4", "patch")]
# Logged quaternions deviate from unit norm by up to 7e-7. The loader normalizes them, the curated arrays do not. Times
# the 0.07 m to the center of mass this gives 1e-7 m, and a few 1e-6 rad.
POSITION_TOLERANCE = 3e-7
ANGLE_TOLERANCE = 5e-6
# The curated finger stream is float32: half a unit in the last place of 0.7 m, of 7 s and of 6.3 rad.
TIP_TOLERANCE = 3e-8
TIME_TOLERANCE = 2.5e-7
YAW_TOLERANCE = 2.5e-7
# The curated force is rounded to 2^-13 N: half of it, and float32 roundoff.
FORCE_TOLERANCE = 0.5 * 2.0**-13 + 1e-6
# Mean of forces up to 10 N in a frame whose angle has an error of ANGLE_TOLERANCE; arms up to 0.1 m.
WRENCH_FORCE_TOLERANCE = 10 * ANGLE_TOLERANCE
WRENCH_TORQUE_TOLERANCE = 1e-5
# Averages of forces with an error of FORCE_TOLERANCE each; no sample changes sides of the filter in this data.
WRENCH_FROM_ROUNDED_TOLERANCE = FORCE_TOLERANCE
# The arrays and README give the support points and forces in full float64.
EXACT = 1e-12


def data_file(folder: str, pattern: str) -> Path:
    found = find_data(folder)
    if found is None:
        pytest.skip(f"no folder {folder}: set PUSHJAX_DATA to the benchmark data")
    files = sorted(found.glob(pattern))
    if not files:
        pytest.skip(f"{found} holds no {pattern}")
    return files[0]


@pytest.fixture(scope="module", params=CONDITIONS)
def both(request: pytest.FixtureRequest) -> tuple[PushLog, dict[str, np.ndarray], Path]:
    """Return the log read from the original text, the curated arrays, and the file of these."""
    tidy = data_file("three_point_push", f"{request.param}.npz")
    raw = load_triangle_log(data_file("raw/three_point_push", f"{request.param}__*.txt.gz"))
    with np.load(tidy) as archive:
        return raw, {name: archive[name] for name in archive.files}, tidy


def paired(raw: PushLog, tidy: dict[str, np.ndarray]) -> list[Push]:
    """Return the pushes of the text log that correspond to the curated rows.

    These are all of them, or, in a whole log, those that the rows' numbers name.
    """
    if len(raw.pushes) == len(tidy["push_index"]):
        return list(raw.pushes)
    by_index = {push.index: push for push in raw.pushes}
    return [by_index[int(index)] for index in tidy["push_index"]]


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs((a - b + math.pi) % (2 * math.pi) - math.pi)


def rows_of(tidy: dict[str, np.ndarray], offsets: str, row: int) -> slice:
    return slice(int(tidy[offsets][row]), int(tidy[offsets][row + 1]))


def test_text_log_gives_the_curated_poses(both) -> None:
    raw, tidy, _ = both
    assert raw.problems == ()
    for row, push in enumerate(paired(raw, tidy)):
        for pose, name in ((push.pose_start, "object_pose_start"), (push.pose_end, "object_pose_end")):
            np.testing.assert_allclose(pose[:2], tidy[name][row, :2], rtol=0, atol=POSITION_TOLERANCE)
            assert angle_between(pose[2], tidy[name][row, 2]) < ANGLE_TOLERANCE
        assert abs(push.pose_end[2] - push.pose_start[2]) < math.pi


def test_text_log_gives_the_curated_finger_path(both) -> None:
    raw, tidy, _ = both
    for row, push in enumerate(paired(raw, tidy)):
        rows = rows_of(tidy, "tip_offsets", row)
        np.testing.assert_allclose(push.tip, tidy["tip_xy"][rows], rtol=0, atol=TIP_TOLERANCE)
        np.testing.assert_allclose(push.tip_time, tidy["tip_t"][rows], rtol=0, atol=TIME_TOLERANCE)
        assert angle_between(push.tip_yaw, tidy["tip_yaw"][rows].astype(float)).max() < YAW_TOLERANCE
        np.testing.assert_allclose(raw.commanded_tip_end(push), tidy["tip_end_commanded_xy"][row], rtol=0, atol=EXACT)


def test_text_log_gives_the_curated_forces_and_filter(both) -> None:
    raw, tidy, _ = both
    for row, push in enumerate(paired(raw, tidy)):
        rows = rows_of(tidy, "ft_offsets", row)
        np.testing.assert_allclose(push.force, tidy["force_world"][rows], rtol=0, atol=FORCE_TOLERANCE)
        np.testing.assert_allclose(push.force_time, tidy["ft_t"][rows], rtol=0, atol=TIME_TOLERANCE)
        np.testing.assert_array_equal(force_filter(push.force), tidy["force_keep_toolbox"][rows])


def test_text_log_gives_the_curated_onset(both) -> None:
    raw, tidy, _ = both
    for row, push in enumerate(paired(raw, tidy)):
        assert push.onset is not None
        assert abs(push.onset.time - tidy["contact_onset_t"][row]) < TIME_TOLERANCE
        np.testing.assert_allclose(push.onset.tip, tidy["contact_onset_tip_xy"][row], rtol=0, atol=TIP_TOLERANCE)


def test_text_log_gives_the_curated_pairs(both) -> None:
    raw, tidy, _ = both
    chosen = {id(push) for push in paired(raw, tidy)}
    rows = [id(push) in chosen for push in raw.pushes]
    wrench, displacement = (pairs[rows] for pairs in raw.wrench_twist_pairs())
    np.testing.assert_allclose(wrench[:, :2], tidy["wrench_body"][:, :2], rtol=0, atol=WRENCH_FORCE_TOLERANCE)
    np.testing.assert_allclose(wrench[:, 2], tidy["wrench_body"][:, 2], rtol=0, atol=WRENCH_TORQUE_TOLERANCE)
    expected = tidy["displacement_body"]
    np.testing.assert_allclose(displacement[:, :2], expected[:, :2], rtol=0, atol=2 * POSITION_TOLERANCE)
    np.testing.assert_allclose(displacement[:, 2], expected[:, 2], rtol=0, atol=2 * ANGLE_TOLERANCE)
    # Where the toolbox turns the object the long way round, its pair is completely different, and ours must differ from
    # it.
    wrong = tidy["angle_wrap_bug"]
    off = np.linalg.norm(wrench - tidy["wrench_body_toolbox"], axis=1)
    assert np.all(off[wrong] > 0.1)
    assert np.all(np.sum(wrench * displacement, axis=1) > 0)


def test_text_log_gives_the_curated_setup(both) -> None:
    raw, tidy, _ = both
    np.testing.assert_allclose(raw.vertices, tidy["vertices_body"], rtol=0, atol=EXACT)
    assert raw.length == pytest.approx(float(tidy["rho"]), abs=EXACT)
    assert raw.tip_radius == float(tidy["tip_radius"])
    assert (raw.surface, raw.arrangement) == (str(tidy["surface"]), str(tidy["arrangement"]))
    # The order of the points differs in one arrangement and has no meaning.
    ours = np.column_stack([raw.support_points, raw.support_force])
    theirs = np.column_stack([tidy["support_points_body"].reshape(-1, 2), tidy["support_normal_force"]])
    ours, theirs = (table[np.lexsort(table.round(9).T)] for table in (ours, theirs))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=EXACT)


def test_curated_archive_agrees_with_its_text_log(both) -> None:
    raw, tidy, file = both
    log = load_push_npz(file)
    assert log.problems == ()
    assert [push.index for push in log.pushes] == tidy["push_index"].tolist()
    assert (log.surface, log.arrangement) == (raw.surface, raw.arrangement)
    for ours, theirs in zip(log.pushes, paired(raw, tidy), strict=True):
        np.testing.assert_allclose(ours.pose_end, theirs.pose_end, rtol=0, atol=ANGLE_TOLERANCE)
        np.testing.assert_allclose(ours.tip_yaw, theirs.tip_yaw, rtol=0, atol=2 * YAW_TOLERANCE)
        np.testing.assert_allclose(ours.force, theirs.force, rtol=0, atol=FORCE_TOLERANCE)
    wrench, displacement = log.wrench_twist_pairs()
    np.testing.assert_allclose(wrench, tidy["wrench_body"], rtol=0, atol=WRENCH_FROM_ROUNDED_TOLERANCE)
    np.testing.assert_allclose(displacement, tidy["displacement_body"], rtol=0, atol=EXACT)


# --- a synthetic log ---

K, M = 30, 12
STEP = 0.010  # m, distance by which each synthetic push moves the object
GAP = 0.0025
T0 = 1.4e9


def quaternion(theta: float) -> list[float]:
    return [math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)]


def record(index: int) -> list[list[str]]:
    """Return a clean push on the middle of the edge x = 0 of the corner frame, along it; the object moves straight.

    The lines of tokens are in the order of the layout: 0, 1 poses; 2 count; 3... force; 3+K count; 4+K... robot.
    """
    theta, t0 = 0.3 + 0.4 * index, T0 + 10.0 * index
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    start = np.array([0.5, 0.1 * index])
    end = start + turn @ [STEP, 0.0]
    times_f, times_r = np.linspace(t0, t0 + 5, K), np.linspace(t0, t0 + 5, M)
    # Contact begins after a fifth of the path; before it the sensor reads only its offset.
    pressed = np.where(np.arange(K) >= K // 5, 2.0, 0.0)
    sensor_offset = np.array([0.02, -0.03])
    readings = np.outer(pressed, setup.FORCE_SIGN * np.linalg.inv(setup.R_TOOL) @ [1.0, 0.0]) + sensor_offset
    path = np.linspace(-GAP, STEP, M)
    center = start + turn @ [0.0, 0.05]
    tip = center + np.outer(path, turn @ [1.0, 0.0])
    lines: list[list[float]] = [
        [*(1e3 * start), 10.0, *quaternion(theta)],
        [*(1e3 * end), 10.0, *quaternion(theta)],
    ]
    lines += [[K], *([t, *f] for t, f in zip(times_f, readings, strict=True))]
    lines += [[M], *([t, *(1e3 * p), 25.0, *quaternion(theta)] for t, p in zip(times_r, tip, strict=True))]
    return [[f"{x:.9f}" if len(line) > 1 else str(x) for x in line] for line in lines]


Records = list[list[list[str]]]
POSE, FORCE_COUNT, FORCE, ROBOT_COUNT, ROBOT = 0, 2, 3, 3 + K, 4 + K
RECORD_LINES = 4 + K + M


def write(path: Path, records: Records, header: str | None = None) -> Path:
    lines = [] if header == "" else [header if header is not None else str(len(records))]
    lines += [" ".join(tokens) for rec in records for tokens in rec]
    path.write_text("\n".join(lines) + "\n")
    return path


def line_of(push: int, row: int) -> int:
    return 2 + RECORD_LINES * push + row


@pytest.fixture
def records() -> Records:
    return [record(index) for index in range(4)]


@pytest.fixture
def log_file(tmp_path: Path) -> Path:
    return tmp_path / "log.txt"


def only_problem(log: PushLog) -> LogError:
    assert len(log.problems) == 1, [str(problem) for problem in log.problems]
    assert "\n" not in str(log.problems[0])
    assert log.source in str(log.problems[0])
    return log.problems[0]


def indices(log: PushLog) -> list[int]:
    return [push.index for push in log.pushes]


def test_clean_log_is_read_as_it_was_made(log_file: Path, records: Records) -> None:
    log = load_triangle_log(write(log_file, records), surface="plywood", arrangement="3pts3")
    assert log.problems == ()
    assert indices(log) == [0, 1, 2, 3]
    assert (log.surface, log.arrangement, log.source) == ("plywood", "3pts3", str(log_file))
    wrench, displacement = log.wrench_twist_pairs()
    # Written with nine digits: force exactly 2 N along the body's x, arm (-0.05 ... , 0) from the center of mass.
    np.testing.assert_allclose(wrench, np.tile([2.0, 0.0, 0.0], (4, 1)), atol=1e-7)
    np.testing.assert_allclose(displacement, np.tile([STEP, 0.0, 0.0], (4, 1)), atol=1e-8)
    for push in log.pushes:
        assert push.force_time[0] == 0
        assert push.onset is not None
        assert push.onset.time == pytest.approx(push.force_time[K // 5])
        along = (push.tip[-1] - push.tip[0]) / np.linalg.norm(push.tip[-1] - push.tip[0])
        np.testing.assert_allclose(log.commanded_tip_end(push), push.tip[0] + 0.0175 * along, atol=1e-12)


def test_gzip_is_told_from_content_and_line_ends_do_not_matter(tmp_path: Path, records: Records) -> None:
    plain = write(tmp_path / "plain.txt.gz", records)
    zipped = tmp_path / "zipped.txt"
    zipped.write_bytes(gzip.compress(plain.read_bytes().replace(b"\n", b"\r\n")))
    for file in (plain, zipped):
        log = load_triangle_log(file)
        assert indices(log) == [0, 1, 2, 3]
        assert log.problems == ()


# Each case damages push 1 of 4: (what to do, line within the record, words of the message).
Damage = Callable[[list[list[str]]], None]


def set_token(row: int, column: int, token: str) -> Damage:
    def damage(rec: list[list[str]]) -> None:
        rec[row][column] = token

    return damage


def set_line(row: int, line: str) -> Damage:
    def damage(rec: list[list[str]]) -> None:
        rec[row] = line.split()

    return damage


def drop_lines(first: int, count: int, counter: int, left: int) -> Damage:
    def damage(rec: list[list[str]]) -> None:
        del rec[first : first + count]
        rec[counter] = [str(left)]

    return damage


def missing_line(row: int) -> Damage:
    def damage(rec: list[list[str]]) -> None:
        del rec[row]

    return damage


DAMAGES: dict[str, tuple[Damage, int, str]] = {
    "short force line": (
        set_line(FORCE + 4, "1.0 2.0"),
        FORCE + 4,
        "expected 3 numbers (force sample 5 of 30), found 2",
    ),
    "long robot line": (
        set_line(ROBOT + 2, "1 2 3 4 5 6 7 8 9"),
        ROBOT + 2,
        "expected 8 numbers (robot sample 3 of 12), found 9",
    ),
    "short pose": (
        set_line(POSE, "1 2 3 4 5 6"),
        POSE,
        "expected 7 numbers (object pose before the push), found 6",
    ),
    "long second pose": (
        set_line(POSE + 1, "1 2 3 4 5 6 7 8"),
        POSE + 1,
        "expected 7 numbers (object pose after the push)",
    ),
    "blank line": (set_line(FORCE, ""), FORCE, "expected 3 numbers (force sample 1 of 30), found 0"),
    "word": (
        set_token(FORCE + 1, 2, "abc"),
        FORCE + 1,
        "expected a number (force sample 2 of 30), found 'abc'",
    ),
    "word in pose": (
        set_token(POSE, 0, "x"),
        POSE,
        "expected a number (object pose before the push), found 'x'",
    ),
    "NaN force": (
        set_token(FORCE + 9, 1, "nan"),
        FORCE + 9,
        "expected finite numbers (force sample 10 of 30), found nan",
    ),
    "infinite robot": (
        set_token(ROBOT, 1, "-inf"),
        ROBOT,
        "expected finite numbers (robot sample 1 of 12), found -inf",
    ),
    "NaN pose": (
        set_token(POSE + 1, 2, "NaN"),
        POSE + 1,
        "expected finite numbers (object pose after the push), found NaN",
    ),
    "overflowing number": (set_token(FORCE, 1, "1e999"), FORCE, "expected finite numbers"),
    "huge number": (
        set_token(POSE + 1, 0, "1e300"),
        POSE + 1,
        "expected numbers below 1e+12 (object pose after the push), found 1e300",
    ),
    "negative count": (
        set_line(FORCE_COUNT, "-5"),
        FORCE_COUNT,
        f"expected the number of force samples (0 to {MAX_SAMPLES}), found -5",
    ),
    "absurd count": (set_line(ROBOT_COUNT, "99999999"), ROBOT_COUNT, "expected the number of robot samples"),
    "count of words": (
        set_line(FORCE_COUNT, "many"),
        FORCE_COUNT,
        "expected the number of force samples, found 'many'",
    ),
    "fractional count": (
        set_line(FORCE_COUNT, "30.5"),
        FORCE_COUNT,
        "expected the number of force samples, found '30.5'",
    ),
    "force count too large": (
        set_line(FORCE_COUNT, str(K + 1)),
        ROBOT_COUNT,
        "expected 3 numbers (force sample 31 of 31), found 1",
    ),
    "force count far too large": (
        set_line(FORCE_COUNT, "9999"),
        ROBOT_COUNT,
        "expected 3 numbers (force sample 31 of 9999), found 1",
    ),
    "force count too small": (
        set_line(FORCE_COUNT, str(K - 1)),
        ROBOT_COUNT - 1,
        "expected the number of robot samples, found",
    ),
    "robot count too large": (
        set_line(ROBOT_COUNT, str(M + 2)),
        RECORD_LINES,
        "expected 8 numbers (robot sample 13 of 14), found 7",
    ),
    "robot count too small": (
        set_line(ROBOT_COUNT, str(M - 3)),
        RECORD_LINES - 3,
        "expected the next push after 9 robot samples",
    ),
    "missing force line": (
        missing_line(FORCE),
        ROBOT_COUNT - 1,
        "expected 3 numbers (force sample 30 of 30), found 1",
    ),
    "missing robot line": (
        missing_line(ROBOT),
        RECORD_LINES - 1,
        "expected 8 numbers (robot sample 12 of 12), found 7",
    ),
    "missing pose": (
        missing_line(POSE + 1),
        POSE + 1,
        "expected 7 numbers (object pose after the push), found 1",
    ),
    "no force samples": (
        drop_lines(FORCE, K, FORCE_COUNT, 0),
        FORCE_COUNT,
        "expected at least 4 force samples, found 0",
    ),
    "no robot samples": (
        drop_lines(ROBOT, M, ROBOT_COUNT, 0),
        ROBOT_COUNT,
        "expected at least 4 robot samples, found 0",
    ),
    "three robot samples": (
        drop_lines(ROBOT, M - 3, ROBOT_COUNT, 3),
        ROBOT_COUNT,
        "expected at least 4 robot samples, found 3",
    ),
    "zero quaternion": (
        set_line(POSE, "500 100 10 0 0 0 0"),
        POSE,
        "expected a unit quaternion (object pose), found one of norm 0",
    ),
    "long quaternion": (
        set_token(ROBOT + 5, 5, "0.5"),
        ROBOT + 5,
        "expected a unit quaternion (robot sample), found one of norm 1.12",
    ),
    "force clock": (
        set_token(FORCE + 7, 0, "1.0"),
        FORCE + 7,
        "expected time stamps that do not decrease (force samples)",
    ),
    "robot clock": (
        set_token(ROBOT + 3, 0, "1.0"),
        ROBOT + 3,
        "expected time stamps that do not decrease (robot samples)",
    ),
    "jump": (set_token(POSE + 1, 0, "650.0"), POSE + 1, "the motion capture jumped"),
    "turn": (set_line(POSE + 1, "500 100 10 0 0 0 1"), POSE + 1, "the motion capture jumped"),
}


@pytest.mark.parametrize("case", DAMAGES)
@pytest.mark.parametrize("push", [0, 1, 3])
def test_damaged_push_is_named_and_the_others_survive(log_file: Path, records: Records, case: str, push: int) -> None:
    damage, row, words = DAMAGES[case]
    damage(records[push])
    log = load_triangle_log(write(log_file, records))
    problem = only_problem(log)
    assert problem.push == push
    assert indices(log) == [index for index in range(4) if index != push]
    if push == 3 and case.endswith("count too large"):
        # With nothing after it, a count beyond the last line cannot be distinguished from a log that was cut short.
        words, row = ("the log ends", RECORD_LINES - 1) if case.startswith("robot") else (words, row)
    if push == 3 and case == "missing robot line":
        words, row = "expected 12 lines (robot sample), the log ends after 11", RECORD_LINES - 2
    assert words in problem.message
    assert problem.line == line_of(push, row)
    with pytest.raises(LogError, match=f"push {push}"):
        load_triangle_log(log_file, strict=True)


@pytest.mark.parametrize("row", range(RECORD_LINES))
@pytest.mark.parametrize("what", ["delete", "repeat", "shorten", "lengthen", "empty", "count", "noise"])
def test_any_damaged_line_costs_one_push(log_file: Path, records: Records, row: int, what: str) -> None:
    rec = records[1]
    line = rec[row]
    new = {
        "delete": [],
        "repeat": [line, line],
        "shorten": [line[:-1]],
        "lengthen": [[*line, "1"]],
        "empty": [[]],
        "count": [["7"]],
        "noise": [["?"] * len(line)],
    }[what]
    rec[row : row + 1] = new
    log = load_triangle_log(write(log_file, records))
    assert only_problem(log).push == 1
    assert indices(log) == [0, 2, 3]
    for push in log.pushes:
        assert push.pose_start[1] == pytest.approx(
            0.1 * push.index + 0.05 * (math.cos(push.pose_start[2]) + math.sin(push.pose_start[2]))
        )


def test_damage_to_two_pushes_gives_two_problems(log_file: Path, records: Records) -> None:
    records[0][FORCE_COUNT] = ["-1"]
    records[2][ROBOT][3] = "?"
    log = load_triangle_log(write(log_file, records))
    assert [problem.push for problem in log.problems] == [0, 2]
    assert indices(log) == [1, 3]


def test_clocks_that_do_not_meet(log_file: Path, records: Records) -> None:
    for tokens in records[2][ROBOT:]:
        tokens[0] = str(float(tokens[0]) + 1000)
    problem = only_problem(load_triangle_log(write(log_file, records)))
    assert problem.push == 2
    assert "expected robot samples from the time of the force samples" in problem.message


def test_finger_that_does_not_move(log_file: Path, records: Records) -> None:
    for tokens in records[2][ROBOT:]:
        tokens[1:] = records[2][ROBOT][1:]
    problem = only_problem(load_triangle_log(write(log_file, records)))
    assert problem.push == 2
    assert "expected the finger to move at least 1 mm" in problem.message


def test_force_that_does_not_last(log_file: Path, records: Records) -> None:
    for row, tokens in enumerate(records[2][FORCE:ROBOT_COUNT]):
        tokens[1:] = ["100", "0"] if 1 <= row < 8 else ["0", "0"]
    problem = only_problem(load_triangle_log(write(log_file, records)))
    assert problem.push == 2
    assert "expected the force to last" in problem.message


def test_push_without_contact_is_usable_but_has_no_onset(log_file: Path, records: Records) -> None:
    for tokens in records[2][FORCE:ROBOT_COUNT]:
        tokens[1:] = ["0.1", "0.1"]
    log = load_triangle_log(write(log_file, records))
    assert log.problems == ()
    assert log.pushes[2].onset is None


# --- headers and ends ---


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("", "expected the number of pushes, found '500.0"),
        ("-4", "expected the number of pushes (0 to 1000000), found -4"),
        ("0", "expected the number of pushes, found 0"),
        ("99999999", "expected the number of pushes (0 to 1000000), found 99999999"),
        ("pushes", "expected the number of pushes, found 'pushes'"),
        ("4 4", "expected the number of pushes, found '4 4'"),
    ],
)
def test_bad_header_costs_no_push(log_file: Path, records: Records, header: str, words: str) -> None:
    log = load_triangle_log(write(log_file, records, header))
    problem = only_problem(log)
    assert (problem.push, problem.line) == (None, 1)
    assert words in problem.message
    assert indices(log) == [0, 1, 2, 3]


def test_header_that_promises_more_whole_pushes(log_file: Path, records: Records) -> None:
    log = load_triangle_log(write(log_file, records, "50"))
    problem = only_problem(log)
    assert (problem.push, problem.line) == (4, 1 + 4 * RECORD_LINES)
    assert "expected 50 pushes as in the header, found 4" in problem.message
    assert len(log.pushes) == 4


def test_header_that_promises_fewer_pushes(log_file: Path, records: Records) -> None:
    log = load_triangle_log(write(log_file, records, "2"))
    problem = only_problem(log)
    assert (problem.push, problem.line) == (None, line_of(2, 0))
    assert "expected the end of the log after 2 pushes" in problem.message
    assert len(log.pushes) == 4


def test_text_after_the_last_push(log_file: Path, records: Records) -> None:
    write(log_file, records)
    log_file.write_text(log_file.read_text() + "operator stopped\n1 2\n\n\n")
    log = load_triangle_log(log_file)
    assert only_problem(log).line == line_of(4, 0)
    assert len(log.pushes) == 4


@pytest.mark.parametrize("row", range(RECORD_LINES))
@pytest.mark.parametrize("inside", [False, True], ids=["between lines", "inside a line"])
def test_log_cut_anywhere_in_a_push(log_file: Path, records: Records, row: int, inside: bool) -> None:
    write(log_file, records, "50")
    keep = log_file.read_text().splitlines()[: line_of(2, row) - 1]
    cut = len(records[2][row]) > 1 and inside
    half = [" ".join(records[2][row][:2])] if cut else []
    log_file.write_text("\n".join(keep + half) + ("" if cut else "\n"))
    log = load_triangle_log(log_file)
    problem = only_problem(log)
    assert problem.push == 2
    assert problem.line == len(keep) + cut
    assert "the log ends" in problem.message or "end of the log" in problem.message or "truncated" in problem.message
    assert "50 pushes" in problem.message
    assert indices(log) == [0, 1]


@pytest.mark.parametrize("part", [0.5, 0.75, 0.99])
def test_gzip_stream_cut_short(tmp_path: Path, records: Records, part: float) -> None:
    whole = gzip.compress(write(tmp_path / "log.txt", records).read_bytes(), mtime=0)
    file = tmp_path / "log.txt.gz"
    file.write_bytes(whole[: int(part * len(whole))])
    log = load_triangle_log(file)
    problem = only_problem(log)
    assert "the gzip stream is damaged" in problem.message
    assert problem.push == len(log.pushes) < 4


def test_gzip_checksum(tmp_path: Path, records: Records) -> None:
    whole = gzip.compress(write(tmp_path / "log.txt", records).read_bytes())
    file = tmp_path / "log.txt.gz"
    file.write_bytes(whole[:-8] + b"\0\0\0\0" + whole[-4:])
    log = load_triangle_log(file)
    assert "the gzip stream is damaged" in only_problem(log).message
    assert only_problem(log).push is None
    assert len(log.pushes) == 4


def test_an_archive_that_unpacks_without_end(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_bytes(gzip.compress(bytes(300 << 20), 9))
    with pytest.raises(LogError, match="found more than 256 MB of text"):
        load_triangle_log(path)


def test_the_home_folder_in_a_path(tmp_path: Path, records: Records, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "log.txt", records)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    assert indices(load_triangle_log("~/log.txt")) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "found an empty file"),
        (b"\n \n", "found an empty file"),
        (gzip.compress(b"", mtime=0), "found an empty file"),
        (gzip.compress(b"1\n" * 50, mtime=0)[:12], "the gzip stream is damaged"),
        (b"4\n", "no usable push: expected 4 pushes as in the header, found 0"),
        (b"0\n", "no usable push: expected the number of pushes, found 0"),
        (b"An unrelated\ntext of several\nlines.\n", "no usable push: expected the number of pushes"),
        (bytes(range(128, 256)) * 20, "no usable push: expected the number of pushes"),
    ],
)
def test_file_without_a_push(log_file: Path, content: bytes, words: str) -> None:
    log_file.write_bytes(content)
    with pytest.raises(LogError) as caught:
        load_triangle_log(log_file)
    assert words in str(caught.value)
    assert caught.value.path == str(log_file)


def test_every_push_damaged(log_file: Path, records: Records) -> None:
    for rec in records:
        rec[FORCE][1] = "nan"
    with pytest.raises(LogError, match=r"no usable push: expected finite numbers .*and 3 more problems"):
        load_triangle_log(write(log_file, records))


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for load in (load_triangle_log, load_push_npz):
        for path in (tmp_path / "absent", tmp_path):
            with pytest.raises(LogError, match="cannot read the file") as caught:
                load(path)
            assert (caught.value.push, caught.value.line) == (None, None)


def test_log_error_is_a_value_error_that_survives_pickling() -> None:
    error = LogError(Path("a.txt"), "expected this, found that", push=3, line=14)
    assert isinstance(error, ValueError)
    assert str(error) == "a.txt, push 3, line 14: expected this, found that"
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.path, copy.push, copy.line) == (str(error), "a.txt", 3, 14)


# --- set-up, names, filter, onset ---


@pytest.mark.parametrize("name", [name for name in setup.ARRANGEMENTS if name != "patch"])
def test_support_forces_balance_the_weight(name: str) -> None:
    points = setup.support_points(name)
    force = setup.support_force(points)
    assert force.sum() == pytest.approx(setup.MASS * setup.GRAVITY)
    np.testing.assert_allclose(force @ points, 0, atol=1e-12)
    assert np.all(force > 0)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[0, 0], [1, 0]], "three finite points"),
        ([[0, 0], [1, 0], [0, math.nan]], "three finite points"),
        ([[0, 0], [0.01, 0.01], [0.02, 0.02]], "not lie on one line"),
        ([[0.01, 0], [0.02, 0], [0.01, 0.01]], "center of mass must lie inside"),
    ],
)
def test_support_points_that_cannot_carry(points: list[list[float]], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        setup.support_force(points)


@pytest.mark.parametrize(
    ("name", "surface", "arrangement"),
    [
        ("plywood_3pts2__log.txt", "plywood", "3pts2"),
        ("30_63.33_43.33_30_43.33_63.33/exp_08_17_50.txt", "hardboard", "3pts1"),
        ("wood_10_90_10_10_30_130/exp_08_18_1100_50.txt", "plywood", "3pts4"),
        ("wood_patch/exp_08_17_0839_50.txt", "plywood", "patch"),
        ("20_90_20_20_20_90/log.txt", "hardboard", "unknown"),
        ("somewhere/log.txt", "unknown", "unknown"),
    ],
)
def test_names_tell_the_setup(tmp_path: Path, records: Records, name: str, surface: str, arrangement: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    log = load_triangle_log(write(file, records))
    assert (log.surface, log.arrangement) == (surface, arrangement)
    if "20_90" in name:
        np.testing.assert_allclose(log.support_points, [[-0.03, -0.03], [0.04, -0.03], [-0.03, 0.04]], atol=1e-12)
    if arrangement in ("patch", "unknown") and "20_90" not in name:
        assert log.support_points.shape == (0, 2)
        assert log.support_force.shape == (0,)


def test_support_can_be_given(log_file: Path, records: Records) -> None:
    write(log_file, records)
    points = [[-0.03, -0.03], [0.04, -0.03], [-0.03, 0.04]]
    log = load_triangle_log(log_file, support_points=points)
    np.testing.assert_array_equal(log.support_points, points)
    with pytest.raises(ValueError, match="arrangement must be one of 3pts1"):
        load_triangle_log(log_file, arrangement="4pts")


def test_filter_counts_from_one() -> None:
    force = np.ones((10, 2))
    assert force_filter(force).tolist() == [False] * 2 + [True] * 8
    force[5] = 0.1
    assert force_filter(force)[5:7].tolist() == [False, True]


def test_onset_lies_on_the_path_between_samples() -> None:
    force = np.array([[0, 0], [0.2, 0], [1.0, 0], [1.0, 0]])
    tip = np.array([[0.0, 0.0], [0.3, 0.6]])
    onset = contact_onset(np.arange(4.0), force, np.array([0.0, 3.0]), tip)
    assert onset is not None
    assert onset.time == 2.0
    np.testing.assert_allclose(onset.tip, [0.2, 0.4], atol=1e-12)


# --- archives ---


def archive(log: PushLog) -> dict[str, np.ndarray]:
    """Return the arrays that a curated archive would hold of a log."""
    pushes = log.pushes
    return {
        "push_index": np.array([10 * push.index for push in pushes]),
        "valid": np.ones(len(pushes), bool),
        "object_pose_start": np.array([push.pose_start for push in pushes]),
        "object_pose_end": np.array([push.pose_end for push in pushes]),
        "tip_offsets": np.cumsum([0, *(len(push.tip) for push in pushes)]),
        "tip_t": np.concatenate([push.tip_time for push in pushes]),
        "tip_xy": np.concatenate([push.tip for push in pushes]),
        "tip_yaw": np.concatenate([push.tip_yaw for push in pushes]),
        "ft_offsets": np.cumsum([0, *(len(push.force) for push in pushes)]),
        "ft_t": np.concatenate([push.force_time for push in pushes]),
        "force_world": np.concatenate([push.force for push in pushes]),
        "vertices_body": log.vertices,
        "rho": np.array(log.length),
        "tip_radius": np.array(log.tip_radius),
        "support_points_body": log.support_points,
        "support_normal_force": log.support_force,
        "surface": np.array(log.surface),
        "arrangement": np.array(log.arrangement),
    }


@pytest.fixture
def arrays(log_file: Path, records: Records) -> dict[str, np.ndarray]:
    return archive(load_triangle_log(write(log_file, records), arrangement="3pts1"))


def saved(tmp_path: Path, arrays: dict[str, np.ndarray]) -> Path:
    path = tmp_path / "log.npz"
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    return path


def test_archive_keeps_order_and_numbers(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    arrays["valid"][1] = False
    arrays["force_world"][-1] = math.nan
    log = load_push_npz(saved(tmp_path, arrays))
    assert indices(log) == [0, 20]
    assert [problem.push for problem in log.problems] == [10, 30]
    assert "marked invalid" in log.problems[0].message
    assert "NaN or infinity in force_world" in log.problems[1].message
    assert log.support_points.shape == (3, 2)
    wrench, _ = log.wrench_twist_pairs()
    np.testing.assert_allclose(wrench, np.tile([2.0, 0.0, 0.0], (2, 1)), atol=1e-7)


def test_archives_that_are_none(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    def fails(words: str, **changes: np.ndarray) -> None:
        with pytest.raises(LogError, match=words):
            load_push_npz(saved(tmp_path, {**arrays, **changes}))

    fails("found none among 4", valid=np.zeros(4, bool))
    fails("expected object_pose_end of shape", object_pose_end=np.zeros((3, 3)))
    fails("expected tip_offsets to rise from 0 in 4 steps", tip_offsets=np.array([0, 5, 3, 7, 9]))
    fails("expected 48 rows of tip_xy, found 47", tip_xy=arrays["tip_xy"][1:])
    del arrays["ft_t"], arrays["rho"]
    fails("found no rho, ft_t")
    other = tmp_path / "other.npz"
    for content in (b"", b"text", gzip.compress(b"text", mtime=0), saved(tmp_path, arrays).read_bytes()[:900]):
        other.write_bytes(content)
        with pytest.raises(LogError, match=r"expected an \.npz archive"):
            load_push_npz(other)
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(LogError, match="found a single array"):
        load_push_npz(tmp_path / "single.npy")


# --- the folder of the data ---


def test_find_data_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some.npz").touch()
    monkeypatch.setenv("PUSHJAX_DATA", str(tmp_path))
    assert find_data() == tmp_path
    assert find_data("some.npz") == tmp_path / "some.npz"
    assert find_data("other.npz") is None
    monkeypatch.setenv("PUSHJAX_DATA", os.fspath(tmp_path / "absent"))
    assert find_data() is None


def test_find_data_without_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PUSHJAX_DATA", raising=False)
    assert find_data() is None
