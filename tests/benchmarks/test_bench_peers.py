"""Fits by a convex program and by jaxopt, and contact problems by general solvers, give the same answers as pushjax."""

import sys

import jax
import numpy as np
import pytest

import pushjax as pj
from benchmarks import cases
from benchmarks.peers import by_jaxopt, contacts, fits

SOLVER = 1e-6  # relative error left by Clarabel


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize(("package", "fit"), [("cvxpy", fits.fit), ("jaxopt", by_jaxopt.fit)])
def test_fits_have_the_same_optimum(package, fit, degree):
    pytest.importorskip(package)
    wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", 3))
    theirs = fit(wrench, twist, length, degree)
    _, ours = jax.jit(cases.fit("float64", 3, degree).function)(wrench, twist, length)
    assert theirs.clipped == 0
    np.testing.assert_allclose(theirs.loss, ours.loss, rtol=SOLVER)


def test_clipped_pairs_are_counted(rng):
    """Twists opposite to their wrenches are counted: no surface makes their scales positive."""
    pytest.importorskip("cvxpy")
    wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", 1))
    against = twist.copy()
    against[:, :40] *= -1
    assert fits.fit(wrench, against, length, 2).clipped >= 40


# The minimum that jaxopt finds for several contacts is mostly not zero.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("solve", "count", "least", "error"), [(contacts.solve, 2, 0.8, 1e-6), (by_jaxopt.solve, 1, 0.5, 1e-2)]
)
def test_general_solvers_have_the_same_answers(solve, count, least, error):
    pytest.importorskip("jaxopt")
    surface, problem = cases.solve("float64", 60, count).args
    motion = jax.jit(jax.vmap(pj.solve_contacts))(surface, problem)
    theirs = solve(surface.coefficients, surface.length, problem)
    status = np.asarray(motion.status)
    assert not theirs.found[status == pj.Status.JAMMED].any()
    both = (status == pj.Status.MOVING) & np.asarray(motion.unique) & theirs.found
    assert both.sum() > least * (status == pj.Status.MOVING).sum()
    scale = np.stack([np.ones(60), np.ones(60), surface.length], axis=1)
    ours = scale * np.asarray(motion.twist)
    apart = np.abs(scale * theirs.twist - ours).max(axis=1) / np.abs(ours).max(axis=1).clip(1e-6)
    assert apart[both].max() < error


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


@pytest.mark.parametrize(("package", "get"), [("cvxpy", fits.cvxpy), ("jaxopt", by_jaxopt.jaxopt)])
def test_without_the_package(monkeypatch, package, get):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=r"pip install '\.\[bench\]'"):
        get()
