"""Inside `jax.enable_x64`, everything has the floats of the context, also what another thread computes."""

import jax
import numpy as np
import pytest

import pushjax as pj
from pushjax._internal.jit import enable_x64


@pytest.mark.parametrize("x64", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_context_and_not_the_default_sets_the_floats(x64):
    default = jax.numpy.zeros(()).dtype == np.float64
    jax.config.update("jax_enable_x64", not x64)
    try:
        with enable_x64(x64):
            square = pj.Polygon.rectangle(0.09, 0.09)
            pairs = pj.Support.uniform(square, points=16, load=1.0).wrench_twist_pairs(jax.random.key(0), 40)
            surface = pj.fit_limit_surface(*pairs, degree=4)
            scene = pj.Slider(square, surface), pj.Hand.finger(0.005), pj.line((-0.05, 0.01), (0.0, 0.01), 4)
            push = pj.rollout(*scene, pose=(0, 0, 0), friction=0.3)
            model = pj.FrictionModel(dof=20.0, friction=(0.1, 0.5))
            pushes = pj.monte_carlo(jax.random.key(1), 4, *scene, pose=(0, 0, 0), model=model)
            twist = surface.twist((0.3, 0.2, 0.001))
            wrench = surface.wrench(twist)
    finally:
        jax.config.update("jax_enable_x64", default)
    dtype = np.float64 if x64 else np.float32
    floats = [leaf for leaf in jax.tree.leaves((surface, push, twist, wrench)) if leaf.dtype.kind == "f"]
    assert {leaf.dtype for leaf in [*floats, pushes.pose, pushes.friction]} == {np.dtype(dtype)}
    assert push.status.tolist() == [pj.Status.MOVING] * 4
    assert set(pushes.status.ravel().tolist()) == {pj.Status.MOVING}
    directions = [each / np.linalg.norm(each) for each in (surface.twist(wrench), twist)]
    np.testing.assert_allclose(*directions, atol=1e-5)
