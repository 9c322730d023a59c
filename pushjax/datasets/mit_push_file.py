"""One push of the MIT pushing data set, as published in a file of its own, and its pairs of wrench and twist.

The time from 10 to 90 % is divided into six equal parts. Each part gives one wrench, the mean over its samples, and one
twist, the displacement of the object. The contact is the point of the outline nearest to the center of the finger. A
part is left out if the object rests, if the force brakes the object or is weak, or if the force cannot be that of a
finger pressing at the contact.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.mit_logs import load_mit_hdf5, load_mit_json
from pushjax.datasets.mit_names import PushParameters
from pushjax.datasets.mit_shapes import MitShape, nearest_on_outline
from pushjax.datasets.push_log import Floats, LogError, rotation
from pushjax.datasets.recordings import interpolated

# Fractions of the duration between which pushes are tested and wrenches are taken. Before the first, the tip may not
# touch the object yet. After the second, the tip may have stopped.
MIDDLE_PART = (0.1, 0.9)
NUM_PARTS = 6  # parts of that time, each of which gives one pair of wrench and twist
# While the tip travels JUMP_WINDOW (m), a pushed object moves by much less than MAX_WINDOW_MOTION (m) and turns by much
# less than MAX_WINDOW_TURN (rad). A tracker that reports more has jumped.
JUMP_WINDOW, MAX_WINDOW_MOTION, MAX_WINDOW_TURN = 0.005, 0.020, np.deg2rad(30)
# Parts of a push with less motion than MIN_MOTION (m) or less force than MIN_FORCE (N) carry no information about
# friction. Neither do parts whose force is farther than MAX_FORCE_ANGLE (rad) from the contact normal. The force of a
# sliding tip is some 15 deg from it. A larger angle may come from an offset of the force sensor: in a third of the logs
# of rect1 on plywood at 100 mm/s, the offset is 1.6 N, with or without contact.
MIN_MOTION, MIN_FORCE, MAX_FORCE_ANGLE = 0.0002, 0.1, np.deg2rad(30)


class MitPush(NamedTuple):
    """A push from the first to the last sample at which tip, object and force are known, in the world frame."""

    index: int  # position of the file in `find_mit_pushes`
    name: PushParameters
    time: Floats  # (m,), s
    tip: Floats  # (m, 2), centers of the tip, m
    pose: Floats  # (m, 3), poses of the object, m and rad
    force: Floats  # (m, 2), forces on the object, N

    def times_at(self, fractions: Sequence[float] | Floats) -> Floats:
        """Return the times (k,), in s, at these fractions (k,) of the duration."""
        begin, end = self.time[0], self.time[-1]
        return np.clip(begin + np.asarray(fractions) * (end - begin), begin, end)  # roundoff might exceed the end

    def states_at(self, fractions: Sequence[float] | Floats) -> tuple[Floats, Floats]:
        """Return the poses (k, 3) and the centers of the tip (k, 2) at these fractions (k,) of the duration."""
        times = self.times_at(fractions)
        return interpolated(times, self.time, self.pose), interpolated(times, self.time, self.tip)


def read_push(index: int, name: PushParameters, path: Path) -> MitPush:
    """Read the push of a file; LogError if the file is damaged or the tracker lost the object."""
    (push,) = (load_mit_json if path.suffix.lower() == ".json" else load_mit_hdf5)(path).pushes
    assert push.force is not None  # these files always have force and time
    assert push.time is not None
    rows = _known_span(path, push.time, push.seen & np.isfinite(push.force[:, 0]))
    time, tip, pose = push.time[rows], push.hand[rows], push.pose[rows]
    _check_no_jump(path, time, tip, pose)
    return MitPush(index, name, time, tip, pose, push.force[rows])


def _known_span(path: Path, time: Floats, known: NDArray[np.bool_]) -> slice:
    """Return the range from the first to the last known sample (m,); LogError if one in between is unknown."""
    rows = np.flatnonzero(known)
    if len(rows) < 2 or time[rows[-1]] == time[rows[0]]:
        raise LogError(path, f"expected a span of time with tip, object and force, found {len(rows)} such samples")
    # the force has no gaps, so an unknown sample is one at which the object was not seen
    lost = rows[0] + np.flatnonzero(~known[rows[0] : rows[-1]])
    if len(lost):
        span = f"{time[lost[0]]:.2f} to {time[lost[-1]]:.2f} s"
        raise LogError(path, f"expected the object to be seen throughout, found it lost from {span}")
    return slice(rows[0], rows[-1] + 1)


def _check_no_jump(path: Path, time: Floats, tip: Floats, pose: Floats) -> None:
    """Raise LogError if the tracker jumps."""
    # All samples of a stretch of the path are compared, not only neighbors. The poses are interpolated at the time
    # stamps of the tip, so where the tracker has fewer samples than the tip, a jump is spread over several samples.
    travel = float(np.linalg.norm(tip[-1] - tip[0]))
    window = len(time) if travel <= JUMP_WINDOW else max(2, round(len(time) * JUMP_WINDOW / travel))
    extent = np.ptp(np.lib.stride_tricks.sliding_window_view(pose, window, axis=0), axis=2)
    distance, turn = np.hypot(extent[:, 0], extent[:, 1]), extent[:, 2]
    excess = np.maximum(distance / MAX_WINDOW_MOTION, turn / MAX_WINDOW_TURN)
    row = int(np.argmax(excess))
    if excess[row] > 1:
        found = f"{1e3 * distance[row]:.0f} mm and {np.rad2deg(turn[row]):.0f} deg"
        limits = f"{1e3 * MAX_WINDOW_MOTION:g} mm and {np.rad2deg(MAX_WINDOW_TURN):.0f} deg"
        during = f"while the tip goes {1e3 * JUMP_WINDOW:g} mm"
        message = f"expected an object that moves by less than {limits} {during}, found {found} from {time[row]:.2f} s"
        raise LogError(path, f"{message}: the tracker jumps")


def in_body(pose: Floats, vectors: Floats) -> Floats:
    """Rotate world vectors (k, 2) into the body frames of k poses (k, 3)."""
    return np.einsum("kji,kj->ki", rotation(pose[:, 2]), vectors)


def training_pairs(push: MitPush, body: MitShape) -> Iterator[tuple[Floats, Floats]]:
    """Iterate over the wrenches (3,), N and N m, and displacements (3,), m and rad, of the parts with pressing."""
    tip, force = in_body(push.pose, push.tip - push.pose[:, :2]), in_body(push.pose, push.force)
    distance, contact = nearest_on_outline(body.vertices, tip)
    inward = (contact - tip) / np.where(distance == 0, np.inf, distance)[:, None]
    torque, along, across = _cross(contact, force), np.sum(inward * force, axis=1), _cross(inward, force)
    fractions = np.linspace(*MIDDLE_PART, 2 * NUM_PARTS + 1)
    poses, _ = push.states_at(fractions)
    row_at = np.searchsorted(push.time, push.times_at(fractions))
    for part in range(0, 2 * NUM_PARTS, 2):
        rows_of_part = slice(row_at[part], row_at[part + 2])
        if rows_of_part.start == rows_of_part.stop:
            continue
        # wrench and displacement are about the body origin, in the body frame at the middle of the part
        to_body = rotation(poses[part + 1, 2]).T
        displacement = poses[part + 2] - poses[part]
        wrench = np.append(to_body @ push.force[rows_of_part].mean(axis=0), torque[rows_of_part].mean())
        twist = np.append(to_body @ displacement[:2], displacement[2])
        motion = np.linalg.norm(twist[:2]) + body.length * abs(twist[2])
        presses = np.abs(np.arctan2(across[rows_of_part].mean(), along[rows_of_part].mean())) < MAX_FORCE_ANGLE
        strong = np.linalg.norm(wrench[:2]) >= MIN_FORCE
        if presses and strong and motion >= MIN_MOTION and wrench @ twist > 0:
            yield wrench, twist


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products (n,) of vectors (n, 2) in the plane."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
