"""Random friction: limit surfaces and contact friction drawn around a mean, every one of them physically consistent.

Ellipsoid         A ~ W(A_mean, n) / n, Wishart's distribution: mean A_mean, variance (A_ij^2 + A_ii A_jj) / n.
Quartic, "gram"   the Gram matrix ~ W(G, n) / n, G that of the mean. Along every ray H varies as for an ellipsoid of the
                  same n: relative variance 2 / n. Not all samples are convex; each is certified
                  (`limit_surface.gram`), and what is not is pulled towards the mean, by as little as the certificate
                  allows.
Quartic, "terms"  H = sum_k (F' P_k F)^2, each P_k ~ W(P_k, m) / m over sqrt(1 + 2 / m): mean H exactly, and always
                  convex. m is such that the relative variance of H, in the mean over rays, is 2 / n too.

Everything is a smooth function of standard draws (Bartlett's decomposition), so there are derivatives by `dof`, by the
range of the friction and by the mean; the pull of a repaired sample, and the terms of a mean, are held fixed.

Source: Zhou et al. 2017, section V. What that leaves open: the Gram matrix that stands for the mean is the one whose
least eigenvalue is largest; the small constant on the diagonal is `LOADING` of that eigenvalue, and the mean's own
share of it, so that it does not shift the mean; and a random Gram matrix goes back to 15 coefficients as H(F) = v' G v,
which is the least squares fit in the norm that depends on no frame.
"""

from abc import abstractmethod
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._autodiff import undifferentiated
from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, non_negative, shaped
from pushjax._programs import quickly_compiled
from pushjax._wishart import lower_of, wishart
from pushjax.limit_surface import Ellipsoid, LimitSurface, Quartic
from pushjax.limit_surface._dense import Cholesky, Lower, combined, entry
from pushjax.limit_surface._rays import half_sphere
from pushjax.limit_surface.gram import Gram, antisymmetric_of, coefficients_of, largest_share
from pushjax.limit_surface.sums import split, squared_quadratics

Sampler = Literal["gram", "terms"]
# Of the least eigenvalue of the mean's Gram matrix
LOADING = 0.01
SPLIT_TOLERANCE = 1e-3  # of the largest coefficient, that a sum of squares may be off
RAYS = 200


class SurfaceSample(NamedTuple):
    """A drawn surface. pull: how far it was moved towards the mean to be convex, of the way there; zero if it was."""

    surface: LimitSurface
    pull: Float[Array, ""]


class RandomSurface(eqx.Module):
    """Limit surfaces around one that is their mean."""

    mean: eqx.AbstractVar[LimitSurface]

    @abstractmethod
    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        """One surface. Batches come from `vmap` over keys."""

    @abstractmethod
    def with_dof(self, dof: Array) -> "RandomSurface":
        """Around the same mean, but with so many degrees of freedom: what `around` has worked out is not again."""


