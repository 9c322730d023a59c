"""Each figure shows the given data, with units on every axis and a legend. The pixels are not tested."""

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle
from mpl_toolkits.mplot3d import Axes3D

mpl.use("Agg")

import matplotlib.pyplot as plt
from drawn import MM, RADIUS, SIDE, ends_of, in_world, legend, legible
from pushes import trajectory

import pushjax as pj
from pushjax import plot
from pushjax.contact.problem import Motion
from pushjax.datasets import Recording
from pushjax.friction.support import WrenchTwistPairs
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, ORANGE, PURPLE, RED

LENGTH = 0.024
BLOCK, FINGER = pj.Polygon.rectangle(SIDE, SIDE), pj.Hand.finger(RADIUS)
SURFACE = pj.Ellipsoid(jnp.eye(3), LENGTH)


def slid(steps: int = 6, turn: float = 0.4, dof: int = 2) -> pj.Trajectory:
    """Return a push along x that rotates, with a hand that follows."""
    t = np.linspace(0, 1, steps + 1)[:, None]
    pose = np.array([0.0, 0.001, 0.1]) + t * np.array([0.03, -0.005, turn])
    configuration = np.concatenate([pose[:, :2] - [SIDE / 2 + RADIUS, 0], np.zeros((steps + 1, dof - 2))], axis=1)
    if dof == 4:
        configuration[:, 3] = SIDE + 0.004
    return trajectory(pose, configuration)


def test_push_figure():
    push = slid(steps=12)
    fixtures = (pj.Wall((0.08, 0.0), (-1.0, 0.0)), pj.Fixture(pj.Disk(0.01), (0.0, 0.2, 0.0)))
    figure = plot.push_figure(BLOCK, FINGER, {"one": push, "two": slid(turn=-0.2)}, frames=3, fixtures=fixtures)
    legible(plot.push_figure(BLOCK, FINGER, {"one": push}))
    assert [axes.get_title() for axes in figure.axes] == ["one", "two"]
    assert legend(figure) == ["centroid of the slider", "start", "between", "end"]
    axes = figure.axes[0]
    for color, k in ((BLACK, 0), (RED, -1)):
        np.testing.assert_allclose(ends_of(axes, color)[0], in_world(push.pose[k]), atol=1e-9)
    assert len(ends_of(axes, GRAY)) == 3
    np.testing.assert_allclose(ends_of(axes, BLUE)[0], MM * np.asarray(push.pose[:, :2]), atol=1e-9)
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert len(circles) == 5
    assert {circle.radius for circle in circles} == {MM * RADIUS}
    np.testing.assert_allclose(circles[-1].center, MM * np.asarray(push.configuration[-1]))
    assert axes.get_aspect() == 1
    assert axes.get_xlim()[1] < 200  # mm: the wall is drawn without extending the picture
    assert axes.get_ylim()[1] > 209  # mm: the disk is in it


def test_a_grasp_is_drawn_until_it_stands_still():
    """Pads are drawn as outlines, round fingers as circles; the last moment is the last in which the slider moves."""
    moving = slid(dof=4)
    held = (np.append(part, np.repeat(part[-1:], 20, axis=0), axis=0) for part in (moving.pose, moving.configuration))
    grasp = trajectory(*held)
    jaw = pj.Hand.parallel_jaw(0.02, 0.01)
    axes = plot.push_figure(BLOCK, jaw, {"held: askew": grasp}, frames=2).axes[0]
    assert axes.get_title() == "held:\naskew"
    slider, upper, lower = ends_of(axes, RED)[:3]
    np.testing.assert_allclose(slider, in_world(grasp.pose[6]), atol=1e-9)
    assert len(upper) == len(lower) == 5
    x, y, _, opening = MM * np.asarray(grasp.configuration[6])
    assert upper[:, 1].min() == pytest.approx(y + opening / 2, abs=1e-3)
    assert lower[:, 1].max() == pytest.approx(y - opening / 2, abs=1e-3)
    assert upper[:, 0].mean() == pytest.approx(x, abs=3)
    fingers = plot.push_figure(BLOCK, pj.Hand.two_fingers(RADIUS), {"a": grasp, "b": grasp}).axes[0]
    assert {patch.radius for patch in fingers.patches} == {MM * RADIUS}
    assert len(fingers.patches) == 2 * 6


def test_outline_of_a_smooth_shape():
    """The outline of a disk is a circle about its center, moved by the pose."""
    axes = plt.figure().add_subplot()
    plot.outline(axes, pj.Disk(0.01, (0.002, 0.0)), np.array([0.01, 0.02, np.pi / 2]), BLUE, 1.0, linestyle=":")
    (line,) = axes.lines
    np.testing.assert_allclose(np.linalg.norm(np.asarray(line.get_xydata()) - [10, 22], axis=1), 10, atol=1e-3)
    np.testing.assert_allclose(line.get_xydata()[0], line.get_xydata()[-1])
    assert line.get_linestyle() == ":"


