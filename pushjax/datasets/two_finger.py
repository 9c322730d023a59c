"""Read pushes of the aluminum triangle with two fingers from curated arrays.

The origin of the hand's frame is midway between the fingers, which are at (0, +-spacing / 2). Its x axis is the
direction in which the hand first approaches. World frame and body frame are those of `datasets.push_log`. The hand's
path is the *commanded* one: a rigid rotation about a fixed point of the world, or a straight line.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pushjax.datasets._archive import Arrays, check_shapes, read_archive, row_count
from pushjax.datasets.push_log import Floats, LogError, rotation, wrap_angle

# Arrays of the archive, with the shape of one push's row (`_PUSH_ARRAYS`) or of the whole array (`_FILE_ARRAYS`).
_PUSH_ARRAYS = {
    "push_index": (),
    "valid": (),
    "action_group": (),
    "t0_unix": (),
    "object_pose_start": (3,),
    "object_pose_end": (3,),
    "pusher_pose_start": (3,),
    "pusher_pose_end": (3,),
    "rotation_angle": (),
    "cor_world": (2,),
    "gap_start": (2,),
    "gap_end": (2,),
    "stick_deviation": (),
}
_FILE_ARRAYS = {"vertices_body": (3, 2), "rho": (), "finger_half_spacing": ()}
_SUPPORT_ARRAYS = ("support_points_body", "support_normal_force", "surface", "arrangement")


@dataclass(frozen=True, eq=False)
class TwoFingerLog:
    """The usable pushes of one archive, one row each, and the problems of the others.

    Attributes:
        index: (n,) number of the push in its log.
        group: (n,) equal for repetitions of the same nominal action.
        time: (n,) time at which the push began, in s since 1970.
        pose_start: (n, 3) pose of the object before the push, in m and rad, world frame, measured at rest.
        pose_end: (n, 3) pose of the object after the push, measured at rest. Its angle is the one nearest to the start
            angle.
        hand_start: (n, 3) pose of the hand before the push, in m and rad, world frame, commanded.
        hand_end: (n, 3) pose of the hand after the push, commanded.
        turn: (n,) angle by which the hand turns in between, in rad.
        center: (n, 2) point about which the hand turns, in m, world frame; NaN if it does not turn.
        gap_start: (n, 2) distances of the fingers' centers from the outline at the start, as commanded, in m.
        gap_end: (n, 2) the same distances at the end, as measured, in m.
        stick_deviation: (n,) motion of the object relative to the hand, in m, as defined by the function
            `stick_deviation`.
        vertices: (3, 2) vertices of the triangle, in m, body frame.
        length: Characteristic length of the metric, in m.
        spacing: Distance between the fingers' centers, in m.
        support_points: (p, 2) support points, in m, body frame; empty if the whole face touches the surface.
        support_force: (p,) normal force at each support point, in N; empty if the whole face touches the surface.
        problems: One error for each unusable push.
        surface: Name of the surface material.
        arrangement: Name of the support arrangement.
        source: The file that was read.
    """

    index: NDArray[np.int64]
    group: NDArray[np.int64]
    time: Floats
    pose_start: Floats
    pose_end: Floats
    hand_start: Floats
    hand_end: Floats
    turn: Floats
    center: Floats
    gap_start: Floats
    gap_end: Floats
    stick_deviation: Floats
    vertices: Floats
    length: float
    spacing: float
    support_points: Floats
    support_force: Floats
    problems: tuple[LogError, ...]
    surface: str
    arrangement: str
    source: str

    def __len__(self) -> int:
        return len(self.index)

    def paths(self, steps: int) -> Floats:
        """Return the hand's configurations along each push, in equal steps.

        Args:
            steps: Number of steps.

        Returns:
            (n, steps + 1, 4) configurations x, y (m), theta (rad), spacing (m), world frame.

        Raises:
            ValueError: If `steps` is less than one.
        """
        if steps < 1:
            raise ValueError(f"steps must be at least 1; got {steps}")
        fraction = np.linspace(0.0, 1.0, steps + 1)
        angle = fraction * self.turn[:, None]
        start, travel = self.hand_start[:, None, :2], (self.hand_end - self.hand_start)[:, None, :2]
        turning = self.turn != 0
        center = np.where(turning[:, None], self.center, 0.0)[:, None]
        turned = center + np.einsum("nsij,nj->nsi", rotation(angle), (start - center)[:, 0])
        position = np.where(turning[:, None, None], turned, start + fraction[:, None] * travel)
        theta = self.hand_start[:, 2, None] + angle
        return np.concatenate([position, theta[..., None], np.full_like(theta, self.spacing)[..., None]], axis=-1)


def stick_deviation(
    hand_start: ArrayLike, hand_end: ArrayLike, pose_start: ArrayLike, pose_end: ArrayLike, length: float
) -> Floats:
    """Return the motions (...,) of the object relative to the hand, m, between poses (..., 3) in the world."""
    before, after = (
        _in_hand_frame(np.asarray(hand), np.asarray(pose))
        for hand, pose in ((hand_start, pose_start), (hand_end, pose_end))
    )
    # zero if both moved as one body; closing an initial gap between hand and object counts as relative motion too
    change = after - before
    return np.hypot(change[..., 0], change[..., 1]) + length * np.abs(wrap_angle(change[..., 2]))


def _in_hand_frame(hand: NDArray, pose: NDArray) -> Floats:
    """Return the poses of the object in the frame of the hand."""
    offset = np.einsum("...ji,...j->...i", rotation(hand[..., 2]), pose[..., :2] - hand[..., :2])
    return np.concatenate([offset, (pose[..., 2] - hand[..., 2])[..., None]], axis=-1)


def load_two_finger_npz(path: str | PathLike[str]) -> TwoFingerLog:
    """Read a file of the `two_finger_push` folder.

    A row becomes a problem if it is marked invalid or has numbers that are not finite.

    Args:
        path: The file.

    Returns:
        The usable pushes, and the problems of the others.

    Raises:
        LogError: If the file is missing or no such archive, if an array is missing or has the wrong size, or if no row
            is usable.
    """
    file = Path(path).expanduser()
    data = read_archive(file, [*_PUSH_ARRAYS, *_FILE_ARRAYS, *_SUPPORT_ARRAYS], "two-finger pushes")
    count = _checked_count(file, data)
    numbers = {name: np.array(data[name], np.float64) for name in (*_PUSH_ARRAYS, *_FILE_ARRAYS, *_SUPPORT_ARRAYS[:2])}
    row_problems = [_row_problem(file, numbers, row) for row in range(count)]
    problems = tuple(problem for problem in row_problems if problem is not None)
    keep = np.array([problem is None for problem in row_problems], bool)
    if not keep.any():
        first = f", the first because: {problems[0].message}" if problems else ""
        raise LogError(file, f"expected usable pushes, found none among {count}{first}")
    rows = {name: numbers[name][keep] for name in _PUSH_ARRAYS}
    start, end = rows["object_pose_start"], rows["object_pose_end"].copy()
    end[:, 2] = start[:, 2] + wrap_angle(end[:, 2] - start[:, 2])
    return TwoFingerLog(
        index=rows["push_index"].astype(np.int64),
        group=rows["action_group"].astype(np.int64),
        time=rows["t0_unix"],
        pose_start=start,
        pose_end=end,
        hand_start=rows["pusher_pose_start"],
        hand_end=rows["pusher_pose_end"],
        turn=rows["rotation_angle"],
        center=rows["cor_world"],
        gap_start=rows["gap_start"],
        gap_end=rows["gap_end"],
        stick_deviation=rows["stick_deviation"],
        vertices=numbers["vertices_body"],
        length=float(numbers["rho"]),
        spacing=2 * float(numbers["finger_half_spacing"]),
        support_points=numbers["support_points_body"].reshape(-1, 2),
        support_force=numbers["support_normal_force"].reshape(-1),
        problems=problems,
        surface=str(data["surface"]),
        arrangement=str(data["arrangement"]),
        source=str(file),
    )


def _checked_count(path: Path, data: Arrays) -> int:
    """Return the number of pushes, after checking shapes and types."""
    count = row_count(path, data, _PUSH_ARRAYS)
    check_shapes(path, data, _FILE_ARRAYS)
    points, force = data["support_points_body"], data["support_normal_force"]
    if points.size != 2 * force.size or points.ndim != 2:
        raise LogError(path, f"expected a force for each support point, found {points.shape} and {force.shape}")
    for name in (*_PUSH_ARRAYS, *_FILE_ARRAYS, *_SUPPORT_ARRAYS[:2]):
        if data[name].dtype.kind not in "fiub":
            raise LogError(path, f"expected numbers in {name}, found {data[name].dtype}")
    return count


def _row_problem(path: Path, numbers: dict[str, Floats], row: int) -> LogError | None:
    """Describe why a row is unusable; None if it is usable."""
    index = int(numbers["push_index"][row])
    if not numbers["valid"][row]:
        return LogError(path, "expected a valid push, found one marked invalid in the archive", push=index)
    straight = numbers["rotation_angle"][row] == 0
    for name in _PUSH_ARRAYS:
        if not np.isfinite(numbers[name][row]).all() and not (straight and name == "cor_world"):
            return LogError(path, f"expected finite numbers, found NaN or infinity in {name}", push=index)
    return None
