"""Read the straight pushes of one object on one surface from the MIT pushing data set as published, one file per push.

The result has the form of the curated archives (`mit_pushes`), with these differences:

- The training pushes are drawn at random.
- Pushes in which the tracker jumps are left out.
- There is no rule that the object's angles at 10 and 90 % of the time lie between those at the ends. The toolbox of
  Zhou, Bagnell, Mason, RSS 2017 needs such a rule, because its angles wrap.
- Nothing is smoothed, and there are no predictions of another program.

The time from 10 to 90 % is divided into six equal parts. Each part gives one wrench, the mean over its samples, and one
twist, the displacement of the object. The contact is the point of the outline nearest to the center of the finger. A
part is left out if the object rests, if the force brakes the object or is weak, or if the force cannot be that of a
finger pressing at the contact.
"""

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets.mit_logs import load_mit_hdf5, load_mit_json
from pushjax.datasets.mit_names import PREFIX, SUFFIXES, PushParameters, parse_push_name
from pushjax.datasets.mit_pushes import MitPushes, StraightPushes, wrap_to_pi
from pushjax.datasets.mit_shapes import MitShape, mit_shape, nearest_on_outline
from pushjax.datasets.pushes import Floats, LogError, rotation
from pushjax.datasets.recordings import interpolated

MIN_PUSHES = 10  # smallest number of pushes, of which a few are used for training
SAME_SPEED = 1e-5  # m/s; file names have speeds in whole mm/s
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
# The rules of the curated archives for pushes whose tracker can be trusted:
# - At the start, the tip is less than MAX_GAP (m) from the outline, outside or inside.
# - At the end, it is less than MAX_OVERLAP (m) inside the outline.
# - The object moves farther than the tip by at most MAX_AHEAD (m).
# - The object turns by less than MAX_TURN (rad).
# - The path of the tip is longer than MIN_PATH times the median path.
MAX_GAP, MAX_OVERLAP, MAX_AHEAD, MAX_TURN, MIN_PATH = 0.008, 0.006, 0.005, np.deg2rad(75), 0.8


def find_mit_pushes(folder: str | PathLike[str], surface: str, shape: str) -> list[tuple[PushParameters, Path]]:
    """Find the files of one object's pushes in a folder and the folders below it.

    Of several files with the same name, JSON is preferred to HDF5. Files with names of another form are ignored.

    Args:
        folder: The folder.
        surface: Name of the surface, as in the file names.
        shape: Name of the object, as in the file names.

    Returns:
        Name and path of each push, sorted by acceleration, speed, side, fraction, angle and repetition.

    Raises:
        LogError: If the folder is missing, or if it has no file of that object on that surface.
    """
    return _find_files(Path(folder), surface, shape)[0]