def test_real_figure():
    measured, predicted = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.3]]), np.array([0.021, 0.001, 0.25])
    path = np.array([[-0.035, 0.0], [-0.02, 0.0], [-0.015, 0.0]])
    draws = predicted + 1e-3 * np.random.default_rng(0).normal(size=(30, 3))
    push = Recording(0, path, np.insert(measured, 1, np.nan, axis=0))
    figure = plot.real_figure(BLOCK, {"median: 1.2 mm": (push, predicted), "cloud": (push, draws)}, FINGER)
    legible(figure)
    left, right = figure.axes
    assert [axes.get_title() for axes in figure.axes] == ["median: 1.2 mm", "cloud"]
    assert legend(figure) == ["start", "measured end", "predicted end", "fingers' paths"]
    for color, pose in ((GRAY, measured[0]), (BLACK, measured[1]), (BLUE, predicted)):
        np.testing.assert_allclose(ends_of(left, color)[0], in_world(pose), atol=1e-9)
    np.testing.assert_allclose(ends_of(left, ORANGE)[0], MM * path)
    (circle,) = left.patches
    assert circle.center == pytest.approx(MM * path[-1])
    (cloud,) = [each for each in right.collections if isinstance(each, LineCollection)]
    np.testing.assert_allclose(cloud.get_segments(), [in_world(pose) for pose in draws], atol=1e-9)
    assert right.get_legend_handles_labels()[1] == ["start", "measured end", "predicted ends", "fingers' paths"]
    assert not plot.real_figure(BLOCK, {"no hand": (push, predicted)}).axes[0].patches


