"""The solver of frictionless contacts: its answers satisfy every condition, and its jams have no motion, by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import pushjax as pj
from pushjax.contact.frictionless import Frictionless
from pushjax.testing.problems import random_contacts_problem

PROBLEMS = 300


@pytest.mark.parametrize("count", [2, 4])
def test_conditions_hold_and_jams_have_no_motion(count):
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(count), PROBLEMS)
        contacts = jax.vmap(lambda key: random_contacts_problem(key, contacts=count).contacts)(keys)
        factor = np.random.default_rng(0).normal(size=(PROBLEMS, 3, 3))
        matrix, length = factor @ factor.transpose(0, 2, 1) + 0.3 * np.eye(3), 0.03

        def solved(matrix, contacts):
            return pj.solve_contacts(pj.Ellipsoid(matrix, length), contacts, solver=Frictionless())

        motion = jax.jit(jax.vmap(solved))(jnp.asarray(matrix), contacts)
    point, normal, gap = (np.asarray(getattr(contacts, name)) for name in ("point", "normal", "gap"))
    lever = point[..., 0] * normal[..., 1] - point[..., 1] * normal[..., 0]
    rows = np.concatenate([normal, lever[..., None]], axis=-1)
    needed = np.sum(normal * np.asarray(contacts.displacement), axis=-1) - gap
    unit = np.abs(needed).max(1)
    status = np.asarray(motion.status)
    moving = status == pj.Status.MOVING
    assert moving.mean() > 0.5

    clear = np.einsum("pci,pi->pc", rows, np.asarray(motion.twist)) - needed
    force = np.asarray(motion.force)[..., 0]
    assert (clear[moving] > -1e-3 * unit[moving, None]).all()
    assert (force >= 0).all()
    loaded = force > 1e-9 * force.max(1, keepdims=True)
    assert (np.abs(clear[moving]) < 1e-6 * unit[moving, None])[loaded[moving]].all()
    # the twist is along the gradient of H at the wrench of the forces
    wrench = np.einsum("pci,pc->pi", rows, force) / [1, 1, length]
    gradient = np.einsum("pij,pj->pi", matrix, wrench)
    twist = np.asarray(motion.twist) * [1, 1, length]
    cosine = np.sum(gradient * twist, 1)[moving] / np.linalg.norm(gradient[moving], axis=1)
    assert np.allclose(cosine, np.linalg.norm(twist[moving], axis=1), rtol=1e-6)
    for k in np.flatnonzero(status == pj.Status.JAMMED):
        limits = [(-1e3 * unit[k], 1e3 * unit[k])] * 3
        found = linprog(np.zeros(3), -rows[k] / [1, 1, length], -needed[k] - 1e-2 * unit[k], bounds=limits)
        assert found.status == 2, "a motion exists"


def test_only_for_ellipsoids():
    contacts = random_contacts_problem(jax.random.key(0), contacts=2).contacts
    quartic = pj.Quartic([1.0, *[0.0] * 14], 0.03)
    with pytest.raises(ValueError, match="Frictionless needs an ellipsoid; the surface has degree 4"):
        pj.solve_contacts(quartic, contacts, solver=Frictionless())


def test_derivatives_are_those_without_friction():
    """The coefficients of friction, which the solver ignores, have no influence on derivatives."""
    with jax.enable_x64(True):
        point, normal = np.array([[-0.03, 0.01], [-0.03, -0.02]]), np.array([[1.0, 0.0], [1.0, 0.0]])
        surface = pj.Ellipsoid(np.diag([1.0, 1.0, 1.3]), 0.03)

        @jax.jit
        def twist(displacement, mu):
            contacts = pj.Contacts(point, normal, displacement, mu)
            return pj.solve_contacts(surface, contacts, solver=Frictionless()).twist

        at, mu = jnp.array([[1e-3, 2e-4], [1.2e-3, -1e-4]]), jnp.array([0.3, 0.3])
        by_displacement, by_friction = jax.jacrev(twist, argnums=(0, 1))(at, mu)
        forward = jax.jacfwd(twist)(at, mu)
        differences = np.zeros((3, 2, 2))
        for i, k in np.ndindex(2, 2):
            change = np.zeros((2, 2))
            change[i, k] = 1e-8
            differences[:, i, k] = (twist(at + change, mu) - twist(at - change, mu)) / 2e-8
        assert (np.asarray(by_friction) == 0).all()
    np.testing.assert_allclose(by_displacement, differences, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(forward, by_displacement, rtol=1e-9, atol=1e-12)
