"""Scores of predicted distributions of many pushes, given as samples; and normal distributions of prediction errors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj

LEVELS = (0.5, 0.9)
FINE = tuple(np.linspace(0.005, 0.995, 199).tolist())
TOGETHER = 16  # pushes that are scored in one batch


class Scored(NamedTuple):
    """Scores of each push.

    Attributes:
        energy: Energy scores, (pushes,), m.
        density: Logarithms of the predicted density at the observation, (pushes,).
        level: Levels of the smallest highest-density region that contains the observation, (pushes,), to half a
            hundredth.
        inside: Whether the regions of the levels `LEVELS` contain the observation, (pushes, 2).
    """

    energy: np.ndarray
    density: np.ndarray
    level: np.ndarray
    inside: np.ndarray

    def calibrated(self, seen: np.ndarray, ratio: tuple[np.ndarray, np.ndarray] | None = None) -> "Scored":
        """Recalibrate the regions by split conformal prediction, from the levels of held-out pushes.

        The new regions have the levels that contained the fractions `LEVELS` of the held-out observations. On average
        the k-th smallest of n levels contains k / (n + 1) of new observations, so the quantiles are taken there. Other
        quantiles contain too much, and more so the smaller n is.

        Args:
            seen: Levels of the held-out pushes, (held out,), as in `level`.
            ratio: Weights for covariate shift from `density_ratio`: for each held-out push, (held out,), and for each
                of these pushes, (pushes,), how many times as frequent its kind is among these pushes as among the
                held-out ones. A push counts that many times. None weighs all alike.

        Returns:
            The same scores with the recalibrated `inside`.

        Reference: Tibshirani et al. 2019, conformal prediction under covariate shift.
        """
        there, here = (np.ones(len(seen)), np.ones(len(self.level))) if ratio is None else ratio
        order = np.argsort(seen)
        held = np.cumsum(there[order])
        # where the held-out pushes do not suffice, only the region of level 1 contains the fraction
        levels = [np.interp(LEVELS, held / (held[-1] + own), seen[order], right=1.0) for own in here]
        return self._replace(inside=self.level[:, None] <= np.reshape(levels, (-1, len(LEVELS))))


def reach(draws: np.ndarray, start: np.ndarray, length: float) -> np.ndarray:
    """Return how far each push is predicted to move the slider, as medians over its samples.

    Args:
        draws: Samples of the final pose, (pushes, n, 3), m and rad.
        start: Start poses, (pushes, 3), m and rad.
        length: Characteristic length, m.

    Returns:
        The distance, and the length times the angle, (pushes, 2), mm.
    """
    moved = draws - start[:, None]
    each = np.stack([np.hypot(moved[..., 0], moved[..., 1]), length * np.abs(moved[..., 2])], axis=-1)
    return 1e3 * np.median(each, axis=1)


def density_ratio(there: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratio of the densities of `reach` in two sets of pushes, `here` divided by `there`.

    The ratio comes from a logistic regression of the set that a push belongs to. It is quadratic in the logarithm of
    the reach plus one millimeter.

    Args:
        there: Reach of the pushes of one set, (pushes there, 2), mm.
        here: Reach of the pushes of the other set, (pushes here, 2), mm.

    Returns:
        The ratio at each push of `there` and at each push of `here`.
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
    """Return the effective sample size of weighted pushes (Kish)."""
    return float(weight.sum() ** 2 / (weight**2).sum())


def scored(draws: np.ndarray, ends: np.ndarray, length: float) -> Scored:
    """Score predicted distributions against the observations.

    Args:
        draws: Samples of the predicted final poses, (pushes, n, 3), m and rad.
        ends: Observed final poses, (pushes, 3), m and rad.
        length: Characteristic length, m.

    Returns:
        The scores of each push.
    """
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
    """Return the measured final poses minus the predicted ones, in the slider's frame at the start.

    Args:
        predicted: Predicted final poses, (..., 3), m and rad.
        end: Measured final poses, (..., 3), m and rad.
        start: Start poses, (..., 3), m and rad.

    Returns:
        Errors, (..., 3), m and rad.
    """
    return turned(end - predicted, -start[..., 2])


def normal_draws(
    rng: np.random.Generator, predicted: np.ndarray, start: np.ndarray, off: np.ndarray, n: int
) -> np.ndarray:
    """Draw final poses about the predicted ones, from a normal distribution of the prediction errors.

    Args:
        rng: Source of randomness.
        predicted: Predicted final poses, (..., 3), m and rad.
        start: Start poses, (..., 3), m and rad.
        off: `errors` of other pushes, (many, 3), whose mean and covariance are used.
        n: Number of samples of each push.

    Returns:
        Samples, (..., n, 3), m and rad.
    """
    drawn = rng.multivariate_normal(off.mean(axis=0), np.cov(off.T), (*predicted.shape[:-1], n))
    return predicted[..., None, :] + turned(drawn, start[..., 2][..., None])


def turned(poses: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotate the positions of poses, (..., 3), by angles, (...,), rad; their own angles stay."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * poses[..., 0] - s * poses[..., 1], s * poses[..., 0] + c * poses[..., 1]
    return np.stack([x, y, poses[..., 2]], axis=-1)
