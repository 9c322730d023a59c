"""Read curated arrays of one-finger pushes of the triangle: one `.npz` per log, in SI units.

The frames are those of `push_log`.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from pushjax.datasets._archive import Arrays, floats, read_archive, row_count
from pushjax.datasets.push_log import (
    Floats,
    LogError,
    Push,
    PushLog,
    contact_onset,
    continuous_angle,
    force_filter,
    wrap_angle,
)

_PUSH_ARRAYS = {"push_index": (), "valid": (), "object_pose_start": (3,), "object_pose_end": (3,)}
_FILE_ARRAYS = (
    "vertices_body",
    "rho",
    "tip_radius",
    "support_points_body",
    "support_normal_force",
    "surface",
    "arrangement",
)
_STREAM_ARRAYS = {"tip_offsets": ("tip_t", "tip_xy", "tip_yaw"), "ft_offsets": ("ft_t", "force_world")}


def load_push_npz(path: str | PathLike[str]) -> PushLog:
    """Read a file of the `three_point_push` folder.

    The order of the rows is kept, and `Push.index` is the `push_index` of the row. A row becomes a problem if it is
    marked invalid or has numbers that are not finite. The constants at the top of this file list the arrays that are
    read.

    Args:
        path: The file.

    Returns:
        The usable pushes, and the problems of the others.

    Raises:
        LogError: If the file is missing or no such archive, if an array is missing or has the wrong size, or if no row
            is usable.
    """
    file = Path(path).expanduser()
    wanted = [
        *_PUSH_ARRAYS,
        *_FILE_ARRAYS,
        *_STREAM_ARRAYS,
        *(name for names in _STREAM_ARRAYS.values() for name in names),
    ]
    data = read_archive(file, wanted, "pushes")
    _check_sizes(file, data)
    pushes: list[Push] = []
    problems: list[LogError] = []
    for row in range(len(data["push_index"])):
        found = _read_push(file, data, row)
        if isinstance(found, Push):
            pushes.append(found)
        else:
            problems.append(found)
    if not pushes:
        first = f", the first because: {problems[0].message}" if problems else ""
        raise LogError(file, f"expected usable pushes, found none among {len(problems)}{first}")
    return PushLog(
        pushes=tuple(pushes),
        problems=tuple(problems),
        vertices=floats(data["vertices_body"]),
        length=float(floats(data["rho"])),
        tip_radius=float(floats(data["tip_radius"])),
        support_points=floats(data["support_points_body"]).reshape(-1, 2),
        support_force=floats(data["support_normal_force"]).reshape(-1),
        surface=str(data["surface"]),
        arrangement=str(data["arrangement"]),
        source=str(file),
    )


def _check_sizes(path: Path, data: Arrays) -> None:
    """Check the numbers of rows, and that the offsets of the streams rise from 0."""
    count = row_count(path, data, _PUSH_ARRAYS)
    for offsets_name, names in _STREAM_ARRAYS.items():
        offsets = data[offsets_name]
        if offsets.shape != (count + 1,) or offsets[0] != 0 or np.any(np.diff(floats(offsets)) < 1):
            raise LogError(path, f"expected {offsets_name} to rise from 0 in {count} steps, found another array")
        for name in names:
            if len(data[name]) != offsets[-1]:
                raise LogError(path, f"expected {offsets[-1]} rows of {name}, found {len(data[name])}")


def _read_push(path: Path, data: Arrays, row: int) -> Push | LogError:
    """Read the push of a row, or return the error that describes its first fault."""
    index = int(floats(data["push_index"])[row])
    if not data["valid"][row]:
        return LogError(path, "expected a valid push, found one marked invalid in the archive", push=index)
    streams: dict[str, Floats] = {}
    for offsets, names in _STREAM_ARRAYS.items():
        begin, end = (int(at) for at in floats(data[offsets])[row : row + 2])
        streams |= {name: floats(data[name][begin:end]) for name in names}
    start, end_pose = floats(data["object_pose_start"])[row], floats(data["object_pose_end"])[row]
    for name, values in {**streams, "object_pose_start": start, "object_pose_end": end_pose}.items():
        if not np.isfinite(values).all():
            return LogError(path, f"expected finite numbers, found NaN or infinity in {name}", push=index)
    if not force_filter(streams["force_world"]).any():
        return LogError(path, "expected the force to last after the first 30 % of the samples, found none", push=index)
    end_pose[2] = start[2] + wrap_angle(end_pose[2] - start[2])
    tip_time, tip = streams["tip_t"], streams["tip_xy"]
    force_time, force = streams["ft_t"], streams["force_world"]
    return Push(
        index=index,
        pose_start=start,
        pose_end=end_pose,
        tip_time=tip_time,
        tip=tip,
        tip_yaw=continuous_angle(streams["tip_yaw"]),
        force_time=force_time,
        force=force,
        onset=contact_onset(force_time, force, tip_time, tip),
    )
