"""Studies of the robot's pushes of table 1, on a part of the data."""

import functools
import json

import numpy as np
import pytest
from drawn import legend, legible
from scipy.stats import norm
from test_table1 import logs as logs

import pushjax as pj
from benchmarks.__main__ import main as run
from benchmarks.robot import causes, gaussian_process, spread
from benchmarks.robot.figures import causes_figure, spread_figure
from benchmarks.robot.predicted import Scored, density_ratio, effective, reach, scored
from pushjax.datasets.mit_pushes import StraightPushes
from pushjax.experiments.table1 import methods


@pytest.mark.long
def test_causes(logs, data, monkeypatch, tmp_path):
    """For one object with ellipsoids, the true tip position matters, and it also explains an initial overlap."""
    monkeypatch.setattr(methods, "MODELS", {"quartic": 2})
    some = {name: causes.CAUSES[name] for name in ("tip offset", "initial overlap")}
    monkeypatch.setattr(causes, "CAUSES", some)
    monkeypatch.setattr(causes, "CALIBRATION", ("tip offset",))
    given = ["--surface", "abs", "--object", "rect1", "--steps", "20", "--data", str(data), "--out", str(tmp_path)]
    run(["table1_causes", *given, "--json", str(tmp_path / "causes.json")])
    record = json.loads((tmp_path / "causes.json").read_text())
    names = ["nothing", "calibration", "tip offset", "initial overlap", "calibration + initial overlap"]
    assert [cell["run"] for cell in record["cells"]] == names
    shares = record["shares"]
    assert shares["nothing"]["change_mm"] == 0
    assert shares["tip offset"] == shares["calibration"]
    assert shares["calibration"]["change_mm"] < -shares["calibration"]["ci95_mm"] < 0
    assert shares["initial overlap"]["change_mm"] < 0
    assert abs(shares["calibration + initial overlap"]["change_mm"]) < 0.1
    found = record["cells"][1]
    assert len(found["each_mm"]) == 196
    assert 0.5e-3 < np.linalg.norm(found["found"]["hand_offset"]) < 2e-3
    assert record["cells"][3]["found"]["overlap"] == 1
    assert record["surfaces"]["abs"]["noise"] < record["surfaces"]["abs"]["calibration"]
    assert (tmp_path / "table1_causes.png").stat().st_size > 5000
    assert not (tmp_path / "table1-causes-cells.json").exists()


@pytest.mark.long
def test_spread(logs, data, monkeypatch, tmp_path):
    """For one object with ellipsoids, noise is better than normal errors, and far better than data alone."""
    monkeypatch.setattr(methods, "MODELS", {"quartic": 2})
    monkeypatch.setattr(spread, "COUNTS", (20,))
    monkeypatch.setattr(spread, "DRAWS", 60)
    monkeypatch.setattr(spread, "FINE_FOLDS", spread.FOLDS)  # one program for both
    monkeypatch.setattr(spread, "FINE_FOLD", spread.FOLD)
    monkeypatch.setattr(pj, "identify_noise", functools.partial(pj.identify_noise, steps=20, samples=8))
    given = ["--surface", "abs", "--object", "rect1", "--steps", "15", "--data", str(data), "--out", str(tmp_path)]
    run(["table1_spread", *given, "--json", str(tmp_path / "spread.json")])
    record = json.loads((tmp_path / "spread.json").read_text())
    for group, methods_there in (
        ("middle", ["noise", "calibrated", "normal"]),
        ("whole", ["noise", "calibrated", "normal", "process"]),
    ):
        pooled = record["pooled"][group]
        assert list(pooled) == methods_there
        for row in pooled.values():
            assert row["pushes"] == 196
            assert 0 <= row["inside_50"] < row["inside_90"] <= 1
        # the same samples, with regions that are not too wide in the center
        assert pooled["calibrated"]["energy_mm"] == pooled["noise"]["energy_mm"]
        assert abs(pooled["calibrated"]["inside_50"] - 0.5) < 0.12
        assert pooled["noise"]["error_50"] == pytest.approx(0.5 / np.sqrt(196))
        both = 1 / 196 + 1 / pooled["calibrated"]["levels_of"]
        assert pooled["calibrated"]["error_50"] == pytest.approx(0.5 * np.sqrt(both))
        energy, error = pooled["normal"]["noise_less_energy_mm"]
        assert energy < -2 * error
        density, error = pooled["normal"]["noise_less_log_density"]
        assert density > 2 * error
    assert record["pooled"]["whole"]["process"]["noise_less_energy_mm"][0] < -1
    (row,) = record["curve"]
    assert row["physics_mm"] < row["process_mm"] / 2
    assert (tmp_path / "table1_spread.png").stat().st_size > 5000


