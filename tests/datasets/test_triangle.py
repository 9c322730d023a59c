"""Logs of the triangle and one finger: against the curated arrays, where these exist, and damaged synthetic ones."""

import gzip
import itertools
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
from recorded import only_problem

from pushjax.datasets import LogError, Recording, Recordings, load_recordings, load_triangle_log
from pushjax.datasets import triangle as setup

# --- compared with the curated arrays ---

CONDITIONS = [f"{s}_{a}" for s in ("hardboard", "plywood") for a in ("3pts1", "3pts2", "3pts3", "3pts4", "patch")]
# Logged quaternions deviate from unit norm by up to 7e-7. The loader normalizes them, the curated arrays do not. Times
# the 0.07 m to the center of mass this gives 1e-7 m, and a few 1e-6 rad.
POSITION_TOLERANCE = 3e-7
ANGLE_TOLERANCE = 5e-6
# The curated finger stream is float32: half a unit in the last place of 0.7 m and of 7 s.
TIP_TOLERANCE = 3e-8
TIME_TOLERANCE = 2.5e-7
# The curated force is rounded to 2^-13 N: half of it, and float32 roundoff. Forces are interpolated at times with an
# error of TIME_TOLERANCE, at which they change by up to some 1000 N/s.
FORCE_TOLERANCE = 0.5 * 2.0**-13 + 1e-6 + 1e3 * TIME_TOLERANCE
# Mean of forces up to 10 N in a frame whose angle has an error of ANGLE_TOLERANCE; arms up to 0.1 m.
WRENCH_TOLERANCE = 10 * ANGLE_TOLERANCE
# The arrays give the support points and forces in full float64.
EXACT = 1e-12


@pytest.fixture(scope="module")
def logs(data, converted) -> list[tuple[Recordings, Recordings]]:
    """Return each log as read from the original text and from the curated arrays."""
    raw, archives = data / "raw" / "three_point_push", converted / "three_point_push"
    return [
        (load_triangle_log(next(raw.glob(f"{name}__*.txt.gz"))), load_recordings(archives / f"{name}.npz"))
        for name in CONDITIONS
    ]


def paired(both) -> list[tuple[Recording, Recording]]:
    """Return the pushes of the text log that correspond to the curated rows, with these."""
    raw, tidy = both
    if len(raw) == len(tidy):
        return list(zip(raw.pushes, tidy.pushes, strict=True))
    by_index = {push.index: push for push in raw.pushes}
    return [(by_index[push.index], push) for push in tidy.pushes]


