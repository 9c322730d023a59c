"""Forces of a push, and forces that hold a slider at the end of a grasp: by statics, and against the certificate."""

import jax.numpy as jnp
import numpy as np
import pytest
from drawn import MM, legend, legible
from pushes import trajectory

import pushjax as pj
from pushjax import plot

STEP = 1e-4  # m, by which each opening is smaller than the one before
APART = np.array([[0.0, -0.012], [0.0, 0.012]])  # m, of two fingers on opposite faces


def closed(opening, pose=(0.0, 0.0, 0.0), status=pj.Status.GRASPED, before=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)):
    """Return two steps of a hand that closes to an opening and stops; the slider rests at a pose."""
    hand = [[*before, opening + STEP], [*at, opening], [*at, opening]]
    return trajectory(np.tile(pose, (3, 1)), hand, 2, status=np.array([pj.Status.MOVING, status], np.int8))


def torque(point, force):
    return np.sum(point[..., 0] * force[..., 1] - point[..., 1] * force[..., 0], axis=-1)


@pytest.mark.parametrize("turned", [0.0, 0.6])
def test_a_flat_grasp_is_held_evenly(turned):
    """Pads as wide as 20 mm on a longer side: a quarter of the squeeze at each end of either pad, straight inward."""
    block, jaw = pj.Polygon.rectangle(0.05, 0.03), pj.Hand.parallel_jaw(0.02, 0.01)
    at = (0.3, -0.2, turned)
    held = plot.squeeze_forces(block, jaw, closed(0.03, pose=at, before=at, at=at), 0.3)
    c, s = np.cos(turned), np.sin(turned)
    to_body = np.array([[c, s], [-s, c]])
    point, force = (held.point - at[:2]) @ to_body.T, held.force @ to_body.T
    order = np.lexsort(point.T)
    np.testing.assert_allclose(
        point[order], [[-0.01, -0.015], [0.01, -0.015], [-0.01, 0.015], [0.01, 0.015]], atol=1e-6
    )
    np.testing.assert_allclose(force[order], [[0, 0.25], [0, 0.25], [0, -0.25], [0, -0.25]], atol=2e-3)


def test_a_disk_is_held_along_its_diameter():
    hand = pj.Hand.two_fingers(0.005)
    held = plot.squeeze_forces(pj.Disk(0.02), hand, closed(0.05), 0.0)
    np.testing.assert_allclose(held.point[np.argsort(held.point[:, 1])], [[0, -0.02], [0, 0.02]], atol=1e-6)
    np.testing.assert_allclose(held.force[np.argsort(held.point[:, 1])], [[0, 0.5], [0, -0.5]], atol=1e-3)


@pytest.mark.parametrize("friction", [0.45, 0.7])
def test_work_is_that_of_the_certificate(friction):
    """Two fingers on opposite faces, apart by 24 mm along them, jam from a friction of 0.4 (`experiments.jam`)."""
    block, length = pj.Polygon.rectangle(0.06, 0.05), 0.024
    hand = pj.Hand([0.0, 0.0], lambda q: jnp.array([[-1.0, 0.0], [1.0, 0.0]]) * q[3] / 2 + APART, 4)
    held = plot.squeeze_forces(block, hand, closed(0.06, status=pj.Status.JAMMED), friction)
    np.testing.assert_allclose(held.force.sum(axis=0), 0, atol=1e-3)
    assert abs(torque(held.point, held.force)) < 1e-3 * length
    normal = -np.sign(held.point[:, 0])
    pressing, across = held.force[:, 0] * normal, held.force[:, 1]
    assert pressing.sum() == pytest.approx(1, abs=1e-3)
    assert np.all(np.abs(across) <= friction * pressing + 1e-3)
    point = jnp.array([[-0.03, -0.012], [0.03, 0.012]])
    inward = jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    problem = pj.Contacts(point, inward, STEP / 2 * inward, friction)
    motion = pj.solve_contacts(pj.Ellipsoid(jnp.eye(3), length), problem)
    assert int(motion.status) == pj.Status.JAMMED
    work = np.sum(pressing * STEP / 2)
    assert work == pytest.approx(-float(motion.margin), rel=2e-3)


def test_nothing_holds():
    """No forces where the hand does not stop, where friction is too small, or where all fingers are on one side."""
    block, hand = pj.Polygon.rectangle(0.05, 0.03), pj.Hand.two_fingers(0.005)
    assert plot.squeeze_forces(block, hand, closed(0.04, status=pj.Status.MOVING), 0.3) is None
    assert plot.squeeze_forces(block, hand, closed(0.06), 0.3) is None  # the fingers are away from it
    aslant = closed(0.04, pose=(0.0, 0.0, 0.0), before=(0.0, 0.0, 0.4), at=(0.0, 0.0, 0.4))
    assert plot.squeeze_forces(block, hand, aslant, 0.1) is None


def test_grasps_are_drawn_with_their_squeeze():
    block, jaw = pj.Polygon.rectangle(0.05, 0.03), pj.Hand.parallel_jaw(0.02, 0.01)
    grasp = closed(0.03)
    words = "forces that hold it, per unit of squeeze"
    figure = plot.push_figure(block, jaw, {"flat": grasp}, friction=0.3)
    legible(figure)
    assert words in legend(figure)
    assert len(figure.axes[0].texts) == 4  # arrows
    assert words not in legend(plot.push_figure(block, jaw, {"flat": grasp}))
    moving = plot.animate(block, jaw, grasp, friction=0.3, frames=3)
    (axes,) = moving.figure.axes
    seen = []
    for frame in range(3):
        moving.draw(frame)
        seen.append(axes.collections[-1].get_visible())
    assert seen == [False, False, True]
    tips = np.asarray(axes.collections[-1].get_offsets())
    np.testing.assert_allclose(np.abs(tips), MM * np.array([[0.01, 0.015]] * 4), atol=1e-3)
    assert words in [text.get_text() for text in moving.figure.legends[0].get_texts()]


def test_the_trace_is_of_the_centroid():
    """Of a triangle whose body origin is its corner, the center of the area is drawn."""
    triangle = pj.Polygon([(0.0, 0.0), (0.06, 0.0), (0.0, 0.03)])
    grasp = closed(0.2, pose=(0.1, 0.2, np.pi / 2))
    axes = plot.push_figure(triangle, pj.Hand.two_fingers(0.005), {"a": grasp}).axes[0]
    (trace,) = [line.get_xydata() for line in axes.lines if line.get_label() == "centroid of the slider"]
    np.testing.assert_allclose(trace, np.broadcast_to([90, 220], (3, 2)), atol=1e-3)
    moving = plot.animate(triangle, pj.Hand.two_fingers(0.005), grasp, frames=2)
    moving.draw(1)
    (trace,) = [line.get_xydata() for line in moving.figure.axes[0].lines if line.get_label() == "its centroid"]
    np.testing.assert_allclose(trace[-1], [90, 220], atol=1e-3)
