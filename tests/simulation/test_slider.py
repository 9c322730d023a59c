"""Sliders: what they are made of, and the two ways to make one in a line."""

import numpy as np
import pytest

import pushjax as pj

BLOCK = pj.Polygon.rectangle(0.09, 0.06)


@pytest.mark.parametrize("degree", [2, 4])
def test_a_slider_in_one_line(degree):
    """It is the slider that is written out with `Support.uniform`, pairs and a fit, to the bit."""
    import jax

    support = pj.Support.uniform(BLOCK, load=2.0)
    pairs = support.wrench_twist_pairs(jax.random.key(0), 400)
    surface = pj.fit_limit_surface(*pairs, degree=degree)
    for slider in (pj.Slider.uniform(BLOCK, degree=degree, load=2.0), pj.Slider.on(BLOCK, support, degree=degree)):
        assert slider.shape is BLOCK
        assert slider.surface.degree == degree
        for made, written in zip(jax.tree.leaves(slider.surface), jax.tree.leaves(surface), strict=True):
            np.testing.assert_array_equal(made, written)


def test_what_is_no_shape_is_refused():
    with pytest.raises(TypeError, match="shape: expected a Shape; got a list"):
        pj.Slider.uniform([(0, 0), (1, 0), (0, 1)])
    with pytest.raises(TypeError, match="surface: expected a LimitSurface"):
        pj.Slider(BLOCK, 4)
