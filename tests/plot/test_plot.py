"""Figures of pushes, contacts and limit surfaces show the given data, with units on every axis and a legend.

The pixels are not tested.
"""

import equinox as eqx
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

import pushjax as pj
from pushjax import plot
from pushjax.contact.problem import Motion
from pushjax.friction.support import WrenchTwistPairs

LENGTH = 0.024


@pytest.fixture(scope="module")
def block():
    return pj.Polygon.rectangle(SIDE, SIDE)


@pytest.fixture(scope="module")
def surface():
    return pj.Ellipsoid(jnp.eye(3), LENGTH)


def slid(steps: int = 6, turn: float = 0.4, dof: int = 2) -> pj.Trajectory:
    """Return a push along x that rotates, with a hand that follows; its arrays are written directly."""
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
        contact_point=jnp.tile(jnp.array([[-SIDE / 2, 0.0]]), (steps, 1, 1)),
        contact_normal=jnp.tile(jnp.array([[1.0, 0.0]]), (steps, 1, 1)),
        mode=jnp.full((steps, 1), pj.ContactMode.STICKING, jnp.int8),
        status=jnp.zeros(steps, jnp.int8),
        overlap=jnp.zeros(steps),
    )


def test_push_figure(block):
    push = slid(steps=12)
    path = np.asarray(push.configuration)
    figure = plot.push_figure(block, {"one": (push, path), "two": (slid(turn=-0.2), path)}, RADIUS, frames=3)
    legible(figure)
    assert [axes.get_title() for axes in figure.axes] == ["one", "two"]
    assert legend(figure) == ["centroid of the slider", "start", "between", "end"]
    axes = figure.axes[0]
    for color, k in ((plot.BLACK, 0), (plot.RED, -1)):
        np.testing.assert_allclose(ends_of(axes, color)[0], in_world(push.pose[k]), atol=1e-9)
    assert len(ends_of(axes, plot.GRAY)) == 3
    np.testing.assert_allclose(ends_of(axes, plot.BLUE)[0], MM * np.asarray(push.pose[:, :2]), atol=1e-9)
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert len(circles) == 5
    assert {circle.radius for circle in circles} == {MM * RADIUS}
    np.testing.assert_allclose(circles[-1].center, MM * path[-1])
    assert axes.get_aspect() == 1


def test_grasp_figure(block):
    """Pads are drawn as outlines, round fingers as circles; the last moment is the last in which the slider moves."""
    grasp = slid(dof=4)
    rest = jnp.concatenate([grasp.pose, jnp.repeat(grasp.pose[-1:], 20, axis=0)])
    held = jnp.concatenate([grasp.configuration, jnp.repeat(grasp.configuration[-1:], 20, axis=0)])
    grasp = eqx.tree_at(lambda push: (push.pose, push.configuration), grasp, (rest, held))
    jaw = pj.Hand.parallel_jaw(0.02, 0.01)
    figure = plot.grasp_figure(block, jaw, {"held: askew": grasp}, frames=2)
    legible(figure)
    axes = figure.axes[0]
    assert axes.get_title() == "held:\naskew"
    assert legend(figure) == ["centroid of the slider", "start", "between", "end"]
    drawn = ends_of(axes, plot.RED)
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
    """The outline of a disk is a circle about its center, moved by the pose."""
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
    for color, pose in ((plot.GRAY, start), (plot.BLACK, end), (plot.BLUE, predicted)):
        np.testing.assert_allclose(ends_of(left, color)[0], in_world(pose), atol=1e-9)
    np.testing.assert_allclose(ends_of(left, plot.ORANGE)[0], MM * path)
    (circle,) = left.patches
    assert circle.center == pytest.approx(MM * path[-1])
    (cloud,) = [each for each in right.collections if isinstance(each, LineCollection)]
    np.testing.assert_allclose(cloud.get_segments(), [in_world(pose) for pose in draws], atol=1e-9)
    assert right.get_legend_handles_labels()[1] == ["start", "measured end", "predicted ends"]


