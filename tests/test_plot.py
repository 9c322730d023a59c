"""Pictures: what is drawn is what was given, with a unit on every axis and a legend that names it. Not their pixels."""

import itertools
import re

import equinox as eqx
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle
from mpl_toolkits.mplot3d import Axes3D

mpl.use("Agg")

import matplotlib.pyplot as plt

import pushjax as pj
from pushjax import plot
from pushjax.plot.style import SERIES, looks

SIDE, RADIUS, LENGTH = 0.06, 0.005, 0.024
MM = 1e3
BARE = re.compile(r" / |^count$|^pushes learned from$")  # an axis names its unit, or what it counts
SMALLEST = 7  # pt
# Severe protanopia, deuteranopia and tritanopia on linear RGB (Machado, Oliveira & Fernandes 2009)
BLIND = (
    ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
)


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def block():
    return pj.Polygon.rectangle(SIDE, SIDE)


@pytest.fixture(scope="module")
def surface():
    return pj.Ellipsoid(jnp.eye(3), LENGTH)


def slid(steps: int = 6, turn: float = 0.4, dof: int = 2) -> pj.Trajectory:
    """A push along x that turns, with a hand that follows; made by hand, nothing is compiled."""
    t = np.linspace(0, 1, steps + 1)[:, None]
    pose = np.array([0.0, 0.001, 0.1]) + t * np.array([0.03, -0.005, turn])
    configuration = np.concatenate([pose[:, :2] - [SIDE / 2 + RADIUS, 0], np.zeros((steps + 1, dof - 2))], axis=1)
    if dof == 4:
        configuration[:, 3] = SIDE + 0.004
    return pj.Trajectory(
        pose=jnp.asarray(pose),
        configuration=jnp.asarray(configuration),
        twist=jnp.zeros((steps, 3)),
        wrench=jnp.tile(jnp.array([1.0, 0, 0]), (steps, 1)),
        force=jnp.tile(jnp.array([[1.0, 0.0]]), (steps, 1, 1)),
        mode=jnp.full((steps, 1), pj.ContactMode.STICKING, jnp.int8),
        status=jnp.zeros(steps, jnp.int8),
    )


def in_world(pose, side=SIDE) -> np.ndarray:
    """The corners of a square at a pose, mm, closed."""
    corners = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return MM * (corners @ np.array([[c, s], [-s, c]]) + np.asarray(pose)[:2])


def legend(figure_or_axes) -> list[str]:
    """Entries of an axes' legend, or of all legends of a figure."""
    of = getattr(figure_or_axes, "legends", None)
    found = [figure_or_axes.get_legend()] if of is None else of
    return [text.get_text() for each in found for text in each.get_texts()]


def legible(figure) -> None:
    """A unit on every axis, nothing too small; and it draws."""
    figure.canvas.draw()
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert BARE.search(label), f"no unit: {label!r}"
        sizes = [text.get_fontsize() for text in axes.texts] + [axes.title.get_fontsize()]
        sizes += [text.get_fontsize() for text in axes.get_xticklabels() + axes.get_yticklabels()]
        assert min(sizes) >= SMALLEST


def ends_of(axes, color) -> list[np.ndarray]:
    """The data of all lines of a colour."""
    return [line.get_xydata() for line in axes.lines if line.get_color() == color and len(line.get_xydata())]


def test_push_figure(block):
    push = slid(steps=12)
    path = np.asarray(push.configuration)
    figure = plot.push_figure(block, {"one": (push, path), "two": (slid(turn=-0.2), path)}, RADIUS, frames=3)
    legible(figure)
    assert [axes.get_title() for axes in figure.axes] == ["one", "two"]
    assert legend(figure) == ["centre of the slider", "start", "between", "end"]
    axes = figure.axes[0]
    for color, k in ((plot.START, 0), (plot.END, -1)):
        np.testing.assert_allclose(ends_of(axes, color)[0], in_world(push.pose[k]), atol=1e-9)
    assert len(ends_of(axes, plot.BETWEEN)) == 3
    np.testing.assert_allclose(ends_of(axes, plot.BLUE)[0], MM * np.asarray(push.pose[:, :2]), atol=1e-9)
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert len(circles) == 5
    assert {circle.radius for circle in circles} == {MM * RADIUS}
    np.testing.assert_allclose(circles[-1].center, MM * path[-1])
    assert axes.get_aspect() == 1


