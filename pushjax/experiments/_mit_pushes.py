"""The pushes of table 1: the groups of a condition, and how well a push predicts its own repetition.

A condition is one object on one surface, a `Recordings` in which each push has two samples, a start and an end.
`Recording.about` has these entries:

- "group": "whole" are complete pushes at 10 mm/s. "middle" are the test pushes of these, from 10 to 90 % of their
  duration. "fast" are complete pushes at 20 mm/s.
- "training": whether a push of "whole" is a training push.
- "valid": whether the tracker can be trusted.
- "action": equal for repetitions of a nominal push; "repetition": their number, if they are numbered.
- "toolbox_quartic" and "toolbox_ellipsoid": the end pose (3,) of a push of "middle" as predicted by the authors'
  toolbox, if known.
"""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pushjax as pj
from pushjax.datasets import LogError, Recording, Recordings, load_mit_folder, load_recordings
from pushjax.datasets.mit_folder import MIDDLE_PART, SAME_SPEED, states_at
from pushjax.datasets.mit_shapes import nearest_on_outline
from pushjax.datasets.planar import in_body, wrap_angle
from pushjax.datasets.recordings import Floats
from pushjax.experiments.tables import no_motion_mm, relative_motions, repetition_floor_mm, repetitions

ARCHIVES = "mit_push"
SLOW, FAST = 0.010, 0.020  # m/s
TRAIN_SHARE = 0.2  # part of the slow pushes to learn from, as in the paper
MIN_PUSHES = 10  # slow pushes, at least
# The rules for pushes whose tracker can be trusted:
# - At the start, the tip is less than MAX_GAP (m) from the outline, outside or inside.
# - At the end, it is less than MAX_OVERLAP (m) inside the outline.
# - The object moves farther than the tip by at most MAX_AHEAD (m).
# - The object turns by less than MAX_TURN (rad).
# - The path of the tip is longer than MIN_PATH times the median path.
MAX_GAP, MAX_OVERLAP, MAX_AHEAD, MAX_TURN, MIN_PATH = 0.008, 0.006, 0.005, np.deg2rad(75), 0.8
# Polygons with fewer vertices get this many, by splitting edges, so that one compiled program serves all polygons.
MIN_VERTICES = 6
# The butterfly has 636 vertices. These are at most 0.3 mm from them, and a spline takes three times as long to compile.
BUTTERFLY_VERTICES = 64


def load(folder: Path, surface: str, name: str, seed: int = 0) -> Recordings:
    """Load the grouped pushes of one object on one surface, from their `.npz` file or else from published files."""
    file = folder / ARCHIVES / f"{surface}_{name}.npz"
    if file.is_file():
        return load_recordings(file)
    log = load_mit_folder(folder, surface, name, speeds=(SLOW, FAST))
    if log.problems:
        what = f"{len(log.problems)} files of {name} on {surface} are left out"
        warnings.warn(f"{what}, the first: {log.problems[0]}", stacklevel=2)
    return grouped(log, seed)


def grouped(log: Recordings, seed: int) -> Recordings:
    """Return the three groups of pushes of a condition, each push cut to two samples; training is chosen at random."""
    slow, fast = (
        [push for push in log.pushes if abs(push.about["speed"] - speed) < SAME_SPEED] for speed in (SLOW, FAST)
    )
    if len(slow) < MIN_PUSHES:
        what = f"{log.object} on {log.surface} at {1e3 * SLOW:g} mm/s"
        raise LogError(log.source, f"expected at least {MIN_PUSHES} usable pushes of {what}, found {len(slow)}")
    count = int(np.clip(round(TRAIN_SHARE * len(slow)), 1, len(slow) - 1))
    chosen = np.random.default_rng(seed).permutation(len(slow))[:count]
    slow = [_with(push, training=k in chosen) for k, push in enumerate(slow)]
    tested = [push for push in slow if not push.about["training"]]
    fast = [_with(push, training=False) for push in fast]
    cuts = {"whole": (slow, (0.0, 1.0)), "middle": (tested, MIDDLE_PART), "fast": (fast, (0.0, 1.0))}
    pushes = (push for name, (each, fractions) in cuts.items() for push in _cut(log, each, fractions, name))
    return replace(log, pushes=tuple(pushes))


def _with(push: Recording, **about: object) -> Recording:
    """Return a push with more entries of `about`."""
    return replace(push, about={**push.about, **about})


def _cut(log: Recordings, pushes: list[Recording], fractions: tuple[float, float], name: str) -> list[Recording]:
    """Return pushes from the first to the second fraction of their duration, as the group `name`."""
    cut = [_between(push, fractions) for push in pushes]
    valid = _valid(replace(log, pushes=tuple(cut)))
    return [_with(push, group=name, valid=bool(each)) for push, each in zip(cut, valid, strict=True)]


