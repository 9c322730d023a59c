"""The contents of a log of single-finger pushes, and the wrench-displacement pairs that the paper takes from it.

Frames: *world* is the base frame of the robot. *body* is fixed to the object, with its origin at the center of mass. A
body point p lies at (x, y) + R(theta) p in the world. Forces and wrenches are those that the finger applies *to the
object*.

There is one deviation from the reference's processing. The toolbox interpolates the object's angle without unwrapping
it, and so turns some pushes the long way round. Here the angle always takes the short way.

Reference: Zhou, Bagnell, Mason, "A fast stochastic contact model for planar pushing and grasping", RSS 2017, and its
published toolbox.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike, fspath

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# The toolbox's filter drops the first 30 % of the samples: the finger approaches, and contact builds up.
SKIPPED_FRACTION = 0.3
# Contact begins when the force exceeds the sensor's noise (N) and a fraction of the typical force of the push. The
# typical force is taken from the second half of the samples, where the finger is surely in contact.
ONSET_FORCE = 0.3
ONSET_FRACTION = 0.3
# The robot was commanded to go 15 mm beyond an approach gap of 2.5 mm; in m. The log misses about the last millimeter
# of this motion (the finger is still moving at the last logged sample), but the measured end pose includes it.
COMMANDED_TRAVEL = 0.0175


class LogError(ValueError):
    """A log, or one push of it, that cannot be used.

    Attributes:
        path: The file, as given by the caller.
        message: What was expected, and what was found.
        push: Index of the push in the file, from 0; None if unknown.
        line: Line in the file, from 1; None if unknown.
    """

    def __init__(
        self, path: str | PathLike[str], message: str, *, push: int | None = None, line: int | None = None
    ) -> None:
        super().__init__(message)
        self.path = fspath(path)
        self.message = message
        self.push = push
        self.line = line

    def __str__(self) -> str:
        place = [self.path]
        if self.push is not None:
            place.append(f"push {self.push}")
        if self.line is not None:
            place.append(f"line {self.line}")
        return f"{', '.join(place)}: {self.message}"

    def __reduce__(self) -> tuple[object, ...]:
        # By default, pickle rebuilds an exception from its message alone. That would fail between processes.
        return _rebuild_error, (self.path, self.message, self.push, self.line)


def _rebuild_error(path: str, message: str, push: int | None, line: int | None) -> LogError:
    """Rebuild a pickled error."""
    return LogError(path, message, push=push, line=line)


def nothing_usable(path: str | PathLike[str], problems: Sequence[LogError]) -> LogError:
    """Return the error for a file without a usable push: the first problem, and how many more there are."""
    if not problems:
        return LogError(path, "expected at least one push, found none")
    first = problems[0]
    more = f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else ""
    return LogError(path, f"no usable push: {first.message}{more}", push=first.push, line=first.line)


@dataclass(frozen=True, eq=False)
class Onset:
    """First contact, as detected from the force.

    Attributes:
        time: Time in s, on the clock of the push.
        tip: (2,) center of the finger at that time, interpolated in the logged path, in m, world frame.
    """

    time: float
    tip: Floats


@dataclass(frozen=True, eq=False)
class Push:
    """One push, with M finger samples and K force samples on one clock that starts at the first force sample.

    Attributes:
        index: Index of the push in its log, from 0.
        pose_start: (3,) pose of the body frame in the world before the push, measured at rest: x, y (m), theta (rad).
            Theta is in (-pi, pi].
        pose_end: (3,) pose after the push, measured at rest. Its angle is the one nearest to the start angle and may
            lie outside (-pi, pi].
        tip_time: (M,) times of the finger samples, in s.
        tip: (M, 2) centers of the finger, in m, world frame.
        tip_yaw: (M,) orientations of the finger about the vertical, in rad, world frame. The first is in (-pi, pi], the
            others continue from it without jumps.
        force_time: (K,) times of the force samples, in s.
        force: (K, 2) forces on the object, in N, world frame. The reading of the first sample is subtracted.
        onset: First contact; None if the force never rises enough.
    """

    index: int
    pose_start: Floats
    pose_end: Floats
    tip_time: Floats
    tip: Floats
    tip_yaw: Floats
    force_time: Floats
    force: Floats
    onset: Onset | None


@dataclass(frozen=True, eq=False)
class PushLog:
    """The usable pushes of one log, and the problems of the others.

    Attributes:
        pushes: The usable pushes, in the order of the log.
        problems: One error for each unusable push, and one for each problem of the file as a whole (header, truncated
            end).
        vertices: (3, 2) vertices of the triangle, in m, body frame: the right-angle corner first, then clockwise.
        length: Characteristic length rho, in m, by which the paper weighs rotation: distance of the right-angle corner
            from the center of mass.
        tip_radius: Radius of the finger, in m.
        support_points: (p, 2) support points, in m, body frame; (0, 2) if the whole face touches the surface.
        support_force: (p,) normal force at each support point, in N.
        surface: Name of the surface material; "unknown" if neither the caller nor the file names it.
        arrangement: Name of the support arrangement; "unknown" if neither the caller nor the file names it.
        source: The file that was read.
    """

    pushes: tuple[Push, ...]
    problems: tuple[LogError, ...]
    vertices: Floats
    length: float
    tip_radius: float
    support_points: Floats
    support_force: Floats
    surface: str
    arrangement: str
    source: str

    def wrench_twist_pairs(self) -> tuple[Floats, Floats]:
        """Return one pair for each push: the wrench that moved the object, and the displacement that followed.

        Neither is normalized. The direction of the displacement stands for that of the twist.

        Returns:
            Two arrays (n, 3). The first has the wrenches fx, fy (N), tau (N m) about the body origin, in the moving
                body frame, averaged over the samples that `force_filter` keeps. The second has the displacements dx, dy
                (m), dtheta (rad) from start to end, in the body frame at the start.

        Reference: The toolbox of Zhou et al. 2017, except that the angle is interpolated the short way.
        """
        wrench = np.array([_mean_wrench(push) for push in self.pushes]).reshape(-1, 3)
        displacement = np.array([_body_displacement(push) for push in self.pushes]).reshape(-1, 3)
        return wrench, displacement

    def commanded_tip_end(self, push: Push) -> Floats:
        """Return where the finger was commanded to stop.

        This is inferred: the logged start plus 17.5 mm along the push.

        Args:
            push: A push of this log.

        Returns:
            (2,) center of the finger, in m, world frame.

        Raises:
            ValueError: If the logged finger does not move, because the push then has no direction.
        """
        travel = push.tip[-1] - push.tip[0]
        distance = np.linalg.norm(travel)
        if not distance > 0:
            raise ValueError(f"push {push.index}: the finger ends where it starts; its direction is not defined")
        return push.tip[0] + COMMANDED_TRAVEL * travel / distance


def force_filter(force: Floats) -> NDArray[np.bool_]:
    """Select the force samples after the first 30 % that are at least as strong as the mean force.

    This is the rule of the toolbox, including its counting from 1. Nothing is smoothed.

    Args:
        force: (K, 2) forces, in N.

    Returns:
        (K,) mask of the samples to keep.
    """
    count = len(force)
    late = np.arange(1, count + 1) >= np.ceil(SKIPPED_FRACTION * count)
    return late & (np.hypot(force[:, 0], force[:, 1]) >= np.hypot(*force.mean(axis=0)))


def contact_onset(force_time: Floats, force: Floats, tip_time: Floats, tip: Floats) -> Onset | None:
    """Find the first sample with |force| > max(0.3 N, 0.3 median |force| of the second half).

    Args:
        force_time: (K,) times of the force samples, in s.
        force: (K, 2) forces, in N.
        tip_time: (M,) times of the finger samples, in s.
        tip: (M, 2) centers of the finger, in m, world frame.

    Returns:
        Time and center of the finger at that sample; None if there is no such sample.
    """
    strength = np.hypot(force[:, 0], force[:, 1])
    threshold = max(ONSET_FORCE, ONSET_FRACTION * float(np.median(strength[len(strength) // 2 :])))
    above_threshold = np.flatnonzero(strength > threshold)
    if len(above_threshold) == 0:
        return None
    time = force_time[above_threshold[0]]
    return Onset(float(time), _interpolate_path(np.array([time]), tip_time, tip)[0])


def rotation(theta: Floats | float) -> Floats:
    """Return the rotation matrices (..., 2, 2) of angles (...) in rad."""
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)


def wrap_angle(angle: Floats) -> Floats:
    """Return the same angle in (-pi, pi], in rad."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def continuous_angle(angle: Floats) -> Floats:
    """Unwrap angles (m,) in rad so that they have no jumps of 2 pi and the first is in (-pi, pi]."""
    smooth = np.unwrap(angle)
    return smooth - smooth[0] + wrap_angle(smooth[0])


