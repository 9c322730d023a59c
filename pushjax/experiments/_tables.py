"""What the tables of predicted against measured pushes share."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import Recordings
from pushjax.experiments._report import Table
from pushjax.geometry.se2 import compose, inverse

MODELS = {"quartic": 4, "ellipsoid": 2}  # limit surfaces and their degrees
SUPPORT_POINTS = 150  # that stand for uniform pressure
BOOTSTRAP_SAMPLES = 2000
Cell = dict[str, Any]  # labels and figures of one condition, model and method


class Prediction(NamedTuple):
    """Predictions of the pushes of one condition, for each of several splits or for none."""

    errors: np.ndarray  # (..., pushes), deviations of the final poses, mm
    friction: np.ndarray  # (...,), coefficient of friction that was learned
    failed: int  # number of failed steps
    found: pj.Identified | None = None  # None if the method identifies nothing else


def polygon(log: Recordings) -> pj.Polygon:
    """Return the outline of the object."""
    assert log.vertices is not None  # known for the objects of all tables
    return pj.Polygon(log.vertices)


def support(log: Recordings) -> pj.Support:
    """Return the support of the object, with unit load: its points, or uniform pressure if it has none."""
    points, force = log.support_points, log.support_force
    if points is None or force is None or len(points) == 0:
        return pj.Support.uniform(polygon(log), SUPPORT_POINTS)
    return pj.Support.points(points, force / np.sum(force))


@jax.jit
def final_poses(slider: pj.Slider, hand: pj.Hand, pushes: pj.Pushes, frictions: jax.Array):
    """Simulate pushes at every friction: poses (frictions, pushes, 3), failed steps and whether the hand stopped."""

    def final_pose(path, start, friction):
        push = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return push.pose[-1], jnp.sum(push.failed), push.stopped >= 0

    over_pushes = jax.vmap(final_pose, in_axes=(0, 0, None))
    return jax.vmap(over_pushes, in_axes=(None, None, 0))(pushes.path, pushes.start, frictions)


def deviation_mm(final, end, length: float | None) -> np.ndarray:
    """Return the deviations (...,), mm, of final poses (..., 3) from the measured ones."""
    assert length is not None  # known for the objects of all tables
    return 1e3 * np.asarray(pj.deviation(final, end, length), np.float64)


def relative_motions(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the end poses (n, 3) in the frames of the starts, in which repetitions are the same push."""
    return np.asarray(compose(inverse(start), end), float)


def bootstrapped_ci95(values: np.ndarray, rng: np.random.Generator, group: np.ndarray | None = None) -> float:
    """Return half the bootstrapped 95 % interval of the mean of values (n,), sampled one by one or by group."""
    place = np.arange(len(values)) if group is None else np.unique(group, return_inverse=True)[1]
    total, count = np.bincount(place, values), np.bincount(place)
    resampled = rng.integers(len(total), size=(BOOTSTRAP_SAMPLES, len(total)))
    means = total[resampled].sum(axis=1) / count[resampled].sum(axis=1)
    return float(np.diff(np.quantile(means, [0.025, 0.975]))[0] / 2)


def mean_figures(cells: Sequence[Cell], paper_percent: float) -> dict[str, float]:
    """Return the means over cells of one method and model, and of the paper's figures for them."""
    return {
        "mean_mm": float(np.mean([cell["mean_mm"] for cell in cells])),
        "paper_mm": float(np.mean([cell["paper_mm"] for cell in cells])),
        "percent": float(100 * np.mean([cell["mean_mm"] / cell["no_motion_mm"] for cell in cells])),
        "paper_percent": paper_percent,
    }


def by_object(cells: Sequence[Cell], title: str, *lines: tuple[str, str, Callable[[Cell], str]]) -> Table:
    """Return a table with a column for each object; a line, for each surface, is a name, a model and a cell's text."""
    surfaces, objects = (list(dict.fromkeys(cell[key] for cell in cells)) for key in ("surface", "object"))
    found = {(cell["surface"], cell["object"], cell["model"]): cell for cell in cells}
    rows = [
        [surface, name, *(text(found[surface, each, model]) for each in objects)]
        for surface in surfaces
        for name, model, text in lines
    ]
    return Table([title, "", *objects], rows)


def failures(cells: Sequence[Cell]) -> list[str]:
    """Return a note on the steps that failed, if there are any."""
    failed = sum(cell.get("failed_steps", 0) for cell in cells)
    return [f"{failed} steps failed; there the object was left where it was (see the JSON)."] if failed else []