def test_calibrated_levels_hold_their_share():
    """Errors half as wide as predicted lie inside too often; calibrated regions contain the stated fraction."""
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(1, 400, 3)) * np.array([1e-3, 1e-3, 0.02])
    ends = 0.5 * rng.normal(size=(400, 3)) * np.array([1e-3, 1e-3, 0.02])
    each = scored(np.broadcast_to(draws, (400, 400, 3)), ends, 0.05)
    np.testing.assert_array_equal(each.inside, each.level[:, None] <= np.array([0.5, 0.9]))
    seen, rest = each._replace(level=each.level[:200]), Scored(*(part[200:] for part in each))
    assert rest.inside[:, 0].mean() > 0.85
    shares = rest.calibrated(seen.level).inside.mean(axis=0)
    assert np.all(np.abs(shares - [0.5, 0.9]) < 3 * np.sqrt([0.25 / 100, 0.09 / 100]))
    # the same in the mean over repetitions with few pushes
    repeats, few = 2000, 19
    shares = []
    for levels in rng.uniform(size=(repeats, 2 * few)):
        some = Scored(*(part[:few] for part in each))._replace(level=levels[:few])
        shares.append(some.calibrated(levels[few:]).inside.mean(axis=0))
    error = np.sqrt(2 * np.array([0.25, 0.09]) / (repeats * few))
    assert np.all(np.abs(np.mean(shares, axis=0) - [0.5, 0.9]) < 4 * error)
    # of five levels, the largest contains five sixths of new observations: only the region of level 1 contains nine
    # tenths
    some = Scored(*(part[:few] for part in each))._replace(level=np.linspace(0, 1, few))
    assert some.calibrated(rng.uniform(size=5)).inside[:, 1].all()
    assert not some.calibrated(np.full(9, 0.5)).inside[:, 1].all()


def test_levels_of_pushes_of_other_reach():
    """Calibration corrects for pushes that go farther than the held-out ones.

    Pushes that go far are predicted better here, so levels of pushes that go less far contain too much unless these are
    weighted. The test weights them by the true density ratio and by the estimated one, which is near it.
    """
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(0)
    count = 4000

    def drawn(middle):  # logarithm of translation and rotation, and a level that falls with the translation
        features = rng.normal(size=(count, 2)) * 0.6 + [middle, 1.0]
        return np.expm1(features), features[:, 0], rng.uniform(size=count) ** np.exp(features[:, 0] - 2)

    (far, x, seen), (further, y, level) = drawn(2.0), drawn(2.5)
    blank = np.zeros(count)
    some = Scored(blank, blank, level, blank)
    plain = some.calibrated(seen).inside.mean(axis=0)
    assert np.all(plain - [0.5, 0.9] > [0.1, 0.02])
    true = tuple(np.exp(0.5 * (z - 2.25) / 0.36) for z in (x, y))  # ratio of normal densities
    ratio = density_ratio(far, further)
    for mine, exact in zip(ratio, true, strict=True):
        assert np.median(np.abs(np.log(mine / exact))) < 0.1
    for weights in (true, ratio):
        error = np.sqrt([0.25, 0.09]) * np.sqrt(1 / count + 1 / effective(weights[0]))
        assert np.all(np.abs(some.calibrated(seen, weights).inside.mean(axis=0) - [0.5, 0.9]) < 3 * error)
    equal = np.full(count, 3.0)
    assert effective(equal) == count
    np.testing.assert_array_equal(some.calibrated(seen, (equal, equal)).inside, some.calibrated(seen).inside)


def test_reach_of_draws():
    start = np.array([[1.0, 2.0, 0.5]])
    moves = np.array([[3e-3, 4e-3, -0.1], [3e-3, 4e-3, 0.3], [0.0, 1.0, 0.2]])
    np.testing.assert_allclose(reach(start[:, None] + moves, start, 0.05), [[5.0, 10.0]])


