"""Random friction: limit surfaces and contact friction sampled around a mean, all of them physically consistent.

There are three distributions of limit surfaces, for n degrees of freedom:

Ellipsoid         A ~ W(A_mean, n) / n, the Wishart distribution: mean A_mean. The variance of A_ij is
                  (A_ij^2 + A_ii A_jj) / n, with the entries of A_mean.
Quartic, "gram"   The Gram matrix ~ W(G, n) / n, where G is the Gram matrix of the mean. Along every ray H varies as for
                  an ellipsoid of the same n: its relative variance is 2 / n. Not all samples are convex. Each is
                  certified (`convexity`); one that is not convex is pulled toward the mean, by as little as the
                  certificate allows.
Quartic, "sum_of_squares"
                  H = sum_k (F' P_k F)^2, each P_k ~ W(P_k, m) / m over sqrt(1 + 2 / m). The mean of H is exact, and all
                  samples are convex. m is chosen such that the relative variance of H, averaged over rays, is 2 / n.

A traced `dof` (under `jit`, `grad` or `vmap`) is not checked. If it is so small that the Wishart distribution does not
exist, the sampled surface is NaN, and every step of a rollout with it has the status INVALID.

All samples are smooth functions of standard draws (Bartlett's decomposition). So they can be differentiated by `dof`,
by the range of the contact friction and by the mean. Three results of searches have no derivative: the shrinkage of a
repaired sample, the block N of a mean's Gram matrix, and its diagonal loading. The derivative of the terms P_k of a
mean is described in `decompose`.

Zhou et al. 2017 leave three choices open, which are made as follows:

- The Gram matrix that represents the mean is the one whose least eigenvalue is largest.
- The small constant on the diagonal (diagonal loading) is `LOADING` times that eigenvalue. It is subtracted from the
  Gram matrix of the mean first, so that it does not shift the mean.
- A random Gram matrix is converted to 15 coefficients as H(F) = v' G v. This is the least squares fit in the norm that
  does not depend on the frame.

Reference: Zhou et al. 2017, section V.
"""

from abc import abstractmethod
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_non_negative,
    common_dtype,
    concrete,
)
from pushjax._internal.jit import quick_jit
from pushjax._internal.warn import warn
from pushjax._math.directions import fibonacci_hemisphere
from pushjax._math.linalg import Cholesky, Lower, add_scaled, entry
from pushjax._math.wishart import sample_wishart, tril
from pushjax.friction.convexity import Gram, antisymmetric_of, coefficients_of, max_feasible_scale
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.sum_of_squares import decompose, squared_quadratics

Sampler = Literal["gram", "sum_of_squares"]
LOADING = 0.01  # relative to the least eigenvalue of the mean's Gram matrix
DECOMPOSITION_TOLERANCE = 1e-3  # largest error of a sum of squares, relative to the largest coefficient
NUM_RAYS = 200
MAX_FRICTION = 5.0  # a larger coefficient of friction is probably in percent


def warn_about_percent(friction: float) -> None:
    """Warn if a coefficient of friction is so large that it is probably in percent."""
    if friction > MAX_FRICTION:
        warn(f"friction: mu is up to {friction:.3g}, and rarely more than 1: is it in percent?")


class SurfaceSample(NamedTuple):
    """A sampled surface, and how it was repaired.

    Attributes:
        surface: The limit surface.
        shrinkage: How far the sample was moved toward the mean to be convex, as a fraction of the distance to the
            mean. Zero if it was convex.
    """

    surface: LimitSurface
    shrinkage: Float[Array, ""]


class SurfaceDistribution(eqx.Module):
    """A distribution of limit surfaces around a mean.

    Attributes:
        mean: The mean of the surfaces.
    """

    mean: eqx.AbstractVar[LimitSurface]

    @abstractmethod
    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        """Sample one surface. Use `vmap` over keys for a batch."""

    @abstractmethod
    def with_dof(self, dof: Array) -> "SurfaceDistribution":
        """Return the same distribution with other degrees of freedom, without repeating the precomputation."""


