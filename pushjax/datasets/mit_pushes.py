"""Thousands of straight pushes of one object on one surface, from the MIT data set, with the toolbox's predictions.

The tip of the pusher moves along a straight line at constant speed. There are three groups of pushes:

- `whole`: pushes of 50 mm at 10 mm/s, from before the contact to the end.
- `middle`: the test pushes of `whole`, from 10 to 90 % of their duration. All other pushes of `whole` are training
  pushes. In the curated archives, the toolbox's authors chose the test pushes.
- `fast`: the same nominal pushes (side, contact position and angle) at 20 mm/s, where recorded.

Reference: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016, as evaluated by the toolbox
of Zhou, Bagnell, Mason, RSS 2017.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets._archive import Arrays, archive_names, check_shapes, floats, read_archive
from pushjax.datasets.push_log import Floats, LogError
from pushjax.datasets.records import LARGEST_NUMBER

GROUP_PREFIXES = {"whole": "full", "middle": "eval", "fast": "v20"}
_POSE_ARRAYS = ("object_pose_start", "object_pose_end")
_TIP_ARRAYS = ("tip_start", "tip_end")
_TRAINING_ARRAYS = ("train_wrench", "train_twist", "train_valid", "eval_to_full", "full_in_eval")
_OBJECT_ARRAYS = ("vertices_body", "rho", "tip_radius", "surface", "shape")
TOOLBOX_SUFFIXES = {"quartic": "poly4", "ellipsoid": "quadratic"}


@dataclass(frozen=True, eq=False)
class StraightPushes:
    """A group of k straight pushes. For `middle`, start and end are at 10 and 90 % of the duration.

    Attributes:
        index: (k,) number of the push. In a curated archive, it is the row in the original file. In the published data
            set, it is the position in the list from `find_mit_pushes`.
        start: (k, 3) pose of the object at the start, in m and rad, world frame.
        end: (k, 3) pose of the object at the end. Its angle is the one nearest to that of the start.
        tip_start: (k, 2) center of the tip at the start, in m, world frame.
        tip_end: (k, 2) center of the tip at the end.
        valid: (k,) whether the tracker can be trusted.
        toolbox: End poses (k, 3) as predicted by the original toolbox, by the kind of the limit surface ("quartic",
            "ellipsoid"); empty if unknown.
    """

    index: NDArray[np.int64]
    start: Floats
    end: Floats
    tip_start: Floats
    tip_end: Floats
    valid: NDArray[np.bool_]
    toolbox: dict[str, Floats]

    def __len__(self) -> int:
        return len(self.index)


class MitPushes(NamedTuple):
    """The straight pushes of one object on one surface; the module docstring describes the three groups.

    Attributes:
        whole: Complete pushes.
        middle: The test pushes, from 10 to 90 % of their duration.
        fast: The same pushes at higher speed; no pushes if none was recorded.
        is_training: (whole,) whether a push of `whole` is a training push.
        middle_of: (middle,) row in `whole` of the same push.
        repeats: (r, 2) rows of the same nominal push in `fast` and in `whole`.
        wrench: (m, 3) wrenches on the object, in the body frame about the body origin, of any scale. Each row, with the
            same row of `twist`, is a training pair.
        twist: (m, 3) twists of the object, in the body frame about the body origin, of any scale.
        vertices: (v, 2) vertices of the outline, in m, body frame.
        length: Characteristic length, in m, which weighs rotation against translation.
        tip_radius: Radius of the tip, in m.
        surface: Name of the surface.
        shape: Name of the object.
        source: The file or folder that was read.
    """

    whole: StraightPushes
    middle: StraightPushes
    fast: StraightPushes
    is_training: NDArray[np.bool_]
    middle_of: NDArray[np.int64]
    repeats: NDArray[np.int64]
    wrench: Floats
    twist: Floats
    vertices: Floats
    length: float
    tip_radius: float
    surface: str
    shape: str
    source: str


def load_mit_pushes_npz(path: str | PathLike[str]) -> MitPushes:
    """Read a curated archive from the folder `mit_push`.

    The toolbox trained with the same pushes, and with the same pairs of wrench and twist.

    Args:
        path: The file.

    Returns:
        The pushes in the file.

    Raises:
        LogError: If the file is missing or is not an archive, if an array is missing or has the wrong shape, if a
            number is not finite or is too large, or if a push of `middle` is not in `whole`.
    """
    file = Path(path).expanduser()
    names = [*_TRAINING_ARRAYS, *_OBJECT_ARRAYS]
    with_fast = "v20_index" in archive_names(file, "straight pushes")
    groups = {name: prefix for name, prefix in GROUP_PREFIXES.items() if name != "fast" or with_fast}
    for prefix in groups.values():
        names += [f"{prefix}_{part}" for part in ("index", *_POSE_ARRAYS, *_TIP_ARRAYS, "valid")]
        names += [f"{prefix}_sim_pose_end_{kind}" for kind in TOOLBOX_SUFFIXES.values()]
    if with_fast:
        names.append("v20_to_full_action")
    data = read_archive(file, names, "straight pushes")
    by_group = {name: _read_group(file, data, prefix) for name, prefix in groups.items()}
    whole, middle = by_group["whole"], by_group["middle"]
    no_rows = whole.index[:0], whole.start[:0], whole.end[:0], whole.tip_start[:0], whole.tip_end[:0], whole.valid[:0]
    fast = by_group.get("fast", StraightPushes(*no_rows, toolbox={}))
    pair_count, vertex_count = (
        len(data[name]) if data[name].ndim else -1 for name in ("train_wrench", "vertices_body")
    )
    expected = {"train_wrench": (pair_count, 3), "train_twist": (pair_count, 3), "train_valid": (pair_count,)}
    expected |= {"vertices_body": (vertex_count, 2), "rho": (), "tip_radius": ()}
    expected |= {"eval_to_full": (len(middle),), "full_in_eval": (len(whole),)}
    check_shapes(file, data, expected)
    _check_finite(file, data, ("train_wrench", "train_twist", "vertices_body", "rho", "tip_radius"))
    valid = data["train_valid"].astype(bool)
    rows = {int(index): row for row, index in enumerate(whole.index)}
    unmatched = [int(index) for index in data["eval_to_full"] if int(index) not in rows]
    if unmatched:
        raise LogError(file, f"expected eval_to_full to name rows of full_index, found {unmatched[0]}")
    repeats = []
    if with_fast:
        check_shapes(file, data, {"v20_to_full_action": (len(fast),)})
        whole_index = data["v20_to_full_action"]
        repeats = [(row, rows[int(index)]) for row, index in enumerate(whole_index) if int(index) in rows]
    return MitPushes(
        whole=whole,
        middle=middle,
        fast=fast,
        is_training=~data["full_in_eval"].astype(bool),
        middle_of=np.array([rows[int(index)] for index in data["eval_to_full"]], np.int64),
        repeats=np.array(repeats, np.int64).reshape(-1, 2),
        wrench=floats(data["train_wrench"])[valid],
        twist=floats(data["train_twist"])[valid],
        vertices=floats(data["vertices_body"]),
        length=float(floats(data["rho"])),
        tip_radius=float(floats(data["tip_radius"])),
        surface=str(data["surface"]),
        shape=str(data["shape"]),
        source=str(file),
    )


def _read_group(path: Path, data: Arrays, prefix: str) -> StraightPushes:
    """Read the group of pushes whose arrays have this prefix."""
    count = len(data[f"{prefix}_index"]) if data[f"{prefix}_index"].ndim else -1
    shapes: dict[str, tuple[int, ...]] = {f"{prefix}_{name}": (count, 3) for name in _POSE_ARRAYS}
    shapes |= {f"{prefix}_sim_pose_end_{kind}": (count, 3) for kind in TOOLBOX_SUFFIXES.values()}
    shapes |= {f"{prefix}_{name}": (count, 2) for name in _TIP_ARRAYS}
    check_shapes(path, data, shapes | {f"{prefix}_index": (count,), f"{prefix}_valid": (count,)})
    _check_finite(path, data, tuple(shapes))
    start, end = (floats(data[f"{prefix}_{name}"]) for name in _POSE_ARRAYS)
    tip_start, tip_end = (floats(data[f"{prefix}_{name}"]) for name in _TIP_ARRAYS)
    toolbox = {name: floats(data[f"{prefix}_sim_pose_end_{kind}"]) for name, kind in TOOLBOX_SUFFIXES.items()}
    for pose in (end, *toolbox.values()):
        pose[:, 2] = start[:, 2] + wrap_to_pi(pose[:, 2] - start[:, 2])
    index, valid = data[f"{prefix}_index"].astype(np.int64), data[f"{prefix}_valid"].astype(bool)
    return StraightPushes(index, start, end, tip_start, tip_end, valid, toolbox)


def _check_finite(path: Path, data: Arrays, names: tuple[str, ...]) -> None:
    """Raise LogError unless the named arrays have only finite numbers, with magnitudes below LARGEST_NUMBER."""
    for name in names:
        if not np.issubdtype(data[name].dtype, np.number) or not (np.abs(data[name]) < LARGEST_NUMBER).all():
            raise LogError(path, f"expected finite numbers below {LARGEST_NUMBER:g}, found others in {name}")


def wrap_to_pi(angle: Floats) -> Floats:
    """Wrap angles, rad, to [-pi, pi)."""
    # `push_log.wrap_angle` wraps to (-pi, pi] and rounds differently. Both are kept, because the poses that are read
    # from the two data sets would otherwise change in their last bits.
    return (angle + np.pi) % (2 * np.pi) - np.pi
