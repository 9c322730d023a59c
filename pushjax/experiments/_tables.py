"""What the tables of predicted against measured pushes share."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import Recordings
from pushjax.geometry.se2 import compose, inverse

MODELS = {"quartic": 4, "ellipsoid": 2}  # limit surfaces and their degrees
SUPPORT_POINTS = 150  # that stand for uniform pressure
BOOTSTRAP_SAMPLES = 2000


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


def bootstrapped_ci95(values: np.ndarray, rng: np.random.Generator) -> float:
    """Return half the width of the bootstrapped 95 % confidence interval of the mean of values (n,)."""
    resampled = rng.choice(values, (BOOTSTRAP_SAMPLES, len(values))).mean(axis=1)
    return float(np.diff(np.quantile(resampled, [0.025, 0.975]))[0] / 2)