class FrictionModel(eqx.Module):
    """Uncertainty of friction: of the limit surface, and of the contact friction between fingers and slider.

    Args:
        dof: Degrees of freedom n of the Wishart distribution, at least 3 for an `Ellipsoid` and at least 9 for a
            `Quartic` (the size of the sampled matrix). It need not be an integer. The relative variance of H along a
            ray is 2 / n. None if the limit surface is known exactly. Not checked if traced.
        friction: Coefficient of contact friction mu, or the range (lowest, highest), shape (2,), on which it is
            uniformly distributed.
        sampler: Distribution of a `Quartic`. "gram" is the paper's: it takes every convex quartic, and repairs draws
            that are not convex. "sum_of_squares" takes a sum of squared quadratic forms, as fits about the center of
            pressure are; its draws are always convex.
        resample_every: Number of steps after which a rollout samples again. None to sample once per rollout.

    Raises:
        ValueError: If `dof` is not finite or less than 3; if `friction` is negative, not finite, or its lowest value
            exceeds its highest; if `sampler` is neither "gram" nor "sum_of_squares"; or if `resample_every` is not a
            positive integer.
    """

    dof: Float[Array, ""] | None
    friction: Float[Array, "2"]
    sampler: Sampler = eqx.field(static=True)
    resample_every: int | None = eqx.field(static=True)

    def __init__(
        self,
        dof: ArrayLike | None,
        friction: ArrayLike,
        sampler: Sampler = "gram",
        *,
        resample_every: int | None = None,
    ):
        dtype = common_dtype(dof, friction)
        if sampler not in ("gram", "sum_of_squares"):
            raise ValueError(f"sampler must be 'gram' or 'sum_of_squares'; got {sampler!r}")
        if resample_every is not None and (not isinstance(resample_every, (int, np.integer)) or resample_every < 1):
            raise ValueError(
                f"resample_every must be a whole number of steps, at least 1, or None; got {resample_every!r}"
            )
        self.sampler, self.resample_every = sampler, None if resample_every is None else int(resample_every)
        self.dof = None
        if dof is not None:
            self.dof = as_float(dof, dtype, "dof")
            if self.dof.shape != ():
                raise ValueError(f"dof has shape {self.dof.shape}; expected a scalar: are dof and friction swapped?")
            check_finite("dof", self.dof)
            _check_dof(self.dof, 3, "an ellipsoid's matrix")
        mu = as_float(friction, dtype, "friction")
        if mu.shape not in ((), (2,)):
            raise ValueError(f"friction has shape {mu.shape}; expected a scalar or (2,), lowest and highest")
        check_finite("friction", mu)
        check_non_negative("friction", mu)
        self.friction = jnp.broadcast_to(mu, (2,))
        known = concrete(self.friction)
        if known is not None and known[0] > known[1]:
            raise ValueError(f"friction must be (lowest, highest); got ({known[0]:g}, {known[1]:g})")
        if known is not None:
            warn_about_percent(known[1])

    def around(self, surface: LimitSurface) -> SurfaceDistribution:
        """Prepare the distribution of surfaces around a mean. This is the expensive part, needed once for many samples.

        Args:
            surface: The mean of the surfaces.

        Returns:
            The distribution. Its `sample` draws from it.

        Raises:
            ValueError: If the mean is a `Quartic` and `dof` is less than 9, or if the sampler is "sum_of_squares" and
                the quartic is not a sum of five squared quadratic forms. Not checked for traced values.
            TypeError: If the surface is neither an `Ellipsoid` nor a `Quartic`.
        """
        dtype = surface.length.dtype
        if self.dof is None:
            return _Deterministic(surface)
        dof = self.dof.astype(dtype)
        if isinstance(surface, Ellipsoid):
            return _WishartEllipsoid.of(surface, dof)
        if not isinstance(surface, Quartic):
            raise TypeError(f"surface: expected an Ellipsoid or a Quartic; got a {type(surface).__name__}")
        _check_dof(dof, 9, "a quartic's Gram matrix")
        return (_GramQuartic if self.sampler == "gram" else SumOfSquaresQuartic).of(surface, dof)

    def sample(self, key: PRNGKeyArray, surface: LimitSurface) -> tuple[LimitSurface, Float[Array, ""]]:
        """Sample a limit surface around `surface`, and a coefficient of contact friction.

        For many samples use `vmap` over keys, or call `around` once and sample from what it returns.

        Args:
            key: PRNG key.
            surface: The mean of the surfaces.

        Returns:
            The limit surface, and mu, a scalar.

        Raises:
            ValueError: As in `around`.
            TypeError: As in `around`.
        """
        first, second = jax.random.split(key)
        return self.around(surface).sample(first).surface, self.sample_friction(second)

    def sample_friction(self, key: PRNGKeyArray) -> Float[Array, ""]:
        """Sample the coefficient of contact friction mu, uniformly from its range.

        Args:
            key: PRNG key.

        Returns:
            mu, a scalar.
        """
        low, high = self.friction
        return low + (high - low) * jax.random.uniform(key, (), self.friction.dtype)


