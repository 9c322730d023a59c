"""A user's own recorded pushes: every kind of file gives the same structure, and damaged ones a clear error."""

import gzip
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from recorded import arrays, fails, mit_log, only_problem, same, saved, tables

from pushjax.datasets import LogError, Recording, Recordings, load_recordings, load_triangle_log

EXACT = 1e-12

# --- tables ---

HEADER = "push,hand_x,hand_y,object_x,object_y,object_theta"
TABLE = [
    HEADER,
    "0,0.10,0.20,0.3,0.4,3.1",
    "0,0.11,0.20,,,",
    "0,0.12,0.20,0.3,0.4,-3.1",
    "1,0.20,0.20,0.3,0.4,0.1",
    "1,0.21,0.20,0.3,0.4,0.2",
]


def table(tmp_path: Path, lines: list[str], name: str = "log.csv") -> Path:
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n")
    return path


def test_table_is_read_as_written(tmp_path):
    found = load_recordings(table(tmp_path, TABLE))
    assert (found.problems, found.source) == ((), str(tmp_path / "log.csv"))
    assert [found.vertices, found.length, found.tip_radius, found.support_points] == [None] * 4
    first, second = found.pushes
    assert (first.index, second.index) == (0, 1)
    np.testing.assert_array_equal(first.hand, [[0.10, 0.2], [0.11, 0.2], [0.12, 0.2]])
    np.testing.assert_array_equal(first.tracked, [True, False, True])
    assert np.isnan(first.pose[1]).all()
    # from 3.1 to -3.1 the short way, through pi
    np.testing.assert_allclose(first.pose[[0, 2]], [[0.3, 0.4, 3.1], [0.3, 0.4, 2 * math.pi - 3.1]], atol=EXACT)
    assert first.force is None
    assert first.time is None
    assert second.tracked.all()


def test_columns_in_any_order_and_all_of_them(tmp_path):
    lines = [
        "time, force_y,force_x,object_theta,object_y,object_x,hand_distance,hand_theta,hand_y,hand_x,push",
        "0.5,2,1,0.3,0.2,0.1,0.05,3.1,0.02,0.01,north",
        "",
        '0.6,,,,,,0.05,-3.1,0.04,"0.03",north',
        "0.7,4,3,0.3,0.2,0.1,0.05,-3.0,0.06,0.05,north",
        "0.1,2,1,0.3,0.2,0.1,0.05,3.1,0.02,0.01,south",
        "0.2,2,1,0.3,0.2,0.1,0.05,3.1,0.02,0.01,south",
    ]
    path = tmp_path / "log.CSV"
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    north, south = load_recordings(path).pushes
    assert (north.index, south.index) == (0, 1)
    turned = 2 * math.pi
    np.testing.assert_allclose(
        north.hand,
        [[0.01, 0.02, 3.1, 0.05], [0.03, 0.04, turned - 3.1, 0.05], [0.05, 0.06, turned - 3.0, 0.05]],
        atol=EXACT,
    )
    np.testing.assert_array_equal(north.time, [0.5, 0.6, 0.7])
    np.testing.assert_array_equal(north.force, [[1, 2], [np.nan, np.nan], [3, 4]])


@pytest.mark.parametrize(
    ("line", "text", "words"),
    [
        (1, "0,,0.2,0.3,0.4,3.1", "expected a number in column hand_x, found a blank"),
        (2, "0,0.1,nan,,,", "expected a finite number in column hand_y, found nan"),
        (2, "0,0.1,0.2,inf,0.4,1", "expected a finite number in column object_x, found inf"),
        (3, "0,0.1,0.2,0.3,0.4,1.2.3", "expected a number in column object_theta, found '1.2.3'"),
        (1, "0,0.1,0.2,,,", "expected the object to be tracked in the first row, found no object_x"),
        (3, "0,0.1,0.2,nan,nan,nan", "expected the object to be tracked in the last row, found no object_x"),
        (2, "0,0.1,0.2,0.3,,1", "for object_y (or none of object_x, object_y, object_theta), found none"),
        (2, "0,0.1,0.2,0.3", "expected 6 cells, as in the header, found 4"),
        (2, "0,0.1,0.2,0.3,0.4,1,7", "expected 6 cells, as in the header, found 7"),
        (2, "0,0.1,1e300,,,", "below 1e+12 for hand_y, found 1e+300"),
    ],
)
def test_a_bad_row_costs_its_push_only(tmp_path, line, text, words):
    lines = [*TABLE[:line], text, *TABLE[line + 1 :]]
    found = load_recordings(table(tmp_path, lines))
    problem = only_problem(found)
    assert words in problem.message
    assert (problem.push, problem.line) == (0, line + 1)
    assert [push.index for push in found.pushes] == [1]


