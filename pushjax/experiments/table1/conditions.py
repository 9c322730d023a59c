"""The objects and surfaces, the paper's figures for them, and the pushes as arrays.

Delrin is in the paper, but not in these data.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes, StraightPushes, load_mit_pushes_npz

SURFACES = ("abs", "plywood")
OBJECTS = ("rect1", "rect2", "rect3", "tri1", "tri3", "ellip1", "ellip2", "ellip3", "hex", "butter", "tri2")
APART = ("tri2",)  # not in the paper, whose tracker lost it: in no mean
MODELS = {"quartic": 4, "ellipsoid": 2}
CONTROLS = 24  # of the butterfly's outline: 0.03 mm from its 636 vertices

# Mean deviation in mm, Zhou et al. 2017, table 1; and the mean over conditions of deviation over no-motion, percent,
# delrin included.
PAPER_MM = {
    ("abs", "quartic"): (5.86, 7.48, 3.59, 7.13, 5.17, 8.45, 9.18, 5.93, 7.56, 3.94),
    ("abs", "ellipsoid"): (6.07, 6.74, 6.19, 8.00, 7.17, 6.66, 7.69, 5.78, 8.19, 5.39),
    ("plywood", "quartic"): (6.86, 6.86, 5.93, 4.61, 7.21, 4.39, 4.99, 5.72, 8.41, 4.72),
    ("plywood", "ellipsoid"): (6.20, 7.22, 6.88, 5.96, 9.43, 4.42, 5.84, 6.46, 8.85, 6.05),
}
PAPER_NO_MOTION_MM = {
    "abs": (34.14, 39.74, 33.98, 35.43, 32.37, 32.68, 33.53, 32.45, 33.23, 33.53),
    "plywood": (31.86, 33.22, 32.94, 32.81, 33.78, 27.24, 28.23, 33.29, 32.77, 34.10),
}
PAPER_PERCENT = {"quartic": 20.05, "ellipsoid": 21.39}


def load(folder: Path, surface: str, name: str) -> MitPushes:
    return load_mit_pushes_npz(folder / f"{surface}_{name}.npz")


def paper_mm(surface: str, name: str, model: str) -> float | None:
    return None if name in APART else PAPER_MM[surface, model][OBJECTS.index(name)]


def outline(log: MitPushes) -> pj.Shape:
    """The ellipses and the butterfly are given by many vertices."""
    if log.shape.startswith("ellip"):
        inverse_squares = np.linalg.lstsq(log.vertices**2, np.ones(len(log.vertices)), rcond=None)[0]
        return pj.Ellipse(*(1 / np.sqrt(inverse_squares)))
    if log.shape == "butter":
        return pj.Curve.fit(log.vertices, CONTROLS)
    return pj.Polygon(log.vertices)


def straight(pushes: StraightPushes, rows: np.ndarray, steps: int, batch: int) -> pj.Pushes:
    """Those of some rows, filled up to a `batch` with pushes of no weight, so that one compiled program does for all
    objects of a kind."""
    start, end, begin, stop = (part[rows] for part in (pushes.start, pushes.end, pushes.tip_start, pushes.tip_end))
    share = np.linspace(0, 1, steps + 1)[None, :, None]
    path = begin[:, None] + share * (stop - begin)[:, None]
    rest = batch - len(start)
    dtype = jnp.result_type(float)
    filled = (np.concatenate([part, np.repeat(part[:1], rest, axis=0)]) for part in (start, path, end))
    start, path, end = (jnp.asarray(part, dtype) for part in filled)
    return pj.Pushes(start, path, end, (np.arange(batch) < batch - rest).astype(float))
