"""Identification of the loads on known support points, with the exact limit surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj

BOX, FINGER, MU = pj.Polygon.rectangle(0.09, 0.09), pj.Hand.finger(0.005), 0.3
PLACES = np.array([[-0.035, -0.03], [0.04, -0.02], [0.0, 0.035]])
LOADS = np.array([0.5, 0.2, 0.3])


@jax.jit
def ends(slider, starts, paths):
    push = jax.vmap(lambda start, path: pj.rollout(slider, FINGER, path, pose=start, friction=MU))(starts, paths)
    return push.pose[:, -1]


@pytest.fixture(scope="module")
def pushes():
    """Pushes of 30 mm of a slider on three feet, from three sides, without noise."""
    rng, starts, paths = np.random.default_rng(0), [], []
    for k in range(12):
        way = np.pi / 2 * (k % 3)
        axis, across = np.array([np.cos(way), np.sin(way)]), np.array([-np.sin(way), np.cos(way)])
        begin = -0.0505 * axis + rng.uniform(-0.03, 0.03) * across
        starts.append(np.zeros(3))
        paths.append(begin + np.linspace(0, 0.03, 13)[:, None] * (axis + rng.uniform(-0.2, 0.2) * across))
    starts, paths = np.array(starts), np.array(paths)
    slider = pj.Slider.on(BOX, pj.Support(PLACES, LOADS), exact=True)
    return pj.Pushes(starts, paths, np.asarray(ends(slider, jnp.asarray(starts), jnp.asarray(paths))))


@pytest.mark.slow
def test_loads_are_recovered(pushes, tmp_path):
    expected = pj.Slider.on(BOX, pj.Support(PLACES, np.full(3, 1 / 3)), exact=True)
    found = pj.identify(pushes, expected, FINGER, pj.Unknowns((0.0, 1.0), surface_dof=5.0))
    assert found.converged
    assert abs(float(found.friction) / MU - 1) < 1e-4
    # a factor of all loads does not matter
    np.testing.assert_allclose(found.surface.limit / jnp.sum(found.surface.limit), LOADS, atol=1e-4)
    assert float(jnp.abs(found.residual).max()) < 1e-6
    found.save(tmp_path / "feet.json")
    again = pj.Identified.load(tmp_path / "feet.json")
    np.testing.assert_array_equal(again.surface.limit, found.surface.limit)
    np.testing.assert_array_equal(again.surface.point, PLACES)
    with pytest.raises(ValueError, match="pressure_center: of exact support points"):
        pj.identify(pushes, expected, FINGER, pj.Unknowns((0.0, 1.0), pressure_center=0.005))
