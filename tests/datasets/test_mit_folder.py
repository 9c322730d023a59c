"""The MIT pushing data set as it is downloaded: names, outlines, and folders of synthetic files with known answers."""

import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from recorded import write_streams

import pushjax as pj
from pushjax.datasets import LogError, Recording, load_mit_folder, load_recordings
from pushjax.datasets.mit_folder import find_files, states_at
from pushjax.datasets.mit_logs import parse_name
from pushjax.datasets.mit_shapes import MIT_SHAPES, mit_shape, nearest_on_outline
from pushjax.datasets.planar import rotation

# The objects move as linear functions of time, whose time stamps have a resolution of 0.2 us: m, rad.
LINEAR = 1e-7
# N and N m. The samples of a part, 10 ms apart, may begin and end late by half of that, while 2 N turn by 0.05 rad/s.
TURNING = 5e-4
# The butterfly's outline is published with eight digits; here it is computed from nine numbers.
OUTLINE = 2e-7

# --- a download ---

FORCE = np.array([-2.0, 0.3])  # N, body
TRAVEL = 0.02  # m
UNIX = 1460088637.25  # s
# s: the first of the tip's samples (10 ms apart) at which all streams are known, and the last before the end of the
# tip's stream
FIRST, LAST = 0.02, -0.11
SPEEDS = [10] * 12 + [20] * 4
NAME = "motion_surface=abs_shape=rect1_a=0_v={}_i=1.000_s={:.3f}_t=0.000"


def name(row: int) -> str:
    """Return the name of one of 16 pushes: twelve slow ones, and the 1st, 3rd, 5th and 7th of these again, fast."""
    return NAME.format(SPEEDS[row], (row if row < 12 else 2 * (row - 12)) / 20)


def contact(row: int) -> np.ndarray:
    """Return the contact point on the right edge, body frame, m."""
    return np.array([0.045, -0.03 + 0.005 * (row % 12)])


def torque(row: int) -> float:
    return contact(row)[0] * FORCE[1] - contact(row)[1] * FORCE[0]


def velocity(row: int) -> np.ndarray:
    """Return the object's velocity, world frame: m/s along the push, and rad/s in the direction of the torque."""
    along = rotation(0.1 * row) @ [-1.0, 0.0]
    return SPEEDS[row] / 1e3 * np.append(along, 5 * np.sign(torque(row)))


def pose(row: int, time: np.ndarray) -> np.ndarray:
    return np.array([0.3, -0.1, 0.1 * row]) + np.multiply.outer(time, velocity(row))


def tip(row: int, at: np.ndarray) -> np.ndarray:
    """Return the tip's center, world frame, m, where the object is at the poses (m, 3)."""
    return at[:, :2] + rotation(at[:, 2]) @ (contact(row) + np.array([0.00475, 0.0]))


def duration(row: int) -> float:
    return 1e3 * TRAVEL / SPEEDS[row]


