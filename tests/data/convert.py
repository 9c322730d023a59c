"""Convert a folder of curated arrays to files as `Recordings.save` writes them, for the experiments and their tests.

    python tests/data/convert.py FROM TO

FROM has some of the folders `three_point_push`, `two_finger_push`, `mit_push` and `mit_push_full`, whose arrays its own
README describes. TO gets the same folders and files. Rows that are marked invalid become problems, except in
`mit_push`, where "valid" is kept.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pushjax.datasets import LogError, Recording, Recordings
from pushjax.datasets.planar import wrap_angle
from pushjax.datasets.streams import Stream, align_streams
from pushjax.datasets.triangle import make_push
from pushjax.datasets.two_finger_logs import make_push as make_two_finger_push

Arrays = dict[str, Any]
TOOLBOX = {"toolbox_quartic": "sim_pose_end_poly4", "toolbox_ellipsoid": "sim_pose_end_quadratic"}


def facts(data: Arrays) -> dict[str, Any]:
    """Return what is known of the object, as fields of `Recordings`."""
    names = {"vertices": "vertices_body", "length": "rho", "tip_radius": "tip_radius"}
    known = {field: np.array(data[name], float)[()] for field, name in names.items() if name in data}
    if "support_points_body" in data:
        known["support_points"] = np.array(data["support_points_body"], float).reshape(-1, 2)
        known["support_force"] = np.array(data["support_normal_force"], float).reshape(-1)
    surface = None if str(data["surface"]) == "unknown" else str(data["surface"])
    return known | {"surface": surface, "object": str(data["arrangement" if "arrangement" in data else "shape"])}


def nearest_end(start: np.ndarray, end: np.ndarray, wrap: Callable = wrap_angle) -> np.ndarray:
    """Return end poses (..., 3) whose angles are the ones nearest to the start angles."""
    end = np.array(end, float)
    end[..., 2] = start[..., 2] + wrap(end[..., 2] - start[..., 2])
    return end


def valid_pushes(path: Path, data: Arrays, pushes: Callable[[int], Recording]) -> list[Recording | LogError]:
    """Return the pushes of an archive, with errors in place of the invalid ones."""
    return [
        pushes(row) if valid else LogError(path, "marked invalid in the archive", push=int(data["push_index"][row]))
        for row, valid in enumerate(data["valid"])
    ]


def recordings(path: Path, data: Arrays, found: list[Recording | LogError]) -> Recordings:
    """Return the recordings of an archive."""
    pushes = tuple(each for each in found if isinstance(each, Recording))
    problems = tuple(each for each in found if isinstance(each, LogError))
    return Recordings(pushes, problems, str(path), **facts(data))


def one_finger(path: Path, data: Arrays) -> Recordings:
    """Convert pushes of the triangle by one finger."""
    start = np.array(data["object_pose_start"], float)
    end = nearest_end(start, data["object_pose_end"])

    def push(row: int) -> Recording:
        tip, force = (slice(*data[f"{name}_offsets"][row : row + 2]) for name in ("tip", "ft"))
        streams = (data["tip_t"][tip], data["tip_xy"][tip], data["ft_t"][force], data["force_world"][force])
        return make_push(
            int(data["push_index"][row]), start[row], end[row], *(np.array(stream, float) for stream in streams)
        )

    return recordings(path, data, valid_pushes(path, data, push))


def two_fingers(path: Path, data: Arrays) -> Recordings:
    """Convert pushes of the triangle by two fingers."""
    start = np.array(data["object_pose_start"], float)
    end = nearest_end(start, data["object_pose_end"])
    names = ("pusher_pose_start", "pusher_pose_end", "rotation_angle", "cor_world")
    hand_start, hand_end, turn, center = (np.array(data[name], float) for name in names)

    def push(row: int) -> Recording:
        about = {"action": int(data["action_group"][row]), "began": float(data["t0_unix"][row])}
        ends, hands = (start[row], end[row]), (hand_start[row], hand_end[row])
        return make_two_finger_push(int(data["push_index"][row]), ends, hands, turn[row], center[row], **about)

    return recordings(path, data, valid_pushes(path, data, push))


def mit_groups(path: Path, data: Arrays) -> Recordings:
    """Convert the straight pushes of table 1, in the groups that `pushjax.experiments._mit_pushes` describes."""
    groups = {"whole": "full", "middle": "eval", "fast": "v20"}
    training = ~np.array(data["full_in_eval"], bool)
    pushes = [
        push
        for group, prefix in groups.items()
        if f"{prefix}_index" in data
        for push in _straight(data, group, prefix, training)
    ]
    # The archives do not say which pushes the pairs of wrench and twist are of: they are spread over the training ones.
    learned = [row for row, push in enumerate(pushes) if push.about["training"] and push.about["valid"]]
    pairs = np.flatnonzero(data["train_valid"])
    for row, part in zip(learned, np.array_split(pairs, len(learned)), strict=True):
        wrench, twist = (np.array(data[name][part], float) for name in ("train_wrench", "train_twist"))
        pushes[row] = replace(pushes[row], wrench=wrench, twist=twist)
    return recordings(path, data, pushes)


def _straight(data: Arrays, group: str, prefix: str, training: np.ndarray) -> Iterator[Recording]:
    """Iterate over the pushes of one group."""

    def wrap(angle: np.ndarray) -> np.ndarray:
        return (angle + np.pi) % (2 * np.pi) - np.pi

    index = data[f"{prefix}_index"]
    start = np.array(data[f"{prefix}_object_pose_start"], float)
    end, *toolbox = (
        nearest_end(start, data[f"{prefix}_{name}"], wrap) for name in ("object_pose_end", *TOOLBOX.values())
    )
    # a push of "fast" has the action of a push of "whole", if there is one
    action = {"whole": index, "middle": data["eval_to_full"], "fast": data.get("v20_to_full_action")}[group]
    for row in range(len(index)):
        about = {
            "group": group,
            "training": group == "whole" and bool(training[row]),
            "valid": bool(data[f"{prefix}_valid"][row]),
            "action": int(action[row]),
            **{name: poses[row] for name, poses in zip(TOOLBOX, toolbox, strict=True)},
        }
        hand = np.array([data[f"{prefix}_tip_start"][row], data[f"{prefix}_tip_end"][row]], float)
        yield Recording(int(index[row]), hand, np.array([start[row], end[row]]), about=about)


def mit_log(path: Path, data: Arrays) -> Recordings:
    """Convert a whole log of the MIT data set."""
    streams = [
        Stream("tip_pose", ("hand_x", "hand_y"), data["tip_t"], data["tip_xy"]),
        Stream("object_pose", ("object_x", "object_y", "object_theta"), data["object_t"], data["object_pose"]),
        Stream("ft_wrench", ("force_x", "force_y"), data["ft_t"], -data["ft_wrench"][:, :2]),
    ]
    double = [each._replace(time=np.array(each.time, float), values=np.array(each.values, float)) for each in streams]
    return recordings(path, data, [align_streams(path, *double)])


KINDS: dict[str, Callable[[Path, Arrays], Recordings]] = {
    "three_point_push": one_finger,
    "two_finger_push": two_fingers,
    "mit_push": mit_groups,
    "mit_push_full": mit_log,
}


def convert(source: Path, target: Path) -> None:
    """Convert every archive of a folder."""
    for kind, function in KINDS.items():
        for file in sorted((source / kind).glob("*.npz")):
            with np.load(file) as archive:
                data = dict(archive)
            (target / kind).mkdir(parents=True, exist_ok=True)
            function(file, data).save(target / kind / file.name)


if __name__ == "__main__":
    convert(Path(sys.argv[1]), Path(sys.argv[2]))