def test_limit_surfaces(monkeypatch):
    """The sections lie on the level set; the arrows start at the pairs' wrenches and point along their twists."""
    drawn = []
    monkeypatch.setattr(Axes3D, "quiver", lambda self, *arrow, **look: drawn.append(arrow))
    ray = np.random.default_rng(0).normal(size=(200, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    load, size = 2.0, np.array([1, 1, LENGTH])
    wide = pj.Ellipsoid(jnp.eye(3) / load**2, LENGTH)  # a ball of the load
    pairs = WrenchTwistPairs(load * ray * size, ray / size, jnp.asarray(LENGTH))
    figure = plot.limit_surfaces({"ball": wide, "small": SURFACE}, pairs, load, arrows=7)
    ball, small, torque, force = figure.axes
    figure.canvas.draw()
    for axes in (ball, small):
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("$f_x$ / load", "$f_y$ / load")
        assert axes.get_zlabel() == torque.get_ylabel() == r"$\tau$ / (length · load)"
    assert [axes.get_title() for axes in (ball, small)] == ["ball", "small"]
    assert legend(torque) == ["ball", "small", "pairs nearby"]
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
    assert apart.min() > 0.4  # spread over the visible side
    plot.limit_surfaces({"ball": wide}, pairs, load, arrows=0)
    assert not np.size(drawn[-1][0])


def test_motion_cone_figure():
    """The friction cone opens by twice atan mu about the normal; both cones start at the contact."""
    point, normal, zero = jnp.array([[-SIDE / 2, 0.01]]), jnp.array([[1.0, 0.0]]), jnp.zeros((1, 2))
    contacts = pj.Contacts(point, normal, jnp.array([[1e-3, 2e-4]]), 0.5)
    turning = jnp.array([1e-3, 2e-4, 0.02])
    motion = Motion(turning, jnp.zeros(3), zero, zero[:, 0], jnp.int8(0), jnp.inf, jnp.array(True))
    support = pj.Support.uniform(BLOCK, points=4)
    figure = plot.motion_cone_figure(BLOCK, support, SURFACE, contacts, motion)
    legible(figure)
    (axes,) = figure.axes
    assert legend(axes) == ["support points", "friction cone", "motion cone", "push", "center of rotation"]
    np.testing.assert_allclose(axes.lines[1].get_xydata(), MM * np.asarray(support.point), atol=1e-5)
    at = MM * np.asarray(point[0])
    cones = (GREEN, pj.friction_cone(normal[0], 0.5)), (BLUE, pj.motion_cone(SURFACE, point[0], normal[0], 0.5))
    for color, edges in cones:
        drawn = np.array([line for line in ends_of(axes, color) if len(line) == 2])
        np.testing.assert_allclose(drawn[:, 0], [at, at], atol=1e-5)
        along = drawn[:, 1] - drawn[:, 0]
        np.testing.assert_allclose(along / np.linalg.norm(along, axis=1, keepdims=True), np.asarray(edges), atol=1e-5)
    arrow = next(text for text in axes.texts if text.arrow_patch is not None)
    np.testing.assert_allclose(arrow.xy, at, atol=1e-5)
    along = np.subtract(arrow.xy, arrow.xyann)
    assert along[1] == pytest.approx(0.2 * along[0])
    center = next(line.get_xydata()[0] for line in axes.lines if line.get_markeredgecolor() == PURPLE)
    np.testing.assert_allclose(center, [-10, 50], atol=1e-5)
    assert "+" in [text.get_text() for text in axes.texts]
    assert axes.get_xlim()[0] < arrow.xyann[0] < axes.get_xlim()[1]


def test_jam_figure():
    """The region of allowed centers is where a rotation moves both contacts away from their fingers."""
    point, normal = jnp.array([[-0.03, -0.012], [0.03, 0.012]]), jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    contacts = pj.Contacts(point, normal, 1e-3 * normal, 0.4)
    zero = jnp.zeros((2, 2))
    still = Motion(jnp.zeros(3), jnp.zeros(3), zero, zero[:, 0], jnp.int8(2), -1e-3, jnp.array(True))
    figure = plot.jam_figure(BLOCK, [(contacts, still)])
    legible(figure)
    (axes,) = figure.axes
    assert axes.get_title() == r"$\mu$ = 0.40: JAMMED"
    plus = "center of rotation allowed, +"
    assert legend(figure) == [plus, "friction cone", "contact normal", "line through both contacts"]
    (band,) = axes.collections
    inside = band.get_paths()[0].get_extents()
    np.testing.assert_allclose([inside.y0, inside.y1], [-12, 12], atol=0.5)
    assert {"A", "C"} <= {text.get_text() for text in axes.texts}
    cone = np.diff(ends_of(axes, GREEN), axis=1)[:, 0]
    np.testing.assert_allclose(np.abs(cone[:, 1] / cone[:, 0]), 0.4)
    np.testing.assert_allclose(axes.lines[-4].get_xydata(), MM * np.asarray(point))


def cloud(n=40) -> np.ndarray:
    rng = np.random.default_rng(0)
    end = np.column_stack([0.03 + 0.002 * rng.normal(size=(n, 2)), rng.permutation(n) / n])
    return np.linspace(0, 1, 5)[None, :, None] * end[:, None]


def test_cloud_figure():
    ways, path = cloud(), np.linspace([-0.04, 0.0], [0.0, 0.0], 5)
    figure = plot.cloud_figure(BLOCK, FINGER, path, ways, "40 pushes")
    legible(figure)
    (axes,) = figure.axes
    assert axes.get_title() == "40 pushes"
    assert legend(figure) == ["paths of the centroid", "start", "end, 2.5 and 97.5 % of θ", "median end"]
    np.testing.assert_allclose(axes.collections[0].get_segments(), MM * ways[..., :2], atol=1e-9)
    crowded, bar = plot.cloud_figure(BLOCK, FINGER, path, np.repeat(ways, 6, axis=0), "240 pushes").axes
    counts = crowded.collections[0].get_array()
    assert bar.get_ylabel() == "paths of the centroid / (1/mm²)"
    assert counts.max() == 240  # where all begin
    assert counts.min() % 6 == 0  # each way is there six times
    order = np.argsort(ways[:, -1, 2])
    drawn = [line for line in axes.lines if line.get_color() == RED]
    for line, place in zip(drawn, (1, 20, 38), strict=True):
        np.testing.assert_allclose(line.get_xydata(), in_world(ways[order[place], -1]), atol=1e-9)
    assert [line.get_linestyle() for line in drawn] == [":", "-", ":"]
    assert [circle.center[0] for circle in axes.patches] == [-40, 0]


def test_panels():
    axes = plt.figure().subplots(1, 4)
    poses = np.array([[0.01, 0.02, np.pi / 2], [0.0, 0.0, 0.0]])
    plot.pose_panel(axes[0], poses, BLUE, "here")
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
    plot.histogram_panel(axes[2], np.array([[0.1, 0.2, 0.3], [1.5, 2.0, np.nan]]), "x / mm", bins=2)
    np.testing.assert_array_equal(axes[2].patches[-1].get_data().values, [3, 2])
    plot.traces(axes[3], np.zeros((2, 3, 3)) + np.arange(3)[None, :, None], GREEN)
    np.testing.assert_allclose(axes[3].collections[0].get_segments(), 2 * [MM * np.arange(3)[:, None] * np.ones(2)])
    assert axes[3].get_xlim()[1] >= 2 * MM