def _between(push: Recording, fractions: tuple[float, float]) -> Recording:
    """Return the states of a push at two fractions of its duration."""
    _, pose, hand = states_at(push, fractions)
    pose[1, 2] = pose[0, 2] + wrap_angle(pose[1, 2] - pose[0, 2])
    return replace(push, hand=hand, pose=pose, force=None, time=None)


def _valid(pushes: Recordings) -> NDArray[np.bool_]:
    """Return a mask (k,) of pushes whose poses and tips at the ends can be trusted."""
    if not len(pushes):
        return np.zeros(0, bool)
    tip, radius = tips(pushes), pushes.tip_radius or 0.0
    before, after = (
        nearest_on_outline(np.asarray(pushes.vertices), in_body(pose, tip[:, end] - pose[:, :2]))[0] - radius
        for end, pose in enumerate((pushes.start, pushes.end))
    )
    moved = np.linalg.norm(pushes.end[:, :2] - pushes.start[:, :2], axis=1)
    path = np.linalg.norm(tip[:, 1] - tip[:, 0], axis=1)
    touching = (np.abs(before) < MAX_GAP) & (after > -MAX_OVERLAP)
    pushed = (moved - path <= MAX_AHEAD) & (np.abs(pushes.end[:, 2] - pushes.start[:, 2]) < MAX_TURN)
    return touching & pushed & (path > MIN_PATH * np.median(path))


def group(log: Recordings, name: str) -> Recordings:
    """Return the pushes of one group."""
    return replace(log, pushes=tuple(push for push in log.pushes if push.about["group"] == name))


def training_pushes(log: Recordings) -> Recordings:
    """Return the training pushes that can be trusted."""
    return replace(log, pushes=tuple(push for push in log.pushes if push.about["training"] and push.about["valid"]))


def tips(pushes: Recordings) -> Floats:
    """Return the centers of the tip at start and end, (pushes, 2, 2), m, world."""
    return np.array([push.hand[[0, -1]] for push in pushes.pushes]).reshape(-1, 2, 2)


def outline(log: Recordings) -> pj.Shape:
    """Return the object's outline: a fitted ellipse, or a polygon with a suitable number of vertices."""
    vertices, name = np.asarray(log.vertices), str(log.object)
    if name.startswith("ellip"):
        inverse_squares = np.linalg.lstsq(vertices**2, np.ones(len(vertices)), rcond=None)[0]
        return pj.Ellipse(*(1 / np.sqrt(inverse_squares)))
    if name == "butter":
        return pj.Polygon(vertices[np.arange(BUTTERFLY_VERTICES) * len(vertices) // BUTTERFLY_VERTICES])
    while len(vertices) < MIN_VERTICES:  # halve the longest edge
        after = np.roll(vertices, -1, axis=0)
        longest = int(np.argmax(np.linalg.norm(after - vertices, axis=1)))
        vertices = np.insert(vertices, longest + 1, (vertices[longest] + after[longest]) / 2, axis=0)
    return pj.Polygon(vertices)


def noise_floor_mm(log: Recordings) -> float | None:
    """Estimate the mean deviation of a push from the mean of its repetitions; None without repetitions."""
    whole, middle, fast = (group(log, name) for name in ("whole", "middle", "fast"))
    rows = _repeat_rows(fast, whole)
    if not len(rows):
        return None
    # The pushes of a pair start a millimeter or less apart, and one was twice as fast. Both are whole. The test pushes
    # are shorter, so their floor is assumed to be lower in proportion to how far the object moves.
    moved = [relative_motions(pushes)[each] for pushes, each in zip((fast, whole), rows.T, strict=True)]
    same = repetitions(np.tile(np.arange(len(rows)), 2))
    floor = repetition_floor_mm(np.concatenate(moved), same, log.length).mean()
    return float(floor * no_motion_mm(middle).mean() / no_motion_mm(whole).mean())


def _repeat_rows(fast: Recordings, whole: Recordings) -> NDArray[np.int64]:
    """Return the rows (r, 2) in `fast` and `whole` of valid repetitions of one push, with the nearest numbers."""

    def repetition(push: Recording) -> int:
        return push.about.get("repetition", 0)

    pairs = []
    for row, push in enumerate(fast.pushes):
        same = [at for at, other in enumerate(whole.pushes) if other.about["action"] == push.about["action"]]
        if same:
            nearest = min(same, key=lambda at: abs(repetition(whole.pushes[at]) - repetition(push)))
            if push.about["valid"] and whole.pushes[nearest].about["valid"]:
                pairs.append((row, nearest))
    return np.array(pairs, np.int64).reshape(-1, 2)
