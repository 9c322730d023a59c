"""How good a predicted distribution of poses is, given what happened.

samples: (n, 3), poses drawn from the prediction. observed: (3,) or (observations, 3). length: m, makes angles
commensurate with positions; angles count modulo a turn.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, non_negative, positive, shaped

# m: what poses are blurred by, at least, where a density is asked for. No tracker sees less, and grasps end in
# distributions that have no density.
BLUR = 1e-4


def energy_score(samples: Numeric, observed: Numeric, length: Numeric) -> Float[Array, "*observations"]:
    """E d(X, y) - E d(X, X') / 2, in m; less is better, and in the mean over what happens no other distribution scores
    as well as the true one.

    d is the distance of (x, y, length cos theta, length sin theta): for small angles that of (x, y, length theta). The
    paper's `deviation` would not do: a sum of distances does not see how position and angle hang together, nor an arc
    length all there is to see on a circle. The second mean is over pairs of different samples, so that the score does
    not depend on n in the mean. Differentiable in the samples.

    Raises ValueError for other shapes, fewer than two samples, values that are not finite, a length that is not
    positive.

    Source: Gneiting & Raftery 2007, section 4.3.
    """
    return _energy_score(*_checked(samples, observed, length))


@jax.jit
def _energy_score(x: Array, y: Array, scale: Array) -> Array:
    n = x.shape[0]
    # row by row: all pairs at once would take n^2 numbers
    within = jax.lax.map(lambda row: jnp.mean(_apart(row[None], x, scale)), x, batch_size=min(n, 64))
    spread = jnp.mean(within) * (n / (n - 1))
    to = jax.lax.map(lambda one: jnp.mean(_apart(one[None], x, scale)), y.reshape(-1, 3), batch_size=64)
    return to.reshape(y.shape[:-1]) - spread / 2


def _apart(a: Array, b: Array, length: Array) -> Array:
    """The distance of poses; its derivative at none, where it has a corner, is zero."""
    a, b = jnp.broadcast_arrays(a, b)
    rel = a - b
    chord = 2 * length * jnp.sin(rel[..., 2] / 2)
    squared = rel[..., 0] ** 2 + rel[..., 1] ** 2 + chord**2
    same = squared == 0
    return jnp.where(same, 0.0, jnp.sqrt(jnp.where(same, 1.0, squared)))


def log_density(
    samples: Numeric, observed: Numeric, length: Numeric, *, blur: float = BLUR
) -> Float[Array, "*observations"]:
    """The logarithm of a kernel density estimate at `observed`, per cubic metre of (x, y, length * theta).

    The kernel is a Gaussian of the samples' covariance times n^(-2/7) (Scott's rule in three dimensions), and `blur`
    (m) on top in every direction; it repeats after a turn. Differentiable. Raises ValueError as `energy_score`, and for
    a blur that is not positive.
    """
    x, y, scale = _checked(samples, observed, length)
    positive("blur", blur)
    return _log_density(x, y, scale, as_float(blur, x.dtype))


@jax.jit
def _log_density(x: Array, y: Array, scale: Array, blur: Array) -> Array:
    points, at = _unrolled(x, y, scale)
    kernel = _Kernel(points, blur, scale)
    flat = jax.lax.map(lambda p: jax.nn.logsumexp(kernel.log(p)), at.reshape(-1, 3))
    return flat.reshape(at.shape[:-1]) - jnp.log(jnp.asarray(x.shape[0], x.dtype))


def coverage(
    samples: Numeric, observed: Numeric, length: Numeric, levels: Sequence[float] = (0.5, 0.9), *, blur: float = BLUR
) -> Float[Array, "levels"]:
    """The share of the observed poses that lie in the region of highest density that holds each share of the
    prediction; of a good one they are equal.

    The density is that of `log_density`, and the region's border its quantile over the samples, each seen by the
    others. Raises ValueError as `energy_score`, and for levels outside (0, 1).
    """
    x, y, scale = _checked(samples, observed, length)
    asked = np.asarray(levels, float)
    positive("blur", blur)
    if asked.ndim != 1 or not np.all((asked > 0) & (asked < 1)):
        raise ValueError(f"levels must be numbers between 0 and 1; got {levels!r}")
    return _coverage(x, y, scale, jnp.asarray(asked, x.dtype), as_float(blur, x.dtype))


@jax.jit
def _coverage(x: Array, y: Array, scale: Array, levels: Array, blur: Array) -> Array:
    points, at = _unrolled(x, y, scale)
    kernel = _Kernel(points, blur, scale)

    def without(index: Array) -> Array:
        log = kernel.log(points[index])
        return jax.nn.logsumexp(jnp.where(jnp.arange(len(points)) == index, -jnp.inf, log))

    own = jax.lax.map(without, jnp.arange(len(points)))
    seen = jax.lax.map(lambda p: jax.nn.logsumexp(kernel.log(p)), at.reshape(-1, 3))
    border = jnp.quantile(own, 1 - levels)
    # a sample's own kernel is not among those it is seen by, an observation is seen by one more
    seen = seen - jnp.log(jnp.asarray(len(points) / (len(points) - 1), own.dtype))
    return jnp.mean(seen[None] >= border[:, None], axis=1, dtype=own.dtype)


def histogram_distance(counts_a: Numeric, counts_b: Numeric) -> float:
    """Total variation between two histograms on the same edges, of any dimension: the share of one that would have to
    move to make it the other, from 0 to 1.

    Raises ValueError for counts of different shapes, negative, not finite, or all zero.
    """
    shares = []
    for name, counts in (("counts_a", counts_a), ("counts_b", counts_b)):
        values = np.asarray(counts, float)
        finite(name, values)
        non_negative(name, values)
        if not values.sum() > 0:
            raise ValueError(f"{name} must not all be zero")
        shares.append(values / values.sum())
    a, b = shares
    if a.shape != b.shape:
        raise ValueError(f"counts_a and counts_b must have one shape; got {a.shape} and {b.shape}")
    return float(np.abs(a - b).sum() / 2)


class _Kernel:
    """A Gaussian about each sample (n, 3), and a turn on either side of it."""

    def __init__(self, points: Array, blur: Array, length: Array):
        n = points.shape[0]
        self.turn = 2 * jnp.pi * length
        centered = points - jnp.mean(points, axis=0, keepdims=True)
        covariance = centered.T @ centered / (n - 1) * n ** (-2 / 7)
        self.factor = jnp.linalg.cholesky(covariance + blur**2 * jnp.eye(3, dtype=points.dtype))
        self.points = self._white(points)
        self.norm = jnp.sum(jnp.log(jnp.diagonal(self.factor))) + 1.5 * float(np.log(2 * np.pi))

    def _white(self, points: Array) -> Array:
        return jax.scipy.linalg.solve_triangular(self.factor, points.T, lower=True).T

    def log(self, at: Float[Array, "3"]) -> Float[Array, "n"]:
        images = jnp.stack([at.at[2].add(k * self.turn) for k in (-1, 0, 1)])
        apart = self.points[None] - self._white(images)[:, None]
        return jax.nn.logsumexp(-jnp.sum(apart**2, axis=2) / 2, axis=0) - self.norm


def _unrolled(samples: Array, observed: Array, length: Array) -> tuple[Array, Array]:
    """(x, y, length * theta), with angles within half a turn of the samples' mean direction, and positions about their
    mean: float32 has no digits to lose."""
    theta = samples[:, 2]
    middle = jnp.arctan2(jnp.mean(jnp.sin(theta)), jnp.mean(jnp.cos(theta)))
    center = jnp.concatenate([jnp.mean(samples[:, :2], axis=0), middle[None]])

    def about(poses: Array) -> Array:
        rel = poses - jnp.broadcast_to(center, poses.shape)
        angle = rel[..., 2] - 2 * jnp.pi * jax.lax.stop_gradient(jnp.round(rel[..., 2] / (2 * jnp.pi)))
        return jnp.concatenate([rel[..., :2], (length * angle)[..., None]], axis=-1)

    return about(samples), about(observed)


def _checked(samples: Numeric, observed: Numeric, length: Numeric) -> tuple[Array, Array, Array]:
    dtype = common_dtype(samples, observed, length)
    x, y, scale = (as_float(value, dtype) for value in (samples, observed, length))
    if x.ndim != 2 or x.shape[1] != 3 or x.shape[0] < 2:
        raise ValueError(f"samples has shape {x.shape}; expected (n, 3), at least two")
    if y.ndim not in (1, 2) or y.shape[-1] != 3:
        raise ValueError(f"observed has shape {y.shape}; expected (3,) or (observations, 3)")
    for name, value in (("samples", x), ("observed", y), ("length", scale)):
        finite(name, value)
    shaped("length", scale, ())
    positive("length", scale)
    return x, y, scale
