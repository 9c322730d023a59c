"""Distributions of limit surfaces around a mean, all of whose samples are convex.

There are four that are random, for n degrees of freedom:

Ellipsoid         A ~ W(A_mean, n) / n, the Wishart distribution: mean A_mean. The variance of A_ij is
                  (A_ij^2 + A_ii A_jj) / n, with the entries of A_mean.
Quartic, "gram"   The Gram matrix ~ W(G, n) / n, where G is the Gram matrix of the mean. Along every ray H varies as for
                  an ellipsoid of the same n: its relative variance is 2 / n. Not all samples are convex. Each is
                  certified (`convexity`); one that is not convex is pulled toward the mean, by as little as the
                  certificate allows.
Quartic, "sum_of_squares"
                  H = sum_k (F' X_k F)^2 / (1 + 2 / m), each X_k ~ W(P_k, m) / m, where sum_k (F' P_k F)^2 is the mean.
                  The mean of H is exact, and all samples are convex. m is chosen such that the relative variance of H,
                  averaged over rays, is 2 / n.
Feet              The friction limit of each support point ~ chi2(n) / n times its mean, all independent: a relative
                  variance of 2 / n.

A traced `dof` (under `jit`, `grad` or `vmap`) is not checked. If it is so small that the Wishart distribution does not
exist, the sampled surface is NaN, and every step of a rollout with it has the status INVALID.

All samples are smooth functions of standard random numbers (Bartlett's decomposition). So they can be differentiated by
`dof` and by the mean. Three results of searches have no derivative: the shrinkage of a repaired sample, the block N of
a mean's Gram matrix, and its diagonal loading. The terms P_k of a mean have the smallest derivative that meets a change
of its coefficients.

Zhou et al. 2017 (section V) leave three choices open, which are made as follows:

- The Gram matrix that represents the mean is the one whose least eigenvalue is largest.
- The small constant on the diagonal (diagonal loading) is `LOADING` times that eigenvalue. It is subtracted from the
  Gram matrix of the mean first, so that it does not shift the mean.
- A random Gram matrix is converted to 15 coefficients as H(F) = v' G v. This is the least squares fit in the norm that
  does not depend on the frame.
"""

from abc import abstractmethod
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.checks import concrete
from pushjax._internal.jit import quick_jit
from pushjax._math.directions import fibonacci_hemisphere
from pushjax._math.linalg import cholesky
from pushjax._math.wishart import sample_wishart
from pushjax.friction.convexity import Gram, antisymmetric_of, coefficients_of, max_feasible_scale
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.feet import Feet
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.sum_of_squares import decompose, squared_quadratics

LOADING = 0.01  # relative to the least eigenvalue of the mean's Gram matrix
ROUNDOFF = 64  # times eps, the least eigenvalue to which the loading raises that matrix, relative to H
DECOMPOSITION_TOLERANCE = 1e-3  # largest error of a sum of squares, relative to the largest coefficient
NUM_RAYS = 200


