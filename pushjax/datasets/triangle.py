"""Read original text logs of the aluminum triangle that one finger pushes.

`_check_record` has the conditions under which a record counts as a push. `_convert_record` interprets its numbers. Both
follow the published toolbox, with two exceptions: quaternions are normalized here, because they are logged with three
to six digits, and angles never turn the long way.

Reference: Zhou et al. 2017, Table 2.
"""

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pushjax.datasets import triangle_setup
from pushjax.datasets.push_log import (
    Floats,
    LogError,
    Push,
    PushLog,
    contact_onset,
    continuous_angle,
    force_filter,
    nothing_usable,
    rotation,
    wrap_angle,
)
from pushjax.datasets.records import ParseError, Record, check_quaternions, read_records

# Broken trials have one to three samples per push. Complete ones have some 670 force and 220 robot samples.
MIN_SAMPLES = 4
# A finger that moves less than this (m) has no clear direction, because its path is logged with a resolution of 0.1 mm.
MIN_TRAVEL = 0.001
# The motion capture has jumped in two cases. (1) The object moved more than MAX_MOTION (m, as |dx| + length |dtheta|),
# which is more than the finger can push it. (2) At the end, the finger is more than MAX_GAP (m) away from the line of
# the edge that it pushes on.
MAX_MOTION = 0.060
MAX_GAP = 0.003


def load_triangle_log(
    path: str | PathLike[str],
    *,
    surface: str | None = None,
    arrangement: str | None = None,
    support_points: ArrayLike | None = None,
    strict: bool = False,
) -> PushLog:
    """Read an original log, plain or gzip-compressed, which is recognized by content and not by name.

    Damaged pushes become entries of `problems`. The others stay usable, as far as the layout can be followed.

    Args:
        path: The log.
        surface: Material that the triangle slides on; by default taken from the names of the file and its folder.
        arrangement: "3pts1" ... "3pts4" or "patch", which determines the support points; by default taken from the
            names.
        support_points: (3, 2) or (0, 2) support points, in m, body frame; they override those of the arrangement.
        strict: Whether to raise the first problem instead of collecting it.

    Returns:
        The usable pushes, and the problems of the others.

    Raises:
        LogError: If no push is usable, or if the file is missing, empty or no such log. With `strict`, for the first
            problem.
        ValueError: If `arrangement` is unknown, or if the support points cannot carry the object.

    Reference: Layout and processing are as in the toolbox of Zhou et al. 2017. The rule for jumps is our own.
    """
    file = Path(path).expanduser()
    name, points = _select_support(file, arrangement, support_points)
    normal_force = triangle_setup.support_force(points)
    pushes: list[Push] = []
    problems: list[LogError] = []
    for record in read_records(file):
        problem = record if isinstance(record, LogError) else None
        if isinstance(record, Record):
            try:
                pushes.append(_usable_push(record))
            except ParseError as fault:
                problem = LogError(file, str(fault), push=record.index, line=fault.line)
        if problem is not None:
            if strict:
                raise problem
            problems.append(problem)
    if not pushes:
        raise nothing_usable(file, problems)
    return PushLog(
        pushes=tuple(pushes),
        problems=tuple(problems),
        vertices=triangle_setup.VERTICES.copy(),
        length=triangle_setup.LENGTH,
        tip_radius=triangle_setup.TIP_RADIUS,
        support_points=points,
        support_force=normal_force,
        surface=surface if surface is not None else triangle_setup.surface_from_name(file),
        arrangement=name,
        source=str(file),
    )


def _select_support(path: Path, arrangement: str | None, points: ArrayLike | None) -> tuple[str, Floats]:
    """Return the name of the arrangement and its support points (p, 2), from the arguments or else the names."""
    name, known = triangle_setup.support_from_name(path) or (triangle_setup.UNKNOWN, np.empty((0, 2)))
    if arrangement is not None:
        name, known = arrangement, triangle_setup.support_points(arrangement)
    if points is not None:
        known = np.array(points, dtype=np.float64).reshape(-1, 2)
        name = arrangement if arrangement is not None else triangle_setup.UNKNOWN
    return name, known


def _usable_push(record: Record) -> Push:
    """Convert a record to a push, or raise ParseError if the record cannot be trusted."""
    _check_record(record)
    push = _convert_record(record)
    _check_motion(push, record.line + 1)
    if not force_filter(push.force).any():
        raise ParseError(
            "expected the force to last after the first 30 % of the samples, found none there",
            record.force_line,
        )
    return push


