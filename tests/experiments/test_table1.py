"""Straight pushes of the MIT data set: loader, outlines, noise floor, and the experiment."""

import json

import jax
import numpy as np
import pytest

import pushjax as pj
from pushjax.cli import main as cli
from pushjax.datasets import LogError, load_mit_pushes_npz
from pushjax.experiments import table1
from pushjax.experiments._cell_cache import CellCache
from pushjax.experiments.table1 import conditions, experiment, methods
from pushjax.experiments.table1.repeats import noise_floor_mm

# Results of the published toolbox: mm, quartic, mean over all test pushes of ten objects, of which the archives contain
# 70 %.
TOOLBOX_MM = {"abs": 6.65, "plywood": 6.12}


def archive(fast=True, **changes):
    """Return the arrays of a small archive: five whole pushes, of which three are test pushes."""
    rng = np.random.default_rng(3)
    data = {"full_index": np.array([1, 4, 5, 8, 9]), "eval_index": np.array([0, 2, 3]), "v20_index": np.array([7, 6])}
    for group, count in (("full", 5), ("eval", 3), ("v20", 2)):
        start = rng.uniform(-1, 1, (count, 3))
        data[f"{group}_object_pose_start"] = start
        data[f"{group}_object_pose_end"] = start + np.array([0.01, 0.02, 0.3 + 2 * np.pi])
        data[f"{group}_tip_start"], data[f"{group}_tip_end"] = rng.uniform(-1, 1, (2, count, 2))
        data[f"{group}_valid"] = np.arange(count) != 1
        for kind in ("poly4", "quadratic"):
            data[f"{group}_sim_pose_end_{kind}"] = start - np.array([0.0, 0.0, 2 * np.pi])
    data |= {"train_wrench": rng.normal(size=(6, 3)), "train_twist": rng.normal(size=(6, 3))}
    data |= {
        "train_valid": np.arange(6) > 0,
        "eval_to_full": np.array([4, 9, 5]),
        "v20_to_full_action": np.array([8, 3]),
    }
    data |= {"full_in_eval": np.isin(data["full_index"], (4, 9, 5)), "rho": np.float64(0.06)}
    data |= {"vertices_body": np.array([[0, 0], [0.1, 0], [0, 0.1]]), "tip_radius": np.float64(0.005)}
    data |= {"surface": np.str_("abs"), "shape": np.str_("tri9")}
    if not fast:
        data = {name: value for name, value in data.items() if not name.startswith("v20")}
    return data | changes


def written(folder, data):
    path = folder / "pushes.npz"
    np.savez(path, **{name: value for name, value in data.items() if value is not None})
    return path


def test_loader_matches_rows(tmp_path):
    log = load_mit_pushes_npz(written(tmp_path, archive()))
    assert (len(log.whole), len(log.middle), len(log.fast)) == (5, 3, 2)
    assert log.is_training.tolist() == [True, False, False, True, False]
    assert log.middle_of.tolist() == [1, 4, 2]
    assert log.repeats.tolist() == [[0, 3]]  # the other action is not in `whole`
    assert log.whole.valid.tolist() == [True, False, True, True, True]
    assert (log.wrench.shape, log.surface, log.shape, log.length) == ((5, 3), "abs", "tri9", 0.06)
    np.testing.assert_allclose(log.middle.end - log.middle.start, [[0.01, 0.02, 0.3]] * 3)
    np.testing.assert_allclose(log.middle.toolbox["quartic"], log.middle.start, atol=1e-12)
    without = load_mit_pushes_npz(written(tmp_path, archive(fast=False)))
    assert (len(without.fast), without.repeats.shape) == (0, (0, 2))
    assert noise_floor_mm(without) is None


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"eval_tip_end": None}, "found no eval_tip_end"),
        ({"full_tip_start": np.zeros((4, 2))}, "full_tip_start"),
        ({"eval_object_pose_end": np.full((3, 3), np.nan)}, "eval_object_pose_end"),
        ({"train_twist": np.zeros((5, 3))}, "train_twist"),
        ({"eval_to_full": np.array([4, 9, 77])}, "expected eval_to_full to name rows of full_index, found 77"),
        ({"vertices_body": np.full((3, 2), np.inf)}, "vertices_body"),
        ({"full_index": np.float64(2)}, "full_"),
    ],
)
def test_damaged_archives_are_refused(tmp_path, changes, what):
    with pytest.raises(LogError, match=what) as raised:
        load_mit_pushes_npz(written(tmp_path, archive(**changes)))
    assert raised.value.path.endswith("pushes.npz")


