"""How good predicted distributions of many pushes are, as draws; and normal ones, of a prediction's errors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj

LEVELS = (0.5, 0.9)
FINE = tuple(np.linspace(0.005, 0.995, 199).tolist())
TOGETHER = 16  # pushes


class Scored(NamedTuple):
    """Of each push. energy: m. density: its logarithm. level: of the smallest region of highest density that holds what
    happened, to half a hundredth. inside: (pushes, 2), whether the regions of `LEVELS` do."""

    energy: np.ndarray
    density: np.ndarray
    level: np.ndarray
    inside: np.ndarray

    def calibrated(self, seen: np.ndarray) -> "Scored":
        """With regions of other levels: those that held a share `LEVELS` of what happened in other pushes, whose levels
        these are (split conformal prediction). Of n of them the k-th smallest holds k / (n + 1) in the mean, so that is
        where the shares are looked up: other quantiles hold too much, the more the fewer there are."""
        return self._replace(inside=self.level[:, None] <= np.quantile(seen, LEVELS, method="weibull")[None])


def scored(draws: np.ndarray, ends: np.ndarray, length: float) -> Scored:
    """draws: (pushes, n, 3); ends: (pushes, 3), what happened."""
    dtype = jnp.result_type(float)
    each = _scores(jnp.asarray(draws, dtype), jnp.asarray(ends, dtype), jnp.asarray(length, dtype))
    return Scored(*(np.asarray(part, float) for part in each))


@jax.jit
def _scores(draws, ends, length):
    def one(drawn, end):
        inside = pj.coverage(drawn, end[None], length, (*LEVELS, *FINE))
        level = 1 - jnp.sum(inside[len(LEVELS) :]) / (len(FINE) + 1)
        return pj.energy_score(drawn, end, length), pj.log_density(drawn, end, length), level, inside[: len(LEVELS)]

    return jax.lax.map(lambda args: one(*args), (draws, ends), batch_size=TOGETHER)


def errors(predicted: np.ndarray, end: np.ndarray, start: np.ndarray) -> np.ndarray:
    """(..., 3): measured less predicted, in the slider's directions at the start."""
    return turned(end - predicted, -start[..., 2])


def normal_draws(
    rng: np.random.Generator, predicted: np.ndarray, start: np.ndarray, off: np.ndarray, n: int
) -> np.ndarray:
    """(..., n, 3): about predicted poses (..., 3), with the mean and the covariance of the `errors` (many, 3)."""
    drawn = rng.multivariate_normal(off.mean(axis=0), np.cov(off.T), (*predicted.shape[:-1], n))
    return predicted[..., None, :] + turned(drawn, start[..., 2][..., None])


def turned(poses: np.ndarray, angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * poses[..., 0] - s * poses[..., 1], s * poses[..., 0] + c * poses[..., 1]
    return np.stack([x, y, poses[..., 2]], axis=-1)
