"""The eight conditions of table 2, the paper's figures for them, and where the robot's finger really was."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import pushjax as pj
from pushjax.datasets import Recording, Recordings, load_recordings, load_triangle_log
from pushjax.experiments._tables import MODELS, polygon, support

SURFACES, OBJECTS = ("hardboard", "plywood"), ("3pts1", "3pts2", "3pts3", "3pts4")
CONDITIONS = [(surface, name) for surface in SURFACES for name in OBJECTS]
PAIRS, SPLITS = 400, 10
COEFFICIENTS = {"quartic": 15, "ellipsoid": 6}  # a surface is fitted to at least as many pairs

# Zhou et al. 2017, table 2: mean deviation in mm; mean deviation in mm if nothing moved; and the mean over conditions
# of the ratio of the two in percent. The numbers of a tuple are in the order of OBJECTS.
PAPER_MM = {
    ("hardboard", "quartic"): (3.52, 2.75, 2.92, 2.80),
    ("hardboard", "ellipsoid"): (3.82, 3.63, 3.35, 3.96),
    ("plywood", "quartic"): (3.78, 2.80, 2.84, 3.26),
    ("plywood", "ellipsoid"): (4.24, 3.56, 3.28, 4.12),
}
PAPER_NO_MOTION_MM = {"hardboard": (16.63, 13.86, 14.83, 15.15), "plywood": (16.56, 13.81, 15.27, 14.20)}
PAPER_PERCENT = {"quartic": 20.48, "ellipsoid": 24.97}


# The robot was commanded to go 15 mm beyond an approach gap of 2.5 mm; in m. The log misses about the last millimeter
# of this motion (the finger is still moving at the last logged sample), but the measured end pose includes it.
COMMANDED_TRAVEL = 0.0175


class Geometry(NamedTuple):
    """Radius and path of the robot's finger, and size of the outline, as they really were."""

    radius: float  # m
    inset: float  # distance by which the outline is smaller than nominal, m
    commanded_end: bool  # whether the path continues past the last logged sample to the commanded end


# nominal: the paper's setup. measured: according to the force sensor, contact began with the center of the finger 0.7
# mm inside the nominal outline, so the finger is a point and the outline is 0.7 mm smaller; and the log misses the last
# millimeter of the motion.
GEOMETRIES = {"nominal": Geometry(0.001, 0.0, False), "measured": Geometry(0.0, 0.0007, True)}


def load_all(folder: Path) -> dict[tuple[str, str], Recordings]:
    """Load the pushes of every condition that the folder has, by surface and object."""
    logs = {condition: load(folder, *condition) for condition in CONDITIONS}
    known = {condition: log for condition, log in logs.items() if log is not None}
    if not known:
        first = "_".join(CONDITIONS[0])
        raise ValueError(
            f"folder: expected {first}.npz, or published logs named {first}….txt, or another condition, in {folder}; "
            "found none"
        )
    return known


def load(folder: Path, surface: str, name: str) -> Recordings | None:
    """Load the pushes of a condition from its `.npz` file or else from the first original log, if there is one."""
    file = folder / f"{surface}_{name}.npz"
    originals = sorted(folder.glob(f"{surface}_{name}*.txt*"))
    if file.exists():
        return load_recordings(file)
    return load_triangle_log(originals[0], surface=surface, arrangement=name) if originals else None


def reason_missing(train: np.ndarray | None, method: str, model: str) -> str | None:
    """Say why a cell cannot be computed from training masks (splits, pushes); None if it can."""
    if train is None:
        return "no log"
    if train.shape[1] < 2:  # one to learn from, one to predict
        return "1 push, needs 2"
    pairs, needed = int(train[0].sum()), COEFFICIENTS[model]
    return f"{pairs} pairs, needs {needed}" if method == "wrench_twist" and pairs < needed else None


def ideal_surface(log: Recordings, model: str, key: jax.Array) -> pj.LimitSurface:
    """Fit a limit surface to pairs of the known support points, under the loads that statics gives them.

    Args:
        log: The pushes of a condition, with the support points and their loads.
        model: "quartic" or "ellipsoid".
        key: PRNG key of the wrench-twist pairs.
    """
    return pj.fit_limit_surface(*support(log).wrench_twist_pairs(key, PAIRS), degree=MODELS[model])


def outline(log: Recordings, geometry: Geometry) -> pj.Polygon:
    """Return the outline of the triangle, smaller by the inset of the geometry."""
    return polygon(log).inset(geometry.inset) if geometry.inset else polygon(log)


def recorded(log: Recordings, geometry: Geometry, steps: int) -> pj.Pushes:
    """Convert a log to `Pushes`, with paths that end where the geometry says."""
    if geometry.commanded_end:
        log = replace(log, pushes=tuple(_with_commanded_end(push) for push in log.pushes))
    return pj.Pushes.of(log, steps)


def _with_commanded_end(push: Recording) -> Recording:
    """Return the push with a path that ends where the robot was told to stop, which is inferred."""
    travel = push.hand[-1] - push.hand[0]
    end = push.hand[0] + COMMANDED_TRAVEL * travel / np.linalg.norm(travel)
    pose = np.vstack([push.pose, push.pose[-1:]])
    pose[-2] = np.nan
    return replace(push, hand=np.vstack([push.hand, end]), pose=pose, force=None, time=None)


def training(log: Recordings, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return masks (splits, pushes) of the training pushes of random splits."""
    # with a share between one and three quarters, two or more pushes are never all on one side
    chosen = np.zeros((SPLITS, len(log.pushes)), bool)
    for row in chosen:
        row[rng.permutation(len(row))[: round(share * len(row))]] = True
    return chosen