def test_a_push_that_never_tracks_the_object(tmp_path):
    found = load_recordings(table(tmp_path, [*TABLE, "2,0.1,0.2,,,", "2,0.1,0.2,,,", "3,0.1,0.2,0.3,0.4,0.5"]))
    assert [push.index for push in found.pushes] == [0, 1]
    unseen, short = found.problems
    assert (unseen.push, unseen.line) == (2, 7)
    assert "tracked in the first row" in unseen.message
    assert (short.push, short.line) == (3, 9)
    assert "at least two rows, found 1" in short.message


def test_a_row_of_no_push(tmp_path):
    found = load_recordings(table(tmp_path, [*TABLE, " ,0.1,0.2,0.3,0.4,0.5"]))
    assert "number of the push in column push, found a blank" in only_problem(found).message
    assert only_problem(found).line == 7


def test_a_table_whose_time_goes_back(tmp_path):
    lines = [f"{line},{time}" for line, time in zip(TABLE, ["time", 0.0, 0.1, 0.05, 0.0, 0.0], strict=True)]
    found = load_recordings(table(tmp_path, lines))
    problem = only_problem(found)
    assert "found a step of -0.05 s in row 2 of the push" in problem.message
    assert (problem.push, problem.line) == (0, 4)
    np.testing.assert_array_equal(found.pushes[0].time, [0, 0])


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("push,hand_x,object_x,object_y,object_theta", ["found no hand_y", "expected columns out of push, hand_x"]),
        (HEADER.replace("hand_x", "hnd_x"), ["found no hand_x; unknown 'hnd_x'"]),
        (HEADER + ",hand_x", ["found more than one hand_x"]),
        (HEADER + ",force_x", ["found no force_y"]),
        (HEADER + ",force_y", ["found no force_x"]),
        (HEADER + ",hand_distance", ["found no hand_theta"]),
        (HEADER.replace(",", ";"), ["separated by commas", "found no push, hand_x"]),
        (HEADER + ",", ["unknown ''"]),
        ("1,2,3", ["found no push"]),
    ],
)
def test_columns_must_be_known_and_enough(tmp_path, header, words):
    error = fails(table(tmp_path, [header, *TABLE[1:]]), *words)
    assert error.line == 1


def test_tables_without_a_push(tmp_path):
    fails(table(tmp_path, [HEADER]), "expected at least one push, found none")
    fails(table(tmp_path, ["", " ", ",,"]), "expected a header of columns (push, hand_x", "found an empty file")
    error = fails(
        table(tmp_path, [HEADER, "0,x,0,0,0,0", "1,0,0,0,0,0"]),
        "no usable push: expected a number in column hand_x, found 'x' (and 1 more problem",
    )
    assert (error.push, error.line) == (0, 2)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(bytes(range(128, 256)) * 20)
    fails(binary, "expected a table in UTF-8 text")
    binary.write_bytes(HEADER.encode() + b"\n0,0,0,0,\x00,0\n")
    fails(binary, "found")
    binary.write_text(HEADER + "\n0,0,0,0,0," + "1" * 200_000)
    fails(binary, "expected a table in UTF-8 text", "field larger than field limit")


# --- plain archives ---


def test_archive_of_both_ends(tmp_path):
    given = {**arrays(dof=4), "force": np.ones((3, 5, 2)), "time": np.tile(np.arange(5.0), (3, 1))}
    given["path"][:, :, 2] = [3.0, 3.1, -3.1, -3.0, -2.9]
    given["start"][:, 2], given["end"][:, 2] = 3.0, -3.0
    given["force"][1, 0] = np.nan
    found = load_recordings(saved(tmp_path, given))
    assert [push.index for push in found.pushes] == [0, 1, 2]
    for index, push in enumerate(found.pushes):
        assert push.tracked.tolist() == [True, False, False, False, True]
        np.testing.assert_array_equal(push.pose[0], given["start"][index])
        np.testing.assert_allclose(push.pose[-1], [*given["end"][index, :2], 2 * math.pi - 3.0], atol=EXACT)
        np.testing.assert_array_equal(push.hand[:, [0, 1, 3]], given["path"][index][:, [0, 1, 3]])
        assert np.abs(np.diff(push.hand[:, 2])).max() < 0.2
        np.testing.assert_array_equal(push.force, given["force"][index])
        np.testing.assert_array_equal(push.time, np.arange(5.0))


