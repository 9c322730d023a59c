"""Paths of hands that close or turn, as they are corrected for identification."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.identification.model import correct_path
from pushjax.identification.pushes_of_recordings import in_meters


@pytest.mark.parametrize("column", [2, 3])
def test_a_hand_that_only_closes_or_turns_keeps_its_path(column):
    path = jnp.zeros((6, 4)).at[:, column].set(jnp.linspace(0.1, 0.05, 6))
    none = jnp.zeros(())
    np.testing.assert_array_equal(correct_path(path, none, none, jnp.zeros(2)), path)
    slope = jax.jacrev(lambda x: correct_path(path, x[0], x[1], x[2:]))(jnp.zeros(4))
    assert np.all(np.isfinite(slope))
    # the end of a closing that goes over into a translation is kept, too
    moves = path.at[:, 0].set(jnp.array([0, 0, 0, 0, 0.001, 0.002]))
    np.testing.assert_allclose(correct_path(moves, none, none, jnp.zeros(2)), moves, atol=1e-15)
    # the hand goes on straight: it translates, and closes or turns, which counts as travel too
    longer = correct_path(moves, jnp.asarray(0.001), none, jnp.zeros(2))
    beyond = (longer - moves)[-1] / (moves[-1] - moves[-2])
    np.testing.assert_allclose(beyond[0], beyond[column], rtol=1e-9)
    np.testing.assert_allclose(jnp.linalg.norm(in_meters(longer - moves)[-1]), 0.001, rtol=1e-9)


@pytest.mark.slow
def test_friction_from_a_jaw_that_closes():
    """Pushes by a jaw that only closes on an askew block determine the friction of its pads."""
    slider = pj.Slider(pj.Polygon.rectangle(0.06, 0.04), pj.Ellipsoid(np.eye(3), length=0.025))
    jaw, rng = pj.Hand.parallel_jaw(width=0.03, thickness=0.01), np.random.default_rng(0)
    path = np.asarray(pj.line((0, 0, 0, 0.075), (0, 0, 0, 0.056), 12))
    starts = np.stack([*rng.uniform(-0.008, 0.008, (2, 8)), rng.uniform(0.35, 0.5, 8)], axis=1)
    ends = jax.jit(jax.vmap(lambda start: pj.rollout(slider, jaw, path, pose=start, friction=0.25).pose[-1]))(starts)
    assert np.abs(ends[:, 2] - starts[:, 2]).min() > 0.01
    pushes = pj.Pushes(start=starts, path=np.tile(path, (8, 1, 1)), end=np.asarray(ends))
    found = pj.identify(pushes, slider, jaw, pj.Unknowns(surface_dof=None), sigma=1e-4)
    assert float(found.friction) == pytest.approx(0.25, abs=0.02)
