"""What a log of single-finger pushes holds, and the wrench-displacement pairs the paper takes from it.

Frames: *world* is the robot's base; *body* is fixed to the object, its origin at the centre of mass; a body
point p lies at (x, y) + R(theta) p in the world. Forces and wrenches are those the finger applies *to the
object*.

Source of the processing: Zhou, Bagnell, Mason, "A fast stochastic contact model for planar pushing and
grasping", RSS 2017, and its published toolbox. One deviation: the toolbox interpolates the object's angle
without looking for wraps and so turns some pushes the long way round; here the angle always goes the short
way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike, fspath

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Filter of the toolbox: the first 30 % of the samples (approach, contact building up) are dropped.
SKIPPED_FRACTION = 0.3
# Onset of contact: above the sensor's noise, and above a fraction of the typical force of the push, which is
# taken from the second half of the samples because the finger is surely in contact there.
ONSET_FORCE = 0.3
ONSET_FRACTION = 0.3
# The robot was told to go 15 mm beyond an approach gap of 2.5 mm. The log misses the last millimetre or so of
# it (the finger is still moving at the last logged sample), while the measured end pose does not.
COMMANDED_TRAVEL = 0.0175


class LogError(ValueError):
    """A log, or one push of it, that cannot be used.

    `path` is the file as given; `push`, its push's number (from 0), and `line` (from 1) are None if unknown.
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
        # The default rebuilds from the message alone, which would break errors that cross a process boundary.
        return _rebuild_error, (self.path, self.message, self.push, self.line)


def _rebuild_error(path: str, message: str, push: int | None, line: int | None) -> LogError:
    return LogError(path, message, push=push, line=line)


def nothing_usable(path: str | PathLike[str], problems: Sequence[LogError]) -> LogError:
    """Of a file without a usable push: the first problem, and how many more there are."""
    if not problems:
        return LogError(path, "expected at least one push, found none")
    first = problems[0]
    more = f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else ""
    return LogError(path, f"no usable push: {first.message}{more}", push=first.push, line=first.line)


@dataclass(frozen=True, eq=False)
class Onset:
    """First touch, as the force shows it.

    time: s, clock of the push. tip: (2,) m, world, the finger's centre then, interpolated in the logged path.
    """

    time: float
    tip: Floats


@dataclass(frozen=True, eq=False)
class Push:
    """One push. M finger samples and K force samples on one clock, which starts at the first force sample.

    index: number of the push in its log, from 0.
    pose_start, pose_end: (3,) x, y (m), theta (rad) of the body frame in the world, measured at rest before
        and after the push. theta starts in (-pi, pi]; the end angle is the one nearest to it and may lie
        outside.
    tip_time: (M,) s; tip: (M, 2) m, world, the finger's centre; tip_yaw: (M,) rad, world, the finger's
        orientation about the vertical: first one in (-pi, pi], continuous after.
    force_time: (K,) s; force: (K, 2) N, world, on the object; the reading of the first sample is subtracted.
    onset: first touch, or None where the force never rises enough.
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
    """The usable pushes of one log and what is wrong with the others.

    pushes: in the order of the log.
    problems: one error per unusable push, and one for what concerns the file as a whole (header, cut end).
    vertices: (3, 2) m, body; the right-angle corner first, then clockwise.
    length: m, the characteristic length rho by which the paper weighs rotation: corner to centre of mass.
    tip_radius: m, radius of the finger.
    support_points: (p, 2) m, body; (0, 2) where the whole face touches the surface.
    support_force: (p,) N, normal force at each support point.
    surface, arrangement: names of the material and of the support arrangement; "unknown" where nothing tells.
    source: the file read.
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
        """One pair per push: the wrench that moved the object, and the displacement that followed.

        Returns wrench (n, 3): fx, fy (N), tau (N m), about the body origin in the moving body frame, averaged
        over the samples `force_filter` keeps; and displacement (n, 3): dx, dy (m), dtheta (rad) from start to
        end in the starting body frame. Neither is normalised; the direction of the displacement stands for
        the twist's.

        Source: the toolbox of Zhou et al. 2017, but with the angle interpolated the short way.
        """
        wrench = np.array([_mean_wrench(push) for push in self.pushes]).reshape(-1, 3)
        displacement = np.array([_displacement(push) for push in self.pushes]).reshape(-1, 3)
        return wrench, displacement

    def commanded_tip_end(self, push: Push) -> Floats:
        """(2,) m, world: where the finger was told to stop. Inferred: the logged start plus 17.5 mm along the
        push.

        Raises ValueError if the logged finger does not move, because the push then has no direction.
        """
        travel = push.tip[-1] - push.tip[0]
        distance = np.linalg.norm(travel)
        if not distance > 0:
            raise ValueError(f"push {push.index}: the finger ends where it starts; its direction is not defined")
        return push.tip[0] + COMMANDED_TRAVEL * travel / distance


