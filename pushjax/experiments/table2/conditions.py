"""The eight conditions, the paper's figures for them, and where the robot's finger really was."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import pushjax as pj
from pushjax.datasets import Push, PushLog, load_push_npz, load_triangle_log

SURFACES, OBJECTS = ("hardboard", "plywood"), ("3pts1", "3pts2", "3pts3", "3pts4")
CONDITIONS = [(surface, name) for surface in SURFACES for name in OBJECTS]
MODELS = {"quartic": 4, "ellipsoid": 2}
PAIRS, SPLITS = 400, 10

# Mean deviation in mm, Zhou et al. 2017, table 2; and the mean over conditions of deviation over no-motion, percent.
PAPER_MM = {
    ("hardboard", "quartic"): (3.52, 2.75, 2.92, 2.80),
    ("hardboard", "ellipsoid"): (3.82, 3.63, 3.35, 3.96),
    ("plywood", "quartic"): (3.78, 2.80, 2.84, 3.26),
    ("plywood", "ellipsoid"): (4.24, 3.56, 3.28, 4.12),
}
PAPER_NO_MOTION_MM = {"hardboard": (16.63, 13.86, 14.83, 15.15), "plywood": (16.56, 13.81, 15.27, 14.20)}
PAPER_PERCENT = {"quartic": 20.48, "ellipsoid": 24.97}


class Geometry(NamedTuple):
    """Where the robot's finger really was: its radius, by how much the outline is smaller than nominal (m), and
    whether the path goes on to where the robot was told to stop, past the last logged sample."""

    radius: float
    inset: float
    commanded_end: bool


# nominal: the paper's set-up. measured: contact began, by the force sensor, with the finger's centre 0.7 mm inside the
# nominal outline, and the log misses the last millimetre of the motion.
GEOMETRIES = {"nominal": Geometry(0.001, 0.0, False), "measured": Geometry(0.0, 0.0007, True)}


def load(folder: Path, surface: str, name: str) -> PushLog:
    """A condition's pushes: its tidy archive, or else an original log whose name begins with the condition."""
    archive = folder / f"{surface}_{name}.npz"
    originals = sorted(folder.glob(f"{surface}_{name}*.txt*"))
    if archive.exists():
        return load_push_npz(archive)
    if not originals:
        raise ValueError(
            f"--data: expected {surface}_{name}.npz, or published logs named {surface}_{name}….txt, in {folder}; "
            "found neither"
        )
    return load_triangle_log(originals[0], surface=surface, arrangement=name)


def ideal_surface(log: PushLog, model: str, key: jax.Array) -> pj.LimitSurface:
    """Fitted to pairs of the known support points under the loads that statics gives them."""
    support = pj.Support.points(log.support_points, log.support_force / np.sum(log.support_force))
    return pj.fit_limit_surface(*support.wrench_twist_pairs(key, PAIRS), degree=MODELS[model])


def outline(log: PushLog, geometry: Geometry) -> pj.Polygon:
    polygon = pj.Polygon(log.vertices)
    return polygon.inset(geometry.inset) if geometry.inset else polygon


def recorded(log: PushLog, geometry: Geometry, steps: int) -> pj.Pushes:
    if geometry.commanded_end:
        log = replace(log, pushes=tuple(_ended(log, push) for push in log.pushes))
    return pj.Pushes.of(log, steps)


def _ended(log: PushLog, push: Push) -> Push:
    tip = np.vstack([push.tip, log.commanded_tip_end(push)])
    return replace(push, tip=tip, tip_time=np.append(push.tip_time, push.tip_time[-1]))


def training(log: PushLog, share: float, rng: np.random.Generator) -> np.ndarray:
    """(splits, pushes): True for the random part that each split learns from."""
    chosen = np.zeros((SPLITS, len(log.pushes)), bool)
    for row in chosen:
        row[rng.permutation(len(row))[: round(share * len(row))]] = True
    return chosen
