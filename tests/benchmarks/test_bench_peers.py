"""Fits by a convex program, and contact problems by a root finder, give the same answers as pushjax."""

import sys

import jax
import numpy as np
import pytest

import pushjax as pj
from benchmarks import cases
from benchmarks.peers import contacts, fits

SOLVER = 1e-6  # relative error left by Clarabel


@pytest.mark.parametrize("degree", [2, 4])
def test_the_convex_program_has_the_same_optimum(degree):
    pytest.importorskip("cvxpy")
    wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", 3))
    theirs = fits.fit(wrench, twist, length, degree)
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


def test_without_cvxpy(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(ValueError, match=r"pip install '\.\[bench\]'"):
        fits.cvxpy()
