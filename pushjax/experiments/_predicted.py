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

    def calibrated(self, seen: np.ndarray, ratio: tuple[np.ndarray, np.ndarray] | None = None) -> "Scored":
        """With regions of other levels: those that held a share `LEVELS` of what happened in other pushes, whose levels
        these are (split conformal prediction). Of n of them the k-th smallest holds k / (n + 1) in the mean, so that is
        where the shares are looked up: other quantiles hold too much, the more the fewer there are.

        ratio: of each of those pushes and of each of these, how many times as common its kind is here as there
        (`density_ratio`); it counts for so many (Tibshirani et al. 2019, conformal prediction under covariate shift).
        """
        there, here = (np.ones(len(seen)), np.ones(len(self.level))) if ratio is None else ratio
        order = np.argsort(seen)
        held = np.cumsum(there[order])
        # where those seen do not suffice, only everything holds the share
        levels = [np.interp(LEVELS, held / (held[-1] + own), seen[order], right=1.0) for own in here]
        return self._replace(inside=self.level[:, None] <= np.reshape(levels, (-1, len(LEVELS))))


def reach(draws: np.ndarray, start: np.ndarray, length: float) -> np.ndarray:
    """(pushes, 2) mm: how far, and length times by what angle, a push is predicted to move the slider; medians of its
    draws (pushes, n, 3)."""
    moved = draws - start[:, None]
    each = np.stack([np.hypot(moved[..., 0], moved[..., 1]), length * np.abs(moved[..., 2])], axis=-1)
    return 1e3 * np.median(each, axis=1)


def density_ratio(there: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many times as common pushes of such a `reach` are `here` as `there`: of each push there, and of each here.

    By logistic regression, quadratic in the logarithms (a millimetre added), of which of the two a push is of.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    features = StandardScaler(), PolynomialFeatures(2, include_bias=False), LogisticRegression()
    both = np.log1p(np.concatenate([there, here]))
    odds = np.exp(make_pipeline(*features).fit(both, np.arange(len(both)) >= len(there)).decision_function(both))
    found = odds * len(there) / len(here)
    return found[: len(there)], found[len(there) :]


def effective(weight: np.ndarray) -> float:
    """How many pushes of equal weight say as much as these (Kish)."""
    return float(weight.sum() ** 2 / (weight**2).sum())


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