def test_grasp_figure(block):
    """Pads as outlines, round fingers as circles; the last moment is the last in which the slider moves."""
    grasp = slid(dof=4)
    rest = jnp.concatenate([grasp.pose, jnp.repeat(grasp.pose[-1:], 20, axis=0)])
    held = jnp.concatenate([grasp.configuration, jnp.repeat(grasp.configuration[-1:], 20, axis=0)])
    grasp = eqx.tree_at(lambda push: (push.pose, push.configuration), grasp, (rest, held))
    jaw = pj.Hand.parallel_jaw(0.02, 0.01)
    figure = plot.grasp_figure(block, jaw, {"held: askew": grasp}, frames=2)
    legible(figure)
    axes = figure.axes[0]
    assert axes.get_title() == "held:\naskew"
    assert legend(figure) == ["centre of the slider", "start", "between", "end"]
    drawn = ends_of(axes, plot.END)
    np.testing.assert_allclose(drawn[0], in_world(grasp.pose[6]), atol=1e-9)
    assert [len(line) for line in drawn[:3]] == [5, 5, 5]  # slider and two pads
    upper, lower = drawn[1], drawn[2]
    x, y, _, opening = MM * np.asarray(grasp.configuration[6])
    assert upper[:, 1].min() == pytest.approx(y + opening / 2, abs=1e-3)
    assert lower[:, 1].max() == pytest.approx(y - opening / 2, abs=1e-3)
    assert upper[:, 0].mean() == pytest.approx(x, abs=3)
    fingers = plot.grasp_figure(block, pj.Hand.two_fingers(RADIUS), {"a": grasp, "b": grasp}).axes[0]
    assert {patch.radius for patch in fingers.patches} == {MM * RADIUS}
    assert len(fingers.patches) == 2 * 6


def test_outline_of_a_smooth_shape():
    """Drawn where it is: a disk's outline is a circle about its centre, moved by the pose."""
    axes = plt.figure().add_subplot()
    plot.outline(axes, pj.Disk(0.01, (0.002, 0.0)), np.array([0.01, 0.02, np.pi / 2]), plot.BLUE, 1.0, linestyle=":")
    (line,) = axes.lines
    away = np.linalg.norm(np.asarray(line.get_xydata()) - [10, 22], axis=1)
    np.testing.assert_allclose(away, 10, atol=1e-3)
    np.testing.assert_allclose(line.get_xydata()[0], line.get_xydata()[-1])
    assert line.get_linestyle() == ":"


def test_real_figure(block):
    start, end, predicted = np.zeros(3), np.array([0.02, 0.0, 0.3]), np.array([0.021, 0.001, 0.25])
    path = np.array([[-0.035, 0.0], [-0.015, 0.0]])
    draws = predicted + 1e-3 * np.random.default_rng(0).normal(size=(30, 3))
    pushes = {"median: 1.2 mm": plot.RealPush(start, end, predicted, path), "cloud": plot.RealPush(start, end, draws)}
    figure = plot.real_figure(block, pushes, pj.Hand.finger(RADIUS))
    legible(figure)
    left, right = figure.axes
    assert [axes.get_title() for axes in figure.axes] == list(pushes)
    assert legend(figure) == ["start", "measured end", "predicted end", "fingers' paths"]
    for color, pose in ((plot.BETWEEN, start), (plot.START, end), (plot.BLUE, predicted)):
        np.testing.assert_allclose(ends_of(left, color)[0], in_world(pose), atol=1e-9)
    np.testing.assert_allclose(ends_of(left, plot.ORANGE)[0], MM * path)
    (circle,) = left.patches
    assert circle.center == pytest.approx(MM * path[-1])
    (cloud,) = [each for each in right.collections if isinstance(each, LineCollection)]
    np.testing.assert_allclose(cloud.get_segments(), [in_world(pose) for pose in draws], atol=1e-9)
    assert right.get_legend_handles_labels()[1] == ["start", "measured end", "predicted ends"]


