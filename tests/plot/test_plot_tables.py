"""Figures of tables, curves and many pushes show the given data."""

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt
from drawn import MM, RADIUS, SIDE, ends_of, in_world, legend, legible

import pushjax as pj
from benchmarks.peers.figure import speed_figure
from pushjax import plot
from pushjax.plot.style import curve_styles


@pytest.fixture(scope="module")
def block():
    return pj.Polygon.rectangle(SIDE, SIDE)


def cell(surface, name, model, mean, paper):
    named = {"surface": surface, "object": name, "model": model}
    return named | {"mean_mm": mean, "ci95_bootstrap_mm": 0.2, "paper_mm": paper}


def test_table_figure():
    cells = [cell("abs", "rect1", "quartic", 5.0, 6.0), cell("abs", "tri1", "quartic", 4.0, None)]
    cells += [cell("abs", "rect1", "ellipsoid", 5.5, 6.5), cell("abs", "tri1", "ellipsoid", 4.5, 5.5)]
    figure = plot.table_figure(cells, "Table")
    (axes,) = figure.axes
    figure.canvas.draw()
    assert axes.get_ylabel() == "mean deviation / mm"
    assert axes.get_title() == "Table"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["rect1", "tri1"]
    assert [text.get_text() for text in axes.texts] == ["abs"]
    assert sorted(legend(axes)) == ["ellipsoid, this run", "quartic, this run", "the paper"]
    assert [bar.get_height() for bar in axes.patches] == [5.0, 4.0, 5.5, 4.5]
    paper = [line.get_ydata() for line in axes.lines if line.get_marker() == "_" and line.get_markersize() == 13]
    np.testing.assert_array_equal(paper, [[6.0, np.nan], [6.5, 5.5]])
    hatched = [bar.get_hatch() is not None for bar in axes.patches]
    assert hatched == [False, False, True, True]  # so that they can be distinguished in grayscale


def cloud(n=40) -> np.ndarray:
    rng = np.random.default_rng(0)
    end = np.column_stack([0.03 + 0.002 * rng.normal(size=(n, 2)), rng.permutation(n) / n])
    return np.linspace(0, 1, 5)[None, :, None] * end[:, None]


def test_cloud_figure(block):
    ways = cloud()
    path = np.linspace([-0.04, 0.0], [0.0, 0.0], 5)
    figure = plot.cloud_figure(block, pj.Hand.finger(RADIUS), path, ways, "40 pushes")
    legible(figure)
    (axes,) = figure.axes
    assert axes.get_title() == "40 pushes"
    assert legend(figure) == ["paths of the centroid", "start", "end, 2.5 and 97.5 % of θ", "median end"]
    np.testing.assert_allclose(axes.collections[0].get_segments(), MM * ways[..., :2], atol=1e-9)
    many = np.repeat(ways, 6, axis=0)
    crowded, bar = plot.cloud_figure(block, pj.Hand.finger(RADIUS), path, many, "240 pushes").axes
    counts = crowded.collections[0].get_array()
    assert bar.get_ylabel() == "paths of the centroid / (1/mm²)"
    assert counts.max() == 240  # where all begin
    assert counts.min() % 6 == 0  # each way is there six times
    order = np.argsort(ways[:, -1, 2])
    drawn = [line for line in axes.lines if line.get_color() == plot.RED]
    for line, place in zip(drawn, (1, 20, 38), strict=True):
        np.testing.assert_allclose(line.get_xydata(), in_world(ways[order[place], -1]), atol=1e-9)
    assert [line.get_linestyle() for line in drawn] == [":", "-", ":"]
    assert [circle.center[0] for circle in axes.patches] == [-40, 0]


