"""Read the pushes of one object on one surface from the MIT pushing data set as published, one file per push.

Pushes in which the tracker jumps or loses the object are left out. Nothing is smoothed.

The time from 10 to 90 % of a push is divided into six equal parts. Each part gives one wrench, the mean over its
samples, and one twist, the displacement of the object. The contact is the point of the outline nearest to the center of
the finger. A part is left out if the object rests, if the force brakes the object or is weak, or if the force cannot be
that of a finger pressing at the contact.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets.mit_logs import PREFIX, SUFFIXES, PushName, load_mit_log, parse_name
from pushjax.datasets.mit_shapes import MitShape, mit_shape, nearest_on_outline
from pushjax.datasets.planar import cross, in_body, interpolated, rotation
from pushjax.datasets.recordings import Floats, LogError, Recording, Recordings, collect

SAME_SPEED = 1e-5  # m/s; file names have speeds in whole mm/s
# Fractions of the duration between which wrenches are taken. Before the first, the tip may not touch the object yet.
# After the second, the tip may have stopped.
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


def load_mit_folder(
    folder: str | PathLike[str],
    surface: str,
    shape: str,
    *,
    speeds: Sequence[float] = (0.010, 0.020),
    progress: ProgressCallback = no_progress,
) -> Recordings:
    """Read the pushes of constant speed of one object on one surface.

    Each push begins and ends where tip, object and force are known. It has up to six pairs of wrench (N, N m) and twist
    (displacements in m, rad). `Recordings.about` has "action", "speed", "side", "fraction", "angle" and "repetition".

    Args:
        folder: Folder of the unpacked `.json`, `.h5` or `.hdf5` files of the data set, which may be in folders of their
            own. Of several files with the same name, JSON is preferred.
        surface: Name of the surface, as in the file names.
        shape: Name of the object, as in the file names: rect1 to rect3, tri1 to tri3, ellip1 to ellip3, hex or butter.
        speeds: Speeds of the pushes in m/s. Files with other speeds are not read.
        progress: Called after each file with the number of files read and the number of files to read.

    Returns:
        The pushes, sorted by speed, side, fraction, angle and repetition, and one problem for each file that is
        misnamed or cannot be used.

    Raises:
        LogError: If the folder is missing, if it has no file of that object on that surface at one of the speeds, or if
            no push is usable.
        ValueError: If the outline of the shape is unknown.
    """
    body, path = mit_shape(shape), Path(folder).expanduser()
    found, problems = find_files(path, surface, shape)
    # the index of a push is its place among all files of the object and surface
    wanted = [
        (index, name, file)
        for index, (name, file) in enumerate(found)
        if name.acceleration == 0 and min(abs(name.speed - speed) for speed in speeds) < SAME_SPEED
    ]
    if not wanted:
        asked, there = (", ".join(f"{1e3 * speed:g}" for speed in sorted(each)) for each in (speeds, _speeds(found)))
        raise LogError(path, f"expected files of {shape} on {surface} at {asked} mm/s, found files at {there} mm/s")
    results: list[Recording | LogError] = []
    for done, (index, name, file) in enumerate(wanted):
        try:
            results.append(_read_push(index, name, file, body))
        except LogError as error:
            results.append(error)
        progress(done + 1, len(wanted))
    return collect(path, [*problems, *results], surface=surface, object=shape, **body._asdict())


def find_files(folder: Path, surface: str, shape: str) -> tuple[list[tuple[PushName, Path]], list[LogError]]:
    """Find the files of one object on one surface, sorted by their names' fields, with an error for a bad name."""
    if not folder.is_dir():
        raise LogError(folder, "expected a folder of the MIT pushing data set, found none")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    found: dict[str, tuple[PushName, Path]] = {}
    misnamed = []
    others = set()
    for path in sorted(files, key=lambda path: SUFFIXES.index(path.suffix.lower())):
        if not path.name.startswith(PREFIX):
            continue
        try:
            name = parse_name(path)
        except LogError as error:
            if path.name.startswith(f"{PREFIX}{surface}_shape={shape}_"):
                misnamed.append(error)
            continue
        if (name.surface, name.shape) == (surface, shape):
            found.setdefault(path.stem, (name, path))
        others.add(f"{name.shape} on {name.surface}")
    if not found:
        zips = "only .zip files: unpack them first" if list(folder.rglob("*.zip")) else "none of the data set"
        there = ", ".join(sorted(others)) or zips
        wanted = f"expected files {PREFIX}{surface}_shape={shape}_... ({', '.join(SUFFIXES)})"
        raise LogError(folder, f"{wanted}, found {there}")
    return sorted(found.values(), key=lambda each: each[0][2:]), misnamed


def _speeds(found: list[tuple[PushName, Path]]) -> set[float]:
    """Return the speeds of the pushes of constant speed, m/s."""
    return {name.speed for name, _ in found if name.acceleration == 0}


