"""Read original text logs of the aluminum triangle that one finger pushes.

The conversion of the numbers follows the published toolbox, with two exceptions: quaternions are normalized here,
because they are logged with three to six digits, and angles never turn the long way. The toolbox has lengths in
millimeters, and points in the *corner frame*: the origin of this frame is at the right-angle corner, and its axes are
along the two legs. Here points are in meters in the body frame, whose origin is at the center of mass.

Reference: Zhou, Bagnell, Mason, "A fast stochastic contact model for planar pushing and grasping", RSS 2017, table 2,
and its toolbox (github.com/robinzhoucmu/PlanarManipulationToolBox).
"""

import re
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pushjax.datasets.planar import cross, in_body, interpolated, rotation, wrap_angle
from pushjax.datasets.recordings import Floats, LogError, Recording, Recordings, collect
from pushjax.datasets.triangle_text import Record, check_quaternions, read_records

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
# The sensor's axes are turned by 45 degrees from the finger's and are viewed from below, so R_TOOL is a reflection. The
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
_SIX_NUMBERS = re.compile(r"(?<![\d.])\d+(?:\.\d+)?(?:_\d+(?:\.\d+)?){5}(?![\d.])")

# The toolbox's filter drops the first 30 % of the samples: the finger approaches, and contact builds up.
SKIPPED_FRACTION = 0.3
# A finger that moves less than this (m) has no clear direction, because its path is logged with a resolution of 0.1 mm.
MIN_TRAVEL = 0.001
# The motion capture has jumped in two cases. (1) The object moved more than MAX_MOTION (m, as |dx| + length |dtheta|),
# which is more than the finger can push it. (2) At the end, the finger is more than MAX_GAP (m) away from the line of
# the edge that it pushes on.
MAX_MOTION = 0.060
MAX_GAP = 0.003


def load_triangle_log(
    path: str | PathLike[str], *, surface: str | None = None, arrangement: str | None = None
) -> Recordings:
    """Read an original log, plain or gzip-compressed, which is recognized by content and not by name.

    The object is tracked at the first and the last sample of each push. The finger's path is the logged one, which ends
    about a millimeter before the object comes to rest. The force is interpolated at the finger's samples. Each push has
    one pair of wrench and twist, as in the paper: the mean wrench (N, N m) of the samples that are at least as strong
    as the mean force, and the displacement (m, rad) in the body frame at the start.

    Args:
        path: The log.
        surface: Material that the triangle slides on; by default taken from the names of the file and its folder.
        arrangement: "3pts1" ... "3pts4" or "patch", which determines the support points; by default taken from the
            names.

    Returns:
        The usable pushes, and the problems of the others.

    Raises:
        LogError: If no push is usable, or if the file is missing, empty or no such log.
        ValueError: If `arrangement` is unknown.

    Reference: Layout and processing are as in the toolbox of Zhou et al. 2017. The rule for jumps is our own.
    """
    file = Path(path).expanduser()
    name, points = support_from_name(file)
    if arrangement is not None:
        name, points = arrangement, support_points(arrangement)
    records, problems = read_records(file)
    found = [_usable_push(file, record) for record in records]
    return collect(file, [*found, *problems], **facts(surface or _surface_from_name(file), name, points))


def facts(surface: str | None, arrangement: str | None, points: Floats | None) -> dict:
    """Return what is known of the triangle on support points (p, 2), as fields of `Recordings`."""
    return {
        "vertices": VERTICES.copy(),
        "length": LENGTH,
        "tip_radius": TIP_RADIUS,
        "support_points": points,
        "support_force": None if points is None else support_force(points),
        "surface": surface,
        "object": arrangement,
    }


def support_points(arrangement: str) -> Floats:
    """Return the support points (p, 2), m, body frame, of a key of ARRANGEMENTS; none for "patch"."""
    if arrangement not in ARRANGEMENTS:
        raise ValueError(f"arrangement must be one of {', '.join(ARRANGEMENTS)}; got {arrangement!r}")
    return _body_from_corner(ARRANGEMENTS[arrangement])