def close(found, expected, tolerance: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_text_logs_give_the_curated_pushes(logs) -> None:
    assert all(log.problems == () for both in logs for log in both)
    for raw, tidy in itertools.chain.from_iterable(map(paired, logs)):
        close(raw.pose[:, :2], tidy.pose[:, :2], POSITION_TOLERANCE)
        turns = raw.pose[[0, -1], 2] - tidy.pose[[0, -1], 2]
        close(turns - 2 * math.pi * np.round(turns / (2 * math.pi)), 0, ANGLE_TOLERANCE)
        assert abs(raw.pose[-1, 2] - raw.pose[0, 2]) < math.pi
        assert raw.tracked.sum() == 2
        close(raw.hand, tidy.hand, TIP_TOLERANCE)
        close(raw.time, tidy.time, TIME_TOLERANCE)
        assert raw.force is not None
        assert tidy.force is not None
        inside = np.isfinite(raw.force[:, 0]) & np.isfinite(tidy.force[:, 0])  # float32 may move a time past the end
        assert inside.sum() >= len(inside) - 60
        close(raw.force[inside], tidy.force[inside], FORCE_TOLERANCE)


def test_text_logs_give_the_curated_pairs(logs, data) -> None:
    for both in logs:
        raw, tidy = (
            np.concatenate([np.hstack([one.wrench, one.twist]) for one in each])
            for each in zip(*paired(both), strict=True)
        )
        close(raw, tidy, WRENCH_TOLERANCE + FORCE_TOLERANCE)
        assert np.all(np.sum(raw[:, :3] * raw[:, 3:], axis=1) > 0)
        with np.load(data / "three_point_push" / Path(both[1].source).name) as archive:
            close(raw[:, :3], archive["wrench_body"], WRENCH_TOLERANCE)
            close(raw[:, 3:], archive["displacement_body"], 2 * ANGLE_TOLERANCE)
            # Where the toolbox turns the object the long way round, its pair is completely different.
            off = np.linalg.norm(raw[:, :3] - archive["wrench_body_toolbox"], axis=1)
            assert np.all(off[archive["angle_wrap_bug"]] > 0.1)


def test_text_logs_give_the_curated_setup(logs) -> None:
    for raw, tidy in logs:
        close(raw.vertices, tidy.vertices, EXACT)
        assert (raw.surface, raw.object, raw.tip_radius) == (tidy.surface, tidy.object, tidy.tip_radius)
        assert raw.length == pytest.approx(tidy.length, abs=EXACT)
        # The order of the points differs in one arrangement and has no meaning.
        tables = [np.column_stack([each.support_points, each.support_force]) for each in (raw, tidy)]
        ours, theirs = (table[np.lexsort(table.round(9).T)] for table in tables)
        close(ours, theirs, EXACT)


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
    lines = [header if header is not None else str(len(records))]
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


def indices(log: Recordings) -> list[int]:
    return [push.index for push in log.pushes]


def test_clean_log_is_read_as_it_was_made(log_file: Path, records: Records) -> None:
    log = load_triangle_log(write(log_file, records), surface="plywood", arrangement="3pts3")
    assert log.problems == ()
    assert indices(log) == [0, 1, 2, 3]
    assert (log.surface, log.object, log.source) == ("plywood", "3pts3", str(log_file))
    for push in log.pushes:
        # Written with nine digits: force exactly 2 N along the body's x, arm (-0.05 ... , 0) from the center of mass.
        np.testing.assert_allclose(push.wrench, [[2.0, 0.0, 0.0]], atol=1e-7)
        np.testing.assert_allclose(push.twist, [[STEP, 0.0, 0.0]], atol=1e-8)
        assert push.time is not None
        assert push.force is not None
        assert push.time[0] == 0
        np.testing.assert_allclose(np.hypot(*push.force[-1]), 2.0, atol=1e-7)
    with pytest.raises(ValueError, match="arrangement must be one of 3pts1"):
        load_triangle_log(log_file, arrangement="4pts")


def test_gzip_is_told_from_content_and_line_ends_do_not_matter(tmp_path: Path, records: Records) -> None:
    plain = write(tmp_path / "plain.txt.gz", records)
    zipped = tmp_path / "zipped.txt"
    zipped.write_bytes(gzip.compress(plain.read_bytes().replace(b"\n", b"\r\n")))
    for file in (plain, zipped):
        log = load_triangle_log(file)
        assert indices(log) == [0, 1, 2, 3]
        assert log.problems == ()


# Numbers that cannot be trusted cost their push only: what replaces the tokens of a line of push 1, and the message.
FAULTS = {
    "zero quaternion": (POSE, "500 100 10 0 0 0 0", "expected a unit quaternion (object pose), found one of norm 0"),
    "long quaternion": (ROBOT, "1400000010 1 1 1 1.5 0 0 0", "expected a unit quaternion (robot sample), found one"),
    "force clock": (FORCE + 7, "1.0 0 0", "expected time stamps that do not decrease (force samples)"),
    "robot clock": (ROBOT + 3, "1.0 1 1 1 1 0 0 0", "expected time stamps that do not decrease (robot samples)"),
    "jump": (POSE + 1, "650 100 10 1 0 0 0", "the motion capture jumped"),
    "turn": (POSE + 1, "500 100 10 0 0 0 1", "the motion capture jumped"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_push_that_cannot_be_trusted_is_named(log_file: Path, records: Records, case: str) -> None:
    row, line, words = FAULTS[case]
    records[1][row] = line.split()
    log = load_triangle_log(write(log_file, records))
    problem = only_problem(log)
    assert words in problem.message
    assert (problem.push, problem.line) == (1, line_of(1, 0))
    assert indices(log) == [0, 2, 3]


def test_samples_that_cannot_be_trusted(log_file: Path, records: Records) -> None:
    for tokens in records[0][ROBOT:]:
        tokens[0] = str(float(tokens[0]) + 1000)
    for tokens in records[1][ROBOT:]:
        tokens[1:] = records[1][ROBOT][1:]
    for row, tokens in enumerate(records[2][FORCE:ROBOT_COUNT]):
        tokens[1:] = ["100", "0"] if 1 <= row < 8 else ["0", "0"]
    records.append([*record(4)[:FORCE_COUNT], ["0"], *record(4)[ROBOT_COUNT:]])
    log = load_triangle_log(write(log_file, records))
    assert indices(log) == [3]
    words = (
        "expected robot samples from the time of the force samples",
        "expected the finger to move at least 1 mm",
        "expected the force to last",
        "expected at least 4 force samples, found 0",
    )
    for problem, word, push in zip(log.problems, words, (0, 1, 2, 4), strict=True):
        assert word in problem.message
        assert problem.push == push


# A line that breaks the layout ends the reading: what replaces a line of push 1, and the message.
BREAKS = {
    "short force line": (FORCE + 4, "1.0 2.0", "expected 3 numbers (force samples), found 2"),
    "long pose": (POSE + 1, "1 2 3 4 5 6 7 8", "expected 7 numbers (object poses before and after the push), found 8"),
    "blank line": (FORCE, "", "expected 3 numbers (force samples), found 0"),
    "word": (FORCE + 1, "1 2 abc", "expected numbers (force samples), found '1 2 abc'"),
    "NaN": (FORCE + 9, "1 nan 2", "expected finite numbers below 1e+12 (force samples)"),
    "huge number": (POSE + 1, "1e300 1 1 1 0 0 0", "expected finite numbers below 1e+12 (object poses"),
    "negative count": (FORCE_COUNT, "-5", "expected the number of force samples (0 to 1000000), found '-5'"),
    "absurd count": (ROBOT_COUNT, "99999999", "expected the number of robot samples (0 to 1000000)"),
    "count too large": (FORCE_COUNT, str(K + 1), "expected 3 numbers (force samples), found 1"),
    "count too small": (FORCE_COUNT, str(K - 1), "expected the number of robot samples"),
}


@pytest.mark.parametrize("case", BREAKS)
def test_a_broken_line_ends_the_reading(log_file: Path, records: Records, case: str) -> None:
    row, line, words = BREAKS[case]
    records[1][row] = line.split()
    log = load_triangle_log(write(log_file, records))
    problem = only_problem(log)
    assert words in problem.message
    assert problem.push == 1
    assert indices(log) == [0]
    if "count" not in case:
        assert problem.line == line_of(1, row)


@pytest.mark.parametrize("row", [0, 1, 2, 3, 10, ROBOT_COUNT, ROBOT, RECORD_LINES - 1])
@pytest.mark.parametrize("inside", [False, True], ids=["between lines", "inside a line"])
def test_log_cut_anywhere_in_a_push(log_file: Path, records: Records, row: int, inside: bool) -> None:
    write(log_file, records, "50")
    keep = log_file.read_text().splitlines()[: line_of(2, row) - 1]
    half = [" ".join(records[2][row][:2])] if inside and len(records[2][row]) > 1 else []
    log_file.write_text("\n".join(keep + half))
    log = load_triangle_log(log_file)
    problem = only_problem(log)
    assert (problem.push, indices(log)) == (2, [0, 1])
    assert "the header promises 50 pushes" in problem.message


def test_header_that_promises_fewer_pushes(log_file: Path, records: Records) -> None:
    log = load_triangle_log(write(log_file, records, "2"))
    problem = only_problem(log)
    assert (problem.push, problem.line) == (None, line_of(2, 0))
    assert "expected the end of the log after 2 pushes" in problem.message
    assert indices(log) == [0, 1]


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
        (b"4\n", "no usable push: expected 2 lines (object poses before and after the push), the log ends after 0"),
        (b"0\n", "expected at least one push, found none"),
        (b"An unrelated\ntext of several\nlines.\n", "expected the number of pushes (0 to 1000000), found 'An unrel"),
        (bytes(range(128, 256)) * 20, "expected the number of pushes"),
    ],
)
def test_file_without_a_push(log_file: Path, content: bytes, words: str) -> None:
    log_file.write_bytes(content)
    with pytest.raises(LogError) as caught:
        load_triangle_log(log_file)
    assert words in str(caught.value)
    assert caught.value.path == str(log_file)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "absent", tmp_path):
        with pytest.raises(LogError, match="cannot read the file") as caught:
            load_triangle_log(path)
        assert (caught.value.push, caught.value.line) == (None, None)


