"""Read the straight pushes of one object on one surface from the MIT pushing data set as published, one file per push.

The result has the form of the curated archives (`mit_pushes`), with these differences:

- The training pushes are drawn at random.
- Pushes in which the tracker jumps are left out.
- There is no rule that the object's angles at 10 and 90 % of the time lie between those at the ends. The toolbox of
  Zhou, Bagnell, Mason, RSS 2017 needs such a rule, because its angles wrap.
- Nothing is smoothed, and there are no predictions of another program.
"""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets.mit_names import PREFIX, SUFFIXES, PushParameters, parse_push_name
from pushjax.datasets.mit_push_file import MIDDLE_PART, MitPush, in_body, read_push, training_pairs
from pushjax.datasets.mit_pushes import MitPushes, StraightPushes, wrap_to_pi
from pushjax.datasets.mit_shapes import MitShape, mit_shape, nearest_on_outline
from pushjax.datasets.push_log import Floats, LogError

MIN_PUSHES = 10  # smallest number of pushes, of which a few are used for training
SAME_SPEED = 1e-5  # m/s; file names have speeds in whole mm/s
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
    return _find_files(Path(folder).expanduser(), surface, shape)[0]


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
    found, misnamed = _find_files(Path(folder).expanduser(), surface, shape)
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
    pairs = np.array([pair for row in training_rows for pair in training_pairs(whole[row], body)]).reshape(-1, 2, 3)
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
) -> tuple[list[list[MitPush]], list[LogError]]:
    """Read the pushes of each of the speeds, m/s, with one error for each file that cannot be used."""
    pushes: list[list[MitPush]] = [[] for _ in speeds]
    problems = []
    wanted = [
        (group, *each)
        for each in files
        for group, speed in zip(pushes, speeds, strict=True)
        if abs(each[1].speed - speed) < SAME_SPEED
    ]
    for done, (group, index, name, path) in enumerate(wanted):
        try:
            group.append(read_push(index, name, path))
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


def _push_group(pushes: Sequence[MitPush], fractions: tuple[float, float], body: MitShape) -> StraightPushes:
    """Return a group of pushes, each from its state at the first to that at the second fraction of its duration."""
    ends = [push.states_at(fractions) for push in pushes]
    pose = np.array([pose for pose, _ in ends]).reshape(-1, 2, 3)
    tip = np.array([tip for _, tip in ends]).reshape(-1, 2, 2)
    start, end = pose[:, 0], pose[:, 1]
    end[:, 2] = start[:, 2] + wrap_to_pi(end[:, 2] - start[:, 2])
    index = np.array([push.index for push in pushes], np.int64)
    return StraightPushes(index, start, end, tip[:, 0], tip[:, 1], _is_trustworthy(pose, tip, body), toolbox={})


def _is_trustworthy(pose: Floats, tip: Floats, body: MitShape) -> NDArray[np.bool_]:
    """Return a mask (k,) of pushes whose poses (k, 2, 3) and tips (k, 2, 2) at the ends can be trusted."""
    if not len(pose):
        return np.zeros(0, bool)
    before, after = (
        nearest_on_outline(body.vertices, in_body(pose[:, end], tip[:, end] - pose[:, end, :2]))[0] - body.tip_radius
        for end in (0, 1)
    )
    moved, path = (np.linalg.norm(each[:, 1, :2] - each[:, 0, :2], axis=1) for each in (pose, tip))
    touching = (np.abs(before) < MAX_GAP) & (after > -MAX_OVERLAP)
    pushed = (moved - path <= MAX_AHEAD) & (np.abs(pose[:, 1, 2] - pose[:, 0, 2]) < MAX_TURN)
    return touching & pushed & (path > MIN_PATH * np.median(path))


def _repeat_rows(fast: Sequence[MitPush], whole: Sequence[MitPush]) -> NDArray[np.int64]:
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


def _nominal_push(push: MitPush) -> tuple[float, ...]:
    """Return side, fraction and angle, which are equal in repetitions of a push."""
    return push.name.side, push.name.fraction, push.name.angle


def _repetition(push: MitPush) -> int:
    """Return the number of the repetition; 0 if the push has none."""
    return push.name.repetition or 0