def streams(row: int) -> dict[str, np.ndarray]:
    """Return the streams as logged.

    The tip does not move relative to the object. Each stream has its own clock, beginning and end.
    """
    end = duration(row)
    time = {
        "tip_pose": np.arange(0, end + 1e-9, 0.01),
        "object_pose": np.arange(-0.033, end - 0.1, 0.0125),
        "ft_wrench": np.arange(0.015, end + 0.05, 0.008),
    }
    time["object_pose"][-1] = end - 0.105
    values = {key: pose(row, at) for key, at in time.items()}
    values["tip_pose"][:, :2] = tip(row, values["tip_pose"])
    values["ft_wrench"][:, :2] = -(rotation(values["ft_wrench"][:, 2]) @ FORCE)  # the reaction
    return {key: np.column_stack([UNIX + time[key], values[key]]) for key in time}


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Write the pushes as JSON, in the folders that the archives unpack to."""
    root = tmp_path_factory.mktemp("published")
    for row in range(len(SPEEDS)):
        write_streams(root / "abs" / "rect1" / "rect1_json" / f"{name(row)}.json", streams(row))
    return root


@pytest.fixture
def download(published, tmp_path):
    """Copy the download, so that it can be damaged."""
    return shutil.copytree(published, tmp_path / "download")


def log(download: Path, row: int) -> Path:
    return next(download.rglob(f"{name(row)}.json"))


# --- names ---


@pytest.mark.parametrize("suffix", [".json", ".h5", ".hdf5", ".H5", ""])
def test_names(suffix):
    found = parse_name(Path(f"some/where/motion_surface=pu_shape=ellip2_a=0_v=20_i=2.000_s=0.025_t=-0.349{suffix}"))
    assert found == ("pu", "ellip2", 0.0, 0.02, 2, 0.025, -0.349, 0)
    assert (found.speed, found.action) == (0.02, "side 2, fraction 0.025, angle -0.349")
    fields = "motion_surface=abs_shape=butter_v=-1_a=2500_i=0.000_s=0.700_t=0.000_rep=0012_note=second_try"
    assert parse_name(Path(fields + suffix)) == ("abs", "butter", 2.5, -0.001, 0, 0.7, 0.0, 12)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("motion_surface=abs_shape=hex_a=0_v=10_i=0.000_t=0.000.json", "found none of s"),
        ("readme.json", "found none of surface, shape, a, v, i, s, t"),
        (f"{NAME.format('fast', 0)}.json", "expected a number for v in the name, found 'fast'"),
        (f"{NAME.format('inf', 0)}.json", "expected a number for v in the name, found 'inf'"),
        (
            f"{NAME.format(10, 0).replace('1.000', '1.5')}.json",
            "expected a whole number for i in the name, found '1.5'",
        ),
        (f"{NAME.format(10, 0)}_rep=.json", "expected a whole number for rep in the name, found ''"),
    ],
)
def test_bad_names(file, words):
    with pytest.raises(LogError) as raised:
        parse_name(Path(file))
    assert words in str(raised.value)
    assert raised.value.path == file


# --- outlines ---


def test_outlines_are_the_archives(converted):
    with pytest.raises(ValueError, match=r"shape must be one of rect1, .*, butter; got 'rect4'"):
        mit_shape("rect4")
    for shape in MIT_SHAPES:
        found = mit_shape(shape)
        for surface in ("abs", "plywood"):
            archive = load_recordings(converted / "mit_push" / f"{surface}_{shape}.npz")
            np.testing.assert_allclose(found.vertices, archive.vertices, rtol=0, atol=OUTLINE)
            assert found.length == pytest.approx(archive.length, abs=OUTLINE)
            assert found.tip_radius == archive.tip_radius


@pytest.mark.parametrize("shape", ["tri1", "hex", "butter"])
def test_nearest_on_outline(shape, rng):
    """The nearest points agree with those of the library's shapes."""
    vertices = mit_shape(shape).vertices
    corners = 0.999 * vertices[:3] + np.array([2e-6, 1e-6])  # less near to two edges
    points = np.concatenate([rng.uniform(-0.1, 0.1, (40, 2)), corners, [[0.0, vertices[1, 1]]]])
    distance, place = nearest_on_outline(vertices, points)
    expected, at, _ = jax.vmap(pj.Polygon(vertices).closest)(points)
    np.testing.assert_allclose(distance, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(place, at, rtol=0, atol=1e-12)


# --- folders ---


def test_files_are_found(download):
    write_streams(download / "elsewhere" / f"{name(0)}_rep=0001.json", streams(0))
    for other in (f"{name(3)}.h5", f"{NAME.format(10, 0.9)}.h5", f"._{name(1)}.json", "notes.json", "rect1_h5.zip"):
        (download / other).write_text("")  # an HDF5 file beside JSON, one without, and a file that is neither
    found, misnamed = find_files(download, "abs", "rect1")
    assert misnamed == []
    assert [(push.speed, push.fraction, push.repetition) for push, _ in found] == [
        (0.01, 0.0, 0),
        (0.01, 0.0, 1),
        *((0.01, row / 20, 0) for row in range(1, 12)),
        (0.01, 0.9, 0),
        *((0.02, row / 10, 0) for row in range(4)),
    ]
    assert [path.suffix for _, path in found] == [".json"] * 13 + [".h5"] + [".json"] * 4


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (None, "expected a folder of the MIT pushing data set, found none"),
        ([], "found none of the data set"),
        (["rect1_h5.zip"], "found only .zip files: unpack them first"),
        (
            [f"{name(0).replace('rect1', 'hex')}{suffix}" for suffix in (".json", ".h5", "_rep=0001.json")],
            "expected files motion_surface=abs_shape=rect1_... (.json, .h5, .hdf5), found hex on abs",
        ),
    ],
)
def test_nothing_there(tmp_path, there, words):
    folder = tmp_path / "download"
    for file in there if there is not None else ():
        folder.mkdir(exist_ok=True)
        (folder / file).write_text("")
    if there == []:
        folder.mkdir()
    with pytest.raises(LogError) as raised:
        load_mit_folder(folder, "abs", "rect1")
    assert words in str(raised.value)
    assert raised.value.path == str(folder)