def test_log_error_is_a_value_error_that_survives_pickling() -> None:
    error = LogError(Path("a.txt"), "expected this, found that", push=3, line=14)
    assert isinstance(error, ValueError)
    assert str(error) == "a.txt, push 3, line 14: expected this, found that"
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.path, copy.push, copy.line) == (str(error), "a.txt", 3, 14)


# --- set-up, names, filter ---


@pytest.mark.parametrize("name", [name for name in setup.ARRANGEMENTS if name != "patch"])
def test_support_forces_balance_the_weight(name: str) -> None:
    points = setup.support_points(name)
    force = setup.support_force(points)
    assert force.sum() == pytest.approx(setup.MASS * setup.GRAVITY)
    np.testing.assert_allclose(force @ points, 0, atol=1e-12)
    assert np.all(force > 0)


@pytest.mark.parametrize("points", [[[0, 0], [0.01, 0.01], [0.02, 0.02]], [[0.01, 0], [0.02, 0], [0.01, 0.01]]])
def test_support_points_that_cannot_carry(points: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="center of mass must lie inside"):
        setup.support_force(points)


@pytest.mark.parametrize(
    ("name", "surface", "arrangement"),
    [
        ("plywood_3pts2__log.txt", "plywood", "3pts2"),
        ("30_63.33_43.33_30_43.33_63.33/exp_08_17_50.txt", "hardboard", "3pts1"),
        ("wood_10_90_10_10_30_130/exp_08_18_1100_50.txt", "plywood", "3pts4"),
        ("wood_patch/exp_08_17_0839_50.txt", "plywood", "patch"),
        ("20_90_20_20_20_90/log.txt", "hardboard", None),
        ("somewhere/log.txt", None, None),
    ],
)
def test_names_tell_the_setup(tmp_path: Path, records: Records, name: str, surface, arrangement) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    log = load_triangle_log(write(file, records))
    assert (log.surface, log.object) == (surface, arrangement)
    if "20_90" in name:
        np.testing.assert_allclose(log.support_points, [[-0.03, -0.03], [0.04, -0.03], [-0.03, 0.04]], atol=1e-12)
    elif arrangement == "patch":
        assert (log.support_points.shape, log.support_force.shape) == ((0, 2), (0,))
    elif arrangement is None:
        assert log.support_points is log.support_force is None