def test_limit_surfaces(surface, monkeypatch):
    """The sections lie on the level set; the arrows start at the pairs' wrenches and point along their twists."""
    drawn = []
    monkeypatch.setattr(Axes3D, "quiver", lambda self, *arrow, **look: drawn.append(arrow))
    rng = np.random.default_rng(0)
    ray = rng.normal(size=(200, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    load = 2.0
    wide = pj.Ellipsoid(jnp.eye(3) / load**2, LENGTH)  # a ball of the load
    size = np.array([1, 1, LENGTH])
    pairs = WrenchTwistPairs(load * ray * size, ray / size, jnp.asarray(LENGTH))
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
    assert apart.min() > 0.4  # spread over the visible side
    plot.limit_surfaces({"ball": wide}, pairs, load, arrows=0)
    assert not np.size(drawn[-1][0])


def one_contact(surface, friction=0.5):
    point, normal = jnp.array([[-SIDE / 2, 0.01]]), jnp.array([[1.0, 0.0]])
    contacts = pj.Contacts(point, normal, jnp.array([[1e-3, 2e-4]]), friction)
    zero = jnp.zeros((1, 2))
    return contacts, Motion(
        jnp.array([1e-3, 2e-4, 0.02]), jnp.zeros(3), zero, zero[:, 0], jnp.int8(0), jnp.inf, jnp.array(True)
    )


def test_motion_cone_figure(block, surface):
    """The friction cone opens by twice atan mu about the normal; both cones start at the contact."""
    support = pj.Support.uniform(block, points=4)
    contacts, motion = one_contact(surface)
    figure = plot.motion_cone_figure(block, support, surface, contacts, motion)
    legible(figure)
    (axes,) = figure.axes
    assert legend(axes) == ["support points", "friction cone", "motion cone", "push", "center of rotation"]
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
    """The region of allowed centers is where a rotation moves both contacts away from their fingers."""
    point, normal = jnp.array([[-0.03, -0.012], [0.03, 0.012]]), jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    contacts = pj.Contacts(point, normal, 1e-3 * normal, 0.4)
    zero = jnp.zeros((2, 2))
    still = Motion(jnp.zeros(3), jnp.zeros(3), zero, zero[:, 0], jnp.int8(2), -1e-3, jnp.array(True))
    figure = plot.jam_figure(block, [(contacts, still)])
    legible(figure)
    (axes,) = figure.axes
    assert axes.get_title() == r"$\mu$ = 0.40: JAMMED"
    plus = "center of rotation allowed, +"
    assert legend(figure) == [plus, "friction cone", "contact normal", "line through both contacts"]
    (band,) = axes.collections
    inside = band.get_paths()[0].get_extents()
    np.testing.assert_allclose([inside.y0, inside.y1], [-12, 12], atol=0.5)
    assert {"A", "C"} <= {text.get_text() for text in axes.texts}
    cone = np.array(ends_of(axes, plot.GREEN))
    slope = (cone[:, 1] - cone[:, 0])[:, 1] / (cone[:, 1] - cone[:, 0])[:, 0]
    np.testing.assert_allclose(np.abs(slope), 0.4)
    np.testing.assert_allclose(axes.lines[-4].get_xydata(), MM * np.asarray(point))


@pytest.mark.slow
def test_fixtures_are_drawn_and_a_jammed_finger_stays_where_it_stopped(block):
    """A block is pushed against a wall; the finger's path goes on through it."""
    slider, hand = pj.Slider(block, pj.Ellipsoid(np.eye(3), 0.03)), pj.Hand.finger(RADIUS)
    left = float(np.min(np.asarray(block.vertices)[:, 0]))
    path = pj.line((left - RADIUS, 0.0), (left - RADIUS + 0.04, 0.0), 8)
    fixtures = (pj.Wall((0.01 - left, 0.0), (-1.0, 0.0)), pj.Fixture(pj.Disk(0.01), (0.0, 0.2, 0.0)))
    push = pj.rollout(slider, hand, path, pose=(0.0, 0.0, 0.0), friction=0.3, fixtures=fixtures)
    axes = plot.push_figure(block, {"jam": (push, path)}, RADIUS, fixtures=fixtures).axes[0]
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert max(circle.center[0] for circle in circles) < 1e3 * (left - RADIUS + 0.0101)
    assert axes.get_xlim()[1] < 200  # mm: the wall is drawn without extending the picture
    assert axes.get_ylim()[1] > 209  # mm: the disk is in it
