"""Straight pushes of the MIT data set: loader, outlines, noise floor, and the experiment."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

import pushjax as pj
from pushjax.cli import main as cli
from pushjax.datasets import LogError, Recording, Recordings
from pushjax.experiments import _mit_pushes as groups
from pushjax.experiments import table1
from pushjax.experiments._mit_pushes import group, noise_floor_mm, outline
from pushjax.experiments.tables import Prediction, deviation_mm, padded

# Results of the published toolbox: mm, quartic, mean over all test pushes of ten objects, of which the archives contain
# 70 %.
TOOLBOX_MM = {"abs": 6.65, "plywood": 6.12}


OUTLINE = 0.045 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
RADIUS = 0.005


def recorded(index, speed, about=None, shift=0.0, turn=0.3):
    """Return a push of the right edge by 50 mm to the left, in eleven samples, from the gap `shift` on."""
    time = np.linspace(0, 1, 11)
    hand = np.column_stack([0.05 + shift - 0.05 * time, 0 * time])
    pose = np.column_stack([-0.05 * time, 0 * time, turn * time * 0.1])
    known = {"speed": speed, "action": f"action {index % 12}", "repetition": 0} | (about or {})
    pairs = np.full((2, 3), float(index))
    return Recording(index, hand, pose, 0 * hand, time, pairs, pairs, known)


def log_of(pushes):
    return Recordings(tuple(pushes), (), "made", OUTLINE, 0.06, RADIUS, surface="abs", object="rect1")


def test_groups():
    """Slow pushes are divided at random, and test pushes are cut."""
    made = [recorded(k, 0.01) for k in range(12)] + [recorded(k, 0.02) for k in (12, 14, 16)]
    first, again, other = (groups.grouped(log_of(made), seed) for seed in (0, 0, 1))
    assert first.about("training").tolist() == again.about("training").tolist() != other.about("training").tolist()
    whole, middle, fast = (groups.group(first, name) for name in ("whole", "middle", "fast"))
    assert (len(whole), len(middle), len(fast), len(groups.training_pushes(first))) == (12, 10, 3, 2)
    assert first.about("valid").all()
    assert not set(middle.about("action")) & set(groups.training_pushes(first).about("action"))
    np.testing.assert_allclose(whole.end - whole.start, [[-0.05, 0, 0.03]] * 12, atol=1e-12)
    np.testing.assert_allclose(middle.end - middle.start, [[-0.04, 0, 0.024]] * 10, atol=1e-12)
    np.testing.assert_allclose(groups.tips(middle)[:, :, 0], [[0.045, 0.005]] * 10, atol=1e-12)
    assert groups._repeat_rows(fast, whole).tolist() == [[0, 0], [1, 2], [2, 4]]
    assert noise_floor_mm(first) == pytest.approx(0, abs=1e-9)
    assert noise_floor_mm(groups.grouped(log_of(made[:12]), 0)) is None
    with pytest.raises(LogError, match="at least 10 usable pushes of rect1 on abs at 10 mm/s, found 3"):
        groups.grouped(log_of(made[9:]), 0)


def test_pushes_not_to_be_believed():
    """Pushes too far from the outline, too short, or with too large a turn are kept and marked as not valid."""
    made = [recorded(k, 0.01) for k in range(12)]
    made[1], made[2], made[4] = (
        recorded(1, 0.01, shift=0.01),
        recorded(2, 0.01, shift=-0.01),
        recorded(4, 0.01, turn=16),
    )
    made[3] = replace(made[3], **{name: getattr(made[3], name)[:6] for name in ("hand", "pose", "force", "time")})
    whole = groups.group(groups.grouped(log_of(made), 0), "whole")
    assert np.flatnonzero(~whole.about("valid")).tolist() == [1, 2, 3, 4]


def test_repetitions():
    """Each repetition of a fast push is matched with the nearest repetition of the slow one."""
    made = [recorded(k, 0.01) for k in range(10)]
    made += [recorded(0, 0.01, {"repetition": number}) for number in (1, 6)]
    made += [recorded(0, 0.02, {"repetition": number}) for number in (0, 3, 4, 9)]
    log = groups.grouped(log_of(made), 0)
    rows = groups._repeat_rows(groups.group(log, "fast"), groups.group(log, "whole"))
    assert rows.tolist() == [[0, 0], [1, 10], [2, 11], [3, 11]]


@pytest.fixture(scope="module")
def logs(converted):
    if not (converted / "mit_push").is_dir():
        pytest.skip("no mit_push")
    each = [(surface, name) for surface in table1.SURFACES for name in table1.OBJECTS]
    return {key: groups.load(converted, *key) for key in each}


def test_real_archives(logs):
    """All pushes of every object are loaded, with the errors of the original program as in its authors' data."""
    assert sum(len(group(log, "whole")) for log in logs.values()) == 5726
    assert sum(len(group(log, "fast")) for log in logs.values()) == 2214
    for log in logs.values():
        whole, middle = group(log, "whole"), group(log, "middle")
        travel = np.linalg.norm(np.diff(groups.tips(middle), axis=1), axis=2)
        assert np.all((travel > 0.04) & (travel < 0.047))
        tested = np.isin(whole.about("action"), middle.about("action"))
        assert not whole.about("training")[tested].any()
        assert np.all(np.abs(whole.end[:, 2] - whole.start[:, 2]) <= np.pi)
    for surface, expected in TOOLBOX_MM.items():
        tests = [group(logs[surface, name], "middle") for name in table1.OBJECTS]
        means = [
            deviation_mm(test.about("toolbox_quartic"), test.end, test.length).mean()
            for test in tests
            if test.object not in table1.NOT_IN_PAPER
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
        distance = jax.vmap(outline(log).signed_distance)(log.vertices)
        assert np.max(np.abs(distance)) < most
    assert not outline(logs["abs", "butter"]).convex
    for name in ("rect1", "tri2", "hex"):
        filled = outline(logs["abs", name])
        assert isinstance(filled, pj.Polygon)
        assert filled.convex
        assert filled.vertices.shape == (6, 2)
        inside, plain = filled.inset(0.003), pj.Polygon(logs["abs", name].vertices).inset(0.003)
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 2))
        np.testing.assert_allclose(
            jax.vmap(inside.signed_distance)(points), jax.vmap(plain.signed_distance)(points), atol=1e-12
        )