def _read_push(index: int, name: PushName, path: Path, body: MitShape) -> Recording:
    """Read the push of a file; LogError if the file is damaged or the tracker lost the object."""
    (push,) = load_mit_log(path).pushes
    push = _known_part(path, push)
    _check_no_jump(path, push)
    pairs = np.array(list(_wrench_twist_pairs(push, body))).reshape(-1, 2, 3)
    about = {"action": name.action, **name._asdict()}
    for known in ("surface", "shape", "acceleration"):  # equal for all pushes of a folder
        del about[known]
    return replace(push, index=index, wrench=pairs[:, 0], twist=pairs[:, 1], about=about)


def _known_part(path: Path, push: Recording) -> Recording:
    """Return a push from its first to its last sample with object and force; LogError if one between lacks them."""
    assert push.force is not None  # these files always have force and time
    assert push.time is not None
    known = push.tracked & np.isfinite(push.force[:, 0])
    rows = np.flatnonzero(known)
    if len(rows) < 2 or push.time[rows[-1]] == push.time[rows[0]]:
        raise LogError(path, f"expected a span of time with tip, object and force, found {len(rows)} such samples")
    # the force has no gaps, so an unknown sample is one at which the object was not tracked
    lost = push.time[rows[0] : rows[-1]][~known[rows[0] : rows[-1]]]
    if len(lost):
        span = f"{lost[0]:.2f} to {lost[-1]:.2f} s"
        raise LogError(path, f"expected the object to be tracked throughout, found it lost from {span}")
    kept = slice(rows[0], rows[-1] + 1)
    return Recording(0, push.hand[kept], push.pose[kept], push.force[kept], push.time[kept])


def _check_no_jump(path: Path, push: Recording) -> None:
    """Raise LogError if the tracker jumps."""
    # All samples of a stretch of the path are compared, not only neighbors. The poses are interpolated at the time
    # stamps of the tip, so where the tracker has fewer samples than the tip, a jump is spread over several samples.
    assert push.time is not None
    count, travel = len(push.hand), float(np.linalg.norm(push.hand[-1] - push.hand[0]))
    window = count if travel <= JUMP_WINDOW else max(2, round(count * JUMP_WINDOW / travel))
    extent = np.ptp(np.lib.stride_tricks.sliding_window_view(push.pose, window, axis=0), axis=2)
    distance, turn = np.hypot(extent[:, 0], extent[:, 1]), extent[:, 2]
    excess = np.maximum(distance / MAX_WINDOW_MOTION, turn / MAX_WINDOW_TURN)
    row = int(np.argmax(excess))
    if excess[row] > 1:
        found = f"{1e3 * distance[row]:.0f} mm and {np.rad2deg(turn[row]):.0f} deg from {push.time[row]:.2f} s"
        limits = f"{1e3 * MAX_WINDOW_MOTION:g} mm and {np.rad2deg(MAX_WINDOW_TURN):.0f} deg"
        during = f"while the tip goes {1e3 * JUMP_WINDOW:g} mm"
        raise LogError(
            path, f"the tracker jumps: expected an object that moves by less than {limits} {during}, found {found}"
        )


def states_at(push: Recording, fractions: Sequence[float] | Floats) -> tuple[Floats, Floats, Floats]:
    """Return times (k,), poses (k, 3) and the hand's configurations (k, dof) at fractions (k,) of the duration."""
    assert push.time is not None
    begin, end = push.time[0], push.time[-1]
    times = np.clip(begin + np.asarray(fractions) * (end - begin), begin, end)  # roundoff might exceed the end
    return times, interpolated(times, push.time, push.pose), interpolated(times, push.time, push.hand)


def _wrench_twist_pairs(push: Recording, body: MitShape) -> Iterator[tuple[Floats, Floats]]:
    """Iterate over the wrenches (3,), N and N m, and displacements (3,), m and rad, of the parts with pressing."""
    assert push.time is not None
    assert push.force is not None
    tip, force = in_body(push.pose, push.hand - push.pose[:, :2]), in_body(push.pose, push.force)
    distance, contact = nearest_on_outline(body.vertices, tip)
    inward = (contact - tip) / np.where(distance == 0, np.inf, distance)[:, None]
    torque, along, across = cross(contact, force), np.sum(inward * force, axis=1), cross(inward, force)
    times, poses, _ = states_at(push, np.linspace(*MIDDLE_PART, 2 * NUM_PARTS + 1))
    row_at = np.searchsorted(push.time, times)
    for part in range(0, 2 * NUM_PARTS, 2):
        rows = slice(row_at[part], row_at[part + 2])
        if rows.start == rows.stop:
            continue
        # wrench and displacement are about the body origin, in the body frame at the middle of the part
        to_body = rotation(poses[part + 1, 2]).T
        displacement = poses[part + 2] - poses[part]
        wrench = np.append(to_body @ push.force[rows].mean(axis=0), torque[rows].mean())
        twist = np.append(to_body @ displacement[:2], displacement[2])
        motion = np.linalg.norm(twist[:2]) + body.length * abs(twist[2])
        presses = np.abs(np.arctan2(across[rows].mean(), along[rows].mean())) < MAX_FORCE_ANGLE
        strong = np.linalg.norm(wrench[:2]) >= MIN_FORCE
        if presses and strong and motion >= MIN_MOTION and wrench @ twist > 0:
            yield wrench, twist