def load_mit_folder(
    folder: str | PathLike[str],
    surface: str,
    shape: str,
    *,
    speed: float = 0.010,
    fast_speed: float = 0.020,
    train_share: float = 0.3,
    seed: int = 0,
    progress: ProgressCallback = no_progress,
) -> tuple[MitPushes, tuple[LogError, ...]]:
    """Read the pushes of constant speed of one object on one surface.

    In the result, `index` is the position in `find_mit_pushes`. `repeats` pairs pushes of the same side, fraction and
    angle, with the nearest repetition. `wrench` (N, N m) and `twist` (displacements in m, rad) are from valid training
    pushes. `toolbox` is empty.

    Args:
        folder: Folder of the unpacked `.json`, `.h5` or `.hdf5` files of the data set, which may be in folders of their
            own.
        surface: Name of the surface, as in the file names.
        shape: Name of the object, as in the file names; one of MIT_SHAPES.
        speed: Speed of the pushes in `whole`, in m/s. Files with neither this speed nor `fast_speed` are not read.
        fast_speed: Speed of the pushes in `fast`, in m/s.
        train_share: Fraction of `whole` to use for training, drawn at random. The rest is `middle`.
        seed: Seed of that draw.
        progress: Called after each file with the number of files read and the number of files to read.

    Returns:
        The pushes, and one error for each file that is misnamed or cannot be used.

    Raises:
        LogError: If the folder is missing, if it has no file of that object on that surface, or if fewer than ten
            pushes at `speed` are usable.
        ValueError: If the outline of the shape is unknown, if the speeds are equal, or if `train_share` is not between
            0 and 1.
    """
    body = mit_shape(shape)
    if not 0 < train_share < 1:
        raise ValueError(f"train_share must be between 0 and 1; got {train_share}")
    if abs(speed - fast_speed) < SAME_SPEED:
        raise ValueError(f"speed and fast_speed must differ; got {speed} and {fast_speed}")
    found, misnamed = _find_files(Path(folder), surface, shape)
    constant_speed = [(index, *each) for index, each in enumerate(found) if each[0].acceleration == 0]
    by_speed, unusable = _read_pushes(constant_speed, (speed, fast_speed), progress)
    problems = [*misnamed, *unusable]
    whole, fast = by_speed
    if len(whole) < MIN_PUSHES:
        raise _too_few_error(
            Path(folder), f"{shape} on {surface} at {1e3 * speed:g} mm/s", len(whole), constant_speed, problems
        )
    is_training = np.zeros(len(whole), bool)
    count = int(np.clip(round(train_share * len(whole)), 1, len(whole) - 1))
    is_training[np.random.default_rng(seed).permutation(len(whole))[:count]] = True
    test_rows = np.flatnonzero(~is_training)
    pushes = _push_group(whole, (0.0, 1.0), body)
    training_rows = np.flatnonzero(is_training & pushes.valid)
    pairs = np.array([pair for row in training_rows for pair in _training_pairs(whole[row], body)]).reshape(-1, 2, 3)
    log = MitPushes(
        whole=pushes,
        middle=_push_group([whole[row] for row in test_rows], MIDDLE_PART, body),
        fast=_push_group(fast, (0.0, 1.0), body),
        is_training=is_training,
        middle_of=test_rows.astype(np.int64),
        repeats=_repeat_rows(fast, whole),
        wrench=pairs[:, 0],
        twist=pairs[:, 1],
        vertices=body.vertices,
        length=body.length,
        tip_radius=body.tip_radius,
        surface=surface,
        shape=shape,
        source=str(folder),
    )
    return log, tuple(problems)


class _Push(NamedTuple):
    """A push from the first to the last sample at which tip, object and force are known, in the world frame.

    Attributes:
        index: Position of the file in `find_mit_pushes`.
        name: Parameters of the push.
        time: (m,) times, in s.
        tip: (m, 2) centers of the tip, in m.
        pose: (m, 3) poses of the object, in m and rad.
        force: (m, 2) forces on the object, in N.
    """

    index: int
    name: PushParameters
    time: Floats
    tip: Floats
    pose: Floats
    force: Floats

    def times_at(self, fractions: Sequence[float] | Floats) -> Floats:
        """Return the times (k,), in s, at these fractions (k,) of the duration."""
        begin, end = self.time[0], self.time[-1]
        return np.clip(begin + np.asarray(fractions) * (end - begin), begin, end)  # roundoff might exceed the end

    def states_at(self, fractions: Sequence[float] | Floats) -> tuple[Floats, Floats]:
        """Return the poses (k, 3) and the centers of the tip (k, 2) at these fractions (k,) of the duration."""
        times = self.times_at(fractions)
        return interpolated(times, self.time, self.pose), interpolated(times, self.time, self.tip)


def _find_files(folder: Path, surface: str, shape: str) -> tuple[list[tuple[PushParameters, Path]], list[LogError]]:
    """Return what `find_mit_pushes` returns, and an error for each misnamed file of the same surface and object."""
    if not folder.is_dir():
        raise LogError(folder, "expected a folder of the MIT pushing data set, found none")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (*SUFFIXES, ".zip"))
    logs = [path for path in files if path.suffix.lower() in SUFFIXES and path.name.startswith(PREFIX)]
    misnamed: list[LogError] = []
    stems_found: dict[tuple[str, str], set[str]] = {}
    found: dict[str, tuple[PushParameters, Path]] = {}
    for path in sorted(logs, key=lambda path: SUFFIXES.index(path.suffix.lower())):
        try:
            name = parse_push_name(path)
        except LogError as error:
            if path.name.startswith(f"{PREFIX}{surface}_shape={shape}_"):
                misnamed.append(error)
            continue
        stems_found.setdefault((name.surface, name.shape), set()).add(path.stem)
        if (name.surface, name.shape) == (surface, shape):
            found.setdefault(path.stem, (name, path))
    if not found:
        raise LogError(
            folder,
            _describe_missing(surface, shape, stems_found, [path for path in files if path.suffix.lower() == ".zip"]),
        )
    return sorted(found.values(), key=_sort_key), misnamed


