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
import numpy as np
from jaxtyping import Array, Float

from pushjax.friction.polynomial import Polynomial

# Directions of wrenches whose ellipsoids are averaged for a first law: along the axes and the diagonals.
DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [1, 1, -1], [1, -1, -1]])


class LinearPatch(NamedTuple):
    """A limit surface at a wrench."""

    gauge: Float[Array, "*rest sliders batch"]  # gamma of the wrench
    normal: Float[Array, "3 *rest sliders batch"]  # n
    curvature: Float[Array, "3 3 *rest sliders batch"]  # C

    @staticmethod
    def at(surface: Polynomial, wrench: Float[Array, "3 *rest sliders batch"]) -> "LinearPatch":
        """The limit surface at a wrench; for a zero wrench, at another one, with a gauge of zero."""
        degree, acts = surface.degree, surface.value(wrench) > 0
        axis = jnp.zeros_like(wrench).at[0].set(1.0)
        wrench = jnp.where(acts[None], wrench, axis)
        gauge = surface.root(surface.value(wrench))
        wrench = wrench / gauge[None]
        normal = surface.gradient(wrench) / degree
        curvature = surface.hessian(wrench) / degree - (degree - 1) * normal[:, None] * normal[None]
        return LinearPatch(jnp.where(acts, gauge, 0.0), normal, curvature)

    def ellipsoid(self) -> Float[Array, "3 3 *rest sliders batch"]:
        """The matrix of the ellipsoid that agrees with the limit surface here."""
        return self.curvature + self.normal[:, None] * self.normal[None]


def mean_ellipsoid(surface: Polynomial, like: Float[Array, "3 sliders batch"]) -> Float[Array, "3 3 sliders batch"]:
    """The mean of the ellipsoids that agree with a limit surface at some wrenches."""
    directions = jnp.asarray(DIRECTIONS.T, like.dtype)[:, :, None, None]
    wrenches = jnp.broadcast_to(directions, (*directions.shape[:2], *like.shape[1:]))
    return jnp.mean(LinearPatch.at(surface, wrenches).ellipsoid(), axis=2)