@pytest.fixture(scope="module")
def logs(data):
    if not (data / "mit_push").is_dir():
        pytest.skip(f"no {data / 'mit_push'}")
    each = [(surface, name) for surface in conditions.SURFACES for name in conditions.OBJECTS]
    return {key: conditions.load(data, *key) for key in each}


def test_real_archives(logs):
    """All pushes of every object are loaded, with the errors of the original program as in its authors' data."""
    assert sum(len(log.whole) for log in logs.values()) == 5726
    assert sum(len(log.fast) for log in logs.values()) == 2214
    for log in logs.values():
        travel = np.linalg.norm(log.middle.tip_end - log.middle.tip_start, axis=1)
        assert np.all((travel > 0.04) & (travel < 0.047))
        assert not log.is_training[log.middle_of].any()
        assert np.all(np.abs(log.whole.end[:, 2] - log.whole.start[:, 2]) <= np.pi)
    for surface, expected in TOOLBOX_MM.items():
        means = [
            experiment.deviation_mm(logs[surface, name], logs[surface, name].middle.toolbox["quartic"]).mean()
            for name in conditions.OBJECTS
            if name not in conditions.NOT_IN_PAPER
        ]
        assert np.mean(means) == pytest.approx(expected, abs=0.3)


@pytest.mark.slow
def test_outlines(logs):
    """The outlines agree with the published vertices.

    Ellipses and polygons, also polygons with halved edges, pass through them. The butterfly, whose corners are a tenth
    of its vertices, passes near them.
    """
    for name, most in (("ellip1", 2e-5), ("ellip3", 2e-5), ("butter", 3.5e-4), ("hex", 1e-9), ("tri1", 1e-9)):
        log = logs["abs", name]
        distance = jax.vmap(conditions.outline(log).signed_distance)(log.vertices)
        assert np.max(np.abs(distance)) < most
    assert not conditions.outline(logs["abs", "butter"]).convex
    for name in ("rect1", "tri2", "hex"):
        filled = conditions.outline(logs["abs", name])
        assert isinstance(filled, pj.Polygon)
        assert filled.convex
        assert filled.vertices.shape == (6, 2)
        inside, plain = filled.inset(0.003), pj.Polygon(logs["abs", name].vertices).inset(0.003)
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 2))
        np.testing.assert_allclose(
            jax.vmap(inside.signed_distance)(points), jax.vmap(plain.signed_distance)(points), atol=1e-12
        )


def test_sides(logs):
    """Pushes are about equally frequent on the sides of an object, or its quadrants; the tip is nearest to its side."""
    for name, many in (("rect1", 4), ("tri1", 3), ("hex", 6), ("ellip2", 4), ("butter", 4)):
        log = logs["abs", name]
        side = conditions.pushed_sides(log, log.whole)
        counts = np.bincount(side, minlength=many)
        assert len(counts) == many
        assert counts.min() > len(side) / many / 3
    rect = logs["abs", "rect1"]
    side = conditions.pushed_sides(rect, rect.whole)
    start = rect.whole.start
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    away = rect.whole.tip_start - start[:, :2]
    local = np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=1)
    middle = (rect.vertices + np.roll(rect.vertices, -1, axis=0)) / 2
    outward = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    reach = np.max(local @ outward.T - np.sum(middle * outward, axis=1)[None], axis=1)
    mine = np.sum(local * outward[side], axis=1) - np.sum(middle * outward, axis=1)[side]
    beside = np.abs(mine - reach) > 1e-3  # a corner, where both sides are equally near
    assert beside.mean() < 0.05
    assert np.all(reach[beside] < 0.007)


def test_noise_floor(logs):
    """Repetitions agree better than any model predicts, but they do differ."""
    for name in conditions.OBJECTS:
        floor = noise_floor_mm(logs["abs", name])
        assert (floor is None) == (name in ("hex", "butter"))
        assert floor is None or 2 < floor < 8
        assert noise_floor_mm(logs["plywood", name]) is None


def test_filled_up(logs):
    log = logs["abs", "tri1"]
    rows = np.flatnonzero(log.is_training)
    pushes = conditions.padded_pushes(log, log.whole, rows, 10, 128)
    assert pushes.path.shape == (128, 11, 2)
    assert float(pushes.weight.sum()) == len(rows)
    assert 0 <= float(pushes.age.min()) < 0.2 < 0.8 < float(pushes.age.max()) <= 1
    np.testing.assert_array_equal(pushes.side[: len(rows)], conditions.pushed_sides(log, log.whole)[rows])
    with pytest.raises(ValueError, match=f"batch must be at least {len(rows)}; got 3"):
        conditions.padded_pushes(log, log.whole, rows, 10, 3)
    np.testing.assert_allclose(pushes.path[: len(rows), -1], log.whole.tip_end[rows])
    np.testing.assert_allclose(pushes.path[3, 5], (log.whole.tip_start[rows[3]] + log.whole.tip_end[rows[3]]) / 2)


