"""Recorded pushes of any hand and object: one structure, whatever the kind of file they come from.

World, body frame and the sign of the force are those of `pushes`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.pushes import Floats, LogError, Push, PushLog, nothing_usable
from pushjax.datasets.records import LARGEST_NUMBER

# What the columns are called, in files and in what is said about them.
HAND = ("hand_x", "hand_y", "hand_theta", "hand_distance")
OBJECT = ("object_x", "object_y", "object_theta")
FORCE = ("force_x", "force_y")
TURNS = 2  # from zero, that an angle in rad is at most: unwrapped, degrees would look like any angle


class InDegrees(LogError):
    """Of a push whose angles cannot be in rad."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One push, as m samples of the hand and what was known of the object at each.

    index: number of the push in its file, from 0.
    hand: (m, dof) m and rad, world: configurations as `pushjax.Hand` takes them. Two numbers are the centre (x, y) of a
        finger; more are x, y, theta (continuous), opening.
    pose: (m, 3) x, y (m), theta (rad) of the body frame in the world; theta goes the short way from one seen sample to
        the next. NaN where the object was not seen.
    seen: (m,) where it was; the first and the last are.
    force: (m, 2) N, world, on the object, NaN where there is none; None where none was recorded.
    time: (m,) s, never going back, from an arbitrary origin; None where none was recorded.
    """

    index: int
    hand: Floats
    pose: Floats
    seen: NDArray[np.bool_]
    force: Floats | None
    time: Floats | None


@dataclass(frozen=True, eq=False)
class Recordings:
    """The usable pushes of one file, what is wrong with the others, and what the file knows of the object.

    pushes: in the order of the file, all with the same dof.
    problems: one error per unusable push, and one for what concerns the file as a whole (a cut end, say).
    source: the file read.
    vertices: (k, 2) m, body. length: m, which weighs rotation against translation. tip_radius: m, of the finger.
    support_points: (p, 2) m, body; (0, 2) where the whole face touches the surface. None for what is unknown.
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
        """The pushes of a triangle log: the object seen at the first and the last sample of the finger only.

        The force is interpolated at the finger's samples. The finger's path is the logged one, which ends a millimetre
        or so before the object comes to rest (see `PushLog.commanded_tip_end`).
        """
        return Recordings(
            pushes=tuple(_of_push(push) for push in log.pushes),
            problems=log.problems,
            source=log.source,
            vertices=log.vertices,
            length=log.length,
            tip_radius=log.tip_radius,
            support_points=log.support_points,
        )


def _of_push(push: Push) -> Recording:
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
    """(m, c): the columns of `known` (k, c) at the times (m,), linearly between those (k,); NaN outside of them."""
    columns = [np.interp(time, known_time, column, left=np.nan, right=np.nan) for column in known.T]
    return np.stack(columns, axis=1)


def gathered(path: Path, found: Iterable[Recording | LogError]) -> Recordings:
    """Recordings of what was made of each push of a file. Raises LogError where nothing is usable."""
    each = list(found)
    if 4 * sum(isinstance(one, InDegrees) for one in each) > len(each):
        # the angles of the others are just small
        message = "the angles of many other pushes of the file cannot be in rad: are all in degrees?"
        each = [InDegrees(path, message, push=one.index) if isinstance(one, Recording) else one for one in each]
    problems = tuple(one for one in each if isinstance(one, LogError))
    pushes = tuple(one for one in each if isinstance(one, Recording))
    if not pushes:
        raise nothing_usable(path, problems)
    return Recordings(pushes, problems, str(path))


def checked(
    path: Path,
    index: int,
    hand: Floats,
    pose: Floats,
    *,
    force: Floats | None = None,
    time: Floats | None = None,
    lines: Sequence[int] | None = None,
) -> Recording | LogError:
    """A Recording of these arrays (as there; pose NaN where not seen), or what is wrong with them.

    lines: (m,) of the file, from 1, one per sample, where it has lines.
    """

    def wrong(message: str, row: int) -> LogError:
        return LogError(
            path, f"{message} in row {row} of the push", push=index, line=None if lines is None else lines[row]
        )

    if len(hand) < 2:
        return LogError(
            path, f"expected at least two rows, found {len(hand)}", push=index, line=lines[0] if lines else None
        )
    problem = _first_problem(hand, pose, force, time, wrong)
    if problem is not None:
        return problem
    seen = np.isfinite(pose[:, 0])
    largest = float(np.max(np.abs(pose[seen, 2])))
    if largest > TURNS * 2 * np.pi:
        message = f"object_theta is up to {largest:.4g} rad; expected at most two turns from zero: is it in degrees?"
        return InDegrees(path, message, push=index, line=lines[0] if lines else None)
    pose, hand = pose.copy(), hand.copy()
    pose[seen, 2] = np.unwrap(pose[seen, 2])
    if hand.shape[1] > 2:
        hand[:, 2] = np.unwrap(hand[:, 2])
    return Recording(index, hand, pose, seen, force, time)


def _first_problem(
    hand: Floats, pose: Floats, force: Floats | None, time: Floats | None, wrong: Callable[[str, int], LogError]
) -> LogError | None:
    columns = [(hand_names(hand.shape[1]), hand, False), (OBJECT, pose, True)]
    if force is not None:
        columns.append((FORCE, force, True))
    if time is not None:
        columns.append((("time",), time[:, None], False))
    for names, values, may_lack in columns:
        fault = bad_number(names, values, may_lack)
        if fault is not None:
            return wrong(*fault)
    for row, where in ((0, "first"), (len(pose) - 1, "last")):
        if np.isnan(pose[row, 0]):
            return wrong(f"expected the object to be seen in the {where} row, found no {', '.join(OBJECT)}", row)
    back = np.flatnonzero(np.diff(time) < 0) if time is not None else []
    if time is not None and len(back):
        row = int(back[0]) + 1
        step = time[row] - time[row - 1]
        return wrong(f"expected time stamps that do not go back, found a step of {step:.3g} s", row)
    return None


def hand_names(dof: int) -> tuple[str, ...]:
    """(dof,) what the columns of a hand's configuration are called."""
    return (*HAND[:dof], *(f"hand_{column}" for column in range(len(HAND), dof)))


def bad_number(names: Sequence[str], values: Floats, may_lack: bool) -> tuple[str, int] | None:
    """What is wrong with the first bad row, and which it is. A row `may_lack` all its numbers: NaN then."""
    bad = ~(np.abs(values) < LARGEST_NUMBER)
    if may_lack:
        bad[np.isnan(values).all(axis=1)] = False
    rows = np.flatnonzero(bad.any(axis=1))
    if not len(rows):
        return None
    row = int(rows[0])
    column = int(np.argmax(bad[row]))
    value = values[row, column]
    limit, found = ("", "none") if np.isnan(value) else (f" below {LARGEST_NUMBER:g}", f"{value:g}")
    lacks = f" (or none of {', '.join(names)})" if may_lack else ""
    return f"expected a number{limit} for {names[column]}{lacks}, found {found}", row