def _check_record(record: Record) -> None:
    """Check that a record has enough samples, unit quaternions, and clocks that rise and overlap in time."""
    robot_count_line = record.robot_line - 1
    for what, samples, line in (
        ("force", record.force, record.line + 2),
        ("robot", record.robot, robot_count_line),
    ):
        if len(samples) < MIN_SAMPLES:
            raise ParseError(f"expected at least {MIN_SAMPLES} {what} samples, found {len(samples)}", line)
    check_quaternions(record.poses[:, 3:], record.line, "object pose")
    check_quaternions(record.robot[:, 4:], record.robot_line, "robot sample")
    _check_clock(record.force[:, 0], record.force_line, "force")
    _check_clock(record.robot[:, 0], record.robot_line, "robot")
    if record.robot[0, 0] > record.force[-1, 0] or record.robot[-1, 0] < record.force[0, 0]:
        raise ParseError("expected robot samples from the time of the force samples, found none", record.robot_line)


def _check_clock(time: Floats, line: int, what: str) -> None:
    """Raise ParseError if the times, the first of which is on `line`, decrease."""
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        step = time[back[0] + 1] - time[back[0]]
        message = f"expected time stamps that do not decrease ({what} samples), found a step of {step:.3g} s"
        raise ParseError(message, line + int(back[0]) + 1)


def _check_motion(push: Push, line: int) -> None:
    """Raise ParseError if the finger does not move or the motion capture jumps."""
    # `line` has the pose after the push, which is where a jump shows
    travel = float(np.hypot(*(push.tip[-1] - push.tip[0])))
    if not travel >= MIN_TRAVEL:
        raise ParseError(
            f"expected the finger to move at least {MIN_TRAVEL * 1e3:g} mm, found {travel * 1e3:.2g} mm",
            line,
        )
    moved = push.pose_end - push.pose_start
    deviation = float(np.hypot(moved[0], moved[1]) + triangle_setup.LENGTH * abs(moved[2]))
    gap = _end_gap(push)
    # The condition is negated so that it also fails for NaN, which very large numbers can give.
    if not (deviation <= MAX_MOTION and abs(gap) <= MAX_GAP):
        expected = f"less than {MAX_MOTION * 1e3:g} mm and to end within {MAX_GAP * 1e3:g} mm of the finger"
        found = f"{deviation * 1e3:.4g} mm and {gap * 1e3:.4g} mm"
        raise ParseError(f"the motion capture jumped: expected the object to move {expected}, found {found}", line)


def _end_gap(push: Push) -> float:
    """Return the distance of the last finger center from the line of the edge facing the first one (m, > 0 outside)."""
    start = _edge_distances(push.pose_start, push.tip[0])
    return float(_edge_distances(push.pose_end, push.tip[-1])[np.argmax(start)])


def _edge_distances(pose: Floats, point: Floats) -> Floats:
    """Return the signed distances (3,) of a world point from the lines of the edges, positive outside."""
    edge = np.roll(triangle_setup.VERTICES, -1, axis=0) - triangle_setup.VERTICES
    # The vertices are in clockwise order, so the outside is to the left of an edge.
    outward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    in_body = rotation(pose[2]).T @ (point - pose[:2])
    return np.sum((in_body - triangle_setup.VERTICES) * outward, axis=1)


def _convert_record(record: Record) -> Push:
    """Convert a checked record to a push, in SI units and the world frame."""
    start, end = (body_pose(row) for row in record.poses)
    end[2] = start[2] + wrap_angle(end[2] - start[2])
    # Unix times in s use most digits of a float64, so the clock of the push starts at its first force sample.
    force_time = record.force[:, 0] - record.force[0, 0]
    tip_time = record.robot[:, 0] - record.force[0, 0]
    tip = record.robot[:, 1:3] / 1000
    yaw = continuous_angle(_yaw(record.robot[:, 4:]))
    # The sensor measures in the finger's frame, which turns a little during the push.
    in_tool = triangle_setup.FORCE_SIGN * record.force[:, 1:] @ triangle_setup.R_TOOL.T
    force = np.einsum("kij,kj->ki", rotation(np.interp(force_time, tip_time, yaw)), in_tool - in_tool[0])
    return Push(
        index=record.index,
        pose_start=start,
        pose_end=end,
        tip_time=tip_time,
        tip=tip,
        tip_yaw=yaw,
        force_time=force_time,
        force=force,
        onset=contact_onset(force_time, force, tip_time, tip),
    )


def body_pose(row: Floats) -> Floats:
    """Convert a logged pose (7,) of the corner to the world pose (3,) of the body frame: x, y (m), theta (rad)."""
    w, x, y, z = row[3:] / np.linalg.norm(row[3:])
    # First two rows of the rotation matrix. The plate's small tilt shortens the distance to its center in the plane.
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        ]
    )
    position = row[:2] / 1000 + matrix @ triangle_setup.CENTER_OF_MASS
    return np.append(position, wrap_angle(_yaw(row[None, 3:]))[0])


def _yaw(quaternions: Floats) -> Floats:
    """Return the rotations (m,) about the vertical, in rad, of quaternions (m, 4) of small tilt, ordered w, x, y, z."""
    return 2 * np.arctan2(quaternions[:, 3], quaternions[:, 0])