def test_gaussian_process():
    """On a law that it can learn, means and densities are right, and samples have the stated spread."""
    rng = np.random.default_rng(0)
    n, length = 60, 0.05
    start = np.column_stack([rng.uniform(-0.2, 0.2, (n, 2)), rng.uniform(-3, 3, n)])
    place, way = rng.uniform(-0.05, 0.05, n), rng.uniform(-0.3, 0.3, n)
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])

    def world(x, y):
        return np.stack([c * x - s * y, s * x + c * y], axis=1)

    tip = start[:, :2] + world(np.full(n, -0.05), place)
    direction = world(np.cos(way), np.sin(way))
    end = start + np.column_stack([0.04 * direction, -8 * place]) + 1e-4 * rng.normal(size=(n, 3)) / [1, 1, length]
    none = np.zeros(n, bool)
    pushes = StraightPushes(np.arange(n), start, end, tip, tip + 0.05 * direction, ~none, {})
    learned = gaussian_process.learn(pushes, np.arange(40), length)
    tests = np.arange(40, n)
    found = gaussian_process.predict(learned, pushes, tests)
    assert 1e3 * np.mean(np.asarray(pj.deviation(found.poses(), end[tests], length))) < 0.5
    assert found.mean.shape == found.deviation.shape == (20, 3)
    np.testing.assert_allclose(found.mean[:, 0], 0.04, atol=1e-3)
    at_mean = norm.logpdf(0, scale=found.deviation).sum(axis=1)
    np.testing.assert_allclose(found.log_density(found.poses()), at_mean, atol=1e-6)
    draws = found.draws(np.random.default_rng(1), 4000)
    assert draws.shape == (20, 4000, 3)
    np.testing.assert_allclose(length * draws[..., 2].std(axis=1), found.deviation[:, 2], rtol=0.1)


def test_pictures():
    """Every bar and curve is drawn, with its label and unit."""
    change = {"change_mm": -0.3, "ci95_mm": 0.1}
    surfaces = {"abs": {"nothing": 5.8, "calibration": 5.3, "noise": None}}
    left, right = causes_figure({"tip offset": change, "drift": change}, {"drift": change}, surfaces).axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["tip offset", "drift"]
    assert [text.get_text() for text in left.get_legend().get_texts()] == ["alone", "beside the calibration"]
    assert "mm" in left.get_xlabel()
    assert sorted(text.get_text() for text in right.texts) == ["5.30", "5.80"]
    shares = {"inside_50": 0.6, "inside_90": 0.9}
    curve = [{"count": n, "physics_mm": 5.0, "process_mm": 30.0 - n} for n in (10, 20)]
    left, right = spread_figure({"middle": {"noise": shares, "normal": shares}}, curve).axes
    labels = [text.get_text() for text in left.get_legend().get_texts()]
    assert labels == ["as it should be", "identified noise, middle", "normal errors, middle"]
    np.testing.assert_array_equal(left.lines[1].get_ydata(), [0, 60, 90, 100])
    np.testing.assert_array_equal(right.lines[1].get_ydata(), [20, 10])
    assert "mm" in right.get_ylabel()


def test_spread_figure():
    shares = {"inside_50": 0.6, "inside_90": 0.9}
    curve = [{"count": n, "physics_mm": 5.0, "process_mm": 30.0 - n} for n in (10, 20)]
    figure = spread_figure({"whole": {"noise": shares, "process": shares}}, curve)
    legible(figure)
    left, right = figure.axes
    assert legend(left) == ["as it should be", "identified noise, whole", "Gaussian process, whole"]
    assert legend(right) == ["physics", "Gaussian process"]
    assert [text.get_text() for text in right.get_xticklabels()] == ["10", "20"]
    assert len({(line.get_color(), line.get_marker()) for line in left.lines}) == 3
    assert spread_figure({}, []).axes[1].get_ylabel() == "mean deviation / mm"


def test_causes_figure():
    change = {"change_mm": -0.3, "ci95_mm": 0.1}
    figure = causes_figure({"tip": change, "drift": change}, {}, {"abs": {"nothing": 5, "calibration": 4, "noise": 3}})
    left, right = figure.axes
    figure.canvas.draw()
    assert [bar.get_width() for bar in left.patches] == [-0.3, -0.3]
    assert legend(left) == ["alone"]
    assert legend(right) == ["no cause", "calibrated", "repetitions"]
    assert [bar.get_height() for bar in right.patches] == [5, 4, 3]