def support_force(points: ArrayLike) -> Floats:
    """Return the normal forces (p,), N, of static equilibrium at three support points (p, 2), m, or at none."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0:
        return np.empty(0)
    # The forces add up to the weight and have no moment about the body origin. Points divided by LENGTH are
    # dimensionless, so the condition number does not depend on the unit. It is large if the points lie on one line.
    balance = np.vstack([np.ones(3), points.T / LENGTH])
    on_a_line = np.linalg.cond(balance) > 1e8
    force = np.full(3, -1.0) if on_a_line else np.linalg.solve(balance, np.array([MASS * GRAVITY, 0.0, 0.0]))
    if np.any(force < 0):  # the object would tip over
        raise ValueError(f"the center of mass must lie inside three support points; got {points.tolist()}")
    return np.asarray(force, np.float64)


def support_from_name(path: Path) -> tuple[str | None, Floats | None]:
    """Determine arrangement and support points (p, 2), m, body frame, from the names of a file and its folder."""
    for name in (path.name, path.parent.name):
        numbers = _SIX_NUMBERS.search(name)
        if numbers:  # such as 30_90_30_30_30_90: x of the three points and then y, mm, corner frame
            points = np.array(numbers.group().split("_"), float).reshape(2, 3).T
            known = [key for key, value in ARRANGEMENTS.items() if value and np.allclose(value, points)]
            return (known[0] if known else None), _body_from_corner(points)
        for arrangement in ARRANGEMENTS:
            if arrangement in name:
                return arrangement, support_points(arrangement)
    return None, None


def _surface_from_name(path: Path) -> str | None:
    """Determine "plywood" or "hardboard" from the names of a file and its folder; None if they do not say."""
    for name in (path.name, path.parent.name):
        if "wood" in name:  # original logs name the folder so, and give only the arrangement for hardboard
            return "plywood"
        if "hardboard" in name:
            return "hardboard"
    return None if support_from_name(path)[1] is None else "hardboard"


def _body_from_corner(points: ArrayLike) -> Floats:
    """Convert points (p, 2) from the corner frame in mm to the body frame in m."""
    return np.asarray(points, dtype=np.float64).reshape(-1, 2) / 1000 - CENTER_OF_MASS[:2]


def _usable_push(path: Path, record: Record) -> Recording | LogError:
    """Convert a record to a push, or return the error that says why it cannot be trusted."""
    try:
        record.check_samples()
        start, end = object_poses(record)
        # Unix times in s use most digits of a float64, so the clock of the push starts at its first force sample.
        force_time = record.force[:, 0] - record.force[0, 0]
        tip_time = record.robot[:, 0] - record.force[0, 0]
        # The sensor measures in the finger's frame, which turns a little during the push.
        yaw = np.unwrap(_yaw(record.robot[:, 4:]))
        in_tool = FORCE_SIGN * record.force[:, 1:] @ R_TOOL.T
        force = np.einsum("kij,kj->ki", rotation(np.interp(force_time, tip_time, yaw)), in_tool - in_tool[0])
        tip = record.robot[:, 1:3] / 1000
        _check_motion(start, end, tip)
        return make_push(record.index, start, end, tip_time, tip, force_time, force)
    except ValueError as fault:
        return LogError(path, str(fault), push=record.index, line=record.line)


def make_push(
    index: int, start: Floats, end: Floats, tip_time: Floats, tip: Floats, force_time: Floats, force: Floats
) -> Recording:
    """Return the push of a finger, from poses (3,), tip (M, 2) and force (K, 2), world frame, on one clock."""
    keep = _force_filter(force)
    if not keep.any():
        raise ValueError("expected the force to last after the first 30 % of the samples, found none there")
    pose = np.full((len(tip), 3), np.nan)
    pose[0], pose[-1] = start, end
    # The object is tracked only before and after the push. Its displacement is spread evenly over the kept samples, by
    # sample number and not by time, because the paper's pairs were made in this way.
    moved = end - start
    moved[2] = wrap_angle(moved[2])
    between = start + np.linspace(0.0, 1.0, int(keep.sum()))[:, None] * moved
    at = np.stack([np.interp(force_time[keep], tip_time, column) for column in tip.T], axis=1)
    body_force = in_body(between, force[keep])
    torque = cross(in_body(between, at - between[:, :2]), body_force)
    return Recording(
        index,
        tip,
        pose,
        interpolated(tip_time, force_time, force),
        tip_time,
        wrench=np.append(body_force.mean(axis=0), torque.mean())[None],
        twist=np.append(rotation(start[2]).T @ moved[:2], moved[2])[None],
    )


def _force_filter(force: Floats) -> NDArray[np.bool_]:
    """Select the forces (K, 2) after the first 30 % that are at least as strong as the mean force, (K,)."""
    # This is the rule of the toolbox, including its counting from 1. Nothing is smoothed.
    count = len(force)
    late = np.arange(1, count + 1) >= np.ceil(SKIPPED_FRACTION * count)
    return late & (np.hypot(force[:, 0], force[:, 1]) >= np.hypot(*force.mean(axis=0)))


def _check_motion(start: Floats, end: Floats, tip: Floats) -> None:
    """Raise ValueError if the finger, with path (M, 2), does not move or the motion capture jumps."""
    travel = float(np.hypot(*(tip[-1] - tip[0])))
    if not travel >= MIN_TRAVEL:
        raise ValueError(f"expected the finger to move at least {1e3 * MIN_TRAVEL:g} mm, found {1e3 * travel:.2g} mm")
    moved = end - start
    deviation = float(np.hypot(moved[0], moved[1]) + LENGTH * abs(moved[2]))
    # distance of the last finger center from the line of the edge that faces the first one, > 0 outside
    gap = float(_edge_distances(end, tip[-1])[np.argmax(_edge_distances(start, tip[0]))])
    # The condition is negated so that it also fails for NaN, which very large numbers can give.
    if not (deviation <= MAX_MOTION and abs(gap) <= MAX_GAP):
        expected = f"less than {MAX_MOTION * 1e3:g} mm and to end within {MAX_GAP * 1e3:g} mm of the finger"
        found = f"{deviation * 1e3:.4g} mm and {gap * 1e3:.4g} mm"
        raise ValueError(f"the motion capture jumped: expected the object to move {expected}, found {found}")


def _edge_distances(pose: Floats, point: Floats) -> Floats:
    """Return the signed distances (3,) of a world point from the lines of the edges, positive outside."""
    edge = np.roll(VERTICES, -1, axis=0) - VERTICES
    # The vertices are in clockwise order, so the outside is to the left of an edge.
    outward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    local = rotation(pose[2]).T @ (point - pose[:2])
    return np.sum((local - VERTICES) * outward, axis=1)


def object_poses(record: Record) -> tuple[Floats, Floats]:
    """Return the poses (3,) of the body frame before and after a push: x, y (m), theta (rad), world frame."""
    check_quaternions(record.poses[:, 3:], "object pose")
    start, end = (_body_pose(row) for row in record.poses)
    end[2] = start[2] + wrap_angle(end[2] - start[2])
    return start, end


def _body_pose(row: Floats) -> Floats:
    """Convert a logged pose (7,) of the corner to the world pose (3,) of the body frame: x, y (m), theta (rad)."""
    w, x, y, z = row[3:] / np.linalg.norm(row[3:])
    # First two rows of the rotation matrix. The plate's small tilt shortens the distance to its center in the plane.
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        ]
    )
    position = row[:2] / 1000 + matrix @ CENTER_OF_MASS
    return np.append(position, wrap_angle(_yaw(row[None, 3:]))[0])


def _yaw(quaternions: Floats) -> Floats:
    """Return the rotations (m,) about the vertical, in rad, of quaternions (m, 4) of small tilt, ordered w, x, y, z."""
    return 2 * np.arctan2(quaternions[:, 3], quaternions[:, 0])
