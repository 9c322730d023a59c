"""A prediction from data alone: the object's displacement as a Gaussian process of the push's start and direction.

The displacement is expressed along and across the push, because it is smoothest so. The position of the tip and the
direction of the push are in the object's frame.

The regression is that of scikit-learn: `pip install '.[peers]'`.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from benchmarks.robot.predicted import turned
from pushjax.datasets.mit_pushes import StraightPushes
from pushjax.datasets.push_log import Floats, rotation

RESTARTS = 1  # restarts of the optimizer for the kernel's hyperparameters


class Learned(NamedTuple):
    """The fitted Gaussian processes.

    Attributes:
        each: One regression for each of: displacement along the push, displacement across it, and length * theta, m.
        length: Characteristic length, m.
    """

    each: list[Any]
    length: float


class Normals(NamedTuple):
    """Predicted normal distributions of the displacement.

    Attributes:
        mean: Means along the push, across it, and of length * theta, (pushes, 3), m.
        deviation: Standard deviations of the same, (pushes, 3), m.
        start: Start poses, (pushes, 3), world frame, m and rad.
        heading: Directions of the pushes, (pushes,), world frame, rad.
        length: Characteristic length, m.
    """

    mean: Floats
    deviation: Floats
    start: Floats
    heading: Floats
    length: float

    def poses(self) -> Floats:
        """Return the mean final poses, (pushes, 3), world frame, m and rad."""
        return self._placed(self.mean)

    def draws(self, rng: np.random.Generator, n: int) -> Floats:
        """Draw `n` final poses of each push, (pushes, n, 3), world frame, m and rad."""
        drawn = rng.normal(self.mean[:, None], self.deviation[:, None], (len(self.mean), n, 3))
        return np.stack([self._placed(drawn[:, k]) for k in range(n)], axis=1)

    def log_density(self, end: Floats) -> Floats:
        """Return the log density of these final poses, (pushes, 3), per cubic meter of x, y, length * theta."""
        moved = _displacement(self.start, end, self.heading, self.length)
        return norm.logpdf(moved, self.mean, self.deviation).sum(axis=1)

    def _placed(self, displacement: Floats) -> Floats:
        return self.start + turned(displacement / [1, 1, self.length], self.heading)


def learn(pushes: StraightPushes, rows: np.ndarray, length: float) -> Learned:
    """Fit the Gaussian processes to some of the pushes.

    Args:
        pushes: All pushes.
        rows: Indices of the training pushes.
        length: Characteristic length, m.

    Returns:
        The fitted Gaussian processes.

    Raises:
        ValueError: If scikit-learn is not installed.
    """
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
        wide: Any = RBF  # its type annotations want a number
        alike = ConstantKernel(1.0, (1e-2, 1e3)) * wide(np.ones(known.shape[1]), (1e-2, 1e2))
        kernel = alike + WhiteKernel(0.1, (1e-4, 1e1))
        process = GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=RESTARTS, random_state=0)
        with warnings.catch_warnings():
            # with few pushes, some hyperparameter of the kernel ends at its bound
            warnings.simplefilter("ignore", ConvergenceWarning)
            each.append(process.fit(known, column))
    return Learned(each, length)


def predict(learned: Learned, pushes: StraightPushes, rows: np.ndarray) -> Normals:
    """Predict the pushes with the indices `rows`."""
    found = [process.predict(features(pushes, rows, learned.length), return_std=True) for process in learned.each]
    mean, deviation = (np.stack([each[k] for each in found], axis=1) for k in range(2))
    return Normals(mean, deviation, pushes.start[rows], _heading(pushes, rows), learned.length)


def features(pushes: StraightPushes, rows: np.ndarray, length: float) -> Floats:
    """Return the inputs of the regression.

    Args:
        pushes: All pushes.
        rows: Indices of the pushes in use.
        length: Characteristic length, m.

    Returns:
        Inputs, (rows, 5): the tip's start position divided by the length (2) and the direction of the push (2), both in
        the object's frame, and the signed distance between the object's origin and the line of the push, divided by the
        length.
    """
    start = pushes.start[rows]
    back = rotation(-start[:, 2])
    where = np.einsum("nij,nj->ni", back, pushes.tip_start[rows] - start[:, :2]) / length
    way = np.einsum("nij,nj->ni", back, pushes.tip_end[rows] - pushes.tip_start[rows])
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    lever = where[:, 0] * way[:, 1] - where[:, 1] * way[:, 0]
    return np.column_stack([where, way, lever])


def _heading(pushes: StraightPushes, rows: np.ndarray) -> Floats:
    """Return the directions of the pushes, world frame, rad."""
    way = pushes.tip_end[rows] - pushes.tip_start[rows]
    return np.arctan2(way[:, 1], way[:, 0])


def _displacement(start: Floats, end: Floats, heading: Floats, length: float) -> Floats:
    return turned(end - start, -heading) * [1, 1, length]
