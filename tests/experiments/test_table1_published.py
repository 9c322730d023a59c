"""Table 1 from the MIT data set as it unpacks: files of its own pushes, slowed down to 10 mm/s, as JSON and as HDF5.

The whole logs at hand are of 100 mm/s. The model is quasi-static, so the same push ten times slower is a push at 10
mm/s: every stream is stretched in time, and sampled again at its own rate.
"""

import json
from typing import NamedTuple

import numpy as np
import pytest

from pushjax.cli import main as cli
from pushjax.datasets import load_mit_folder
from pushjax.datasets.mit_folder import states_at
from pushjax.experiments import _mit_pushes as groups
from pushjax.experiments import table1

SLOWER = 10
RATES = {"tip_pose": 250.0, "object_pose": 180.0, "ft_wrench": 250.0}  # Hz
MARGIN = 0.01  # s of the fast push, at rest before and after the motion
REST = 2e-4  # m, within which the tip still is at its first place, or is already at its last
CUT, TURN = 5e-5, 5e-4  # m, rad: by which poses differ when their jitter is interpolated from other samples


class Slowed(NamedTuple):
    """A push at 10 mm/s: the name of its file, and its streams with rows of time, x, y, angle."""

    name: str
    streams: dict[str, np.ndarray]


def slowed(path) -> Slowed:
    """Return a push of a curated archive of 100 mm/s, ten times slower."""
    log = np.load(path)
    tip = log["tip_xy"]
    moves = np.linalg.norm(tip - tip[0], axis=1) > REST
    comes = np.linalg.norm(tip - tip[-1], axis=1) > REST
    first, last = log["tip_t"][np.flatnonzero(moves)[0]], log["tip_t"][np.flatnonzero(comes)[-1]]
    fast = {
        "tip_pose": (log["tip_t"], np.column_stack([tip, log["tip_yaw"]])),
        "object_pose": (log["object_t"], log["object_pose"]),
        "ft_wrench": (log["ft_t"], log["ft_wrench"]),
    }
    streams = {}
    for name, (time, values) in fast.items():
        begin, end = max(first - MARGIN, time[0]), min(last + MARGIN, time[-1])
        at = np.arange(begin, end, 1 / (SLOWER * RATES[name]))
        columns = [np.interp(at, time, column) for column in values.T]
        streams[name] = np.column_stack([float(log["t0_unix"]) + SLOWER * at, *columns])
    where = f"i={int(log['side_index'])}.000_s={float(log['side_fraction']):.3f}_t={float(log['push_angle']):.3f}"
    return Slowed(f"motion_surface=plywood_shape=rect1_a=0_v=10_{where}", streams)


@pytest.fixture(scope="module")
def pushes(data):
    paths = sorted((data / "mit_push_full").glob("plywood_rect1_v100_*.npz"))
    if len(paths) < 20:
        pytest.skip(f"no logs in {data / 'mit_push_full'}")
    return [slowed(path) for path in paths]


@pytest.fixture(scope="module")
def published(pushes, tmp_path_factory):
    """Write the pushes in the folders that the archive of a surface unpacks to: all as JSON, and all as HDF5."""
    h5py = pytest.importorskip("h5py")
    root = tmp_path_factory.mktemp("published")
    for kind in ("json", "h5"):
        (root / kind / "plywood" / "rect1" / f"rect1_{kind}").mkdir(parents=True)
    for name, streams in pushes:
        rows = {key: table.tolist() for key, table in streams.items()}
        (root / "json" / "plywood" / "rect1" / "rect1_json" / f"{name}.json").write_text(json.dumps(rows))
        with h5py.File(root / "h5" / "plywood" / "rect1" / "rect1_h5" / f"{name}.h5", "w") as file:
            for key, table in streams.items():
                file[key] = table
    return root


def test_the_motion_is_read_as_written(pushes, published):
    """Poses at the ends, and at 10 and 90 % of the time in which tip, object and force are known, are those logged."""
    log = load_mit_folder(published / "json", "plywood", "rect1")
    assert (log.problems, len(log)) == ((), len(pushes))
    by_name = {push.name: push.streams for push in pushes}
    order = sorted(by_name, key=lambda name: [float(part.split("=")[1]) for part in name.split("_")[-3:]])
    whole = groups.group(groups.grouped(log, 0), "whole")
    travel = np.linalg.norm(np.diff(groups.tips(whole), axis=1), axis=2)
    assert np.all((travel > 0.04) & (travel < 0.051))  # the object is not always seen to the end
    for name, push in zip(order, log.pushes, strict=True):
        streams = by_name[name]
        span = max(table[0, 0] for table in streams.values()), min(table[-1, 0] for table in streams.values())
        motion = streams["object_pose"]
        for shares in ((0, 1), (0.1, 0.9)):
            at = span[0] + np.array(shares) * (span[1] - span[0])
            expected = np.column_stack([np.interp(at, motion[:, 0], column) for column in motion[:, 1:].T])
            _, found, _ = states_at(push, shares)
            np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=0, atol=CUT)
            np.testing.assert_allclose(np.diff(found[:, 2]), np.diff(expected[:, 2]), rtol=0, atol=TURN)


@pytest.mark.slow
def test_table1_reads_json_and_hdf5_alike(pushes, published, monkeypatch, tmp_path):
    """The command gives the same cell from both forms; it predicts far better than that nothing moves."""
    monkeypatch.setattr(table1, "MODELS", {"ellipsoid": 2})
    choice = ["--surface", "plywood", "--object", "rect1", "--method", "wrench_twist", "--steps", "30"]
    cells = []
    for kind in ("json", "h5"):
        out = ["--out", str(tmp_path / kind), "--json", str(tmp_path / f"{kind}.json")]
        cli.main(["reproduce", "table1", "--data", str(published / kind), *choice, *out])
        (cell,) = json.loads((tmp_path / f"{kind}.json").read_text())["cells"]
        cells.append({name: value for name, value in cell.items() if name != "run_s"})
    from_json, from_hdf5 = cells
    assert from_json == from_hdf5
    assert from_json["pushes"] == len(pushes) - round(0.2 * len(pushes))
    assert from_json["failed_steps"] == 0
    assert 25 < from_json["no_motion_mm"] < 40  # the paper: 31.86, of all pushes
    assert from_json["mean_mm"] < 0.5 * from_json["no_motion_mm"]
    assert from_json["toolbox_mm"] is None