def _check_dof(dof: Array, least: int, what: str) -> None:
    """Raise ValueError if `dof` is less than `least`, the size of the matrix that `what` names."""
    known = concrete(dof)
    if known is not None and not known >= least:
        raise ValueError(f"dof must be at least {least}, the size of {what}; got {known:g}")


class _Deterministic(SurfaceDistribution):
    """The distribution of a surface that is known exactly."""

    mean: LimitSurface

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        return SurfaceSample(self.mean, jnp.zeros_like(self.mean.length))

    def with_dof(self, dof: Array) -> "_Deterministic":
        return self


class _WishartEllipsoid(SurfaceDistribution):
    """Ellipsoids with A ~ W(A_mean, n) / n.

    Attributes:
        mean: The mean surface.
        factor: Lower triangular L with L L' = A_mean.
        dof: Degrees of freedom n.
    """

    mean: Ellipsoid
    factor: Lower
    dof: Float[Array, ""]

    @staticmethod
    def of(mean: Ellipsoid, dof: Array) -> "_WishartEllipsoid":
        return _WishartEllipsoid(mean, Cholesky.of(tril(mean.A)).lower, dof)

    def with_dof(self, dof: Array) -> "_WishartEllipsoid":
        return eqx.tree_at(lambda s: s.dof, self, dof)

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        drawn = sample_wishart(key, self.factor, self.dof)
        rows = [[entry(drawn, i, j) for j in range(3)] for i in range(3)]
        surface = eqx.tree_at(lambda s: s.A, self.mean, jnp.array(rows))
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


class _GramQuartic(SurfaceDistribution):
    """Quartics whose Gram matrix has a Wishart distribution.

    Only the 6 x 6 block of the 9 x 9 matrix is sampled. H depends on nothing else, and a block of a Wishart matrix is a
    Wishart matrix too.

    Attributes:
        mean: The mean surface.
        gram: Gram matrix of the mean.
        loading: Multiple of the identity that is not random: the diagonal loading.
        factor: Lower triangular L, where L L' is the 6 x 6 block of `gram` without the loading.
        dof: Degrees of freedom n.
    """

    mean: Quartic
    gram: Gram
    loading: Float[Array, ""]
    factor: Lower
    dof: Float[Array, ""]

    @staticmethod
    @quick_jit
    def of(mean: Quartic, dof: Array) -> "_GramQuartic":
        form = mean.form()
        scale = jax.lax.stop_gradient(form.c[0] + form.c[1] + form.c[2])
        scaled = tuple(c / scale for c in form.c)
        best = without_derivatives(_best_gram, scaled)
        gram = Gram.of(form.c, tuple(scale * n for n in best.n))
        least = best.scale
        # For a mean on the border of convexity the least eigenvalue is zero, up to the tolerance of the search.
        loading = scale * jnp.where(least > 0, LOADING * least, least)
        unloaded = gram.plus(-loading, Gram.identity(loading)).symmetric
        return _GramQuartic(mean, gram, loading, Cholesky.of(unloaded).lower, dof)

    def with_dof(self, dof: Array) -> "_GramQuartic":
        return eqx.tree_at(lambda s: s.dof, self, dof)

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        identity = Gram.identity(self.loading)
        drawn = add_scaled(sample_wishart(key, self.factor, self.dof), self.loading, identity.symmetric)
        coefficients = coefficients_of(drawn)
        # The Gram matrix of a mean on the border of convexity is not positive definite, so pulling a sample toward it
        # does not help in every direction. Add a very small multiple of the identity to it.
        reference = self.gram.plus(jnp.maximum(-2 * self.loading, 0), identity)
        mean = coefficients_of(reference.symmetric)
        certificate = without_derivatives(_certify, coefficients, antisymmetric_of(drawn), reference)
        shrinkage = jnp.where(certificate.scale < 0, -certificate.scale / (1 - certificate.scale), 0.0)
        # Never observed: a search that ends at a scale that is not finite. The sample is then replaced by the mean.
        shrinkage = jnp.where(jnp.isfinite(certificate.scale), shrinkage, 1.0)
        repaired = [c + shrinkage * (m - c) for c, m in zip(coefficients, mean, strict=True)]
        return SurfaceSample(eqx.tree_at(lambda s: s.coefficients, self.mean, jnp.stack(repaired)), shrinkage)


