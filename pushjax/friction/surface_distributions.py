"""Distributions of limit surfaces around a mean, all of whose samples are convex.

There are three that are random, for n degrees of freedom:

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
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.checks import concrete
from pushjax._internal.jit import quick_jit
from pushjax._math.directions import fibonacci_hemisphere
from pushjax._math.linalg import Cholesky, Lower, add_scaled, entry
from pushjax._math.wishart import sample_wishart, tril
from pushjax.friction.convexity import Gram, antisymmetric_of, coefficients_of, max_feasible_scale
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.sum_of_squares import decompose, squared_quadratics

LOADING = 0.01  # relative to the least eigenvalue of the mean's Gram matrix
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

    @abstractmethod
    def with_dof(self, dof: Array) -> "SurfaceDistribution":
        """Return the same distribution with other degrees of freedom, without repeating the precomputation."""


class Deterministic(SurfaceDistribution):
    """The distribution of a surface that is known exactly."""

    mean: LimitSurface

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        return SurfaceSample(self.mean, jnp.zeros_like(self.mean.length))

    def with_dof(self, dof: Array) -> "Deterministic":
        return self


class WishartEllipsoid(SurfaceDistribution):
    """Ellipsoids with A ~ W(A_mean, n) / n."""

    mean: Ellipsoid
    factor: Lower  # L with L L' = A_mean
    dof: Float[Array, ""]

    @staticmethod
    def of(mean: Ellipsoid, dof: Array) -> "WishartEllipsoid":
        """Return the distribution around a mean; raise ValueError if A is singular up to roundoff."""
        cholesky = Cholesky.of(tril(mean.A))
        if concrete(cholesky.positive) is not None and not cholesky.positive:
            raise ValueError(
                "surface: A is singular up to roundoff, so no surfaces can be sampled around it; use float64"
            )
        # all samples of a traced singular A are NaN
        factor = jax.tree.map(lambda entry: jnp.where(cholesky.positive, entry, jnp.nan), cholesky.lower)
        return WishartEllipsoid(mean, factor, dof)

    def with_dof(self, dof: Array) -> "WishartEllipsoid":
        return eqx.tree_at(lambda s: s.dof, self, dof)

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        drawn = sample_wishart(key, self.factor, self.dof)
        rows = [[entry(drawn, i, j) for j in range(3)] for i in range(3)]
        surface = eqx.tree_at(lambda s: s.A, self.mean, jnp.array(rows))
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


class GramQuartic(SurfaceDistribution):
    """Quartics whose Gram matrix has a Wishart distribution."""

    # Only the 6 x 6 block of the 9 x 9 matrix is sampled. H depends on nothing else, and a block of a Wishart matrix is
    # a Wishart matrix too.
    mean: Quartic
    gram: Gram
    loading: Float[Array, ""]  # multiple of the identity that is not random
    factor: Lower  # L, where L L' is the 6 x 6 block of `gram` without the loading
    dof: Float[Array, ""]

    @staticmethod
    @quick_jit
    def of(mean: Quartic, dof: Array) -> "GramQuartic":
        form = mean.form()
        scale = jax.lax.stop_gradient(form.c[0] + form.c[1] + form.c[2])
        scaled = tuple(c / scale for c in form.c)
        best = without_derivatives(_best_gram, scaled)
        gram = Gram.of(form.c, tuple(scale * n for n in best.n))
        least = best.scale
        # For a mean on the border of convexity the least eigenvalue is zero, up to the tolerance of the search.
        # Then the loading is zero or a very small negative number.
        loading = scale * jnp.where(least > 0, LOADING * least, least)
        unloaded = gram.plus(-loading, Gram.identity(loading)).symmetric
        return GramQuartic(mean, gram, loading, Cholesky.of(unloaded).lower, dof)

    def with_dof(self, dof: Array) -> "GramQuartic":
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
    """Find the Gram matrix of a quartic whose least eigenvalue is largest: that eigenvalue is `scale`."""
    one = jnp.ones_like(coefficients[0])
    start_n = (0.2 * one,) * 3 + (0 * one,) * 3
    tolerance = 1e-6 if one.dtype == jnp.float64 else 1e-4
    return max_feasible_scale(coefficients, start_n, Gram.identity(one), enough=np.inf, tolerance=tolerance)


def _certify(coefficients, n, reference):
    """Certify that a quartic is convex, or find how much of the Gram matrix `reference` makes it so."""
    # `scale` is not negative if the quartic is convex. Otherwise -`scale` is the multiple of `reference` to add.
    return max_feasible_scale(coefficients, n, reference, enough=0.0, tolerance=1e-3)


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
    def of(mean: Quartic, dof: Array) -> "SumOfSquaresQuartic":
        """Return the distribution around a mean, with n = `dof` degrees of freedom.

        Raises:
            ValueError: If the mean is not a sum of five squared quadratic forms. Not checked for traced values.
        """
        terms = quick_jit(decompose)(mean.coefficients)
        error = concrete(terms.error)
        if error is not None and not error < DECOMPOSITION_TOLERANCE:
            raise ValueError(
                f"surface: the nearest sum of five squared quadratic forms is {error:.1g} of its coefficients away; "
                "the sampler 'gram' takes every convex quartic"
            )
        return SumOfSquaresQuartic(mean, terms.lower, dof_of_terms(terms.lower, dof))

    @staticmethod
    def of_terms(mean: Quartic, factors: Array, dof: Array) -> "SumOfSquaresQuartic":
        """Return the distribution around a mean whose factors are known.

        Args:
            mean: The mean surface.
            factors: Lower triangular factors of the P_k of the mean, shape (terms, 3, 3).
            dof: Degrees of freedom n: the relative variance of H, averaged over rays, is 2 / n.
        """
        return SumOfSquaresQuartic(mean, factors, dof_of_terms(factors, dof))

    def with_dof(self, dof: Array) -> "SumOfSquaresQuartic":
        return eqx.tree_at(lambda s: s.term_dof, self, dof_of_terms(self.factors, dof))

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        def term(factor: Array, key: PRNGKeyArray) -> Array:
            drawn = sample_wishart(key, tril(factor), self.term_dof)
            return jnp.array([[entry(drawn, i, j) for j in range(3)] for i in range(3)])

        forms = jax.vmap(term)(self.factors, jax.random.split(key, self.factors.shape[0]))
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
