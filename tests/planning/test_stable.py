"""Stable pushes: no slip within the bound, slip beyond it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax._internal.jit import quick_jit
from pushjax.planning import PlanStatus, shortest_push, stable_contacts, stable_push
from pushjax.planning.line_contact import LineContact, tightest_turn
from pushjax.planning.scene import draw_friction

WIDTH, HEIGHT, RADIUS, SPACING = 0.09, 0.06, 0.005, 0.04
BLOCK, HAND = pj.Polygon.rectangle(WIDTH, HEIGHT), pj.Hand.two_fingers(RADIUS)
MODEL = pj.FrictionModel(dof=200, friction=(0.3, 0.5))
SAMPLES, STEPS, GOALS = 8, 120, 8
KEY = jax.random.key(0)


def isotropic(length=0.03):
    return pj.Ellipsoid(np.eye(3), length=length)


@pytest.fixture(scope="module")
def slider():
    return pj.Slider.uniform(BLOCK, degree=2)


@pytest.fixture(scope="module")
def contacts(slider):
    return stable_contacts(KEY, slider, HAND, model=MODEL, opening=(SPACING,), samples=SAMPLES)


@pytest.fixture(scope="module")
def goals():
    return np.random.default_rng(0).uniform(-1, 1, (GOALS, 3)) * [0.3, 0.3, np.pi]


@quick_jit
def rollouts(draws, paths):
    def one(path, surface, friction):
        return pj.rollout(pj.Slider(BLOCK, surface), HAND, path, pose=jnp.zeros(3), friction=friction)

    over_samples = jax.vmap(one, (None, 0, 0))
    return jax.vmap(over_samples, (0, None, None))(paths, draws.surface, draws.friction)


def simulated(slider, pushes):
    """Simulate paths under every sampled friction.

    Returns:
        Largest motion of a corner of the slider against the hand, m, (goals, samples); how far the hand's wrench is
        inside the cone of its two contacts, (goals, samples), relative to the normal force; the final poses.
    """
    draws = jax.tree.map(lambda leaf: leaf[:, 0], draw_friction(KEY, slider.surface, MODEL, SAMPLES))
    paths = np.stack([push.path for push in pushes])
    done = rollouts(draws, jnp.asarray(paths))
    pose, corners = np.asarray(done.pose), np.asarray(BLOCK.vertices)[:, 0] + 1j * np.asarray(BLOCK.vertices)[:, 1]
    placed = (pose[..., 0] + 1j * pose[..., 1])[..., None] + corners * np.exp(1j * pose[..., 2])[..., None]
    hand = (paths[..., 0] + 1j * paths[..., 1])[:, None, :, None]
    seen = (placed - hand) * np.exp(-1j * paths[..., 2])[:, None, :, None]
    slip = np.abs(seen - seen[:, :, :1]).max(axis=(2, 3))
    inside = [
        _inside(np.asarray(done.wrench)[k], push.contact.contact, np.asarray(draws.friction)[:, None])
        for k, push in enumerate(pushes)
    ]
    return slip, np.stack(inside), pose[:, :, -1]


def _inside(wrench, contact, friction):
    """Least distance of wrenches (samples, steps, 3) from the border of the cone, by the definition of the cone."""
    x, y, angle = contact.frame
    c, s = np.cos(angle), np.sin(angle)
    normal, tangential = c * wrench[..., 0] + s * wrench[..., 1], c * wrench[..., 1] - s * wrench[..., 0]
    torque = wrench[..., 2] - x * wrench[..., 1] + y * wrench[..., 0]
    by_force = friction - np.abs(tangential) / normal
    by_torque = 1 - np.abs(torque) / normal / contact.half_width
    return np.minimum(by_force, by_torque).min(axis=1)


def steps_error(pushes):
    """How accurate a simulation is, (goals, 1), m: three times the sum over the steps of chord against arc."""
    turns = np.diff(np.stack([push.path for push in pushes])[:, :, 2], axis=1)
    return 3 * np.sum(np.abs(turns) ** 3, axis=1, keepdims=True) / 24 * np.hypot(WIDTH, HEIGHT) + 1e-9


@pytest.mark.slow
def test_no_slip_for_any_sampled_friction(slider, contacts, goals):
    assert [each.contact.edge for each in contacts] == [0, 1, 2, 3]
    pushes = [shortest_push(contacts, np.zeros(3), goal, steps=STEPS) for goal in goals]
    slip, inside, final = simulated(slider, pushes)
    assert np.all(slip < steps_error(pushes))
    assert slip.max() < 2e-4
    assert inside.min() > 0.02  # of the margin of 0.1 of at least 0.3
    miss = final - goals[:, None]
    assert np.all(np.hypot(miss[..., 0], miss[..., 1]) < steps_error(pushes))
    assert np.all(np.hypot(WIDTH, HEIGHT) * np.abs(np.exp(1j * miss[..., 2]) - 1) < steps_error(pushes))


@pytest.mark.slow
def test_slip_at_twice_the_curvature(slider, contacts, goals):
    """The bound is not much more careful than it must be: along turns twice as tight some friction makes it slip."""
    tighter = [
        each._replace(turn=each.turn._replace(left=2 * each.turn.left, right=2 * each.turn.right)) for each in contacts
    ]
    pushes = [shortest_push(tighter, np.zeros(3), goal, steps=STEPS) for goal in goals]
    slip, _, _ = simulated(slider, pushes)
    assert np.any(slip > 3 * steps_error(pushes), axis=1).mean() > 0.8


@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_bound_of_an_isotropic_surface(margin):
    """Closed form: force proportional to velocity at the center, torque to length^2 times the angular velocity."""
    half, friction, depth, length = 0.02, 0.3, 0.06, 0.03
    frame = np.array([0.0, -depth / 2, np.pi / 2])
    contact = LineContact(0, np.zeros(3), frame, half, 0.0, depth)
    surfaces = jax.tree.map(lambda leaf: leaf[None], isotropic(length))
    found = tightest_turn(contact, surfaces, jnp.array([friction]), margin)
    swing = depth / 2 - found.point  # lateral velocity of the center, per curvature
    by_force = (1 - margin) * friction / abs(swing)
    by_torque = (1 - margin) * half / abs(length**2 + depth / 2 * swing)
    np.testing.assert_allclose([found.left, found.right], min(by_force, by_torque), rtol=1e-6)


def test_a_pad_longer_than_the_edge():
    """It touches the whole edge, and where it touches off its middle it still pushes through the center."""
    pad = pj.Hand((pj.Polygon([(-0.01, -0.03), (0, -0.03), (0, 0.07), (-0.01, 0.07)]),), lambda q: q[None], 3)
    slider = pj.Slider(BLOCK, isotropic())
    found = stable_contacts(KEY, slider, pad, model=pj.FrictionModel(None, 0.3), samples=1)
    assert [round(2 * each.contact.half_width, 6) for each in found] == [WIDTH, HEIGHT, WIDTH, HEIGHT]
    np.testing.assert_allclose([each.contact.heading for each in found], 0.0, atol=1e-9)
    for each in found:
        face = pj.se2.transform(each.contact.hand, [0.0, 0.02])
        np.testing.assert_allclose(face, each.contact.frame[:2], atol=1e-9)


def test_why_there_is_no_push(slider):
    key, there = jax.random.key(1), (0.2, 0.0, 0.0)
    slippery = stable_push(key, slider, HAND, np.zeros(3), there, model=pj.FrictionModel(20, 0.02), opening=(SPACING,))
    assert slippery.status is PlanStatus.NOT_STABLE
    assert slippery.path is None
    assert "not even when it pushes straight ahead" in slippery.reason
    straight = [
        each._replace(turn=each.turn._replace(left=0.0, right=0.0))
        for each in stable_contacts(key, slider, HAND, model=MODEL, opening=(SPACING,), samples=1)
    ]
    assert shortest_push(straight, np.zeros(3), there).status is PlanStatus.OUT_OF_REACH


def test_bad_input(slider):
    def contacts(hand=HAND, opening=(SPACING,), **settings):
        return stable_contacts(KEY, slider, hand, model=MODEL, opening=opening, **settings)

    with pytest.raises(ValueError, match="a hand that does not turn cannot push stably"):
        contacts(pj.Hand.finger(RADIUS), ())
    with pytest.raises(ValueError, match="hand touches an edge in one point"):
        contacts(pj.Hand.three_fingers(RADIUS))
    with pytest.raises(ValueError, match=r"opening has shape \(0,\); expected \(1,\)"):
        contacts(opening=())
    with pytest.raises(ValueError, match="margin must be at least 0 and below 1; got 1"):
        contacts(margin=1)
    with pytest.raises(ValueError, match="samples must be a whole number, at least 1; got 0"):
        contacts(samples=0)
    with pytest.raises(ValueError, match="must move like a rigid body"):
        contacts(pj.Hand((RADIUS, RADIUS), lambda q: jnp.stack([q, q + 0.02]) * 2, 3), ())
    with pytest.raises(TypeError, match=r"slider.shape: expected a Polygon; got a Disk"):
        stable_contacts(KEY, eqx.tree_at(lambda s: s.shape, slider, pj.Disk(0.05)), HAND, model=MODEL)
    with pytest.raises(ValueError, match="goal must be finite"):
        shortest_push((), np.zeros(3), (np.nan, 0, 0))
    with pytest.raises(ValueError, match="steps must be at least 3"):
        shortest_push((), np.zeros(3), (1, 0, 0), steps=2)
