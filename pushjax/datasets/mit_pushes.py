"""Thousands of straight pushes of one object on one surface, from the MIT pushing data set, with what another program
made of them.

The tip goes along a straight line at constant speed. `whole` are pushes of 50 mm at 10 mm/s from before the touch to
the end; `middle` those of them that the original authors tested with, from 10 to 90 % of their time; `fast` are the
same nominal pushes at 20 mm/s, where recorded. Pushes that are not in `middle` were trained with.

Source: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016, as evaluated by the toolbox of
Zhou, Bagnell, Mason, RSS 2017.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets._archive import Arrays, archive_names, check_shapes, floats, read_archive
from pushjax.datasets.pushes import Floats, LogError
from pushjax.datasets.records import LARGEST_NUMBER

GROUPS = {"whole": "full", "middle": "eval", "fast": "v20"}
_POSES = ("object_pose_start", "object_pose_end")
_TIPS = ("tip_start", "tip_end")
_ABOUT = ("train_wrench", "train_twist", "train_valid", "eval_to_full", "full_in_eval")
_SHAPE = ("vertices_body", "rho", "tip_radius", "surface", "shape")
TOOLBOX = {"quartic": "poly4", "ellipsoid": "quadratic"}


@dataclass(frozen=True, eq=False)
class StraightPushes:
    """k pushes. index: (k,) the push's row in the original file. start, end: (k, 3) m, rad, world, the object's poses;
    the end angle is the one nearest to that of the start. tip_start, tip_end: (k, 2) m, world, the tip's centre.
    valid: (k,) whether the tracker can be believed. toolbox: (k, 3) the end as the original toolbox predicted it, by
    the name of the limit surface's kind; empty where it is not known."""

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
    """Of one object on one surface.

    whole, middle, fast: see above; fast has no push where none was recorded. learned: (whole,) the pushes of `whole`
    that the toolbox trained with. middle_of: (middle,) the row in `whole` of the same push. repeats: (r, 2) rows in
    `fast` and in `whole` of the same nominal push. wrench, twist: (m, 3) on the object in its body frame about the body
    origin, of any scale: pairs that the toolbox trained with. vertices: (v, 2) m, body. length: m, which weighs
    rotation against translation. tip_radius: m. surface, shape: names. source: the file or folder.
    """

    whole: StraightPushes
    middle: StraightPushes
    fast: StraightPushes
    learned: NDArray[np.bool_]
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
    """Reads a file of the `mit_push` folder.

    Raises LogError if the file is missing, is no such archive, lacks an array, or holds one of the wrong shape or with
    numbers that are not finite.
    """
    file = Path(path)
    names = [*_ABOUT, *_SHAPE]
    with_fast = "v20_index" in archive_names(file, "straight pushes")
    groups = {name: prefix for name, prefix in GROUPS.items() if name != "fast" or with_fast}
    for prefix in groups.values():
        names += [f"{prefix}_{part}" for part in ("index", *_POSES, *_TIPS, "valid")]
        names += [f"{prefix}_sim_pose_end_{kind}" for kind in TOOLBOX.values()]
    if with_fast:
        names.append("v20_to_full_action")
    data = read_archive(file, names, "straight pushes")
    found = {name: _group(file, data, prefix) for name, prefix in groups.items()}
    whole, middle = found["whole"], found["middle"]
    none = whole.index[:0], whole.start[:0], whole.end[:0], whole.tip_start[:0], whole.tip_end[:0], whole.valid[:0]
    fast = found.get("fast", StraightPushes(*none, toolbox={}))
    pairs, corners = (len(data[name]) if data[name].ndim else -1 for name in ("train_wrench", "vertices_body"))
    expected = {"train_wrench": (pairs, 3), "train_twist": (pairs, 3), "train_valid": (pairs,)}
    expected |= {"vertices_body": (corners, 2), "rho": (), "tip_radius": ()}
    expected |= {"eval_to_full": (len(middle),), "full_in_eval": (len(whole),)}
    check_shapes(file, data, expected)
    _finite(file, data, ("train_wrench", "train_twist", "vertices_body", "rho", "tip_radius"))
    used = data["train_valid"].astype(bool)
    rows = {int(index): row for row, index in enumerate(whole.index)}
    lost = [int(index) for index in data["eval_to_full"] if int(index) not in rows]
    if lost:
        raise LogError(file, f"expected eval_to_full to name rows of full_index, found {lost[0]}")
    repeats = []
    if with_fast:
        check_shapes(file, data, {"v20_to_full_action": (len(fast),)})
        same = data["v20_to_full_action"]
        repeats = [(row, rows[int(index)]) for row, index in enumerate(same) if int(index) in rows]
    return MitPushes(
        whole=whole,
        middle=middle,
        fast=fast,
        learned=~data["full_in_eval"].astype(bool),
        middle_of=np.array([rows[int(index)] for index in data["eval_to_full"]], np.int64),
        repeats=np.array(repeats, np.int64).reshape(-1, 2),
        wrench=floats(data["train_wrench"])[used],
        twist=floats(data["train_twist"])[used],
        vertices=floats(data["vertices_body"]),
        length=float(floats(data["rho"])),
        tip_radius=float(floats(data["tip_radius"])),
        surface=str(data["surface"]),
        shape=str(data["shape"]),
        source=str(file),
    )


def _group(path: Path, data: Arrays, prefix: str) -> StraightPushes:
    count = len(data[f"{prefix}_index"]) if data[f"{prefix}_index"].ndim else -1
    shapes: dict[str, tuple[int, ...]] = {f"{prefix}_{name}": (count, 3) for name in _POSES}
    shapes |= {f"{prefix}_sim_pose_end_{kind}": (count, 3) for kind in TOOLBOX.values()}
    shapes |= {f"{prefix}_{name}": (count, 2) for name in _TIPS}
    check_shapes(path, data, shapes | {f"{prefix}_index": (count,), f"{prefix}_valid": (count,)})
    _finite(path, data, tuple(shapes))
    start, end = (floats(data[f"{prefix}_{name}"]) for name in _POSES)
    tip_start, tip_end = (floats(data[f"{prefix}_{name}"]) for name in _TIPS)
    toolbox = {name: floats(data[f"{prefix}_sim_pose_end_{kind}"]) for name, kind in TOOLBOX.items()}
    for pose in (end, *toolbox.values()):
        pose[:, 2] = start[:, 2] + nearest_turn(pose[:, 2] - start[:, 2])
    index, valid = data[f"{prefix}_index"].astype(np.int64), data[f"{prefix}_valid"].astype(bool)
    return StraightPushes(index, start, end, tip_start, tip_end, valid, toolbox)


def _finite(path: Path, data: Arrays, names: tuple[str, ...]) -> None:
    for name in names:
        if not np.issubdtype(data[name].dtype, np.number) or not (np.abs(data[name]) < LARGEST_NUMBER).all():
            raise LogError(path, f"expected finite numbers below {LARGEST_NUMBER:g}, found others in {name}")


def nearest_turn(angle: Floats) -> Floats:
    """The same angles within half a turn, rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