def check(found, rows):
    """Check the poses, pairs and names of a complete download."""
    assert (found.problems, found.surface, found.object) == ((), "abs", "rect1")
    assert found.vertices.shape == (4, 2)
    assert (found.length, found.tip_radius) == (pytest.approx(0.045 * np.sqrt(2)), 0.00475)
    assert [push.index for push in found.pushes] == list(range(rows))
    assert found.about("speed").tolist() == [SPEEDS[row] / 1e3 for row in range(rows)]
    for row, push in enumerate(found.pushes):
        lasts = duration(row) + LAST - FIRST
        for shares in ((0, 1), (0.1, 0.9)):
            at = pose(row, FIRST + np.array(shares) * lasts)
            _, poses, tips = states_at(push, shares)
            np.testing.assert_allclose(poses, at, rtol=0, atol=LINEAR)
            # the tip rotates a little: its path is not linear between its samples, 10 ms apart
            np.testing.assert_allclose(tips, tip(row, at), rtol=0, atol=LINEAR)
        check_pairs(push, row, 0.8 * lasts / 6)


def check_pairs(push: Recording, row: int, lasts: float):
    """Check the six pairs, with the force on the object in its own frame and about its origin."""
    assert push.wrench.shape == push.twist.shape == (6, 3)
    np.testing.assert_allclose(push.wrench, np.tile([*FORCE, torque(row)], (6, 1)), rtol=0, atol=2 * TURNING)
    np.testing.assert_allclose(push.twist[:, 2], velocity(row)[2] * lasts, rtol=0, atol=LINEAR)
    # in the frame at the middle of each part, the motion turns more and more to the side that the object turned from
    middle = (np.arange(6) + 0.5) * lasts + 0.1 * 6 / 0.8 * lasts + FIRST
    along = np.array([-SPEEDS[row] / 1e3 * lasts, 0])
    side = rotation(-velocity(row)[2] * middle) @ along
    np.testing.assert_allclose(push.twist[:, :2], side, rtol=0, atol=LINEAR)


def test_known_motion(published):
    calls = []
    found = load_mit_folder(published, "abs", "rect1", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(done, 16) for done in range(1, 17)]
    assert found.source == str(published)
    check(found, 16)
    slow = load_mit_folder(published, "abs", "rect1", speeds=(0.01,))
    check(slow, 12)
    action = found.about("action").tolist()
    assert action[12:] == action[0:8:2]


def test_parts_without_force_are_no_pairs(download):
    """Parts whose force is missing, brakes, or is along the edge, as with a sensor offset, give no pairs."""
    aside = rotation(np.deg2rad(60))
    for row, change in enumerate((0.04 * np.eye(2), -np.eye(2), aside, aside.T)):
        made = streams(row)
        made["ft_wrench"][:, 1:3] @= change
        write_streams(log(download, row), made)
    found = load_mit_folder(download, "abs", "rect1")
    assert found.problems == ()
    assert [len(push.wrench) for push in found.pushes] == [0] * 4 + [6] * 12