def force_filter(force: Floats) -> NDArray[np.bool_]:
    """(K,) which of the force samples (K, 2) count: not in the first 30 %, and at least as strong as the mean
    force.

    Same rule as the toolbox, including its counting from 1; nothing is smoothed.
    """
    count = len(force)
    late = np.arange(1, count + 1) >= np.ceil(SKIPPED_FRACTION * count)
    return late & (np.hypot(force[:, 0], force[:, 1]) >= np.hypot(*force.mean(axis=0)))


def contact_onset(force_time: Floats, force: Floats, tip_time: Floats, tip: Floats) -> Onset | None:
    """First sample with |force| > max(0.3 N, 0.3 median |force| of the second half), or None.

    Shapes, units and frames as in `Push`.
    """
    strength = np.hypot(force[:, 0], force[:, 1])
    threshold = max(ONSET_FORCE, ONSET_FRACTION * float(np.median(strength[len(strength) // 2 :])))
    above = np.flatnonzero(strength > threshold)
    if len(above) == 0:
        return None
    time = force_time[above[0]]
    return Onset(float(time), _path_at(np.array([time]), tip_time, tip)[0])


def rotation(theta: Floats | float) -> Floats:
    """(..., 2, 2) rotation matrices of angles (...) in rad."""
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)


def wrap_angle(angle: Floats) -> Floats:
    """The same angle in (-pi, pi], rad."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def continuous_angle(angle: Floats) -> Floats:
    """(m,) rad: without jumps of 2 pi, and with the first one in (-pi, pi]."""
    smooth = np.unwrap(angle)
    return smooth - smooth[0] + wrap_angle(smooth[0])


def _displacement(push: Push) -> Floats:
    moved = push.pose_end - push.pose_start
    return np.append(rotation(push.pose_start[2]).T @ moved[:2], wrap_angle(moved[2]))


def _mean_wrench(push: Push) -> Floats:
    keep = force_filter(push.force)
    # The object is only seen before and after the push. Its way between is spread evenly over the kept
    # samples, by their number and not by their time: that is how the paper's pairs were made.
    share = np.linspace(0.0, 1.0, int(keep.sum()))[:, None]
    moved = push.pose_end - push.pose_start
    moved[2] = wrap_angle(moved[2])
    pose = push.pose_start + share * moved
    body_from_world = rotation(pose[:, 2]).swapaxes(1, 2)
    tip = _path_at(push.force_time[keep], push.tip_time, push.tip)
    force = np.einsum("kij,kj->ki", body_from_world, push.force[keep])
    arm = np.einsum("kij,kj->ki", body_from_world, tip - pose[:, :2])
    torque = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
    return np.append(force.mean(axis=0), torque.mean())


def _path_at(time: Floats, path_time: Floats, path: Floats) -> Floats:
    return np.stack([np.interp(time, path_time, path[:, axis]) for axis in range(2)], axis=1)
