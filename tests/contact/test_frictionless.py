"""The solver of frictionless contacts: its answers satisfy every condition, and its jams have no motion, by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import first, flat_push, problems
from scipy.optimize import linprog
from slopes import slopes

import pushjax as pj
from pushjax.contact.frictionless import MAX_MOTION, Frictionless

PROBLEMS = 300


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_conditions_hold_and_jams_have_no_motion(count):
    contacts = first(problems(count, seed=count).contacts, PROBLEMS)
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
    # An answer is the smallest motion in the surface's metric, and its entries sum to less than `MAX_MOTION`. So no
    # motion out of a jam is smaller than `largest`. The variables are the positive and negative parts of its entries.
    for k in np.flatnonzero(status == pj.Status.JAMMED):
        opening = rows[k] / [1, 1, length]
        conditions = np.concatenate([np.concatenate([-opening, opening], axis=1), np.ones((1, 6))])
        largest = MAX_MOTION / np.sqrt(3 * np.linalg.cond(matrix[k]))
        limits = np.append(-needed[k] / unit[k] - 1e-2, largest)
        found = linprog(np.zeros(6), conditions, limits, bounds=(0, None))
        assert found.status == 2, "a motion exists"


def test_only_for_ellipsoids():
    quartic = pj.Quartic([1.0, *[0.0] * 14], 0.03)
    with pytest.raises(ValueError, match="Frictionless needs an ellipsoid; the surface has degree 4"):
        pj.solve_contacts(quartic, flat_push(), solver=Frictionless())


def test_derivatives_are_those_without_friction():
    """The coefficients of friction, which the solver ignores, have no influence on derivatives."""
    point, normal = np.array([[-0.03, 0.01], [-0.03, -0.02]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    surface = pj.Ellipsoid(np.diag([1.0, 1.0, 1.3]), 0.03)

    @jax.jit
    @jax.vmap
    def program(displacement, along, weights):
        def twist(inputs):
            return pj.solve_contacts(surface, pj.Contacts(point, normal, *inputs), solver=Frictionless()).twist, None

        mu = jnp.array([0.3, 0.3])
        value, _, forward, (by_displacement, by_friction) = slopes(twist, (displacement, mu), (along, 0 * mu), weights)
        return value, forward, by_displacement, by_friction

    # each row is a derivative along one entry of the displacements, and of one entry of the twist
    at, entries, weights = np.array([[1e-3, 2e-4], [1.2e-3, -1e-4]]), np.eye(4).reshape(4, 2, 2), np.eye(4, 3)
    ahead, behind = (np.asarray(program(at + t * entries, entries, weights)[0]) for t in (1e-8, -1e-8))
    _, forward, by_displacement, by_friction = program(at + 0 * entries, entries, weights)
    assert not np.any(by_friction)
    reverse = np.asarray(by_displacement)[:3].reshape(3, 4)
    np.testing.assert_allclose(reverse, (ahead - behind).T / 2e-8, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.asarray(forward).T, reverse, rtol=1e-9, atol=1e-12)
