"""What data alone can do: the object's displacement as a Gaussian process of where and in which direction it is pushed.

The displacement is told along the push and across, where it is smoothest; tip and direction in the object's frame.

The regression is scikit-learn's: `pip install '.[peers]'`.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from pushjax.datasets.mit_pushes import StraightPushes
from pushjax.datasets.pushes import Floats, rotation
from pushjax.experiments._predicted import turned

RESTARTS = 1  # of the search for the kernel's numbers


class Learned(NamedTuple):
    """Of the displacement along the push and across it, and of length * theta, m, a regression each."""

    each: list[Any]
    length: float


class Normals(NamedTuple):
    """mean, deviation: (pushes, 3), along the push, across, length * theta, m. start: (pushes, 3), world. heading:
    (pushes,), of the push, rad, world."""

    mean: Floats
    deviation: Floats
    start: Floats
    heading: Floats
    length: float

    def poses(self) -> Floats:
        return self._placed(self.mean)

    def draws(self, rng: np.random.Generator, n: int) -> Floats:
        """(pushes, n, 3)."""
        drawn = rng.normal(self.mean[:, None], self.deviation[:, None], (len(self.mean), n, 3))
        return np.stack([self._placed(drawn[:, k]) for k in range(n)], axis=1)

    def log_density(self, end: Floats) -> Floats:
        moved = _displacement(self.start, end, self.heading, self.length)
        return norm.logpdf(moved, self.mean, self.deviation).sum(axis=1)

    def _placed(self, displacement: Floats) -> Floats:
        return self.start + turned(displacement / [1, 1, self.length], self.heading)


def learn(pushes: StraightPushes, rows: np.ndarray, length: float) -> Learned:
    """From some of the pushes. Raises ValueError without scikit-learn."""
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    except ImportError as error:
        message = "the Gaussian process needs the package scikit-learn, found none: pip install '.[peers]'"
        raise ValueError(message) from error
    known = features(pushes, rows, length)
    moved = _displacement(pushes.start[rows], pushes.end[rows], _heading(pushes, rows), length)
    each = []
    for column in moved.T:
        wide: Any = RBF  # its types want a number
        alike = ConstantKernel(1.0, (1e-2, 1e3)) * wide(np.ones(known.shape[1]), (1e-2, 1e2))
        kernel = alike + WhiteKernel(0.1, (1e-4, 1e1))
        process = GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=RESTARTS, random_state=0)
        with warnings.catch_warnings():
            # of few pushes, some number of the kernel ends at its bound
            warnings.simplefilter("ignore", ConvergenceWarning)
            each.append(process.fit(known, column))
    return Learned(each, length)


def predict(learned: Learned, pushes: StraightPushes, rows: np.ndarray) -> Normals:
    found = [process.predict(features(pushes, rows, learned.length), return_std=True) for process in learned.each]
    mean, deviation = (np.stack([each[k] for each in found], axis=1) for k in range(2))
    return Normals(mean, deviation, pushes.start[rows], _heading(pushes, rows), learned.length)


def features(pushes: StraightPushes, rows: np.ndarray, length: float) -> Floats:
    """(rows, 5): where the tip starts, over the length, its direction, both in the object's frame, and on which side of
    the object's origin the push goes past, over the length."""
    start = pushes.start[rows]
    back = rotation(-start[:, 2])
    where = np.einsum("nij,nj->ni", back, pushes.tip_start[rows] - start[:, :2]) / length
    way = np.einsum("nij,nj->ni", back, pushes.tip_end[rows] - pushes.tip_start[rows])
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    lever = where[:, 0] * way[:, 1] - where[:, 1] * way[:, 0]
    return np.column_stack([where, way, lever])


def _heading(pushes: StraightPushes, rows: np.ndarray) -> Floats:
    way = pushes.tip_end[rows] - pushes.tip_start[rows]
    return np.arctan2(way[:, 1], way[:, 0])


def _displacement(start: Floats, end: Floats, heading: Floats, length: float) -> Floats:
    return turned(end - start, -heading) * [1, 1, length]
