"""Recorded pushes of any hand and object: one structure for all kinds of files.

World frame, body frame and the sign of the force are those of `push_log`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.push_log import Floats, LogError, Push, PushLog, nothing_usable
from pushjax.datasets.records import LARGEST_NUMBER

# Names of the columns, in files and in error messages.
HAND = ("hand_x", "hand_y", "hand_theta", "hand_distance")
OBJECT = ("object_x", "object_y", "object_theta")
FORCE = ("force_x", "force_y")
# Largest object angle, in turns from zero; a larger one is taken to be in degrees. This is tested before unwrapping,
# because unwrapped degrees look like any other angle.
MAX_TURNS = 2


class AnglesInDegrees(LogError):
    """The error for a push whose angles are so large that they are probably in degrees."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One push: m samples of the hand, and what is known of the object at each of them.

    Attributes:
        index: Index of the push in its file, from 0.
        hand: (m, dof) configurations of the hand as `pushjax.Hand` takes them, in m and rad, world frame. With dof = 2
            they are the center (x, y) of a finger. With more, the third is the angle theta, which is continuous, and
            the fourth is the distance d of the hand (the column `hand_distance` of a file).
        pose: (m, 3) pose of the body frame in the world: x, y (m), theta (rad). Theta takes the short way from one seen
            sample to the next. NaN where the object was not seen.
        seen: (m,) whether the object was seen. True for the first and the last sample.
        force: (m, 2) forces on the object, in N, world frame, NaN where there is none; None if no force was recorded.
        time: (m,) times, in s, non-decreasing, from an arbitrary origin; None if no time was recorded.
    """

    index: int
    hand: Floats
    pose: Floats
    seen: NDArray[np.bool_]
    force: Floats | None
    time: Floats | None


@dataclass(frozen=True, eq=False)
class Recordings:
    """The usable pushes of one file, the problems of the others, and what the file says about the object.

    Optional attributes are None if they are unknown.

    Attributes:
        pushes: The usable pushes, in the order of the file, all with the same dof.
        problems: One error for each unusable push, and one for each problem of the file as a whole (a truncated end,
            say).
        source: The file that was read.
        vertices: (k, 2) vertices of the object, in m, body frame.
        length: Characteristic length, in m, which weighs rotation against translation.
        tip_radius: Radius of the finger, in m.
        support_points: (p, 2) support points, in m, body frame; (0, 2) if the whole face touches the surface.
    """

    pushes: tuple[Recording, ...]
    problems: tuple[LogError, ...]
    source: str
    vertices: Floats | None = None
    length: float | None = None
    tip_radius: float | None = None
    support_points: Floats | None = None

    @staticmethod
    def of_log(log: PushLog) -> "Recordings":
        """Convert a triangle log, in which the object is seen only at the first and the last sample of the finger.

        The force is interpolated at the finger's samples. The finger's path is the logged one, which ends about a
        millimeter before the object comes to rest (see `PushLog.commanded_tip_end`).

        Args:
            log: The log, from `load_triangle_log` or `load_push_npz`.

        Returns:
            The same pushes and problems.
        """
        return Recordings(
            pushes=tuple(_from_push(push) for push in log.pushes),
            problems=log.problems,
            source=log.source,
            vertices=log.vertices,
            length=log.length,
            tip_radius=log.tip_radius,
            support_points=log.support_points,
        )


def _from_push(push: Push) -> Recording:
    """Convert a push of a triangle log."""
    count = len(push.tip)
    pose = np.full((count, 3), np.nan)
    pose[0], pose[-1] = push.pose_start, push.pose_end
    return Recording(
        index=push.index,
        hand=push.tip,
        pose=pose,
        seen=np.isfinite(pose[:, 0]),
        force=interpolated(push.tip_time, push.force_time, push.force),
        time=push.tip_time,
    )


def interpolated(time: Floats, known_time: Floats, known: Floats) -> Floats:
    """Interpolate known values (k, c) linearly at the times (m,); NaN outside the known times (k,)."""
    columns = [np.interp(time, known_time, column, left=np.nan, right=np.nan) for column in known.T]
    return np.stack(columns, axis=1)


def collect(path: Path, results: Iterable[Recording | LogError]) -> Recordings:
    """Collect the recordings and the errors of all pushes of a file; LogError if no push is usable."""
    results = list(results)
    if 4 * sum(isinstance(result, AnglesInDegrees) for result in results) > len(results):
        # The others only seem to be in rad, because their angles in degrees are small.
        message = "the angles of many other pushes of the file cannot be in rad: are all in degrees?"
        results = [
            AnglesInDegrees(path, message, push=result.index) if isinstance(result, Recording) else result
            for result in results
        ]
    problems = tuple(result for result in results if isinstance(result, LogError))
    pushes = tuple(result for result in results if isinstance(result, Recording))
    if not pushes:
        raise nothing_usable(path, problems)
    return Recordings(pushes, problems, str(path))


def checked_recording(
    path: Path,
    index: int,
    hand: Floats,
    pose: Floats,  # NaN where the object was not seen, as `force` where there is none; angles may be wrapped
    *,
    force: Floats | None = None,
    time: Floats | None = None,
    lines: Sequence[int] | None = None,  # (m,), line of each sample in the file, from 1
) -> Recording | LogError:
    """Return the recording of one push, with unwrapped angles, or the error for its first fault."""

    def error_at(message: str, row: int) -> LogError:
        return LogError(
            path, f"{message} in row {row} of the push", push=index, line=None if lines is None else lines[row]
        )

    if len(hand) < 2:
        return LogError(
            path, f"expected at least two rows, found {len(hand)}", push=index, line=lines[0] if lines else None
        )
    problem = _find_problem(hand, pose, force, time, error_at)
    if problem is not None:
        return problem
    seen = np.isfinite(pose[:, 0])
    largest = float(np.max(np.abs(pose[seen, 2])))
    if largest > MAX_TURNS * 2 * np.pi:
        message = f"object_theta is up to {largest:.4g} rad; expected at most two turns from zero: is it in degrees?"
        return AnglesInDegrees(path, message, push=index, line=lines[0] if lines else None)
    pose, hand = pose.copy(), hand.copy()
    pose[seen, 2] = np.unwrap(pose[seen, 2])
    if hand.shape[1] > 2:
        hand[:, 2] = np.unwrap(hand[:, 2])
    return Recording(index, hand, pose, seen, force, time)


def _find_problem(
    hand: Floats, pose: Floats, force: Floats | None, time: Floats | None, error_at: Callable[[str, int], LogError]
) -> LogError | None:
    """Return the first fault in the arrays of `checked_recording`; `error_at` makes it of message and row."""
    columns = [(hand_columns(hand.shape[1]), hand, False), (OBJECT, pose, True)]
    if force is not None:
        columns.append((FORCE, force, True))
    if time is not None:
        columns.append((("time",), time[:, None], False))
    for names, values, may_be_missing in columns:
        fault = find_bad_number(names, values, may_be_missing)
        if fault is not None:
            return error_at(*fault)
    for row, where in ((0, "first"), (len(pose) - 1, "last")):
        if np.isnan(pose[row, 0]):
            return error_at(f"expected the object to be seen in the {where} row, found no {', '.join(OBJECT)}", row)
    back = np.flatnonzero(np.diff(time) < 0) if time is not None else []
    if time is not None and len(back):
        row = int(back[0]) + 1
        step = time[row] - time[row - 1]
        return error_at(f"expected time stamps that do not go back, found a step of {step:.3g} s", row)
    return None


def hand_columns(dof: int) -> tuple[str, ...]:
    """Return the names (dof,) of the columns of a hand's configuration."""
    return (*HAND[:dof], *(f"hand_{column}" for column in range(len(HAND), dof)))


def find_bad_number(names: Sequence[str], values: Floats, may_be_missing: bool) -> tuple[str, int] | None:
    """Return a message and the row of the first number (m, c) that is not finite or too large, or None."""
    bad = ~(np.abs(values) < LARGEST_NUMBER)
    if may_be_missing:  # then all numbers of a row may be NaN
        bad[np.isnan(values).all(axis=1)] = False
    rows = np.flatnonzero(bad.any(axis=1))
    if not len(rows):
        return None
    row = int(rows[0])
    column = int(np.argmax(bad[row]))
    value = values[row, column]
    limit, found = ("", "none") if np.isnan(value) else (f" below {LARGEST_NUMBER:g}", f"{value:g}")
    alternative = f" (or none of {', '.join(names)})" if may_be_missing else ""
    return f"expected a number{limit} for {names[column]}{alternative}, found {found}", row
