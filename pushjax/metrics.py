"""Error metrics for predicted poses and for predicted distributions of poses.

A distribution is given by `samples`, poses (n, 3) drawn from the prediction. The poses that occurred are `observed`, of
shape (3,) or (observations, 3). Poses are (x, y, theta) in m and rad. `length`, in m, makes angles commensurate with
positions. Angles are compared modulo a full turn.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_finite, check_positive, checked_array, common_dtype
from pushjax._internal.jit import quick_jit

# The smallest bandwidth of a density estimate, in m. No tracker resolves less, and grasps end in distributions that
# have no density.
MIN_BANDWIDTH = 1e-4


def deviation(pose_a: ArrayLike, pose_b: ArrayLike, length: ArrayLike) -> Float[Array, "*batch"]:
    """Return the paper's distance between two poses: |difference in position| + length * |smaller angle between them|.

    The distance has a corner at equal positions and at equal angles. Its gradient there is zero.

    Args:
        pose_a: Poses (..., 3), in m and rad.
        pose_b: Poses (..., 3), in m and rad, broadcast against `pose_a`.
        length: Length that weighs the angle, in m. The paper uses the object's characteristic length.

    Returns:
        The distances, in m.

    Raises:
        ValueError: If a pose has another shape, the shapes do not broadcast, or `length` is not positive and finite.

    Examples:
        >>> print(f"{1e3 * deviation((0.003, 0.004, 0.0), (0.0, 0.0, 0.1), length=0.05):.1f} mm")
        10.0 mm

    Reference: Zhou et al. 2017, section VI.A.
    """
    dtype = common_dtype(pose_a, pose_b, length)
    named = (("pose_a", pose_a), ("pose_b", pose_b), ("length", length))
    a, b, scale = (as_float(value, dtype, name) for name, value in named)
    check_finite("length", scale)
    check_positive("length", scale)
    for name, pose in (("pose_a", a), ("pose_b", b)):
        if pose.ndim == 0 or pose.shape[-1] != 3:
            raise ValueError(f"{name} has shape {pose.shape}; expected (..., 3)")
    return _deviation(a, b, scale)


@quick_jit
def _deviation(a: Array, b: Array, scale: Array) -> Array:
    """Return `deviation` for arrays of one dtype, by a single program."""
    shape = jnp.broadcast_shapes(a.shape, b.shape)
    delta = jnp.broadcast_to(a, shape) - jnp.broadcast_to(b, shape)
    squared = delta[..., 0] ** 2 + delta[..., 1] ** 2
    coincide = squared == 0
    distance = jnp.where(coincide, 0.0, jnp.sqrt(jnp.where(coincide, 1.0, squared)))
    # `abs` has the derivative one at zero; this has zero
    angle = delta[..., 2] * jnp.sign(delta[..., 2]) % (2 * jnp.pi)
    return distance + scale * jnp.minimum(angle, 2 * jnp.pi - angle)


def energy_score(samples: ArrayLike, observed: ArrayLike, length: ArrayLike) -> Float[Array, "*observations"]:
    """Return the energy score E d(X, y) - E d(X, X') / 2 of a predicted distribution; lower is better.

    The score is strictly proper: in the mean over the observations, no other distribution scores as well as the true
    one.

    d is the Euclidean distance between points (x, y, length cos theta, length sin theta). For small angles it is the
    distance between points (x, y, length theta). The paper's `deviation` is not suitable as d: the sum of a position
    distance and an angle distance is blind to the correlation of position and angle, and arc length on a circle does
    not make the score strictly proper. E d(X, X') is the mean over pairs of different samples, so that the expected
    score does not depend on n. Differentiable in the samples.

    Args:
        samples: Poses (n, 3) drawn from the prediction, in m and rad; at least two.
        observed: Observed poses (3,) or (observations, 3), in m and rad.
        length: Length that weighs the angle, in m.

    Returns:
        The score of each observed pose, in m: a scalar or (observations,).

    Raises:
        ValueError: If a shape is different, there are fewer than two samples, a value is not finite, or `length` is not
            positive.

    Reference: Gneiting & Raftery 2007, section 4.3.
    """
    return _energy_score(*_checked(samples, observed, length))


@jax.jit
def _energy_score(x: Array, y: Array, scale: Array) -> Array:
    n = x.shape[0]
    # row by row, because all pairs at once would take the memory of n^2 numbers
    to_other_samples = jax.lax.map(lambda row: jnp.mean(_score_distance(row[None], x, scale)), x, batch_size=min(n, 64))
    mean_pair_distance = jnp.mean(to_other_samples) * (n / (n - 1))
    to_samples = jax.lax.map(
        lambda pose: jnp.mean(_score_distance(pose[None], x, scale)), y.reshape(-1, 3), batch_size=64
    )
    return to_samples.reshape(y.shape[:-1]) - mean_pair_distance / 2


def _score_distance(a: Array, b: Array, length: Array) -> Array:
    """Return the distance d of `energy_score` between poses, m; its derivative at its corner, zero, is zero."""
    a, b = jnp.broadcast_arrays(a, b)
    difference = a - b
    chord = 2 * length * jnp.sin(difference[..., 2] / 2)
    squared = difference[..., 0] ** 2 + difference[..., 1] ** 2 + chord**2
    coincide = squared == 0
    return jnp.where(coincide, 0.0, jnp.sqrt(jnp.where(coincide, 1.0, squared)))


def log_density(
    samples: ArrayLike, observed: ArrayLike, length: ArrayLike, *, min_bandwidth: float = MIN_BANDWIDTH
) -> Float[Array, "*observations"]:
    """Return the logarithm of a kernel density estimate at the observed poses.

    The kernel is Gaussian. Its covariance is that of the samples times n^(-2/7) (Scott's rule in three dimensions),
    plus `min_bandwidth` squared in every direction. It is repeated after a full turn. Differentiable.

    Args:
        samples: Poses (n, 3) drawn from the prediction, in m and rad; at least two.
        observed: Observed poses (3,) or (observations, 3), in m and rad.
        length: Length that weighs the angle, in m.
        min_bandwidth: Standard deviation that is added to the kernel in every direction, in m.

    Returns:
        The logarithm of the density per cubic meter of (x, y, length * theta): a scalar or (observations,).

    Raises:
        ValueError: If an argument is one that `energy_score` refuses, or `min_bandwidth` is not positive.
    """
    x, y, scale = _checked(samples, observed, length)
    check_positive("min_bandwidth", min_bandwidth)
    return _log_density(x, y, scale, as_float(min_bandwidth, x.dtype, "min_bandwidth"))


@jax.jit
def _log_density(x: Array, y: Array, scale: Array, min_bandwidth: Array) -> Array:
    points, observed_points = _flat_points(x, y, scale)
    log_sums = _Kernel(points, min_bandwidth, scale).log_sums(observed_points)
    return log_sums.reshape(y.shape[:-1]) - jnp.log(jnp.asarray(x.shape[0], x.dtype))


def coverage(
    samples: ArrayLike,
    observed: ArrayLike,
    length: ArrayLike,
    levels: Sequence[float] = (0.5, 0.9),
    *,
    min_bandwidth: float = MIN_BANDWIDTH,
) -> Float[Array, "levels"]:
    """Return the fraction of the observed poses inside the prediction's highest-density region of each level.

    The region of a level is the one of highest density that contains this fraction of the prediction. For a calibrated
    prediction, coverage and level are equal.

    The density is that of `log_density`. The region's border is a quantile of the samples' densities, where the density
    at each sample is estimated from the other samples (leave-one-out).

    Args:
        samples: Poses (n, 3) drawn from the prediction, in m and rad; at least two.
        observed: Observed poses (3,) or (observations, 3), in m and rad.
        length: Length that weighs the angle, in m.
        levels: Fractions of the prediction that the regions contain, between 0 and 1.
        min_bandwidth: As in `log_density`, in m.

    Returns:
        The fraction of the observed poses inside the region of each level, (levels,).

    Raises:
        ValueError: If an argument is one that `energy_score` refuses, a level is outside (0, 1), or `min_bandwidth`
            is not positive.
    """
    x, y, scale = _checked(samples, observed, length)
    fractions = np.asarray(levels, float)
    check_positive("min_bandwidth", min_bandwidth)
    if fractions.ndim != 1 or not np.all((fractions > 0) & (fractions < 1)):
        raise ValueError(f"levels must be numbers between 0 and 1; got {levels!r}")
    return _coverage(x, y, scale, jnp.asarray(fractions, x.dtype), as_float(min_bandwidth, x.dtype, "min_bandwidth"))


@jax.jit
def _coverage(x: Array, y: Array, scale: Array, levels: Array, min_bandwidth: Array) -> Array:
    points, observed_points = _flat_points(x, y, scale)
    kernel = _Kernel(points, min_bandwidth, scale)

    def leave_one_out(index: Array) -> Array:
        log_densities = kernel.log_densities(points[index])
        return jax.nn.logsumexp(jnp.where(jnp.arange(len(points)) == index, -jnp.inf, log_densities))

    sample_log_densities = jax.lax.map(leave_one_out, jnp.arange(len(points)))
    thresholds = jnp.quantile(sample_log_densities, 1 - levels)
    # leave-one-out densities sum n - 1 kernels, those of observations n: give both the same normalization
    excess = jnp.log(jnp.asarray(len(points) / (len(points) - 1), sample_log_densities.dtype))
    observed_log_densities = kernel.log_sums(observed_points) - excess
    return jnp.mean(observed_log_densities[None] >= thresholds[:, None], axis=1, dtype=sample_log_densities.dtype)


def mean_pose(poses: Float[Array, "n *sliders 3"]) -> Float[Array, "*sliders 3"]:
    """Return the mean of poses, m and rad: of angles the mean direction, within half a turn of the first angle."""
    turns = poses[..., 2] - poses[:1, ..., 2]
    angle = poses[0, ..., 2] + jnp.arctan2(jnp.mean(jnp.sin(turns), axis=0), jnp.mean(jnp.cos(turns), axis=0))
    return jnp.concatenate([jnp.mean(poses[..., :2], axis=0), angle[..., None]], axis=-1)


class _Kernel:
    """Gaussian kernels centered at the points of `_flat_points`, each repeated one full turn away on either side."""

    def __init__(self, points: Array, min_bandwidth: Array, length: Array):
        n = points.shape[0]
        self.turn = 2 * jnp.pi * length
        centered = points - jnp.mean(points, axis=0, keepdims=True)
        covariance = centered.T @ centered / (n - 1) * n ** (-2 / 7)
        self.cholesky = jnp.linalg.cholesky(covariance + min_bandwidth**2 * jnp.eye(3, dtype=points.dtype))
        self.points = self._whitened(points)
        self.log_normalization = jnp.sum(jnp.log(jnp.diagonal(self.cholesky))) + 1.5 * float(np.log(2 * np.pi))

    def _whitened(self, points: Array) -> Array:
        """Return points (k, 3) in coordinates in which the kernel's covariance is the identity."""
        return jax.scipy.linalg.solve_triangular(self.cholesky, points.T, lower=True).T

    def log_densities(self, point: Float[Array, "3"]) -> Float[Array, "n"]:
        """Return the log density of each sample's kernel, with its repetitions, at a point, m."""
        images = jnp.stack([point.at[2].add(k * self.turn) for k in (-1, 0, 1)])
        offsets = self.points[None] - self._whitened(images)[:, None]
        return jax.nn.logsumexp(-jnp.sum(offsets**2, axis=2) / 2, axis=0) - self.log_normalization

    def log_sums(self, points: Float[Array, "*observations 3"]) -> Float[Array, "n"]:
        """Return the log of the sum of all kernels at each of the points, m."""
        return jax.lax.map(lambda point: jax.nn.logsumexp(self.log_densities(point)), points.reshape(-1, 3))


def _flat_points(samples: Array, observed: Array, length: Array) -> tuple[Array, Array]:
    """Return samples and observations as points (x, y, length * theta), m, relative to the mean of the samples."""
    # Positions are relative because float32 has no digits to lose, and angles are within half a turn of their mean.
    center = mean_pose(samples)

    def relative_points(poses: Array) -> Array:
        relative = poses - jnp.broadcast_to(center, poses.shape)
        angle = relative[..., 2] - 2 * jnp.pi * jax.lax.stop_gradient(jnp.round(relative[..., 2] / (2 * jnp.pi)))
        return jnp.concatenate([relative[..., :2], (length * angle)[..., None]], axis=-1)

    return relative_points(samples), relative_points(observed)


def _checked(samples: ArrayLike, observed: ArrayLike, length: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the arguments as arrays of one dtype, or raise ValueError."""
    dtype = common_dtype(samples, observed, length)
    x, y = as_float(samples, dtype, "samples"), as_float(observed, dtype, "observed")
    if x.ndim != 2 or x.shape[1] != 3 or x.shape[0] < 2:
        raise ValueError(f"samples has shape {x.shape}; expected (n, 3), at least two")
    if y.ndim not in (1, 2) or y.shape[-1] != 3:
        raise ValueError(f"observed has shape {y.shape}; expected (3,) or (observations, 3)")
    check_finite("samples", x)
    check_finite("observed", y)
    return x, y, checked_array("length", length, (), dtype, positive=True)
