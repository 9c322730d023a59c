"""The objects and surfaces of table 1, the paper's figures for them, and the pushes as arrays."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import Recordings, load_mit_folder, load_recordings
from pushjax.datasets.mit_folder import in_body
from pushjax.datasets.mit_shapes import nearest_on_outline
from pushjax.datasets.recordings import Floats
from pushjax.experiments.table1.groups import FAST, SLOW, grouped, tips

ARCHIVES = "mit_push"
SURFACES = ("abs", "plywood")
OBJECTS = ("rect1", "rect2", "rect3", "tri1", "tri3", "ellip1", "ellip2", "ellip3", "hex", "butter", "tri2")
ALL_SURFACES = ("delrin", *SURFACES)
NOT_IN_PAPER = ("tri2",)  # not in the paper, because the tracker lost it; excluded from every mean
# Polygons with fewer vertices get this many, by splitting edges, so that one compiled program serves all polygons.
MIN_VERTICES = 6
BUTTERFLY_VERTICES = (
    64  # vertices, at most 0.3 mm from its 636 original ones; a spline takes three times as long to compile
)
SIDES = 6  # at most; an outline with more vertices is divided into quadrants

# Zhou et al. 2017, table 1: mean deviation in mm; mean deviation in mm if nothing moved; and the mean over conditions
# of the ratio of the two in percent, delrin included.
PAPER_MM = {
    ("delrin", "quartic"): (8.28, 5.37, 6.10, 9.71, 7.54, 7.68, 8.90, 7.35, 6.38, 4.83),
    ("delrin", "ellipsoid"): (8.60, 5.92, 8.20, 9.90, 8.18, 6.85, 6.29, 8.08, 6.42, 5.97),
    ("abs", "quartic"): (5.86, 7.48, 3.59, 7.13, 5.17, 8.45, 9.18, 5.93, 7.56, 3.94),
    ("abs", "ellipsoid"): (6.07, 6.74, 6.19, 8.00, 7.17, 6.66, 7.69, 5.78, 8.19, 5.39),
    ("plywood", "quartic"): (6.86, 6.86, 5.93, 4.61, 7.21, 4.39, 4.99, 5.72, 8.41, 4.72),
    ("plywood", "ellipsoid"): (6.20, 7.22, 6.88, 5.96, 9.43, 4.42, 5.84, 6.46, 8.85, 6.05),
}
PAPER_NO_MOTION_MM = {
    "delrin": (35.48, 40.53, 35.98, 36.91, 34.66, 32.18, 38.05, 33.37, 33.55, 34.09),
    "abs": (34.14, 39.74, 33.98, 35.43, 32.37, 32.68, 33.53, 32.45, 33.23, 33.53),
    "plywood": (31.86, 33.22, 32.94, 32.81, 33.78, 27.24, 28.23, 33.29, 32.77, 34.10),
}
PAPER_PERCENT = {"quartic": 20.05, "ellipsoid": 21.39}


def checked_surfaces(surface: Sequence[str] | None, object: Sequence[str]) -> tuple[str, ...]:
    """Check the names of surfaces and objects, and return the surfaces, by default SURFACES."""
    surface = SURFACES if surface is None else surface
    for name, given, allowed in (("surface", surface, ALL_SURFACES), ("object", object, OBJECTS)):
        unknown = [one for one in given if one not in allowed]
        if unknown or not given:
            raise ValueError(f"{name} must be one or more of {', '.join(allowed)}; got {unknown or 'none'}")
    return tuple(surface)


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


def paper_mm(surface: str, name: str, model: str) -> float | None:
    """Return the paper's mean deviation in mm, or None for an object that is not in the paper."""
    return None if name in NOT_IN_PAPER else PAPER_MM[surface, model][OBJECTS.index(name)]


def outline(log: Recordings) -> pj.Shape:
    """Return the object's outline: a fitted ellipse, or a polygon with a suitable number of vertices."""
    vertices, name = np.asarray(log.vertices), str(log.object)
    if name.startswith("ellip"):
        inverse_squares = np.linalg.lstsq(vertices**2, np.ones(len(vertices)), rcond=None)[0]
        return pj.Ellipse(*(1 / np.sqrt(inverse_squares)))
    if name == "butter":
        return pj.Polygon(vertices[np.arange(BUTTERFLY_VERTICES) * len(vertices) // BUTTERFLY_VERTICES])
    return pj.Polygon(_with_split_edges(vertices))


def _with_split_edges(vertices: Floats) -> Floats:
    """Halve the longest edges until there are at least `MIN_VERTICES` vertices."""
    while len(vertices) < MIN_VERTICES:
        after = np.roll(vertices, -1, axis=0)
        longest = int(np.argmax(np.linalg.norm(after - vertices, axis=1)))
        vertices = np.insert(vertices, longest + 1, (vertices[longest] + after[longest]) / 2, axis=0)
    return vertices


def pushed_sides(pushes: Recordings) -> np.ndarray:
    """Return the edge (or quadrant) nearest to the tip at the start of each push, (pushes,)."""
    tip = in_body(pushes.start, tips(pushes)[:, 0] - pushes.start[:, :2])
    vertices = np.asarray(pushes.vertices)
    if len(vertices) > SIDES:  # the quadrant of the body frame that the tip is in
        return (np.arctan2(tip[:, 1], tip[:, 0]) // (np.pi / 2)).astype(int) % 4
    edges = [
        np.stack([vertex, next_vertex])
        for vertex, next_vertex in zip(vertices, np.roll(vertices, -1, axis=0), strict=True)
    ]
    return np.argmin([np.abs(nearest_on_outline(edge, tip)[0]) for edge in edges], axis=0)


def padded_pushes(pushes: Recordings, last: int, steps: int, batch: int) -> pj.Pushes:
    """Convert straight pushes to `Pushes` that are padded to the number `batch`; `last` is the index of the latest."""
    age = np.array([push.index for push in pushes.pushes]) / max(last, 1)  # how late a push comes in the file
    parts = pushes.start, straight_paths(pushes, steps), pushes.end, age, pushed_sides(pushes)
    # The padding has no weight. With it, one compiled program serves all objects of a kind.
    padding = batch - len(pushes)
    if padding < 0:
        raise ValueError(f"batch must be at least {len(pushes)}; got {batch}")
    dtype = jnp.result_type(float)
    start, path, end, age, side = (
        jnp.asarray(np.concatenate([part, np.repeat(part[:1], padding, axis=0)]), dtype) for part in parts
    )
    return pj.Pushes(start, path, end, (np.arange(batch) < len(pushes)).astype(float), age=age, side=side)


def straight_paths(pushes: Recordings, steps: int) -> Floats:
    """Return the straight paths of the tip, (pushes, steps + 1, 2), m, world."""
    begin, stop = tips(pushes).swapaxes(0, 1)
    return begin[:, None] + np.linspace(0, 1, steps + 1)[None, :, None] * (stop - begin)[:, None]