def _best_gram(coefficients):
    """Find the Gram matrix of a quartic whose least eigenvalue is largest; `scale` of the result is that eigenvalue."""
    one = jnp.ones_like(coefficients[0])
    start_n = (0.2 * one,) * 3 + (0 * one,) * 3
    tolerance = 1e-6 if one.dtype == jnp.float64 else 1e-4
    return max_feasible_scale(coefficients, start_n, Gram.identity(one), enough=np.inf, tolerance=tolerance)


def _certify(coefficients, n, reference):
    """Certify that a quartic is convex, or find how much of the Gram matrix `reference` must be added to make it so.

    `scale` of the result is not negative if the quartic is convex. Otherwise -`scale` is the multiple to add.
    """
    return max_feasible_scale(coefficients, n, reference, enough=0.0, tolerance=1e-3)


class SumOfSquaresQuartic(SurfaceDistribution):
    """Quartics H = sum_k (F' P_k F)^2, where each P_k has a Wishart distribution.

    Attributes:
        mean: The mean surface.
        lower: Lower triangular factors of the P_k of the mean, shape (terms, 3, 3).
        dof: Degrees of freedom m of each P_k.
    """

    mean: Quartic
    lower: Float[Array, "terms 3 3"]
    dof: Float[Array, ""]

    @staticmethod
    def of(mean: Quartic, dof: Array) -> "SumOfSquaresQuartic":
        terms = quick_jit(decompose)(mean.coefficients)
        error = concrete(terms.error)
        if error is not None and not error < DECOMPOSITION_TOLERANCE:
            raise ValueError(
                f"surface: the nearest sum of five squared quadratic forms is {error:.1g} of its coefficients away; "
                "the sampler 'gram' takes every convex quartic"
            )
        return SumOfSquaresQuartic(mean, terms.lower, dof_of_terms(terms.lower, dof))

    @staticmethod
    def of_terms(mean: Quartic, lower: Array, dof: Array) -> "SumOfSquaresQuartic":
        """Return the distribution around a mean whose factors are known.

        Args:
            mean: The mean surface.
            lower: Lower triangular factors of the P_k of the mean, shape (terms, 3, 3).
            dof: Degrees of freedom n: the relative variance of H, averaged over rays, is 2 / n.
        """
        return SumOfSquaresQuartic(mean, lower, dof_of_terms(lower, dof))

    def with_dof(self, dof: Array) -> "SumOfSquaresQuartic":
        return eqx.tree_at(lambda s: s.dof, self, dof_of_terms(self.lower, dof))

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        def term(lower: Array, key: PRNGKeyArray) -> Array:
            drawn = sample_wishart(key, tril(lower), self.dof)
            return jnp.array([[entry(drawn, i, j) for j in range(3)] for i in range(3)])

        forms = jax.vmap(term)(self.lower, jax.random.split(key, self.lower.shape[0]))
        coefficients = squared_quadratics(forms) / (1 + 2 / self.dof)
        surface = eqx.tree_at(lambda s: s.coefficients, self.mean, coefficients)
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


def dof_of_terms(lower: Array, dof: Array) -> Array:
    """Return the m for which the relative variance of H, averaged over rays, is 2 / dof.

    (F' P F)^2 has the relative variance (8 m + 24) / (m (m + 2)). For a sum, this is multiplied by the sum of the
    squares of the terms' shares of H, averaged over rays.

    Args:
        lower: Lower triangular factors of the P_k, shape (terms, 3, 3).
        dof: Degrees of freedom n.
    """
    forms = lower @ jnp.swapaxes(lower, 1, 2)
    rays = jnp.asarray(fibonacci_hemisphere(NUM_RAYS), dof.dtype)
    value = jnp.einsum("fi,kij,fj->fk", rays, forms, rays) ** 2
    share = value / jnp.sum(value, axis=1, keepdims=True)
    # With s the mean sum of squared shares: s (8 m + 24) / (m (m + 2)) = 2 / n, so m^2 - b m - 3 (b + 2) = 0.
    b = 4 * jnp.mean(jnp.sum(share**2, axis=1)) * dof - 2
    return (b + jnp.sqrt(b**2 + 12 * (b + 2))) / 2