def test_limit_surfaces(surface, monkeypatch):
    """The cuts lie on the level set, the arrows start at wrenches of pairs and point along their twists."""
    drawn = []
    monkeypatch.setattr(Axes3D, "quiver", lambda self, *arrow, **look: drawn.append(arrow))
    rng = np.random.default_rng(0)
    ray = rng.normal(size=(200, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    load = 2.0
    wide = pj.Ellipsoid(jnp.eye(3) / load**2, LENGTH)  # a ball of the load
    size = np.array([1, 1, LENGTH])
    pairs = pj.WrenchTwistPairs(load * ray * size, ray / size, jnp.asarray(LENGTH))
    figure = plot.limit_surfaces({"ball": wide, "small": surface}, pairs, load, arrows=7)
    ball, small, torque, force = figure.axes
    figure.canvas.draw()
    for axes in (ball, small):
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("$f_x$ / load", "$f_y$ / load")
        assert axes.get_zlabel() == r"$\tau$ / (length · load)"
    assert [axes.get_title() for axes in (ball, small)] == ["ball", "small"]
    assert legend(torque) == ["ball", "small", "pairs nearby"]
    assert torque.get_ylabel() == ball.get_zlabel()
    assert force.get_ylabel() == ball.get_ylabel()
    for axes in (torque, force):
        for line, radius in zip(axes.lines, (1.0, 1 / load), strict=False):
            np.testing.assert_allclose(np.linalg.norm(line.get_xydata(), axis=1), radius, rtol=1e-6)
        other = 1 if axes is torque else 2
        near = ray[np.abs(ray[:, other]) < 0.06]
        np.testing.assert_allclose(axes.lines[-1].get_xydata(), np.delete(near, other, axis=1), atol=1e-9)
    tails, along = (np.array(part).T for part in (drawn[0][:3], drawn[0][3:]))
    assert tails.shape == (7, 3)
    assert all(np.min(np.linalg.norm(ray - tail, axis=1)) < 1e-9 for tail in tails)
    np.testing.assert_allclose(along / np.linalg.norm(along, axis=1, keepdims=True), tails, atol=1e-9)
    apart = np.linalg.norm(tails[:, None] - tails[None], axis=-1) + 9 * np.eye(7)
    assert apart.min() > 0.4  # spread over the side that is seen
    plot.limit_surfaces({"ball": wide}, pairs, load, arrows=0)
    assert not np.size(drawn[-1][0])


def one_contact(surface, friction=0.5):
    point, normal = jnp.array([[-SIDE / 2, 0.01]]), jnp.array([[1.0, 0.0]])
    contacts = pj.Contacts(point, normal, jnp.array([[1e-3, 2e-4]]), friction)
    zero = jnp.zeros((1, 2))
    return contacts, pj.Motion(
        jnp.array([1e-3, 2e-4, 0.02]), jnp.zeros(3), zero, zero[:, 0], jnp.int8(0), jnp.inf, jnp.array(True)
    )


def test_motion_cone_figure(block, surface):
    """The friction cone opens by twice atan mu about the normal; both cones start at the contact."""
    support = pj.Support.uniform(block, points=4)
    contacts, motion = one_contact(surface)
    figure = plot.motion_cone_figure(block, support, surface, contacts, motion)
    legible(figure)
    (axes,) = figure.axes
    assert legend(axes) == ["support points", "friction cone", "motion cone", "push", "centre of rotation"]
    np.testing.assert_allclose(axes.lines[1].get_xydata(), MM * np.asarray(support.point), atol=1e-5)
    at = MM * np.asarray(contacts.point[0])
    for color, edges in (
        (plot.GREEN, pj.friction_cone(contacts.normal[0], 0.5)),
        (plot.BLUE, pj.motion_cone(surface, contacts.point[0], contacts.normal[0], 0.5)),
    ):
        drawn = np.array([line for line in ends_of(axes, color) if len(line) == 2])
        np.testing.assert_allclose(drawn[:, 0], [at, at], atol=1e-5)
        along = drawn[:, 1] - drawn[:, 0]
        np.testing.assert_allclose(along / np.linalg.norm(along, axis=1, keepdims=True), np.asarray(edges), atol=1e-5)
    arrow = next(text for text in axes.texts if text.arrow_patch is not None)
    np.testing.assert_allclose(arrow.xy, at, atol=1e-5)
    along, push = np.subtract(arrow.xy, arrow.xyann), np.asarray(contacts.displacement[0])
    assert along[0] * push[1] - along[1] * push[0] == pytest.approx(0, abs=1e-9)
    center = next(line.get_xydata()[0] for line in axes.lines if line.get_markeredgecolor() == plot.PURPLE)
    np.testing.assert_allclose(center, [-10, 50], atol=1e-5)
    assert "+" in [text.get_text() for text in axes.texts]
    left, right = axes.get_xlim()
    assert left < arrow.xyann[0] < right


def test_jam_figure(block):
    """The region of allowed centres is where a turn moves both contacts away from their fingers."""
    point, normal = jnp.array([[-0.03, -0.012], [0.03, 0.012]]), jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    contacts = pj.Contacts(point, normal, 1e-3 * normal, 0.4)
    zero = jnp.zeros((2, 2))
    still = pj.Motion(jnp.zeros(3), jnp.zeros(3), zero, zero[:, 0], jnp.int8(2), -1e-3, jnp.array(True))
    figure = plot.jam_figure(block, [(contacts, still)])
    legible(figure)
    (axes,) = figure.axes
    assert axes.get_title() == r"$\mu$ = 0.40: JAMMED"
    plus = "centre of rotation allowed, +"
    assert legend(figure) == [plus, "friction cone", "contact normal", "line through both contacts"]
    (band,) = axes.collections
    inside = band.get_paths()[0].get_extents()
    np.testing.assert_allclose([inside.y0, inside.y1], [-12, 12], atol=0.5)
    assert {"A", "C"} <= {text.get_text() for text in axes.texts}
    cone = np.array(ends_of(axes, plot.GREEN))
    slope = (cone[:, 1] - cone[:, 0])[:, 1] / (cone[:, 1] - cone[:, 0])[:, 0]
    np.testing.assert_allclose(np.abs(slope), 0.4)
    np.testing.assert_allclose(axes.lines[-4].get_xydata(), MM * np.asarray(point))


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
    assert hatched == [False, False, True, True]  # so that a greyscale print tells them apart


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
    assert legend(axes) == ["start", "end, 2.5 and 97.5 % of θ", "median end", "ways of the centre"]
    np.testing.assert_allclose(axes.collections[0].get_segments(), MM * ways[..., :2])
    order = np.argsort(ways[:, -1, 2])
    drawn = [line for line in axes.lines if line.get_color() == plot.END]
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
    figure = plot.capture_figure(block, pj.Hand.two_fingers(RADIUS), path, runs, density, ways=10)
    figure.canvas.draw()
    few, more, heat, bar = figure.axes
    assert [axes.get_title() for axes in (few, more, heat)] == ["few", "more", "start centres, more"]
    assert legend(figure) == ["end as wanted", "do not"]
    assert [axes.get_xlabel() for axes in (few, more, heat)] == ["x / mm"] * 3
    assert bar.get_ylabel() == "density / (1/mm²)"
    caught, missed = few.collections[:2]
    np.testing.assert_allclose(caught.get_segments(), MM * ways[:10][wanted[:10], :, :2])
    np.testing.assert_allclose(missed.get_segments(), MM * ways[:10][~wanted[:10], :, :2])
    assert len(few.patches) == 4  # two fingers at both ends
    (outside,) = ends_of(heat, plot.START)
    np.testing.assert_allclose(outside, MM * ways[wanted, 0, :2])
    alone = plot.capture_figure(block, pj.Hand.two_fingers(RADIUS), path, {"none": (ways, np.zeros(40, bool))})
    assert len(alone.axes) == 1
    assert not ends_of(alone.axes[0], plot.BLUE)  # none was caught


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
    assert np.trapezoid(height, x) == pytest.approx(8, rel=0.06)  # of a Gaussian two deviations wide, 95 %
    plot.histogram_panel(axes[2], counts, "x / mm", gaussian=(1.0, 0.0))
    assert not axes[2].lines
    plot.traces(axes[3], np.zeros((2, 3, 3)) + np.arange(3)[None, :, None], plot.GREEN)
    np.testing.assert_allclose(axes[3].collections[0].get_segments(), 2 * [MM * np.arange(3)[:, None] * np.ones(2)])
    assert axes[3].get_xlim()[1] >= 2 * MM


def test_spread_figure():
    shares = {"inside_50": 0.6, "inside_90": 0.9}
    curve = [{"count": n, "physics_mm": 5.0, "process_mm": 30.0 - n} for n in (10, 20)]
    figure = plot.spread_figure({"whole": {"noise": shares, "process": shares}}, curve)
    legible(figure)
    left, right = figure.axes
    assert legend(left) == ["as it should be", "identified noise, whole", "Gaussian process, whole"]
    assert legend(right) == ["physics", "Gaussian process"]
    assert [text.get_text() for text in right.get_xticklabels()] == ["10", "20"]
    assert len({(line.get_color(), line.get_marker()) for line in left.lines}) == 3
    assert plot.spread_figure({}, []).axes[1].get_ylabel() == "mean deviation / mm"


def test_causes_figure():
    change = {"change_mm": -0.3, "ci95_mm": 0.1}
    figure = plot.causes_figure(
        {"tip": change, "drift": change}, {}, {"abs": {"nothing": 5, "calibration": 4, "noise": 3}}
    )
    left, right = figure.axes
    figure.canvas.draw()
    assert [bar.get_width() for bar in left.patches] == [-0.3, -0.3]
    assert legend(left) == ["alone"]
    assert legend(right) == ["no cause", "calibrated", "repetitions"]
    assert [bar.get_height() for bar in right.patches] == [5, 4, 3]


def test_speed_figure():
    figure = plot.speed_figure({"a": [(2e-6, 0.01), (1e-6, 0.1)], "b": [(1e-3, 0.2)]}, 0.1)
    legible(figure)
    (axes,) = figure.axes
    assert [line.get_marker() for line in axes.lines[:2]] == ["o", "s"]
    np.testing.assert_allclose(axes.lines[2].get_xdata(), 0.1)
    assert axes.get_xscale() == axes.get_yscale() == "log"


def test_no_more_curves_than_can_be_told_apart():
    with pytest.raises(ValueError, match="at most 6 curves can be told apart; got 7: a, b"):
        plot.speed_figure({name: [(1e-6, 0.1)] for name in "abcdefg"}, 0.1)
    seen = [tuple(map(str, look.values())) for _, _, look in looks(dict.fromkeys("abcdef", 0))]
    for column in zip(*seen, strict=True):
        assert len(set(column)) == 6


def lab(linear: np.ndarray) -> np.ndarray:
    """CIE Lab under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ linear / [0.9505, 1, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def seen_by(color, eyes) -> np.ndarray:
    c = np.array(to_rgb(color))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return lab(np.clip(np.asarray(eyes) @ linear, 0, 1))


@pytest.mark.parametrize("eyes", [np.eye(3), *BLIND], ids=["full", "protan", "deutan", "tritan"])
def test_colors_can_be_told_apart(eyes):
    """Curves by 15, moments of a push by 40, where 2.3 is just noticeable."""
    for colors, least in (([color for color, _, _ in SERIES], 15), ((plot.START, plot.BETWEEN, plot.END), 40)):
        for a, b in itertools.combinations(colors, 2):
            assert np.linalg.norm(seen_by(a, eyes) - seen_by(b, eyes)) > least, (a, b)


def test_moments_in_greyscale():
    lightness = sorted(seen_by(color, np.eye(3))[0] for color in (plot.START, plot.END, plot.BETWEEN, "white"))
    assert np.diff(lightness).min() > 20


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_save(tmp_path, suffix, block):
    """In the folder it makes, at the resolution and with the letters of the style, also outside of its context."""
    figure = plot.push_figure(block, {"push": (slid(), np.zeros((7, 2)))}, RADIUS)
    path = plot.save(figure, tmp_path / "new" / f"push.{suffix}")
    start = path.read_bytes()[:300]
    assert {"png": b"PNG", "pdf": b"%PDF", "svg": b"<svg"}[suffix] in path.read_bytes()[:800], start
    assert not plt.fignum_exists(figure.number)
    if suffix == "png":
        width = plt.imread(path).shape[1]
        assert 3.5 * 160 < width < 5 * 160  # of about four inches
    if suffix == "svg":
        assert "centre of the slider" in path.read_text()  # text that stays text
