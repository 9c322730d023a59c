"""Pushes agree with a second implementation in plain Python."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import plain_push

from benchmarks import reference_push


@pytest.mark.parametrize(
    ("offset", "angle", "modes"),
    [(0.01, 0.0, {1}), (0.03, 0.2, {1, 2, 3}), (0.02, -0.5, {3}), (-0.01, 0.6, {2})],
)
def test_rollouts_are_the_plain_push(offset, angle, modes):
    here = reference_push.task("quartic", "float64")
    path = np.asarray(reference_push.paths(jnp.array([offset]), jnp.array([angle]), 20)[0])
    vertices = [tuple(map(float, v)) for v in here.slider.shape.vertices]
    surface = here.slider.surface
    task = plain_push.Push(
        vertices,
        [float(c) for c in surface.coefficients],
        float(surface.length),
        reference_push.RADIUS,
        reference_push.FRICTION,
    )
    push = here.push(jnp.asarray(path))
    assert set(np.asarray(push.mode[:, 0]).tolist()) == modes
    pose = plain_push.push(task, [tuple(map(float, q)) for q in path], (0.0, 0.0, 0.0))
    np.testing.assert_allclose(pose, push.pose[-1], rtol=0, atol=1e-14)