class FrictionModel(eqx.Module):
    """How uncertain friction is: the limit surface's, and that between the fingers and the slider.

    every: a rollout draws anew after so many steps; None: once.

    dof: n, the degrees of freedom: the relative variance of H along a ray is 2 / n. At least 3 for an `Ellipsoid`, at
    least 9 for a `Quartic` (the size of the matrix that is drawn); need not be whole. None: the surface is certain.
    friction: mu, or the range (lowest, highest) on which it is uniform. sampler: of a `Quartic`, see this module's
    header; "gram" (the paper's) takes any, "terms" one that is a sum of squared quadratic forms, as all fits are.

    Raises ValueError for a dof that is not finite and at least 3, a friction that is negative, not finite or upside
    down, another sampler, or an `every` that is no number of steps.
    """

    dof: Float[Array, ""] | None
    friction: Float[Array, "2"]
    sampler: Sampler = eqx.field(static=True)
    every: int | None = eqx.field(static=True)

    def __init__(self, dof: Numeric | None, friction: Numeric, sampler: Sampler = "gram", *, every: int | None = None):
        dtype = common_dtype(dof, friction)
        if sampler not in ("gram", "terms"):
            raise ValueError(f"sampler must be 'gram' or 'terms'; got {sampler!r}")
        if every is not None and (not isinstance(every, (int, np.integer)) or every < 1):
            raise ValueError(f"every must be a whole number of steps, at least 1, or None; got {every!r}")
        self.sampler, self.every = sampler, None if every is None else int(every)
        self.dof = None
        if dof is not None:
            self.dof = as_float(dof, dtype)
            shaped("dof", self.dof, ())
            finite("dof", self.dof)
            _at_least(self.dof, 3, "an ellipsoid's matrix")
        mu = as_float(friction, dtype)
        if mu.shape not in ((), (2,)):
            raise ValueError(f"friction has shape {mu.shape}; expected a scalar or (2,), lowest and highest")
        finite("friction", mu)
        non_negative("friction", mu)
        self.friction = jnp.broadcast_to(mu, (2,))
        known = concrete(self.friction)
        if known is not None and known[0] > known[1]:
            raise ValueError(f"friction must be (lowest, highest); got ({known[0]:g}, {known[1]:g})")

    def around(self, surface: LimitSurface) -> RandomSurface:
        """The surfaces around a mean: what costs time once, for many draws.

        Raises ValueError for a dof below 9 around a `Quartic`, and, of the sampler "terms", for one that is no sum of
        five squared quadratic forms, where they are not traced.
        """
        dtype = surface.length.dtype
        if self.dof is None:
            return _Certain(surface)
        dof = self.dof.astype(dtype)
        if isinstance(surface, Ellipsoid):
            return _WishartEllipsoid.of(surface, dof)
        if not isinstance(surface, Quartic):
            raise TypeError(f"surface: expected an Ellipsoid or a Quartic; got a {type(surface).__name__}")
        _at_least(dof, 9, "a quartic's Gram matrix")
        return (_GramQuartic if self.sampler == "gram" else TermsQuartic).of(surface, dof)

    def sample(self, key: PRNGKeyArray, surface: LimitSurface) -> tuple[LimitSurface, Float[Array, ""]]:
        """A limit surface around `surface`, and mu. For many draws, `vmap` over keys; or `around` once, outside.

        Raises ValueError as `around` does.
        """
        first, second = jax.random.split(key)
        return self.around(surface).sample(first).surface, self.sample_friction(second)

    def sample_friction(self, key: PRNGKeyArray) -> Float[Array, ""]:
        """mu."""
        low, high = self.friction
        return low + (high - low) * jax.random.uniform(key, (), self.friction.dtype)


def _at_least(dof: Array, least: int, what: str) -> None:
    known = concrete(dof)
    if known is not None and not known >= least:
        raise ValueError(f"dof must be at least {least}, the size of {what}; got {known:g}")


class _Certain(RandomSurface):
    mean: LimitSurface

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        return SurfaceSample(self.mean, jnp.zeros_like(self.mean.length))

    def with_dof(self, dof: Array) -> "_Certain":
        return self


class _WishartEllipsoid(RandomSurface):
    """factor: L, with L L' = A."""

    mean: Ellipsoid
    factor: Lower
    dof: Float[Array, ""]

    @staticmethod
    def of(mean: Ellipsoid, dof: Array) -> "_WishartEllipsoid":
        return _WishartEllipsoid(mean, Cholesky.of(lower_of(mean.A)).lower, dof)

    def with_dof(self, dof: Array) -> "_WishartEllipsoid":
        return eqx.tree_at(lambda s: s.dof, self, dof)

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        drawn = wishart(key, self.factor, self.dof)
        rows = [[entry(drawn, i, j) for j in range(3)] for i in range(3)]
        surface = eqx.tree_at(lambda s: s.A, self.mean, jnp.array(rows))
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