def _read_pushes(
    files: list[tuple[int, PushParameters, Path]], speeds: tuple[float, ...], progress: ProgressCallback
) -> tuple[list[list[_Push]], list[LogError]]:
    """Read the files whose push has one of the wanted speeds.

    Args:
        files: Index, parameters and path of each push.
        speeds: The wanted speeds, in m/s.
        progress: Called after each file with the number of files read and the number of files to read.

    Returns:
        The pushes of each speed, and one error for each file that cannot be used.
    """
    pushes: list[list[_Push]] = [[] for _ in speeds]
    problems = []
    wanted = [
        (group, *each)
        for each in files
        for group, speed in zip(pushes, speeds, strict=True)
        if abs(each[1].speed - speed) < SAME_SPEED
    ]
    for done, (group, index, name, path) in enumerate(wanted):
        try:
            group.append(_read_push(index, name, path))
        except LogError as error:
            problems.append(error)
        progress(done + 1, len(wanted))
    return pushes, problems


def _sort_key(named: tuple[PushParameters, Path]) -> tuple[float, ...]:
    """Return the key by which pushes are sorted."""
    _, _, *numbers, repetition = named[0]
    return (*numbers, -1 if repetition is None else repetition)


def _describe_missing(surface: str, shape: str, stems_found: dict[tuple[str, str], set[str]], zips: list[Path]) -> str:
    """Describe what was found in place of the wanted files."""
    wanted = f"expected files {PREFIX}{surface}_shape={shape}_... ({', '.join(SUFFIXES)})"
    if stems_found:
        counts = (f"{len(stems)} of {other} on {on}" for (on, other), stems in sorted(stems_found.items()))
        return f"{wanted}, found {', '.join(counts)}"
    if zips:
        return f"{wanted}, found only .zip files ({zips[0].name}, say): unpack them first"
    return f"{wanted}, found none of the data set"


def _too_few_error(
    folder: Path,
    what: str,
    count: int,
    constant_speed: list[tuple[int, PushParameters, Path]],
    problems: list[LogError],
) -> LogError:
    """Make the error for a folder with too few usable pushes."""
    speeds = ", ".join(f"{1e3 * speed:g}" for speed in sorted({name.speed for _, name, _ in constant_speed})) or "none"
    message = f"expected at least {MIN_PUSHES} usable pushes of {what}, found {count}; files there are at {speeds} mm/s"
    if problems:
        message += f"; {len(problems)} files cannot be used: {Path(problems[0].path).name}: {problems[0].message}"
    return LogError(folder, message)


def _read_push(index: int, name: PushParameters, path: Path) -> _Push:
    """Read the push of a file.

    Raises:
        LogError: If the file is damaged, or if the tracker lost the object.
    """
    (push,) = (load_mit_json if path.suffix.lower() == ".json" else load_mit_hdf5)(path).pushes
    assert push.force is not None  # these files always have force and time
    assert push.time is not None
    rows = _known_span(path, push.time, push.seen & np.isfinite(push.force[:, 0]))
    time, tip, pose = push.time[rows], push.hand[rows], push.pose[rows]
    _check_no_jump(path, time, tip, pose)
    return _Push(index, name, time, tip, pose, push.force[rows])


def _known_span(path: Path, time: Floats, known: NDArray[np.bool_]) -> slice:
    """Return the range from the first to the last sample (m,) that is known.

    Raises:
        LogError: If a sample in between is unknown. The object was not seen there, because the force has no gaps.
    """
    rows = np.flatnonzero(known)
    if len(rows) < 2 or time[rows[-1]] == time[rows[0]]:
        raise LogError(path, f"expected a span of time with tip, object and force, found {len(rows)} such samples")
    lost = rows[0] + np.flatnonzero(~known[rows[0] : rows[-1]])
    if len(lost):
        span = f"{time[lost[0]]:.2f} to {time[lost[-1]]:.2f} s"
        raise LogError(path, f"expected the object to be seen throughout, found it lost from {span}")
    return slice(rows[0], rows[-1] + 1)


