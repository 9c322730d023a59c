"""The contact points and normals that a trajectory records: the forces act there, and together they are the wrench."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax import plot

LENGTH = 0.04
ANGLE = 2 * np.pi * np.arange(16) / 16
BEAN = (0.045 + 0.014 * np.cos(2 * ANGLE) - 0.012 * np.sin(ANGLE))[:, None] * np.stack(
    [np.cos(ANGLE), np.sin(ANGLE)], axis=1
)
L = np.array([(-0.05, -0.05), (0.05, -0.05), (0.05, 0.0), (0.0, 0.0), (0.0, 0.05), (-0.05, 0.05)])
T = [(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)]
BLOCK = pj.Polygon.rectangle(0.09, 0.06)
FINGER, TWO = pj.Hand.finger(0.005), pj.Hand.two_fingers(0.008)
CORNER = pj.Hand((pj.Polygon.rectangle(0.03, 0.02),), lambda q: q[None], 3)
WIDE = pj.Hand((pj.Polygon.rectangle(0.05, 0.01),), lambda q: q[None], 3)
RAKE = pj.Hand((0.004,) * 5, lambda q: q[None] + 0.018 * jnp.stack([jnp.arange(-2.0, 3.0), jnp.zeros(5)], axis=1), 2)
CLOSING = pj.line((0, 0, 0, 0.105), (0, 0, 0, 0.0765), 4)
# Shape, hand, path, start and number of contacts; what they show is written behind each.
CASES = {
    "finger, square": (BLOCK, FINGER, pj.line((-0.06, 0.01), (-0.02, 0.015), 20), (0, 0, 0), 1),  # first free, then not
    "finger, disk": (pj.Disk(0.045), FINGER, pj.line((-0.06, 0.01), (-0.02, 0.015), 20), (0, 0, 0), 1),
    "finger, T": (pj.Polygon(1e-3 * np.array(T)), FINGER, pj.line((0.03, 0.05), (0.01, 0.02), 20), (0, 0, 0.1), 2),
    "two fingers": (BLOCK, TWO, CLOSING, (0.012, 0.002, 0.6), 2),  # divides a step
    "jaw": (BLOCK, pj.Hand.parallel_jaw(0.03, 0.01), pj.line((0, 0, 0, 0.08), (0, 0, 0, 0.05), 30), (0.01, 0, 0.1), 4),
    "pad, L": (pj.Polygon(L), CORNER, pj.line((0.015, 0.01, 0), (-0.015, -0.02, 0), 30), (0, 0, 0), 3),
    "pad, bean": (pj.Curve.through(BEAN), WIDE, pj.line((0, 0.08, 0), (0.01, 0.0, 1.0), 40), (0, 0, 0.3), 2),
    "rake": (BLOCK, RAKE, pj.line((0.004, 0.05), (0.0, 0.02), 12), (0, 0, 0.1), 5),  # four of five are solved together
}


def pushed(name: str) -> tuple[pj.Shape, pj.Trajectory]:
    shape, hand, path, pose, contacts = CASES[name]
    slider = pj.Slider(shape, pj.Ellipsoid(np.eye(3), LENGTH))
    push = pj.rollout(slider, hand, path, pose=pose, friction=0.3)
    assert push.contact_point.shape == push.contact_normal.shape == (len(path) - 1, contacts, 2)
    return shape, push


QUICK = ("finger, square", "finger, disk")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in CASES])
def test_forces_at_the_contact_points_are_the_wrench(name):
    shape, push = pushed(name)
    found = plot.contact_forces(push)
    torque = found.point[..., 0] * found.force[..., 1] - found.point[..., 1] * found.force[..., 0]
    total = np.concatenate([found.force.sum(axis=1), torque.sum(axis=1)[:, None]], axis=1)
    np.testing.assert_allclose(total, push.wrench, rtol=0, atol=1e-9)
    moving = np.asarray(push.status) == pj.Status.MOVING
    assert moving.sum() > 2
    assert np.all(np.linalg.norm(np.asarray(push.wrench)[moving] / [1, 1, LENGTH], axis=1) > 0.5)

    # the points lie on the outline, and the normals are of unit length and point into the slider
    loaded = np.asarray(push.force)[..., 0] > 1e-9
    point, normal = np.asarray(push.contact_point)[loaded], np.asarray(push.contact_normal)[loaded]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-9)
    depth = 1e-5
    distance = jax.vmap(shape.signed_distance)
    np.testing.assert_allclose(distance(jnp.asarray(point)), 0, atol=1e-7)
    assert np.all(np.asarray(distance(jnp.asarray(point + depth * normal))) < -0.5 * depth)


@pytest.mark.slow
def test_contacts_are_finite_and_zero_where_nothing_pushes():
    """Before the finger arrives, and in steps that fail because the path is not finite."""
    push = pushed("finger, square")[1]
    free = np.asarray(push.status) == pj.Status.FREE
    assert 0 < free.sum() < len(free)
    slider = pj.Slider(BLOCK, pj.Ellipsoid(np.eye(3), LENGTH))
    for name, hand in (("finger, square", FINGER), ("two fingers", TWO)):
        path = CASES[name][2].at[2].set(jnp.nan)
        run = jax.jit(lambda path, hand=hand: pj.rollout(slider, hand, path, pose=(0, 0, 0), friction=0.3))
        broken = run(path)
        for one in (push, broken):
            still = np.asarray(one.status) != pj.Status.MOVING
            for field in (one.contact_point, one.contact_normal):
                assert np.all(np.isfinite(field))
                assert not np.asarray(field)[still].any()
        assert pj.Status.INVALID in np.asarray(broken.status)
