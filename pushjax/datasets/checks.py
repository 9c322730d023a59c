"""Checks of the numbers of one push, which come before everything else is computed from them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pushjax.datasets.recordings import Floats, LogError, Recording, Recordings, collect

# Names of the columns, in files and in error messages.
HAND = ("hand_x", "hand_y", "hand_theta", "hand_distance")
OBJECT = ("object_x", "object_y", "object_theta")
FORCE = ("force_x", "force_y")
# Largest object angle, in turns from zero; a larger one is taken to be in degrees. This is tested before unwrapping,
# because unwrapped degrees look like any other angle.
MAX_TURNS = 2
# No logged quantity (s, mm, N) comes near this value. Squares of larger numbers might overflow later.
LARGEST_NUMBER = 1e12


class AnglesInDegrees(LogError):
    """The error for a push whose angles are so large that they are probably in degrees."""


def collect_checked(path: Path, results: Iterable[Recording | LogError], **facts: Any) -> Recordings:
    """Collect what `checked_recording` returned for each push of a file; LogError if no push is usable."""
    results = list(results)
    if 4 * sum(isinstance(result, AnglesInDegrees) for result in results) > len(results):
        # The others only seem to be in rad, because their angles in degrees are small.
        message = "the angles of many other pushes of the file cannot be in rad: are all in degrees?"
        results = [
            AnglesInDegrees(path, message, push=result.index) if isinstance(result, Recording) else result
            for result in results
        ]
    return collect(path, results, **facts)


def checked_recording(
    path: Path,
    index: int,
    hand: Floats,
    pose: Floats,  # NaN where the object was not tracked, as `force` where there is none; angles may be wrapped
    *,
    force: Floats | None = None,
    time: Floats | None = None,
    lines: Sequence[int] | None = None,  # (m,), line of each sample in the file, from 1
    **others: Any,  # fields of `Recording` that need no check
) -> Recording | LogError:
    """Return the recording of one push, with unwrapped angles, or the error for its first fault."""
    first_line = lines[0] if lines else None
    if len(hand) < 2:
        return LogError(path, f"expected at least two rows, found {len(hand)}", push=index, line=first_line)
    fault = _find_fault(hand, pose, force, time)
    if fault is not None:
        message, row = fault
        line = lines[row] if lines else None
        return LogError(path, f"{message} in row {row} of the push", push=index, line=line)
    tracked = np.isfinite(pose[:, 0])
    largest = float(np.max(np.abs(pose[tracked, 2])))
    if largest > MAX_TURNS * 2 * np.pi:
        message = f"object_theta is up to {largest:.4g} rad; expected at most two turns from zero: is it in degrees?"
        return AnglesInDegrees(path, message, push=index, line=first_line)
    pose, hand = pose.copy(), hand.copy()
    pose[tracked, 2] = np.unwrap(pose[tracked, 2])
    if hand.shape[1] > 2:
        hand[:, 2] = np.unwrap(hand[:, 2])
    return Recording(index, hand, pose, force, time, **others)


def _find_fault(hand: Floats, pose: Floats, force: Floats | None, time: Floats | None) -> tuple[str, int] | None:
    """Return a message and the row of the first fault in the arrays of `checked_recording`, or None."""
    columns = [(hand_columns(hand.shape[1]), hand, False), (OBJECT, pose, True)]
    if force is not None:
        columns.append((FORCE, force, True))
    if time is not None:
        columns.append((("time",), time[:, None], False))
    for names, values, may_be_missing in columns:
        fault = find_bad_number(names, values, may_be_missing)
        if fault is not None:
            return fault
    for row, where in ((0, "first"), (len(pose) - 1, "last")):
        if np.isnan(pose[row, 0]):
            return f"expected the object to be tracked in the {where} row, found no {', '.join(OBJECT)}", row
    back = np.flatnonzero(np.diff(time) < 0) if time is not None else []
    if time is not None and len(back):
        row = int(back[0]) + 1
        step = time[row] - time[row - 1]
        return f"expected time stamps that do not go back, found a step of {step:.3g} s", row
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
