"""Limit surfaces of several sliders, made linear at a wrench.

The gauge of a limit surface, gamma(F) = H(F)^(1/d), is one on it and grows in proportion to the wrench F. While a
slider slides, V = s grad gamma(F), where s is its dissipation V . F. Near a wrench F0 this is

    V = s n + s C (F - F0),   0 <= s  _|_  1 - n . F >= 0,

with the normal n = grad gamma and the curvature C = hess gamma at gamma = 1. A slider whose limit surface were the
ellipsoid F . (C + n n') F = 1 would move in the same way at F0, and one that resists in proportion to its motion would
have the law V = s (C + n n') F.

Arrays have components first, then sliders, and the batch last.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax.friction.polynomial import Polynomial
from pushjax.friction.support_points import SupportPoints


class MixedSurfaces(NamedTuple):
    """The limit surfaces of sliders, some of which are exact."""

    polynomial: Polynomial
    points: SupportPoints
    is_exact: Bool[Array, "sliders *batch"]

    def patch(
        self, wrench: Float[Array, "3 *rest sliders batch"], near: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """As of each kind."""
        both = zip(self.points.patch(wrench, near), self.polynomial.patch(wrench), strict=True)
        gauge, normal, curvature = (
            jnp.where(jnp.broadcast_to(self.is_exact, exact.shape), exact, smooth) for exact, smooth in both
        )
        return gauge, normal, curvature

    def mean_ellipsoid(self, wrench: Float[Array, "3 sliders batch"]) -> Float[Array, "3 3 sliders batch"]:
        """As of each kind."""
        exact, smooth = self.points.mean_ellipsoid(wrench), self.polynomial.mean_ellipsoid(wrench)
        return jnp.where(jnp.broadcast_to(self.is_exact, exact.shape), exact, smooth)

    def reweighted(self, twist: Array, ellipsoid: Array, weight: Array) -> tuple[Array, Array]:
        """As of each kind."""
        own, own_weight = self.points.reweighted(twist, ellipsoid, weight)
        is_exact = jnp.broadcast_to(self.is_exact, weight.shape)
        return jnp.where(is_exact[None, None], own, ellipsoid), jnp.where(is_exact, own_weight, weight)

    def usable(self) -> tuple["MixedSurfaces", Bool[Array, " batch"]]:
        """Those without numbers that cannot be computed with, and whether there were none."""
        polynomial, are_finite = self.polynomial.usable()
        points, are_valid = self.points.usable()
        return MixedSurfaces(polynomial, points, self.is_exact), are_finite & are_valid


Surface = Polynomial | SupportPoints | MixedSurfaces  # of all sliders; its arrays have axes for sliders and batch


class LinearPatch(NamedTuple):
    """A limit surface at a wrench."""

    gauge: Float[Array, "*rest sliders batch"]  # gamma of the wrench
    normal: Float[Array, "3 *rest sliders batch"]  # n
    curvature: Float[Array, "3 3 *rest sliders batch"]  # C

    @staticmethod
    def at(surface: Surface, wrench: Float[Array, "3 *rest sliders batch"], near: Array | None = None) -> "LinearPatch":
        """The limit surface at a wrench, with a normal `near` by; for a zero wrench at another one, with gauge zero."""
        size = jnp.max(jnp.abs(wrench), axis=0)
        acts = size > jnp.finfo(size.dtype).tiny ** 0.2  # of a smaller one, H may be zero
        axis = jnp.zeros_like(wrench).at[0].set(1.0)
        gauge, normal, curvature = surface.patch(jnp.where(acts[None], wrench, axis), near)
        return LinearPatch(jnp.where(acts, gauge, 0.0), normal, curvature)

    def ellipsoid(self) -> Float[Array, "3 3 *rest sliders batch"]:
        """The matrix of the ellipsoid that agrees with the limit surface here."""
        return self.curvature + self.normal[:, None] * self.normal[None]