def test_capture_figure(block):
    ways = cloud() + np.linspace(0, 0.02, 40)[:, None, None] * np.array([0, 1, 0])
    wanted = np.arange(40) % 3 == 0
    path = np.linspace([0, -0.04, 0, 0.08], [0, 0.0, 0, 0.08], 5)
    x, y = np.meshgrid(np.linspace(-0.01, 0.01, 6), np.linspace(0, 0.02, 6))
    density = ((x, y), np.exp(-((x / 0.005) ** 2)))
    runs = {"few": (ways, wanted), "more": (ways, ~wanted)}
    figure = plot.capture_figure(block, pj.Hand.two_fingers(RADIUS), path, runs, density, max_paths=10)
    figure.canvas.draw()
    few, more, heat, bar = figure.axes
    assert [axes.get_title() for axes in (few, more, heat)] == ["few", "more", "start positions, more"]
    assert legend(figure) == ["end as wanted", "do not"]
    assert [axes.get_xlabel() for axes in (few, more, heat)] == ["x / mm"] * 3
    assert bar.get_ylabel() == "density / (1/mm²)"
    caught, missed = few.collections[:2]
    np.testing.assert_allclose(caught.get_segments(), MM * ways[:10][wanted[:10], :, :2])
    np.testing.assert_allclose(missed.get_segments(), MM * ways[:10][~wanted[:10], :, :2])
    assert len(few.patches) == 4  # two fingers at both ends
    (outside,) = ends_of(heat, plot.BLACK)
    np.testing.assert_allclose(outside, MM * ways[wanted, 0, :2])
    alone = plot.capture_figure(block, pj.Hand.two_fingers(RADIUS), path, {"none": (ways, np.zeros(40, bool))})
    assert len(alone.axes) == 1
    assert not ends_of(alone.axes[0], plot.BLUE)  # no slider was caught


def test_panels():
    axes = plt.figure().subplots(1, 4)
    poses = np.array([[0.01, 0.02, np.pi / 2], [0.0, 0.0, 0.0]])
    plot.pose_panel(axes[0], poses, plot.BLUE, "here")
    np.testing.assert_allclose(axes[0].lines[0].get_xydata(), [[10, 20], [0, 0]])
    (ticks,) = axes[0].collections
    np.testing.assert_allclose(np.diff(ticks.get_segments(), axis=1)[:, 0], [[0, 1.6], [1.6, 0]], atol=1e-9)
    counts = {"edges": np.array([0.0, 1, 2]), "counts": np.array([3, 5])}
    plot.histogram_panel(axes[1], counts, "x / mm", gaussian=(1.0, 0.5))
    np.testing.assert_array_equal(axes[1].patches[0].get_data().values, [3, 5])
    x, height = axes[1].lines[0].get_xydata().T
    assert np.trapezoid(height, x) == pytest.approx(8, rel=0.06)  # 95 %: two deviations to each side
    plot.histogram_panel(axes[2], counts, "x / mm", gaussian=(1.0, 0.0))
    assert not axes[2].lines
    numbers = np.array([[0.1, 0.2, 0.3], [1.5, 2.0, np.nan]])
    plot.histogram_panel(axes[2], numbers, "x / mm", bins=2)
    np.testing.assert_array_equal(axes[2].patches[-1].get_data().values, [3, 2])
    plot.traces(axes[3], np.zeros((2, 3, 3)) + np.arange(3)[None, :, None], plot.GREEN)
    np.testing.assert_allclose(axes[3].collections[0].get_segments(), 2 * [MM * np.arange(3)[:, None] * np.ones(2)])
    assert axes[3].get_xlim()[1] >= 2 * MM


def test_speed_figure():
    figure = speed_figure({"a": [(2e-6, 0.01), (1e-6, 0.1)], "b": [(1e-3, 0.2)]}, 0.1)
    legible(figure)
    (axes,) = figure.axes
    assert [line.get_marker() for line in axes.lines[:2]] == ["o", "s"]
    np.testing.assert_allclose(axes.lines[2].get_xdata(), 0.1)
    assert axes.get_xscale() == axes.get_yscale() == "log"


def test_no_more_curves_than_can_be_told_apart():
    with pytest.raises(ValueError, match="at most 6 curves can be told apart; got 7: a, b"):
        speed_figure({name: [(1e-6, 0.1)] for name in "abcdefg"}, 0.1)
    seen = [tuple(map(str, look.values())) for _, _, look in curve_styles(dict.fromkeys("abcdef", 0))]
    for column in zip(*seen, strict=True):
        assert len(set(column)) == 6


def test_a_model_looks_the_same_in_every_picture():
    one, other = curve_styles({"quartic": 0, "ellipsoid": 0}), curve_styles({"ellipsoid": 0, "quartic": 0})
    assert one == other[::-1]
    assert curve_styles({"ellipsoid": 0})[0][2] == one[1][2]
    assert (
        curve_styles({"a": 0})[0][2] == curve_styles({"ellipsoid": 0, "a": 0})[0][2] == one[0][2]
    )  # other names: in order
