"""Constants of the aluminum triangle that Zhou et al. 2017 pushed, and the ways in which it was supported.

The constants come from the authors' toolbox. It has lengths in millimeters, and points in the *corner frame*: the
origin of this frame is at the right-angle corner, and its axes are along the two legs. The functions here return points
in meters in the body frame, whose origin is at the center of mass.

Reference: Constants of the toolbox that processed the logs for Table 2 of Zhou et al. 2017
(github.com/robinzhoucmu/PlanarManipulationToolBox).
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pushjax.datasets.push_log import Floats

# Calibration of the motion capture: the center of mass in the corner frame, in m (a third of each leg).
CENTER_OF_MASS = np.array([0.05, 0.05, 0.0])
# Outline about the center of mass, in m, with legs of 0.15 m.
VERTICES = np.array([[0.0, 0.0], [0.0, 0.15], [0.15, 0.0]]) - CENTER_OF_MASS[:2]
# The paper's characteristic length, in m: right-angle corner to center of mass (not the radius of gyration).
LENGTH = float(np.hypot(CENTER_OF_MASS[0], CENTER_OF_MASS[1]))
# Radius of the finger in the toolbox, in m. A finger of this radius would touch about 1.6 mm of travel before the
# measured forces begin.
TIP_RADIUS = 0.001
# From comments in the toolbox: mass in kg, and the gravity that it computes with, in m/s^2.
MASS, GRAVITY = 1.518, 9.8
# The sensor's axes are turned by 45 degrees from the finger's and are seen from below, so R_TOOL is a reflection. The
# sensor measures the reaction on the finger. The force on the object, in the finger's frame, is therefore
# FORCE_SIGN * R_TOOL @ reading.
R_TOOL = np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
FORCE_SIGN = -1.0

# Support points in the corner frame, in mm. Names of logs can contain these numbers: first the three x, then the three
# y. "patch" has no points, because the whole face touches the surface.
ARRANGEMENTS: dict[str, tuple[tuple[float, float], ...]] = {
    "3pts1": ((30.0, 30.0), (63.33, 43.33), (43.33, 63.33)),
    "3pts2": ((10.0, 10.0), (130.0, 10.0), (10.0, 130.0)),
    "3pts3": ((30.0, 30.0), (90.0, 30.0), (30.0, 90.0)),
    "3pts4": ((10.0, 10.0), (90.0, 30.0), (10.0, 130.0)),
    "patch": (),
}
UNKNOWN = "unknown"
_SIX_NUMBERS = re.compile(r"(?<![\d.])\d+(?:\.\d+)?(?:_\d+(?:\.\d+)?){5}(?![\d.])")


def support_points(arrangement: str) -> Floats:
    """Return the support points (p, 2), m, body frame, of a key of ARRANGEMENTS; none for "patch"."""
    if arrangement not in ARRANGEMENTS:
        raise ValueError(f"arrangement must be one of {', '.join(ARRANGEMENTS)}; got {arrangement!r}")
    return _body_from_corner(ARRANGEMENTS[arrangement])


def support_force(points: ArrayLike) -> Floats:
    """Return the normal forces (p,), N, of static equilibrium at three support points (p, 2), m, or at none."""
    vertices = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if len(vertices) == 0:
        return np.empty(0)
    if len(vertices) != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"support points must be three finite points, or none; got {vertices.tolist()}")
    # The forces add up to the weight and have no moment about the body origin. Points divided by LENGTH are
    # dimensionless. So the condition number does not depend on the unit. It is large if the points lie on one line.
    balance = np.vstack([np.ones(3), vertices.T / LENGTH])
    if np.linalg.cond(balance) > 1e8:
        raise ValueError(f"support points must not lie on one line; got {vertices.tolist()}")
    force = np.linalg.solve(balance, np.array([MASS * GRAVITY, 0.0, 0.0]))
    if np.any(force < 0):  # the object would tip over
        raise ValueError(f"the center of mass must lie inside the support points; got {vertices.tolist()}")
    return force.astype(np.float64)


def support_from_name(path: Path) -> tuple[str, Floats] | None:
    """Determine arrangement and support points (p, 2), m, body frame, from the names of a file and its folder."""
    for name in (path.name, path.parent.name):
        numbers = _SIX_NUMBERS.search(name)
        if numbers:  # such as 30_90_30_30_30_90: x of the three points and then y, mm, corner frame
            values = np.array([float(number) for number in numbers.group().split("_")])
            points = values.reshape(2, 3).T
            known = [key for key, value in ARRANGEMENTS.items() if value and np.allclose(value, points)]
            return (known[0] if known else UNKNOWN), _body_from_corner(points)
        for arrangement in ARRANGEMENTS:
            if arrangement in name:
                return arrangement, support_points(arrangement)
    return None


def surface_from_name(path: Path) -> str:
    """Determine "plywood", "hardboard" or "unknown" from the names of a file and its folder."""
    for name in (path.name, path.parent.name):
        if "wood" in name:  # original logs name the folder so, and give only the arrangement for hardboard
            return "plywood"
        if "hardboard" in name:
            return "hardboard"
    return UNKNOWN if support_from_name(path) is None else "hardboard"


def _body_from_corner(points: ArrayLike) -> Floats:
    """Convert points (p, 2) from the corner frame in mm to the body frame in m."""
    return np.asarray(points, dtype=np.float64).reshape(-1, 2) / 1000 - CENTER_OF_MASS[:2]