def _body_displacement(push: Push) -> Floats:
    """Return the displacement dx, dy (m), dtheta (rad) of a push in the body frame at its start."""
    moved = push.pose_end - push.pose_start
    return np.append(rotation(push.pose_start[2]).T @ moved[:2], wrap_angle(moved[2]))


def _mean_wrench(push: Push) -> Floats:
    """Return the wrench (3,) of a push about the body origin, averaged over the samples of `force_filter`."""
    keep = force_filter(push.force)
    # The object is seen only before and after the push. Its displacement is spread evenly over the kept samples, by
    # sample number and not by time, because the paper's pairs were made in this way.
    fraction = np.linspace(0.0, 1.0, int(keep.sum()))[:, None]
    moved = push.pose_end - push.pose_start
    moved[2] = wrap_angle(moved[2])
    pose = push.pose_start + fraction * moved
    body_from_world = rotation(pose[:, 2]).swapaxes(1, 2)
    tip = _interpolate_path(push.force_time[keep], push.tip_time, push.tip)
    force = np.einsum("kij,kj->ki", body_from_world, push.force[keep])
    arm = np.einsum("kij,kj->ki", body_from_world, tip - pose[:, :2])
    torque = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
    return np.append(force.mean(axis=0), torque.mean())


def _interpolate_path(query_time: Floats, path_time: Floats, path: Floats) -> Floats:
    """Interpolate a path (m, 2), known at the times `path_time` (m,), at other times (k,); the result is (k, 2)."""
    return np.stack([np.interp(query_time, path_time, path[:, axis]) for axis in range(2)], axis=1)