def _check_no_jump(path: Path, time: Floats, tip: Floats, pose: Floats) -> None:
    """Check that the tracker does not jump.

    The test compares all samples of a stretch of the path, not only neighbors. The poses are interpolated at the time
    stamps of the tip. Where the tracker has fewer samples than the tip, a jump is spread over several samples.

    Raises:
        LogError: If it jumps.
    """
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


def _push_group(pushes: Sequence[_Push], fractions: tuple[float, float], body: MitShape) -> StraightPushes:
    """Return a group of pushes, each from its state at the first to that at the second fraction of its duration."""
    ends = [push.states_at(fractions) for push in pushes]
    pose = np.array([pose for pose, _ in ends]).reshape(-1, 2, 3)
    tip = np.array([tip for _, tip in ends]).reshape(-1, 2, 2)
    start, end = pose[:, 0], pose[:, 1]
    end[:, 2] = start[:, 2] + wrap_to_pi(end[:, 2] - start[:, 2])
    index = np.array([push.index for push in pushes], np.int64)
    return StraightPushes(index, start, end, tip[:, 0], tip[:, 1], _is_trustworthy(pose, tip, body), toolbox={})


def _is_trustworthy(pose: Floats, tip: Floats, body: MitShape) -> NDArray[np.bool_]:
    """Return whether the tracker can be trusted in each of k pushes.

    Args:
        pose: (k, 2, 3) poses of the object before and after each push, in m and rad.
        tip: (k, 2, 2) centers of the tip before and after each push, in m.
        body: The object.
    """
    if not len(pose):
        return np.zeros(0, bool)
    before, after = (
        nearest_on_outline(body.vertices, _in_body(pose[:, end], tip[:, end] - pose[:, end, :2]))[0] - body.tip_radius
        for end in (0, 1)
    )
    moved, path = (np.linalg.norm(each[:, 1, :2] - each[:, 0, :2], axis=1) for each in (pose, tip))
    touching = (np.abs(before) < MAX_GAP) & (after > -MAX_OVERLAP)
    pushed = (moved - path <= MAX_AHEAD) & (np.abs(pose[:, 1, 2] - pose[:, 0, 2]) < MAX_TURN)
    return touching & pushed & (path > MIN_PATH * np.median(path))


def _in_body(pose: Floats, vectors: Floats) -> Floats:
    """Rotate world vectors (k, 2) into the body frames of k poses (k, 3)."""
    return np.einsum("kji,kj->ki", rotation(pose[:, 2]), vectors)


def _training_pairs(push: _Push, body: MitShape) -> Iterator[tuple[Floats, Floats]]:
    """Iterate over the wrenches and displacements of the parts in which the finger pushes.

    Yields:
        The wrench (3,), in N and N m, and the displacement (3,), in m and rad, both about the body origin and in the
            body frame at the middle of the part.
    """
    tip, force = _in_body(push.pose, push.tip - push.pose[:, :2]), _in_body(push.pose, push.force)
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


def _repeat_rows(fast: Sequence[_Push], whole: Sequence[_Push]) -> NDArray[np.int64]:
    """Return the rows (r, 2) in `fast` and `whole` of the same nominal push with the nearest repetition."""
    rows_by_nominal: dict[tuple[float, ...], list[int]] = {}
    for row, push in enumerate(whole):
        rows_by_nominal.setdefault(_nominal_push(push), []).append(row)
    pairs = []
    for row, push in enumerate(fast):
        same = rows_by_nominal.get(_nominal_push(push), [])
        if same:
            pairs.append((row, min(same, key=lambda at: abs(_repetition(whole[at]) - _repetition(push)))))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _nominal_push(push: _Push) -> tuple[float, ...]:
    """Return side, fraction and angle, which are equal in repetitions of a push."""
    return push.name.side, push.name.fraction, push.name.angle


def _repetition(push: _Push) -> int:
    """Return the number of the repetition; 0 if the push has none."""
    return push.name.repetition or 0
