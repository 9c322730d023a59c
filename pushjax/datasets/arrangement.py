"""The aluminium triangle and the ways it was supported.

Source: the constants of the toolbox that processed the logs for Table 2 of Zhou et al. 2017
(github.com/robinzhoucmu/PlanarManipulationToolBox). Its lengths are millimetres in the *corner frame*: origin
at the right-angle corner, axes along the two legs.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pushjax.datasets.pushes import Floats

# Calibration of the motion capture: the centre of mass in the corner frame, m (a third of each leg).
CENTRE_OF_MASS = np.array([0.05, 0.05, 0.0])
# Outline about the centre of mass, m; legs of 0.15 m.
VERTICES = np.array([[0.0, 0.0], [0.0, 0.15], [0.15, 0.0]]) - CENTRE_OF_MASS[:2]
# The paper's characteristic length: right-angle corner to centre of mass (not the radius of gyration).
LENGTH = float(np.hypot(CENTRE_OF_MASS[0], CENTRE_OF_MASS[1]))
# The toolbox's radius for the finger, m. (The forces set in about 1.6 mm later than it implies.)
TIP_RADIUS = 0.001
# Comments of the toolbox: mass in kg; the acceleration it computes with, m/s^2.
MASS, GRAVITY = 1.518, 9.8
# The sensor's axes are turned by 45 degrees against the finger's, and seen from below (so a reflection). It
# reads the reaction on the finger: the force on the object in the finger's frame is FORCE_SIGN * R_TOOL @
# reading.
R_TOOL = np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
FORCE_SIGN = -1.0

# Support points in the corner frame, mm. The logs are named by these numbers, the three x before the three y.
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
    """(p, 2) m, body: support points of a named arrangement, none for "patch"; ValueError for other names."""
    if arrangement not in ARRANGEMENTS:
        raise ValueError(f"arrangement must be one of {', '.join(ARRANGEMENTS)}; got {arrangement!r}")
    return _body_from_corner(ARRANGEMENTS[arrangement])


def support_force(points: ArrayLike) -> Floats:
    """(p,) N: normal forces at `points` (p, 2), m, body, that carry the triangle's weight in equilibrium.

    Only three points (or none, giving none) determine them. Raises ValueError for another number, for points
    on one line, and where the centre of mass lies outside their triangle, so that the object would tip over.
    """
    where = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if len(where) == 0:
        return np.empty(0)
    if len(where) != 3 or not np.isfinite(where).all():
        raise ValueError(f"support points must be three finite points, or none; got {where.tolist()}")
    # Forces add up to the weight and have no moment about the body origin. Scaled by the length so that the
    # condition number says whether the points lie on one line, whatever the unit.
    balance = np.vstack([np.ones(3), where.T / LENGTH])
    if np.linalg.cond(balance) > 1e8:
        raise ValueError(f"support points must not lie on one line; got {where.tolist()}")
    force = np.linalg.solve(balance, np.array([MASS * GRAVITY, 0.0, 0.0]))
    if np.any(force < 0):
        raise ValueError(f"the centre of mass must lie inside the support points; got {where.tolist()}")
    return force.astype(np.float64)


def name_support(path: Path) -> tuple[str, Floats] | None:
    """Arrangement and support points (p, 2), m, body, told from the file's and folder's names, or None.

    Recognised are `3pts1` ... `3pts4`, `patch`, and six numbers such as `30_90_30_30_30_90`: millimetres in
    the corner frame, x of the three points and then y. Numbers that match no known arrangement give it the
    name "unknown".
    """
    for name in (path.name, path.parent.name):
        numbers = _SIX_NUMBERS.search(name)
        if numbers:
            values = np.array([float(number) for number in numbers.group().split("_")])
            points = values.reshape(2, 3).T
            known = [key for key, value in ARRANGEMENTS.items() if value and np.allclose(value, points)]
            return (known[0] if known else UNKNOWN), _body_from_corner(points)
        for arrangement in ARRANGEMENTS:
            if arrangement in name:
                return arrangement, support_points(arrangement)
    return None


def name_surface(path: Path) -> str:
    """The surface that the names of the file and of its folder tell: "plywood", "hardboard" or "unknown".

    The originals say `wood` in the folder for plywood, and nothing but the arrangement for hardboard.
    """
    for name in (path.name, path.parent.name):
        if "wood" in name:
            return "plywood"
        if "hardboard" in name:
            return "hardboard"
    return UNKNOWN if name_support(path) is None else "hardboard"


def _body_from_corner(points: ArrayLike) -> Floats:
    return np.asarray(points, dtype=np.float64).reshape(-1, 2) / 1000 - CENTRE_OF_MASS[:2]
