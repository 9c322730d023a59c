"""Several sliders in physical units: frames and units, guesses, batches, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax._math.vec import Vec2, cos_sin
from pushjax.contact.contact_plane import Contact
from pushjax.contact.sliders_solving import Touching, solve_touching
from pushjax.friction.polynomial import Polynomial

RADIUS = 0.04
ELLIPSOID = pj.Ellipsoid(np.diag([1.0, 1.2, 0.9]), length=0.03)


@pytest.fixture(scope="module")
def quartic():
    support = pj.Support.uniform(pj.Polygon.rectangle(0.08, 0.05), points=32)
    return pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(1), 100), degree=4)


def columns(rows) -> Vec2:
    return Vec2.of(jnp.asarray(rows, float).T)


def solved(surfaces, touching, guess=None):
    """Solve, and return vectors as arrays."""
    found = solve_touching(tuple(surface.form() for surface in surfaces), touching, guess)
    return found._replace(twist=found.twist.array(), wrench=found.wrench.array(), force=found.force.array())


def two_disks(surfaces, angles=(0.0, 0.0), angle=0.4, displacement=(1e-3, 2e-4), friction=(0.3, 0.2), guess=None):
    """Disk 0 at the origin, pushed from the left, and disk 1 in this direction from it; frames turned by angles."""
    apart = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    frames = [cos_sin(jnp.asarray(turn, float)) for turn in angles]
    push, forward = jnp.array([-RADIUS, 0.0]), jnp.array([1.0, 0.0])
    into = [Vec2.of(forward).unrotate(frames[0]), Vec2.of(apart).unrotate(frames[1])]
    point = [Vec2.of(push).unrotate(frames[0]), Vec2.of(-RADIUS * apart).unrotate(frames[1])]
    moved = [Vec2.of(jnp.asarray(displacement)).unrotate(frames[0]), Vec2(jnp.zeros(()), jnp.zeros(()))]
    contact = Contact(
        *(jax.tree.map(lambda *x: jnp.stack(x), *each) for each in (point, into, moved)),
        jnp.asarray(friction),
        jnp.zeros(2),
    )
    none = Vec2(jnp.zeros(()), jnp.zeros(()))
    of_second = [(none, Vec2.of(RADIUS * apart).unrotate(frames[0])), (none, Vec2.of(apart).unrotate(frames[0]))]
    at_second = [jax.tree.map(lambda *x: jnp.stack(x), *each) for each in of_second]
    touching = Touching(contact, *at_second, ((0, None), (1, 0)), jnp.ones(2, bool))
    return solved(surfaces, touching, guess)


def test_square_of_an_ellipsoid():
    surface = Polynomial.of(ELLIPSOID.form().table())
    wrench = jax.random.normal(jax.random.key(0), (3, 20))
    np.testing.assert_allclose(surface.squared().value(wrench), surface.value(wrench) ** 2, rtol=1e-12)
    expected = jax.vmap(jax.hessian(lambda f: surface.value(f) ** 2), in_axes=-1, out_axes=-1)(wrench)
    np.testing.assert_allclose(surface.squared().hessian(wrench), expected, rtol=1e-12, atol=1e-12)


def test_one_slider_moves_as_by_solve_contacts(quartic):
    points, normals, moves = [(-0.04, 0.02), (-0.04, -0.02)], [(1.0, 0.0)] * 2, [(1e-3, 0.0), (1.2e-3, 4e-4)]
    for surface in (ELLIPSOID, quartic):
        alone = pj.solve_contacts(surface, pj.Contacts(points, normals, moves, 0.3))
        contact = Contact(*map(columns, (points, normals, moves)), jnp.full(2, 0.3), jnp.zeros(2))
        touching = Touching(contact, contact.point, contact.normal, ((0, None), (0, None)), jnp.ones(2, bool))
        found = solved((surface,), touching)
        assert found.status == pj.Status.MOVING
        np.testing.assert_allclose(found.twist[:, 0], alone.twist, rtol=1e-8)
        np.testing.assert_allclose(found.force.T, alone.force, rtol=1e-8)
        np.testing.assert_allclose(found.wrench[:, 0] * np.array([1, 1, surface.length]), alone.wrench, rtol=1e-8)
        np.testing.assert_array_equal(found.mode, alone.mode)


def test_frames_do_not_matter(quartic):
    """A round limit surface is the same in every frame; forces and the motion in the world are, too."""
    round_one = pj.Ellipsoid(np.eye(3), length=0.03)
    plain, turned = (two_disks((round_one, round_one), angles) for angles in ((0.0, 0.0), (0.7, -2.0)))
    np.testing.assert_allclose(turned.force, plain.force, rtol=1e-8)
    for slider, angle in enumerate((0.7, -2.0)):
        world = Vec2(turned.twist[0, slider], turned.twist[1, slider]).rotate(cos_sin(jnp.asarray(angle)))
        np.testing.assert_allclose([*world, turned.twist[2, slider]], plain.twist[:, slider], rtol=1e-8, atol=1e-12)
    # a heavy slider behind resists more, so the finger has to push harder
    heavy = pj.Ellipsoid(np.eye(3) / 16, length=0.03)
    assert two_disks((round_one, heavy)).force[0, 0] > 1.5 * plain.force[0, 0]
    # a quartic and an ellipsoid in one scene
    mixed = two_disks((quartic, ELLIPSOID))
    assert mixed.status == pj.Status.MOVING
    for slider, surface in enumerate((quartic, ELLIPSOID)):
        wrench = mixed.wrench[:, slider] * jnp.array([1, 1, surface.length])
        np.testing.assert_allclose(surface.value(wrench), 1, rtol=1e-8)
        twist = np.asarray(mixed.twist[:, slider])
        direction = np.asarray(surface.twist(wrench))
        np.testing.assert_allclose(twist / np.linalg.norm(twist), direction / np.linalg.norm(direction), rtol=1e-7)


def test_a_guess_changes_nothing():
    angles = jnp.linspace(-0.6, 0.6, 16)
    solve = jax.jit(jax.vmap(lambda angle, guess: two_disks((ELLIPSOID, ELLIPSOID), angle=angle, guess=guess)))
    first = jax.jit(jax.vmap(lambda angle: two_disks((ELLIPSOID, ELLIPSOID), angle=angle)))(angles)
    again = solve(angles + 0.01, first.best)
    anew = jax.jit(jax.vmap(lambda angle: two_disks((ELLIPSOID, ELLIPSOID), angle=angle)))(angles + 0.01)
    np.testing.assert_array_equal(again.status, pj.Status.MOVING)
    np.testing.assert_allclose(again.twist, anew.twist, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(again.force, anew.force, rtol=1e-8, atol=1e-12)


def test_derivatives_in_batches(quartic):
    """Forward and reverse, alone and under nested vmap, against differences."""
    x = jnp.array([0.4, 1e-3, 2e-4, 0.3, 0.2])

    def twists(x):
        found = two_disks((quartic, ELLIPSOID), angle=x[0], displacement=x[1:3], friction=x[3:])
        return found.twist * jnp.array([[1.0], [1.0], [0.03]])

    batch = x[None] + jnp.linspace(0, 1, 4)[:, None] * jnp.array([[0.2, 0.0, 1e-4, 0.05, 0.1]])
    forward = jax.jit(jax.vmap(jax.jacfwd(twists)))(batch)
    reverse = jax.jit(jax.vmap(jax.jacrev(twists)))(batch)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-12)
    nested = jax.jit(jax.vmap(jax.vmap(jax.jacfwd(twists))))(batch.reshape(2, 2, -1))
    np.testing.assert_allclose(nested.reshape(forward.shape), forward, rtol=1e-8, atol=1e-12)
    step = 1e-6 * jnp.array([1.0, 1e-3, 1e-3, 1.0, 1.0])
    both = batch[:, None] + jnp.concatenate([jnp.diag(step), -jnp.diag(step)])[None]
    moved = jax.jit(jax.vmap(jax.vmap(twists)))(both)
    central = jnp.moveaxis((moved[:, :5] - moved[:, 5:]) / (2 * step[None, :, None, None]), 1, -1)
    size = np.maximum(np.abs(forward).max((1, 2), keepdims=True), 1e-6)
    np.testing.assert_allclose(central / size, forward / size, atol=1e-5)
