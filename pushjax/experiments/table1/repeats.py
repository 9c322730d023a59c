"""How well a push predicts its own repetition: what no model without noise can be better than."""

import numpy as np

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes, StraightPushes
from pushjax.se2 import compose, inverse


def noise_floor_mm(log: MitPushes) -> float | None:
    """Mean deviation of a push from the mean of all its repetitions, as told by pairs of them: two pushes differ by
    sqrt(2) of that. None without repetitions.

    The two of a pair start a millimetre or less apart, and one was twice as fast. Both are whole; of the pushes that
    are tested, which are shorter, the floor is taken to be lower in proportion to how far the object moves.
    """
    rows = log.repeats[log.fast.valid[log.repeats[:, 0]] & log.whole.valid[log.repeats[:, 1]]]
    if not len(rows):
        return None
    one, other = _motion(log.fast)[rows[:, 0]], _motion(log.whole)[rows[:, 1]]
    apart = np.asarray(pj.deviation(one, other, log.length), float)
    share = _moved(log.middle, log.length) / _moved(log.whole, log.length)
    return float(1e3 * apart.mean() / np.sqrt(2) * share)


def _motion(pushes: StraightPushes) -> np.ndarray:
    """(n, 3): the end poses in the frames of the starts, where repetitions are the same push."""
    return np.asarray(compose(inverse(pushes.start), pushes.end), float)


def _moved(pushes: StraightPushes, length: float) -> float:
    return float(np.mean(np.asarray(pj.deviation(pushes.start, pushes.end, length), float)))