def test_hdf5_is_the_same(tmp_path):
    pytest.importorskip("h5py")
    for row in range(len(SPEEDS)):
        write_streams(tmp_path / f"{name(row)}.h5", streams(row))
    check(load_mit_folder(tmp_path, "abs", "rect1"), 16)


def test_hdf5_without_its_reader(tmp_path, monkeypatch):
    for row in range(3):
        (tmp_path / f"{name(row)}.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(LogError, match=r"no usable push: .*pip install '\.\[hdf5\]' \(and 2 more problems\)"):
        load_mit_folder(tmp_path, "abs", "rect1")


def damaged(row: int, stream: str, change) -> dict[str, np.ndarray]:
    made = streams(row)
    made[stream] = change(made[stream])
    return made


def flipped(rows: np.ndarray) -> np.ndarray:
    """Return streams in which the tracker confuses two sides halfway."""
    rows[len(rows) // 2 :, 3] += np.pi / 2
    return rows


def spike(rows: np.ndarray) -> np.ndarray:
    rows[len(rows) // 2 : len(rows) // 2 + 2, 1] += 0.05
    return rows


def test_broken_files_cost_themselves_only(download):
    log(download, 0).write_text("{")
    log(download, 13).write_text("")
    write_streams(log(download, 14), damaged(14, "ft_wrench", lambda rows: rows[:1]))
    (log(download, 0).parent / f"{NAME.format('slow', 0)}.json").write_text("{}")
    (log(download, 0).parent / f"{NAME.format('slow', 0).replace('rect1', 'hex')}.json").write_text("{}")
    found = load_mit_folder(download, "abs", "rect1")
    assert [Path(problem.path).name for problem in found.problems] == [
        f"{NAME.format('slow', 0)}.json",
        *(f"{name(row)}.json" for row in (0, 13, 14)),
    ]
    assert [push.index for push in found.pushes] == [*range(1, 12), 12, 15]


def test_a_lost_object_is_reported(download):
    away = slice(30, 130)  # 1.25 s
    for row, change, words in (
        (2, flipped, "while the tip goes 5 mm, found"),
        (4, spike, "the tracker jumps"),
        (7, lambda rows: np.delete(rows, away, axis=0), "to be tracked throughout, found it lost from 0.33 to 1.59 s"),
    ):
        write_streams(log(download, row), damaged(row, "object_pose", change))
        (problem,) = load_mit_folder(download, "abs", "rect1").problems
        assert (problem.path, words in problem.message) == (str(log(download, row)), True)
        write_streams(log(download, row), streams(row))


def test_other_speeds_and_accelerated_pushes_are_not_read(download):
    with pytest.raises(LogError, match=r"expected files of rect1 on abs at 50, 80 mm/s, found files at 10, 20 mm/s"):
        load_mit_folder(download, "abs", "rect1", speeds=(0.05, 0.08))
    for row in range(12, 16):
        path = log(download, row)
        path.rename(path.with_name(path.name.replace("a=0_v=20", "a=1000_v=-1")))
    check(load_mit_folder(download, "abs", "rect1"), 12)


# --- files of the data set itself ---


def test_real_samples(data):
    folder = data / "raw" / "mit_push_full"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    log = load_mit_folder(folder, "plywood", "rect1", speeds=(0.1,))
    assert (log.problems, len(log)) == ((), 4)
    pairs = np.concatenate([np.sum(push.wrench * push.twist, axis=1) for push in log.pushes])
    assert len(pairs) >= 4
    assert np.all(pairs > 0)
    travel = [np.linalg.norm(push.hand[-1] - push.hand[0]) for push in log.pushes]
    np.testing.assert_allclose(travel, 0.05, atol=0.001)