class _GramQuartic(RandomSurface):
    """gram: of the mean. loading: of the identity, what is certain of it. factor: L, L L' the rest of its 6 x 6 block.

    That block is all of the 9 x 9 matrix that H depends on, and the block of a Wishart matrix is one too.
    """

    mean: Quartic
    gram: Gram
    loading: Float[Array, ""]
    factor: Lower
    dof: Float[Array, ""]

    @staticmethod
    @quickly_compiled
    def of(mean: Quartic, dof: Array) -> "_GramQuartic":
        form = mean.form()
        size = jax.lax.stop_gradient(form.c[0] + form.c[1] + form.c[2])
        scaled = tuple(c / size for c in form.c)
        canonical = undifferentiated(_canonical, scaled)
        gram = Gram.of(form.c, tuple(size * n for n in canonical.n))
        least = canonical.share
        # of a mean on the border of convexity the least eigenvalue is zero, give or take the search's tolerance
        loading = size * jnp.where(least > 0, LOADING * least, least)
        within = gram.plus(-loading, Gram.identity(loading)).symmetric
        return _GramQuartic(mean, gram, loading, Cholesky.of(within).lower, dof)

    def with_dof(self, dof: Array) -> "_GramQuartic":
        return eqx.tree_at(lambda s: s.dof, self, dof)

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        identity = Gram.identity(self.loading)
        drawn = combined(wishart(key, self.factor, self.dof), self.loading, identity.symmetric)
        coefficients = coefficients_of(drawn)
        # a mean on the border is no measure in every direction: a hair is added to it
        reference = self.gram.plus(jnp.maximum(-2 * self.loading, 0), identity)
        mean = coefficients_of(reference.symmetric)
        found = undifferentiated(_certified, coefficients, antisymmetric_of(drawn), reference)
        pull = jnp.where(found.share < 0, -found.share / (1 - found.share), 0.0)
        pull = jnp.where(jnp.isfinite(found.share), pull, 1.0)  # never seen: of numbers that are none
        moved = [c + pull * (m - c) for c, m in zip(coefficients, mean, strict=True)]
        return SurfaceSample(eqx.tree_at(lambda s: s.coefficients, self.mean, jnp.stack(moved)), pull)


def _canonical(coefficients):
    one = jnp.ones_like(coefficients[0])
    ball = (0.2 * one,) * 3 + (0 * one,) * 3
    tolerance = 1e-6 if one.dtype == jnp.float64 else 1e-4
    return largest_share(coefficients, ball, Gram.identity(one), enough=np.inf, tolerance=tolerance)


def _certified(coefficients, n, reference):
    return largest_share(coefficients, n, reference, enough=0.0, tolerance=1e-3)


class TermsQuartic(RandomSurface):
    """lower: (terms, 3, 3), the factors of P_k. dof: m, of each."""

    mean: Quartic
    lower: Float[Array, "terms 3 3"]
    dof: Float[Array, ""]

    @staticmethod
    def of(mean: Quartic, dof: Array) -> "TermsQuartic":
        terms = quickly_compiled(split)(mean.coefficients)
        error = concrete(terms.error)
        if error is not None and not error < SPLIT_TOLERANCE:
            raise ValueError(
                f"surface: the nearest sum of five squared quadratic forms is {error:.1g} of its coefficients away; "
                "the sampler 'gram' takes every convex quartic"
            )
        return TermsQuartic(mean, terms.lower, dof_of_terms(terms.lower, dof))

    @staticmethod
    def of_terms(mean: Quartic, lower: Array, dof: Array) -> "TermsQuartic":
        """Of a mean whose factors are known."""
        return TermsQuartic(mean, lower, dof_of_terms(lower, dof))

    def with_dof(self, dof: Array) -> "TermsQuartic":
        return eqx.tree_at(lambda s: s.dof, self, dof_of_terms(self.lower, dof))

    def sample(self, key: PRNGKeyArray) -> SurfaceSample:
        def term(lower: Array, key: PRNGKeyArray) -> Array:
            drawn = wishart(key, lower_of(lower), self.dof)
            return jnp.array([[entry(drawn, i, j) for j in range(3)] for i in range(3)])

        forms = jax.vmap(term)(self.lower, jax.random.split(key, self.lower.shape[0]))
        coefficients = squared_quadratics(forms) / (1 + 2 / self.dof)
        surface = eqx.tree_at(lambda s: s.coefficients, self.mean, coefficients)
        return SurfaceSample(surface, jnp.zeros_like(self.dof))


def dof_of_terms(lower: Array, dof: Array) -> Array:
    """m, with which the relative variance of H, in the mean over rays, is 2 / dof.

    (F' P F)^2 has the relative variance (8 m + 24) / (m (m + 2)); of a sum, that times the mean of the terms' squared
    shares of H.
    """
    forms = lower @ jnp.swapaxes(lower, 1, 2)
    rays = jnp.asarray(half_sphere(RAYS), dof.dtype)
    each = jnp.einsum("fi,kij,fj->fk", rays, forms, rays) ** 2
    share = each / jnp.sum(each, axis=1, keepdims=True)
    b = 4 * jnp.mean(jnp.sum(share**2, axis=1)) * dof - 2
    return (b + jnp.sqrt(b**2 + 12 * (b + 2))) / 2
