"""Resample separately recorded streams of hand, object and force at the times of the hand's samples."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.checks import checked_recording, find_bad_number
from pushjax.datasets.planar import interpolated
from pushjax.datasets.recordings import Floats, LogError, Recording

# If the object is unseen for longer than this (s), its pose is not interpolated. Good logs have gaps of up to 0.39 s.
MAX_GAP = 0.5
# If the object's time stamps go back by more than this (s), the cause is not jitter of the tracker but another clock.
# The largest jitter is 0.007 s.
MAX_JITTER = 0.05


class Stream(NamedTuple):
    """One recorded stream."""

    name: str  # in the file
    columns: tuple[str, ...]  # names of the c values
    time: Floats  # (n,), s
    values: Floats  # (n, c)

    def rows(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> "Stream":
        """Return the stream of the selected rows, given as a mask or as indices."""
        return self._replace(time=self.time[which], values=self.values[which])


def align_streams(path: Path, hand: Stream, body: Stream, force: Stream) -> Recording | LogError:
    """Combine three streams of one clock into the one push of a file, sampled as the hand, or return its fault."""
    for stream, max_backstep, may_be_missing in ((hand, 0.0, False), (body, MAX_JITTER, True), (force, 0.0, False)):
        fault = _describe_fault(stream, max_backstep, may_be_missing)
        if fault is not None:
            return LogError(path, fault, push=0)
    # A tracker's time stamps jitter, so some are earlier than the one before. Interpolation needs them in order.
    body = body.rows(np.argsort(body.time, kind="stable"))
    for other in (body, force):
        if hand.time[0] > other.time[-1] or other.time[0] > hand.time[-1]:
            return LogError(path, _describe_disjoint_times(hand, other), push=0)
    body = body.rows(np.isfinite(body.values[:, 0]))  # without the rows that are all NaN
    # Unix times in s use most digits of a float64, so times are taken relative to the first one.
    time, seen_time, force_time = (stream.time - hand.time[0] for stream in (hand, body, force))
    pose = _interpolate_poses(time, seen_time, body.values)
    seen = np.flatnonzero(np.isfinite(pose[:, 0]))
    if len(seen) < 2:
        message = f"expected the object to be tracked at two samples of {hand.name} at least, found {len(seen)}"
        return LogError(path, f"{message} that are not in a gap of {body.name} longer than {MAX_GAP:g} s", push=0)
    # the hand's samples from the first to the last one at which the object is tracked
    span = slice(seen[0], seen[-1] + 1)
    object_force = interpolated(time[span], force_time, force.values)
    return checked_recording(path, 0, hand.values[span], pose[span], force=object_force, time=time[span])


def _describe_fault(stream: Stream, max_backstep: float, may_be_missing: bool) -> str | None:
    """Describe the first fault of a stream, whose time stamps may go back by `max_backstep`, s; else None."""
    if len(stream.time) < 2:
        return f"expected at least two samples in {stream.name}, found {len(stream.time)}"
    for names, values, row_may_be_missing in (
        (("time",), stream.time[:, None], False),
        (stream.columns, stream.values, may_be_missing),
    ):
        fault = find_bad_number(names, values, row_may_be_missing)
        if fault is not None:
            return f"{fault[0]} in row {fault[1]} of {stream.name}"
    step = np.diff(stream.time)
    row = int(np.argmin(step))
    if step[row] < -max_backstep:
        back = f"by more than {max_backstep:g} s" if max_backstep else "at all"
        message = f"expected time stamps of {stream.name} that do not go back {back}"
        return f"{message}, found a step of {step[row]:.3g} s in row {row + 1}"
    return None


def _describe_disjoint_times(hand: Stream, other: Stream) -> str:
    """Describe two streams that do not overlap in time."""
    # Times are given relative to the hand's first stamp, because unix times are hard to read.
    origin = hand.time[0]
    first, second = (
        f"{stream.name} from {stream.time[0] - origin:.3f} s to {stream.time[-1] - origin:.3f} s"
        for stream in (hand, other)
    )
    return f"expected streams that overlap in time, found {first} and {second} (after a stamp of {origin:.3f} s)"


def _interpolate_poses(time: Floats, known_time: Floats, known: Floats) -> Floats:
    """Interpolate poses (k, 3) at times (m,); NaN outside the known times (k,) and in gaps over MAX_GAP."""
    if len(known) == 0:
        return np.full((len(time), 3), np.nan)
    pose = interpolated(time, known_time, np.column_stack([known[:, :2], np.unwrap(known[:, 2])]))
    before = np.clip(np.searchsorted(known_time, time, side="right") - 1, 0, None)
    after = np.clip(np.searchsorted(known_time, time, side="left"), None, len(known_time) - 1)
    pose[known_time[after] - known_time[before] > MAX_GAP] = np.nan
    return pose