def test_noise_floor(logs):
    """Repetitions agree better than any model predicts, but they do differ."""
    for name in table1.OBJECTS:
        floor = noise_floor_mm(logs["abs", name])
        assert (floor is None) == (name in ("hex", "butter"))
        assert floor is None or 2 < floor < 8
        assert noise_floor_mm(logs["plywood", name]) is None


def test_padding(logs):
    """The path of the tip is straight, and pushes that only fill an array up have no weight."""
    training = groups.training_pushes(logs["abs", "tri1"])
    count, tips = len(training), groups.tips(training)
    pushes = padded(pj.Pushes.of(training, 10), 128)
    assert pushes.path.shape == (128, 11, 2)
    np.testing.assert_array_equal(pushes.weight, np.arange(128) < count)
    with pytest.raises(ValueError, match="batch must be at least 128; got 3"):
        padded(pushes, 3)
    np.testing.assert_allclose(pushes.path[:count, -1], tips[:, 1])
    np.testing.assert_allclose(pushes.path[3, 5], tips[3].mean(axis=0))


@pytest.mark.slow
def test_experiment(logs, converted, monkeypatch, tmp_path):
    """With ellipsoids for one object, results are as good as the paper's from forces, and no worse with calibration."""
    monkeypatch.setattr(table1, "MODELS", {"ellipsoid": 2})
    given = ["--surface", "abs", "--object", "rect1", "--steps", "30", "--data", str(converted)]
    cli.main(["reproduce", "table1", *given, "--out", str(tmp_path), "--json", str(tmp_path / "t.json")])
    record = json.loads((tmp_path / "t.json").read_text())
    forces, found = record["cells"]
    assert [cell["method"] for cell in record["cells"]] == ["wrench_twist", "identified"]
    for cell in record["cells"]:
        assert (cell["pushes"], cell["learned"], cell["failed_steps"]) == (196, 82, 0)
        assert cell["no_motion_mm"] == pytest.approx(
            table1.PAPER_NO_MOTION_MM["abs"][0] / 0.975, abs=0.4
        )  # the paper's window was a little shorter
        assert 0 < cell["friction"] < 0.5
        assert cell["noise_floor_mm"] < cell["mean_mm"] < 1.1 * cell["paper_mm"]
    assert found["mean_mm"] < forces["mean_mm"] + 0.1
    for name in ("wrench_twist", "identified"):
        assert (tmp_path / f"table1_{name}.png").stat().st_size > 5000
    assert not (tmp_path / "table1-cells.json").exists()


def test_an_interrupted_run_goes_on(logs, converted, monkeypatch, tmp_path):
    calls = []

    def guess(setting):
        calls.append(setting)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return Prediction(np.zeros((1, 196)), np.array(0.2), 0)

    monkeypatch.setattr(table1, "METHODS", {"identified": guess})
    monkeypatch.setattr(table1, "ConditionData", type("Nothing", (), {"of": staticmethod(lambda *given: given)}))
    monkeypatch.setattr(table1, "saved", lambda out, figures: [])
    choice = {"surface": ("abs",), "object": ("rect1",), "method": ("identified",), "out": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        table1.run(converted, **choice)
    assert len(json.loads((tmp_path / "table1-cells.json").read_text())["cells"]) == 1
    with pytest.raises(ValueError, match=r"table1-cells\.json is of a run with other settings"):
        table1.run(converted, steps=7, **choice)
    record = table1.run(converted, **choice)
    assert len(calls) == 3
    assert [cell["model"] for cell in record["cells"]] == ["quartic", "ellipsoid"]
    assert [path.name for path in tmp_path.iterdir()] == ["table1-cells.json"]  # until the results are written


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--object", "rect9"], "object must be one or more of rect1"),
        (["--surface", "delrin"], "expected files motion_surface=delrin_shape=rect1_"),
    ],
)
def test_bad_choices(arguments, message, capsys, tmp_path):
    with pytest.raises(ValueError, match=r"method must be one or more of wrench_twist, identified; got \['ideal'\]"):
        table1.run(tmp_path, method=("ideal",))
    with pytest.raises(SystemExit) as stop:
        cli.main(["reproduce", "table1", "--data", str(tmp_path), "--out", str(tmp_path), *arguments])
    assert stop.value.code == 1
    assert message in capsys.readouterr().err


def test_files_left_out_are_named(tmp_path, monkeypatch):
    problem = LogError(tmp_path / "a.json", "the tracker jumps")
    log = replace(log_of(recorded(k, 0.01) for k in range(12)), problems=(problem, problem))
    monkeypatch.setattr(groups, "load_mit_folder", lambda *given, **options: log)
    with pytest.warns(UserWarning, match=r"2 files of hex on delrin are left out, the first: .*a\.json.*tracker jumps"):
        assert len(groups.load(tmp_path, "delrin", "hex")) == 22


def test_folder_without_the_pushes(tmp_path):
    with pytest.raises(LogError, match="expected"):
        table1.run(tmp_path, surface=("abs",), object=("rect1",))
    with pytest.raises(ValueError, match="surface must be one or more of delrin, abs, plywood; got none"):
        table1.run(tmp_path, surface=())
