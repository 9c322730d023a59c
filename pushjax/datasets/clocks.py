"""Streams that were sampled apart from each other, brought to the hand's samples."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.pushes import Floats, LogError
from pushjax.datasets.recordings import Recording, bad_number, checked, interpolated

# s; where the object goes unseen for longer, its pose is not interpolated. Sound logs have gaps of up to 0.39 s.
LONGEST_GAP = 0.5
# s; stamps of the object that go back by more are no jitter of a tracker but another clock. Seen: 0.007 s.
MOST_JITTER = 0.05


@dataclass(frozen=True, eq=False)
class Stream:
    """name: as in the file. columns: what its c values are called. time: (n,) s; values: (n, c)."""

    name: str
    columns: tuple[str, ...]
    time: Floats
    values: Floats

    def rows(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> "Stream":
        return Stream(self.name, self.columns, self.time[which], self.values[which])


def aligned(path: Path, hand: Stream, body: Stream, force: Stream) -> Recording | LogError:
    """The one push of a file from three streams whose stamps are of the same clock, or what is wrong with them.

    Of the hand (m, dof) the samples stay at which the object was seen, and those between. The object's pose and the
    force on it are interpolated there, the pose's angle the short way. The object is not seen within gaps of its
    stream longer than LONGEST_GAP; its samples that are all NaN do not count. Time starts at the hand's first sample.
    """
    for stream, most_back, may_lack in ((hand, 0.0, False), (body, MOST_JITTER, True), (force, 0.0, False)):
        fault = _fault(stream, most_back, may_lack)
        if fault is not None:
            return LogError(path, fault, push=0)
    # A tracker's stamps jitter, so that some fall behind the one before; interpolation needs them in order.
    body = body.rows(np.argsort(body.time, kind="stable"))
    for other in (body, force):
        if hand.time[0] > other.time[-1] or other.time[0] > hand.time[-1]:
            return LogError(path, _apart(hand, other), push=0)
    body = body.rows(np.isfinite(body.values[:, 0]))
    # Unix seconds use up most of a float64's digits.
    time, seen_time, force_time = (stream.time - hand.time[0] for stream in (hand, body, force))
    pose = _poses(time, seen_time, body.values)
    seen = np.flatnonzero(np.isfinite(pose[:, 0]))
    if len(seen) < 2:
        message = f"expected the object to be seen at two samples of {hand.name} at least, found {len(seen)}"
        return LogError(path, f"{message} that are not in a gap of {body.name} longer than {LONGEST_GAP:g} s", push=0)
    kept = slice(seen[0], seen[-1] + 1)
    on_object = interpolated(time[kept], force_time, force.values)
    return checked(path, 0, hand.values[kept], pose[kept], force=on_object, time=time[kept])


def _fault(stream: Stream, most_back: float, may_lack: bool) -> str | None:
    if len(stream.time) < 2:
        return f"expected at least two samples in {stream.name}, found {len(stream.time)}"
    for names, values, lacks in ((("time",), stream.time[:, None], False), (stream.columns, stream.values, may_lack)):
        fault = bad_number(names, values, lacks)
        if fault is not None:
            return f"{fault[0]} in row {fault[1]} of {stream.name}"
    step = np.diff(stream.time)
    row = int(np.argmin(step))
    if step[row] < -most_back:
        back = f"by more than {most_back:g} s" if most_back else "at all"
        message = f"expected time stamps of {stream.name} that do not go back {back}"
        return f"{message}, found a step of {step[row]:.3g} s in row {row + 1}"
    return None


def _apart(hand: Stream, other: Stream) -> str:
    # Seconds after the hand's first stamp: differences of unix times can be read, the times themselves cannot.
    origin = hand.time[0]
    first, second = (
        f"{stream.name} from {stream.time[0] - origin:.3f} s to {stream.time[-1] - origin:.3f} s"
        for stream in (hand, other)
    )
    return f"expected streams that overlap in time, found {first} and {second} (after a stamp of {origin:.3f} s)"


def _poses(time: Floats, known_time: Floats, known: Floats) -> Floats:
    """(m, 3) the poses `known` (k, 3), interpolated; NaN outside of them and within their gaps."""
    if len(known) == 0:
        return np.full((len(time), 3), np.nan)
    pose = interpolated(time, known_time, np.column_stack([known[:, :2], np.unwrap(known[:, 2])]))
    pose[_within_gap(time, known_time)] = np.nan
    return pose


def _within_gap(time: Floats, known: Floats) -> NDArray[np.bool_]:
    """(m,) whether each time lies between two of the `known` ones that are too far apart."""
    before = np.clip(np.searchsorted(known, time, side="right") - 1, 0, None)
    after = np.clip(np.searchsorted(known, time, side="left"), None, len(known) - 1)
    return known[after] - known[before] > LONGEST_GAP