class SurfaceSample(NamedTuple):
    """A sampled surface, and how it was repaired.

    Attributes:
        surface: The limit surface.
        shrinkage: How far the sample was moved toward the mean to be convex, as a fraction of the distance to the mean.
            Zero if it was convex.
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

    def with_dof(self, dof: Array) -> Self:
        """Return the same distribution with other degrees of freedom, without repeating the precomputation."""
        return eqx.tree_at(lambda s: s.dof, self, dof)


class Deterministic(SurfaceDistribution):
    """The distribution of a surface that is known exactly."""

    mean: LimitSurface

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        return SurfaceSample(self.mean, jnp.zeros_like(self.mean.length))

    def with_dof(self, dof: Array) -> Self:
        return self


class WishartEllipsoid(SurfaceDistribution):
    """Ellipsoids with A ~ W(A_mean, n) / n."""

    mean: Ellipsoid
    factor: Float[Array, "3 3"]  # L with L L' = A_mean
    dof: Float[Array, ""]

    @staticmethod
    def of(mean: Ellipsoid, dof: Array) -> "WishartEllipsoid":
        """Return the distribution around a mean; raise ValueError if A is singular up to roundoff."""
        found = cholesky(mean.A)
        if concrete(found.positive) is not None and not found.positive:
            raise ValueError(
                "surface: A is singular up to roundoff, so no surfaces can be sampled around it; use float64"
            )
        return WishartEllipsoid(mean, found.lower(), dof)  # NaN for a traced singular A

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        surface = eqx.tree_at(lambda s: s.A, self.mean, sample_wishart(key, self.factor, self.dof))
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


class RandomFeet(SurfaceDistribution):
    """Support points with random friction limits."""

    mean: Feet
    dof: Float[Array, ""]

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        half = jnp.where(self.dof > 0, self.dof, jnp.nan) / 2
        factor = jax.random.gamma(key, half, self.mean.limit.shape, half.dtype) / half
        surface = eqx.tree_at(lambda s: s.limit, self.mean, self.mean.limit * factor)
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


class GramQuartic(SurfaceDistribution):
    """Quartics whose Gram matrix has a Wishart distribution."""

    # Only the 6 x 6 block of the 9 x 9 matrix is sampled. H depends on nothing else, and a block of a Wishart matrix is
    # a Wishart matrix too.
    mean: Quartic
    reference: Gram  # that of the mean, toward which samples are pulled
    loading: Float[Array, ""]  # multiple of the identity that is not random
    factor: Float[Array, "6 6"]  # L, where L L' is the 6 x 6 block of the mean's Gram matrix without the loading
    dof: Float[Array, ""]

    @staticmethod
    @quick_jit
    def of(mean: Quartic, dof: Array) -> "GramQuartic":
        c, identity = mean.coefficients, Gram.identity(dof.dtype)
        scale = jax.lax.stop_gradient(c[0] + c[1] + c[2])
        least, n = without_derivatives(_best_gram, c / scale)
        gram = Gram.of(c, scale * n)
        # For a mean on the border of convexity the least eigenvalue is zero, up to the tolerance of the search. Then
        # the loading is a very small negative number, and the Gram matrix of the mean is not positive definite, so
        # pulling a sample toward it does not help in every direction. Add a very small multiple of a ball to it, whose
        # eigenvalues are a third or more. (The identity is no Gram matrix of a quartic: it would prove nothing.)
        margin = ROUNDOFF * float(jnp.finfo(dof.dtype).eps)
        loading = scale * jnp.where(least > margin, LOADING * least, least - margin)
        reference = gram.plus(jnp.maximum(-6 * loading, 0), Gram.ball(dof.dtype))
        # NaN for a traced mean that has no Gram matrix, up to any loading
        return GramQuartic(mean, reference, loading, cholesky(gram.plus(-loading, identity).symmetric).lower(), dof)

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        drawn = sample_wishart(key, self.factor, self.dof) + self.loading * Gram.identity(self.dof.dtype).symmetric
        coefficients, mean = coefficients_of(drawn), coefficients_of(self.reference.symmetric)
        scale = without_derivatives(_certified_scale, drawn, self.reference)
        # A sample that is not within the range of the search is replaced by the mean.
        shrinkage = jnp.where(jnp.isfinite(scale), jnp.maximum(-scale, 0) / (1 - jnp.minimum(scale, 0)), 1.0)
        repaired = coefficients + shrinkage * (mean - coefficients)
        return SurfaceSample(eqx.tree_at(lambda s: s.coefficients, self.mean, repaired), shrinkage)


def _best_gram(coefficients: Float[Array, "15"]) -> tuple[Float[Array, ""], Float[Array, "6"]]:
    """Find the Gram matrix of a quartic whose least eigenvalue is largest; return that eigenvalue, and N."""
    dtype = coefficients.dtype
    start = jnp.asarray([0.2, 0.2, 0.2, 0, 0, 0], dtype)
    tolerance = 1e-6 if dtype == jnp.float64 else 1e-4
    gram, identity = Gram.of(coefficients, start), Gram.identity(dtype)
    found = max_feasible_scale(gram, identity, enough=np.inf, tolerance=tolerance)
    return found.scale, start + found.change


def _certified_scale(symmetric: Float[Array, "6 6"], reference: Gram) -> Float[Array, ""]:
    """Return a number that is not negative if a quartic is convex, else minus the multiple of `reference` to add."""
    gram = Gram(symmetric, antisymmetric_of(symmetric))
    return max_feasible_scale(gram, reference, enough=0.0, tolerance=1e-3).scale


class SumOfSquaresQuartic(SurfaceDistribution):
    """Quartics that are sums of squared quadratic forms, the matrix of each with a Wishart distribution.

    Attributes:
        mean: The mean surface.
        factors: Lower triangular L_k with L_k L_k' = P_k, the matrices of the mean, shape (terms, 3, 3).
        term_dof: Degrees of freedom m of each random matrix, which are not the n of the other distributions.
    """

    mean: Quartic
    factors: Float[Array, "terms 3 3"]
    term_dof: Float[Array, ""]

    @staticmethod
    def of(mean: Quartic, dof: Array, factors: Array | None = None) -> "SumOfSquaresQuartic":
        """Return the distribution around a mean.

        Args:
            mean: The mean surface.
            dof: Degrees of freedom n: the relative variance of H, averaged over rays, is 2 / n.
            factors: Lower triangular factors of the P_k of the mean, shape (terms, 3, 3), where they are known.

        Raises:
            ValueError: If the mean is not a sum of five squared quadratic forms. Not checked for traced values.
        """
        if factors is not None:
            return SumOfSquaresQuartic(mean, factors, dof_of_terms(factors, dof))
        terms = quick_jit(decompose)(mean.coefficients)
        error = concrete(terms.error)
        if error is not None and not error < DECOMPOSITION_TOLERANCE:
            raise ValueError(
                f"surface: the nearest sum of five squared quadratic forms is {error:.1g} of its coefficients away; "
                "the sampler 'gram' takes every convex quartic"
            )
        return SumOfSquaresQuartic(mean, terms.lower, dof_of_terms(terms.lower, dof))

    def with_dof(self, dof: Array) -> Self:
        return eqx.tree_at(lambda s: s.term_dof, self, dof_of_terms(self.factors, dof))

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        keys = jax.random.split(key, len(self.factors))
        forms = jax.vmap(sample_wishart, (0, 0, None))(keys, self.factors, self.term_dof)
        coefficients = squared_quadratics(forms) / (1 + 2 / self.term_dof)
        surface = eqx.tree_at(lambda s: s.coefficients, self.mean, coefficients)
        return SurfaceSample(surface, jnp.zeros_like(self.term_dof))


def dof_of_terms(factors: Array, dof: Array) -> Array:
    """Return the m for which the relative variance of H, averaged over rays, is 2 / dof."""
    # (F' P F)^2 has the relative variance (8 m + 24) / (m (m + 2)). For a sum, this is multiplied by the sum of the
    # squares of the terms' shares of H, averaged over rays.
    forms = factors @ jnp.swapaxes(factors, 1, 2)
    rays = jnp.asarray(fibonacci_hemisphere(NUM_RAYS), dof.dtype)
    value = jnp.einsum("fi,kij,fj->fk", rays, forms, rays) ** 2
    share = value / jnp.sum(value, axis=1, keepdims=True)
    # With s the mean sum of squared shares: s (8 m + 24) / (m (m + 2)) = 2 / n, so m^2 - b m - 3 (b + 2) = 0.
    b = 4 * jnp.mean(jnp.sum(share**2, axis=1)) * dof - 2
    return (b + jnp.sqrt(b**2 + 12 * (b + 2))) / 2