@pytest.mark.slow
def test_experiment(logs, data, monkeypatch, tmp_path):
    """With ellipsoids for one object, results are as good as the paper's from forces, and no worse with calibration."""
    monkeypatch.setattr(experiment, "MODELS", {"ellipsoid": 2})
    given = ["--surface", "abs", "--object", "rect1", "--steps", "30", "--data", str(data)]
    cli.main(["reproduce", "table1", *given, "--out", str(tmp_path), "--json", str(tmp_path / "t.json")])
    record = json.loads((tmp_path / "t.json").read_text())
    forces, found = record["cells"]
    assert [cell["method"] for cell in record["cells"]] == ["wrench_twist", "identified"]
    for cell in record["cells"]:
        assert (cell["tested"], cell["learned"], cell["failed_steps"]) == (196, 82, 0)
        assert cell["no_motion_mm"] == pytest.approx(
            conditions.PAPER_NO_MOTION_MM["abs"][0] / 0.975, abs=0.4
        )  # the paper's window was a little shorter
        assert 0 < cell["friction"] < 0.5
        assert cell["noise_floor_mm"] < cell["mean_mm"] < 1.1 * cell["paper_mm"]
    assert found["mean_mm"] < forces["mean_mm"] + 0.1
    for name in ("wrench_twist", "identified"):
        assert (tmp_path / f"table1_{name}.png").stat().st_size > 5000
    assert not (tmp_path / "table1-cells.json").exists()


def test_an_interrupted_run_goes_on(logs, data, monkeypatch, tmp_path):
    calls = []

    def guess(setting):
        calls.append(setting)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return methods.Prediction(np.zeros((196, 3)), 0.2, 0, None)

    monkeypatch.setattr(experiment, "METHODS", {"identified": guess})
    monkeypatch.setattr(experiment, "ConditionData", type("Nothing", (), {"of": staticmethod(lambda *given: given)}))
    monkeypatch.setattr(experiment, "_draw", lambda cells, out: [])
    choice = {"surface": ("abs",), "object": ("rect1",), "method": ("identified",), "out": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        table1.run(data, **choice)
    assert len(json.loads((tmp_path / "table1-cells.json").read_text())["cells"]) == 1
    with pytest.raises(ValueError, match=r"table1-cells\.json is of a run with other settings"):
        table1.run(data, steps=7, **choice)
    record = table1.run(data, **choice)
    assert len(calls) == 3
    assert [cell["model"] for cell in record["cells"]] == ["quartic", "ellipsoid"]
    assert [path.name for path in tmp_path.iterdir()] == ["table1-cells.json"]  # until the results are written
    CellCache.delete("table1", tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--object", "rect9"], "object must be one or more of rect1"),
        (["--surface", "delrin"], "has no pushes on delrin; the published data set has"),
    ],
)
def test_bad_choices(data, arguments, message, capsys, tmp_path):
    with pytest.raises(ValueError, match=r"method must be one or more of wrench_twist, identified; got \['ideal'\]"):
        table1.run(data, method=("ideal",))
    with pytest.raises(SystemExit) as stop:
        cli.main(["reproduce", "table1", "--data", str(data), "--out", str(tmp_path), *arguments])
    assert stop.value.code == 1
    assert message in capsys.readouterr().err


def test_files_left_out_are_named(tmp_path, monkeypatch):
    problem = LogError(tmp_path / "a.json", "the tracker jumps")
    monkeypatch.setattr(conditions, "load_mit_folder", lambda *given, **options: ("log", (problem, problem)))
    with pytest.warns(UserWarning, match=r"2 files of hex on delrin are left out, the first: .*a\.json.*tracker jumps"):
        assert conditions.load(tmp_path, "delrin", "hex") == "log"


def test_folder_without_the_pushes(tmp_path):
    with pytest.raises(LogError, match="expected"):
        table1.run(tmp_path, surface=("abs",), object=("rect1",))
    with pytest.raises(ValueError, match="surface must be one or more of delrin, abs, plywood; got none"):
        table1.run(tmp_path, surface=())