def test_archive_of_poses_all_along(tmp_path):
    pose = np.zeros((2, 4, 3), np.float32)
    pose[..., 2] = [3.0, np.nan, -3.0, -2.8]
    pose[:, 1, :2] = np.nan
    found = load_recordings(saved(tmp_path, {"path": np.zeros((2, 4, 3), int), "pose": pose}))
    for push in found.pushes:
        assert push.tracked.tolist() == [True, False, True, True]
        assert push.pose.dtype == push.hand.dtype == np.float64
        np.testing.assert_allclose(push.pose[push.tracked, 2], [3.0, 2 * math.pi - 3.0, 2 * math.pi - 2.8], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a["path"].__setitem__((1, 2, 1), np.nan), "for hand_y, found none in row 2 of the push"),
        (lambda a: a["start"].__setitem__((1, 0), np.inf), "for object_x (or none of"),
        (lambda a: a["end"].__setitem__(1, np.nan), "expected the object to be tracked in the last row"),
        (
            lambda a: a.update(time=np.array([[0, 1, 2, 3, 4], [0, 1, 3, 2, 4], [0, 0, 0, 0, 0]])),
            "step of -1 s in row 3",
        ),
        (lambda a: a.update(force=np.where(np.arange(30).reshape(3, 5, 2) == 13, np.nan, 1.0)), "for force_y (or none"),
    ],
)
def test_a_bad_row_of_an_archive(tmp_path, change, words):
    given = arrays()
    change(given)
    found = load_recordings(saved(tmp_path, given))
    assert words in only_problem(found).message
    assert only_problem(found).push == 1
    assert [push.index for push in found.pushes] == [0, 2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("end"), "found no end"),
        (lambda a: a.pop("path"), "expected arrays of pushes: path (n, k, dof)"),
        (lambda a: a.update(wrench=np.ones((3, 5, 3))), "found no twist"),
        (lambda a: a.update(forces=np.ones((3, 5, 2))), "found unknown arrays forces"),
        (lambda a: a.update(pose=np.ones((3, 5, 3))), "expected either start and end or pose, found both"),
        (lambda a: a.update(path=np.ones((3, 5))), "expected path of shape (n, k, dof)"),
        (lambda a: a.update(path=np.ones((3, 1, 2))), "dof and k at least 2; found (3, 1, 2)"),
        (lambda a: a.update(path=np.ones((0, 5, 2))), "expected path of shape (n, k, dof)"),
        (lambda a: a.update(start=np.ones((2, 3))), "expected start of shape (n=3, 3), found (2, 3)"),
        (lambda a: a.update(time=np.ones(5)), "expected time of shape (n=3, k=5), found (5,)"),
        (lambda a: a.update(about_side=np.ones(2)), "expected about_side of shape (n=3), found (2,)"),
        (lambda a: a.update(surface=np.ones(())), "expected text in surface"),
        (lambda a: a.update(length=np.array(np.nan)), "expected finite numbers in length"),
        (lambda a: a.update(end=np.full((3, 3), "x")), "expected numbers in end"),
        (lambda a: a["path"].fill(np.nan), "no usable push: expected at least two rows, found 0"),
    ],
)
def test_archives_that_are_none(tmp_path, change, words):
    given = arrays()
    change(given)
    fails(saved(tmp_path, given), words)


