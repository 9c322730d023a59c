"""The sliders that are grasped: their outlines, supports and start poses.

The rectangle is the paper's. For the butterfly the paper gives two diameters: 39 mm across its convex ends and 28.6 mm
across its concave waist. The outline here is r(angle) = a + b cos(2 angle) + c cos(4 angle) with these two diameters
and c = -1 mm, which makes the waist a hollow of 17 mm radius.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import pushjax as pj

ENDS_DIAMETER, WAIST_DIAMETER = 0.039, 0.0286  # m, diameters of the butterfly
HOLLOW_TERM = -0.001  # c, m
CURVE_POINTS = 24


class Setting(NamedTuple):
    """Slider, supports, start poses and jaw of one experiment."""

    shape: pj.Shape
    supports: dict[str, pj.Support]  # by the name of the pressure distribution
    n: int  # number of grasps
    circle: float  # radius of the circle of start centers, m
    symmetry: float  # rotation after which the outline is the same, rad
    opening: tuple[float, float]  # first and last opening of the jaw, m


def rectangle() -> Setting:
    """Return the setting of the rectangle, on its rim or on six points."""
    block = pj.Polygon.rectangle(0.050, 0.035)
    x, y = 0.025, 0.0175
    six = np.array([(-x, -y), (0, -y), (x, -y), (x, y), (0, y), (-x, y)])
    supports = {"rim": pj.Support.rim(block, points=200), "six points": pj.Support.points(six)}
    return Setting(block, supports, 600, 0.020, np.pi, (0.085, 0.001))


def butterfly() -> Setting:
    """Return the setting of the butterfly, on its rim."""
    angle = 2 * np.pi * np.arange(CURVE_POINTS) / CURVE_POINTS
    b = (ENDS_DIAMETER - WAIST_DIAMETER) / 4
    r = ENDS_DIAMETER / 2 - b - HOLLOW_TERM + b * np.cos(2 * angle) + HOLLOW_TERM * np.cos(4 * angle)
    points = jnp.asarray(np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1), jnp.result_type(float))
    curve = pj.Curve.through(points)
    return Setting(curve, {"rim": pj.Support.rim(curve, points=200)}, 900, 0.030, np.pi, (0.085, 0.001))


SLIDERS: dict[str, Any] = {"rectangle": rectangle, "butterfly": butterfly}
