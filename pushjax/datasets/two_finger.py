"""Pushes of the aluminium triangle with two fingers, as tidy arrays.

The hand's frame: origin midway between the fingers, which sit at (0, +-spacing / 2); x is the direction it first
approaches in. World, body frame and triangle are those of `pushes`. The hand's path is the *commanded* one: it turns
rigidly about a fixed point of the world, or goes straight.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pushjax.datasets._archive import Arrays, check_shapes, read_archive, row_count
from pushjax.datasets.pushes import Floats, LogError, rotation, wrap_angle

# Shapes of what the archive holds; n counts its pushes, p its support points.
_PER_PUSH = {
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
_PER_FILE = {"vertices_body": (3, 2), "rho": (), "finger_half_spacing": ()}
_SUPPORT = ("support_points_body", "support_normal_force", "surface", "arrangement")


@dataclass(frozen=True, eq=False)
class TwoFingerLog:
    """The usable pushes of one archive, row by row, and what is wrong with the others.

    index: (n,) the push's number in the log. group: (n,) equal where the same nominal action was repeated. time: (n,)
    s since 1970, when it began.
    pose_start, pose_end: (n, 3) m, rad, the object's, world, measured at rest; the end angle is the one nearest to the
        start's.
    hand_start, hand_end: (n, 3) m, rad, the hand's, world, commanded. turn: (n,) rad, by how much it turns between.
    center: (n, 2) m, world, what it turns about; NaN where it does not turn.
    gap_start, gap_end: (n, 2) m, from the fingers' centres to the outline, as told at the start, measured at the end.
    stick_deviation: (n,) m, as `stick_deviation` gives it.
    vertices: (3, 2) m, body. length: m, the metric's. spacing: m, between the fingers' centres.
    support_points: (p, 2) m, body, and support_force: (p,) N; empty where the whole face touches the surface.
    problems: one error per unusable push. surface, arrangement, source: names of material, support and file.
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
        """(n, steps + 1, 4): the hand's configurations (x, y, theta, spacing) along each push, in equal steps.

        Raises ValueError for fewer than one step.
        """
        if steps < 1:
            raise ValueError(f"steps must be at least 1; got {steps}")
        share = np.linspace(0.0, 1.0, steps + 1)
        angle = share * self.turn[:, None]
        start, travel = self.hand_start[:, None, :2], (self.hand_end - self.hand_start)[:, None, :2]
        turning = self.turn != 0
        center = np.where(turning[:, None], self.center, 0.0)[:, None]
        turned = center + np.einsum("nsij,nj->nsi", rotation(angle), (start - center)[:, 0])
        where = np.where(turning[:, None, None], turned, start + share[:, None] * travel)
        theta = self.hand_start[:, 2, None] + angle
        return np.concatenate([where, theta[..., None], np.full_like(theta, self.spacing)[..., None]], axis=-1)


def stick_deviation(
    hand_start: ArrayLike, hand_end: ArrayLike, pose_start: ArrayLike, pose_end: ArrayLike, length: float
) -> Floats:
    """(...,) m: |dx| + length |dtheta| of the object as the hand sees it, from start to end; zero where they moved as
    one body. A gap that closed first counts as well. All poses (..., 3), world."""
    before, after = (
        _seen(np.asarray(hand), np.asarray(pose)) for hand, pose in ((hand_start, pose_start), (hand_end, pose_end))
    )
    change = after - before
    return np.hypot(change[..., 0], change[..., 1]) + length * np.abs(wrap_angle(change[..., 2]))


def _seen(hand: NDArray, pose: NDArray) -> Floats:
    away = np.einsum("...ji,...j->...i", rotation(hand[..., 2]), pose[..., :2] - hand[..., :2])
    return np.concatenate([away, (pose[..., 2] - hand[..., 2])[..., None]], axis=-1)


def load_two_finger_npz(path: str | PathLike[str]) -> TwoFingerLog:
    """Reads a file of the `two_finger_push` folder.

    Rows marked invalid, or holding numbers that are not finite, become problems. Raises LogError if the file is
    missing, is no such archive, lacks an array or has one of the wrong size, or if no row is usable.
    """
    file = Path(path)
    data = read_archive(file, [*_PER_PUSH, *_PER_FILE, *_SUPPORT], "two-finger pushes")
    count = _checked_count(file, data)
    numbers = {name: np.array(data[name], np.float64) for name in (*_PER_PUSH, *_PER_FILE, *_SUPPORT[:2])}
    found = [_problem(file, numbers, row) for row in range(count)]
    problems = tuple(problem for problem in found if problem is not None)
    keep = np.array([problem is None for problem in found], bool)
    if not keep.any():
        first = f", the first because: {problems[0].message}" if problems else ""
        raise LogError(file, f"expected usable pushes, found none among {count}{first}")
    rows = {name: numbers[name][keep] for name in _PER_PUSH}
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
    count = row_count(path, data, _PER_PUSH)
    check_shapes(path, data, _PER_FILE)
    points, force = data["support_points_body"], data["support_normal_force"]
    if points.size != 2 * force.size or points.ndim != 2:
        raise LogError(path, f"expected a force for each support point, found {points.shape} and {force.shape}")
    for name in (*_PER_PUSH, *_PER_FILE, *_SUPPORT[:2]):
        if data[name].dtype.kind not in "fiub":
            raise LogError(path, f"expected numbers in {name}, found {data[name].dtype}")
    return count


def _problem(path: Path, numbers: dict[str, Floats], row: int) -> LogError | None:
    index = int(numbers["push_index"][row])
    if not numbers["valid"][row]:
        return LogError(path, "expected a valid push, found one marked invalid in the archive", push=index)
    straight = numbers["rotation_angle"][row] == 0
    for name in _PER_PUSH:
        if not np.isfinite(numbers[name][row]).all() and not (straight and name == "cor_world"):
            return LogError(path, f"expected finite numbers, found NaN or infinity in {name}", push=index)
    return None