def test_saved_recordings_are_read_back(tmp_path):
    rng = np.random.default_rng(0)
    pushes = tuple(
        Recording(
            10 * k,
            rng.normal(size=(m, 4)),
            np.vstack([rng.normal(size=(1, 3)), np.full((m - 2, 3), np.nan), rng.normal(size=(1, 3)) / 9]),
            force=np.vstack([np.full((1, 2), np.nan), rng.normal(size=(m - 1, 2))]),
            time=np.sort(rng.normal(size=m)),
            wrench=rng.normal(size=(p, 3)),
            twist=rng.normal(size=(p, 3)),
            about={"action": f"push {k}", "speed": 0.1 * k, "end": rng.normal(size=3)},
        )
        for k, (m, p) in enumerate(((5, 1), (2, 0), (7, 3)))
    )
    facts = {"vertices": rng.normal(size=(4, 2)), "length": 0.1, "tip_radius": 0.0, "surface": "ice", "object": "duck"}
    supports = {"support_points": np.empty((0, 2)), "support_force": np.empty(0)}
    problems = (LogError("old", "damaged", push=7), LogError("old", "truncated"))
    made = Recordings(pushes, problems, "old", **facts, **supports)
    file = tmp_path / "log"  # without a suffix
    made.save(file)
    found = load_recordings(file)
    assert (len(found), found.source) == (3, str(file))
    assert [str(each) for each in found.problems] == [f"{file}, push 7: damaged", f"{file}: truncated"]
    for ours, theirs in zip(found.pushes, pushes, strict=True):
        assert ours.index == theirs.index
        for name in ("hand", "pose", "force", "time", "wrench", "twist"):
            # angles take the short way from one sample to the next
            expected = getattr(theirs, name).copy()
            if name in ("hand", "pose"):
                seen = np.isfinite(expected[:, 2])
                expected[seen, 2] = np.unwrap(expected[seen, 2])
            np.testing.assert_array_equal(getattr(ours, name), expected, err_msg=name)
    assert found.about("action").tolist() == ["push 0", "push 1", "push 2"]
    np.testing.assert_array_equal(found.about("end"), [push.about["end"] for push in pushes])
    np.testing.assert_array_equal(found.start, [push.pose[0] for push in found.pushes])
    for name, value in {**facts, **supports}.items():
        np.testing.assert_array_equal(getattr(found, name), value)
    with pytest.raises(ValueError, match="pushes: expected at least one to save"):
        Recordings((), (), "none").save(file)


def test_text_log(data):
    file = sorted((data / "raw" / "three_point_push").glob("plywood_3pts2__*.txt.gz"))[0]
    log, found = load_triangle_log(file), load_recordings(file)
    for ours, theirs in zip(found.pushes, log.pushes, strict=True):
        same(ours, theirs, 0.0)
    np.testing.assert_array_equal(found.support_points, log.support_points)


# --- detection of the kind of file ---


def test_the_kind_is_told_by_content_before_the_name(tmp_path):
    wrong = tmp_path / "named.csv"
    for file, count in ((mit_log(tmp_path, tables(), ".h5"), 1), (saved(tmp_path, arrays()), 3)):
        shutil.copy(file, wrong)
        assert len(load_recordings(wrong)) == count
    zipped = tmp_path / "log.csv"
    zipped.write_bytes(gzip.compress(b"An unrelated text\n"))
    fails(zipped, "expected the number of pushes")


def test_files_of_no_kind(tmp_path):
    fails(tmp_path / "absent.csv", "cannot read the file: No such file")
    fails(tmp_path, "cannot read the file: Is a directory")
    for suffix in (".csv", ".npz", ".json", ".h5", ".txt", ".gz", ""):
        empty = tmp_path / f"empty{suffix}"
        empty.touch()
        fails(empty, "found an empty file")
    junk = bytes(range(128, 256)) * 20
    for suffix, words in (
        (".csv", "expected a table in UTF-8 text"),
        (".npz", "expected an .npz archive of pushes"),
        (".json", "expected a JSON log of a push"),
        (".h5", "expected an HDF5 log of a push"),
        (".txt", "expected the number of pushes"),
        (".bag", "by its suffix: .csv, .npz, .json, .h5, .hdf5, .txt, .gz; found '.bag'"),
        ("", "by its suffix: .csv, .npz, .json, .h5, .hdf5, .txt, .gz; found none"),
    ):
        path = tmp_path / f"junk{suffix}"
        path.write_bytes(junk)
        fails(path, words)
    saved(tmp_path, {"poses": np.ones(3)}, "other.npz")
    fails(tmp_path / "other.npz", "expected arrays of pushes", "found unknown arrays poses")
    np.save(tmp_path / "single.npy", np.ones(3))
    shutil.copy(tmp_path / "single.npy", tmp_path / "single.npz")
    fails(tmp_path / "single.npz", "found a single array")


@pytest.mark.parametrize("suffix", [".json", ".h5", ".npz"])
def test_files_cut_short_or_damaged_never_fail_otherwise(tmp_path, suffix, rng):
    file = saved(tmp_path, arrays()) if suffix == ".npz" else mit_log(tmp_path, tables(), suffix)
    whole = file.read_bytes()
    path = tmp_path / f"damaged{suffix}"
    for part in np.linspace(0.01, 0.99, 25):
        path.write_bytes(whole[: int(part * len(whole))])
        fails(path)
    for at in rng.integers(0, len(whole), 150):
        path.write_bytes(whole[:at] + bytes([int(rng.integers(256))]) + whole[at + 1 :])
        try:
            found = load_recordings(path)
        except LogError:
            continue
        assert np.isfinite(found.pushes[0].hand).all()
