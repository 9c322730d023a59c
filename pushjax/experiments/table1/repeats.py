"""How well a push predicts its own repetition: no model without noise can do better."""

import numpy as np

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes, StraightPushes
from pushjax.geometry.se2 import compose, inverse


def noise_floor_mm(log: MitPushes) -> float | None:
    """Estimate the mean deviation of a push from the mean of its repetitions; None without repetitions."""
    rows = log.repeats[log.fast.valid[log.repeats[:, 0]] & log.whole.valid[log.repeats[:, 1]]]
    if not len(rows):
        return None
    # Two pushes of a pair differ by sqrt(2) times the deviation. They start a millimeter or less apart, and one was
    # twice as fast. Both are whole. The test pushes are shorter, so their floor is assumed to be lower in proportion to
    # how far the object moves.
    fast, slow = relative_motions(log.fast)[rows[:, 0]], relative_motions(log.whole)[rows[:, 1]]
    differences = np.asarray(pj.deviation(fast, slow, log.length), float)
    ratio = _mean_motion(log.middle, log.length) / _mean_motion(log.whole, log.length)
    return float(1e3 * differences.mean() / np.sqrt(2) * ratio)


def relative_motions(pushes: StraightPushes) -> np.ndarray:
    """Return the end poses in the frames of the starts, (n, 3), in which repetitions are the same push."""
    return np.asarray(compose(inverse(pushes.start), pushes.end), float)


def _mean_motion(pushes: StraightPushes, length: float) -> float:
    """Return the mean deviation of the end poses from the start poses, m."""
    return float(np.mean(np.asarray(pj.deviation(pushes.start, pushes.end, length), float)))
