"""Fits by a convex program or by jaxopt, and contact problems by a root finder, give the same answers as pushjax."""

import sys

import jax
import numpy as np
import pytest

import pushjax as pj
from benchmarks import cases
from benchmarks.peers import by_jaxopt, contacts, fits

SOLVER = 1e-6  # relative error left by Clarabel


@pytest.mark.parametrize("degree", [2, 4])
def test_the_convex_program_has_the_same_optimum(degree):
    pytest.importorskip("cvxpy")
    wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", 3))
    theirs = fits.fit(wrench, twist, length, degree)
    _, ours = jax.jit(cases.fit("float64", 3, degree).function)(wrench, twist, length)
    assert theirs.clipped == 0
    np.testing.assert_allclose(theirs.loss, ours.loss, rtol=SOLVER)


@pytest.mark.parametrize("degree", [2, 4])
def test_second_derivatives_as_a_tensor(degree, rng):
    a = rng.normal(size=len(fits.monomials(degree)))
    tensor, f, z = fits.gram(a, degree), *rng.normal(size=(2, 3))

    def value(f):
        return float(np.prod(f ** fits.monomials(degree), axis=1) @ a)

    step = 1e-3
    expected = (value(f + step * z) - 2 * value(f) + value(f - step * z)) / step**2
    found = z @ tensor @ z if degree == 2 else np.einsum("ijkm,i,j,k,m", tensor, z, z, f, f)
    assert found == pytest.approx(expected, rel=1e-4)


def test_clipped_pairs_are_counted(rng):
    """Twists opposite to their wrenches are counted: no surface makes their scales positive."""
    pytest.importorskip("cvxpy")
    wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", 1))
    against = twist.copy()
    against[:, :40] *= -1
    assert fits.fit(wrench, against, length, 2).clipped >= 40


@pytest.mark.long
def test_the_root_finder_has_the_same_answers():
    surface, problem = cases.solve("float64", 60, 2).args
    motion = jax.jit(jax.vmap(pj.solve_contacts))(surface, problem)
    theirs = contacts.solve(surface.coefficients, surface.length, problem)
    status = np.asarray(motion.status)
    assert not theirs.found[status == pj.Status.JAMMED].any()
    both = (status == pj.Status.MOVING) & np.asarray(motion.unique) & theirs.found
    assert both.sum() > 0.8 * (status == pj.Status.MOVING).sum()
    scale = np.stack([np.ones(60), np.ones(60), surface.length], axis=1)
    ours = scale * np.asarray(motion.twist)
    apart = np.abs(scale * theirs.twist - ours).max(axis=1) / np.abs(ours).max(axis=1).clip(1e-6)
    assert apart[both].max() < 1e-6


@pytest.mark.parametrize("degree", [2, 4])
def test_jaxopt_has_the_same_optimum(degree):
    pytest.importorskip("jaxopt")
    wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", 3))
    theirs = by_jaxopt.fit(wrench, twist, length, degree)
    _, ours = jax.jit(cases.fit("float64", 3, degree).function)(wrench, twist, length)
    np.testing.assert_allclose(theirs.loss, ours.loss, rtol=SOLVER)
    assert np.all(theirs.steps < by_jaxopt.FIT_STEPS)


@pytest.mark.slow
def test_contact_problems_that_jaxopt_solves_have_the_same_answers():
    pytest.importorskip("jaxopt")
    surface, problem = cases.solve("float64", 60, 1).args
    motion = jax.jit(jax.vmap(pj.solve_contacts))(surface, problem)
    theirs = by_jaxopt.solve(surface.coefficients, surface.length, problem)
    both = (np.asarray(motion.status) == pj.Status.MOVING) & theirs.found
    assert both.sum() > 30
    scale = np.stack([np.ones(60), np.ones(60), surface.length], axis=1)
    ours = scale * np.asarray(motion.twist)
    apart = np.abs(scale * theirs.twist - ours).max(axis=1) / np.abs(ours).max(axis=1).clip(1e-6)
    assert apart[both].max() < 1e-2


def test_nearest_force_in_the_cone(rng):
    """The projection is in the cone, keeps what is there, and is nearer than any other force there."""
    friction = 0.4
    others = np.stack([np.ones(200), np.linspace(-friction, friction, 200)], axis=1)
    others = np.concatenate([0 * others[:1], *(size * others for size in np.linspace(0, 3, 200))])
    for force in rng.normal(size=(20, 2)):
        nearest = np.asarray(by_jaxopt.nearest_in_cone(force, friction))
        assert np.abs(nearest[1]) <= friction * nearest[0] + 1e-12
        np.testing.assert_allclose(by_jaxopt.nearest_in_cone(nearest, friction), nearest, atol=1e-12)
        assert np.linalg.norm(force - nearest) <= np.linalg.norm(force - others, axis=1).min() + 1e-12


def test_without_jaxopt(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxopt", None)
    with pytest.raises(ValueError, match=r"pip install '\.\[bench\]'"):
        by_jaxopt.jaxopt()


def test_without_cvxpy(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(ValueError, match=r"pip install '\.\[bench\]'"):
        fits.cvxpy()
