"""Random friction: the limit surface and the contact friction that a `FrictionModel` samples around their means."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_count,
    check_finite,
    check_non_negative,
    common_dtype,
    concrete,
    warn,
)
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.feet import Feet
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.surface_distributions import (
    Deterministic,
    GramQuartic,
    RandomFeet,
    SumOfSquaresQuartic,
    SurfaceDistribution,
    WishartEllipsoid,
)

Sampler = Literal["gram", "sum_of_squares"]
MAX_FRICTION = 5.0  # a larger coefficient of friction is probably in percent


def warn_about_percent(friction: float) -> None:
    """Warn if a coefficient of friction is so large that it is probably in percent."""
    if friction > MAX_FRICTION:
        warn(f"friction: mu is up to {friction:.3g}, and rarely more than 1: is it in percent?")


class FrictionModel(eqx.Module):
    """Uncertainty of friction: of the limit surface, and of the contact friction between fingers and slider.

    Args:
        dof: Degrees of freedom n of the Wishart distribution, at least 3 for an `Ellipsoid` and at least 9 for a
            `Quartic` (the size of the sampled matrix). It need not be an integer. The relative variance of H along a
            ray is 2 / n; for exact support points, that of the friction limit of each. None if the limit surface is
            known exactly. Not checked if traced.
        friction: Coefficient of contact friction mu, or the range (lowest, highest), shape (2,), on which it is
            uniformly distributed.
        sampler: Distribution of a `Quartic`. "gram" (Zhou et al. 2017) takes every convex quartic, and repairs samples
            that are not convex. "sum_of_squares" takes a sum of squared quadratic forms, as fits about the center of
            pressure are; its samples are always convex.
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
        if resample_every is not None:
            check_count("resample_every", resample_every)
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
            The distribution, whose `sample` returns random surfaces.

        Raises:
            ValueError: If the mean is a `Quartic` and `dof` is less than 9, or if the sampler is "sum_of_squares" and
                the quartic is not a sum of five squared quadratic forms. Not checked for traced values.
            TypeError: If the surface is not an `Ellipsoid`, a `Quartic` or `Feet`.
        """
        dtype = surface.length.dtype
        if self.dof is None:
            return Deterministic(surface)
        dof = self.dof.astype(dtype)
        if isinstance(surface, Ellipsoid):
            return WishartEllipsoid.of(surface, dof)
        if isinstance(surface, Feet):
            return RandomFeet(surface, dof)
        if not isinstance(surface, Quartic):
            raise TypeError(f"surface: expected an Ellipsoid, a Quartic or Feet; got a {type(surface).__name__}")
        _check_dof(dof, 9, "a quartic's Gram matrix")
        return (GramQuartic if self.sampler == "gram" else SumOfSquaresQuartic).of(surface, dof)

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
