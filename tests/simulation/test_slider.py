"""Sliders: what they are made of, and the two ways to make one in a line."""

import warnings

import jax
import numpy as np
import pytest

import pushjax as pj

BLOCK = pj.Polygon.rectangle(0.09, 0.06)


@pytest.mark.parametrize("degree", [2, 4])
def test_a_slider_in_one_line(degree):
    """It is the slider that is written out with `Support.uniform`, pairs and a fit, to the bit."""
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


@pytest.mark.parametrize(
    ("scale", "path", "pose", "words"),
    [
        (1.0, [(-60.0, 0.0), (-50.0, 0.0)], (0.0, 0.0, 0.0), r"path: .* in millimeters\?"),
        (1.0, [(-0.06, 0.0), (-0.05, 0.0)], (0.0, 0.0, 90.0), r"pose: its angle is 90 rad: is it in degrees\?"),
        (1e3, [(-60.0, 0.0), (-50.0, 0.0)], (0.0, 0.0, 0.0), r"slider: .* 30 m: are its coordinates in millimeters\?"),
    ],
)
def test_units_that_are_probably_wrong_are_named(scale, path, pose, words):
    """Each gets one warning, at the caller's line; under `jit`, where values are not known, there is none."""
    slider = pj.Slider(pj.Disk(0.05 * scale), pj.Ellipsoid(np.eye(3), 0.03 * scale))
    hand = pj.Hand.finger(0.005 * scale)
    with pytest.warns(UserWarning, match=words) as seen:
        pj.step(slider, hand, *path, pose=pose, friction=0.3)
    assert len(seen) == 1
    assert seen[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda path, pose: pj.step(slider, hand, *path, pose=pose, friction=0.3).pose)(
            np.asarray(path), np.asarray(pose)
        )
