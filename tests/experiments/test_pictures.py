"""Pictures of experiments show the given data."""

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from drawn import MM, RADIUS, SIDE, ends_of, legend
from matplotlib.collections import LineCollection

import pushjax as pj
from pushjax.experiments.capture import MAX_DRAWN, capture_figure
from pushjax.experiments.tables import table_figure
from pushjax.plot.style import BLACK, BLUE, RED


def test_capture_figure(rng):
    block, hand = pj.Polygon.rectangle(SIDE, SIDE), pj.Hand.two_fingers(RADIUS)
    many = MAX_DRAWN + 40
    start, turn = 0.02 * rng.normal(size=(many, 2)), rng.normal(size=(many, 1))
    poses = np.concatenate([start, turn], axis=1)[:, None] + np.linspace(0, 0.02, 5)[None, :, None]
    converge = np.arange(many) % 3 == 0
    path = np.linspace([0, -0.04, 0, 0.08], [0, 0.0, 0, 0.08], 5)
    figure = capture_figure(block, hand, path, {"few": (poses, converge), "more": (poses, ~converge)})
    figure.canvas.draw()
    few, more, heat, bar = figure.axes
    assert [axes.get_title() for axes in (few, more, heat)] == ["few", "more", "start positions, more"]
    assert legend(figure) == ["end as wanted", "do not"]
    assert bar.get_ylabel() == "density / (1/mm²)"
    traces = [drawn for drawn in few.collections if isinstance(drawn, LineCollection)]
    for drawn, which in zip(traces, (converge[:MAX_DRAWN], ~converge[:MAX_DRAWN]), strict=True):
        np.testing.assert_allclose(drawn.get_segments(), MM * poses[:MAX_DRAWN][which, :, :2])
    assert len(few.patches) == 4  # two fingers at both ends
    for color, which in ((BLACK, converge), (RED, ~converge)):
        (points,) = ends_of(heat, color)
        np.testing.assert_allclose(points, MM * start[which])
    alone = capture_figure(block, hand, path, {"none": (poses, np.zeros(many, bool))})
    assert len(alone.axes) == 1
    assert not ends_of(alone.axes[0], BLUE)  # no slider was caught


def cell(name, model, mean, paper):
    named = {"surface": "abs", "object": name, "model": model}
    return named | {"mean_mm": mean, "ci95_bootstrap_mm": 0.2, "paper_mm": paper}


def test_table_figure():
    cells = [cell("rect1", "quartic", 5.0, 6.0), cell("tri1", "quartic", 4.0, None)]
    cells += [cell("rect1", "ellipsoid", 5.5, 6.5), cell("tri1", "ellipsoid", 4.5, 5.5)]
    figure = table_figure(cells, "Table")
    (axes,) = figure.axes
    figure.canvas.draw()
    assert (axes.get_ylabel(), axes.get_title()) == ("mean deviation / mm", "Table")
    assert [label.get_text() for label in axes.get_xticklabels()] == ["rect1", "tri1"]
    assert [text.get_text() for text in axes.texts] == ["abs"]
    assert sorted(legend(axes)) == ["ellipsoid, this run", "quartic, this run", "the paper"]
    assert [bar.get_height() for bar in axes.patches] == [5.0, 4.0, 5.5, 4.5]
    paper = [line.get_ydata() for line in axes.lines if line.get_marker() == "_" and line.get_markersize() == 13]
    np.testing.assert_array_equal(paper, [[6.0, np.nan], [6.5, 5.5]])
    hatched = [bar.get_hatch() is not None for bar in axes.patches]
    assert hatched == [False, False, True, True]  # so that they can be distinguished in grayscale
