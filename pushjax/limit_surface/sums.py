"""Convex surfaces as sums: H(F) = sum_k (F' P_k F)^(d/2) is convex for any positive semi-definite P_k."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from pushjax._autodiff import undifferentiated
from pushjax.limit_surface._rays import half_sphere
from pushjax.limit_surface.quartic import MONOMIALS

TERMS = 5  # with which a fit reaches the optimum over all convex quartics
MAX_STEPS = 100
_LOWER = np.tril_indices(3)


def squared_quadratics(p: Float[Array, "terms 3 3"]) -> Float[Array, "15"]:
    """Coefficients of sum_k (F' P_k F)^2, in `Quartic`'s order. P_k symmetric, (terms, 3, 3)."""
    products = jnp.einsum("kij,klm->ijlm", p, p)
    return jnp.asarray(_COLLECT, p.dtype) @ products.reshape(81)


def of_lower(lower: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    """P_k = L_k L_k', from the lower triangles of L_k, row by row."""
    full = triangles(lower)
    return full @ jnp.swapaxes(full, 1, 2)


def triangles(lower: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    """L_k."""
    return jnp.zeros((lower.shape[0], 3, 3), lower.dtype).at[:, *_LOWER].set(lower)


def near_ball(degree: int, terms: int, dtype: Any) -> Float[Array, "terms 6"]:
    """Where a search for L_k begins. The terms differ, each a ball stretched along its own direction, or they would
    never part."""
    u = half_sphere(terms)
    spread = 0.5 if terms > 1 else 0.0
    lower = np.linalg.cholesky(np.eye(3) + spread * (3 * u[:, :, None] * u[:, None] - np.eye(3)))
    size = terms ** (-1 / degree)
    return jnp.asarray(size * lower[:, *_LOWER], dtype)


class Terms(NamedTuple):
    """lower: (terms, 3, 3), the L_k. error: how far the coefficients of their sum are off, of the largest."""

    lower: Float[Array, "terms 3 3"]
    error: Float[Array, ""]


def split(coefficients: Float[Array, "15"], terms: int = TERMS) -> Terms:
    """Terms whose sum of squares is a given quartic: of many choices the one that Levenberg-Marquardt's method reaches
    from `near_ball`. Every fit is such a sum; a convex quartic need not be, which `error` tells.

    Derivatives are those of the smallest change of the L_k that changes the sum as asked.
    """
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(coefficients)))
    target = coefficients / size
    found = undifferentiated(_search, target, near_ball(4, terms, coefficients.dtype))
    slope = jax.lax.stop_gradient(jax.jacobian(_sum)(found).reshape(len(MONOMIALS), -1))
    off = target - jax.lax.stop_gradient(target)
    found = found + (jnp.linalg.pinv(slope) @ off).reshape(found.shape)
    return Terms(triangles(found) * size**0.25, jnp.max(jnp.abs(_sum(found) - target)))


def _sum(lower: Float[Array, "terms 6"]) -> Float[Array, "15"]:
    return squared_quadratics(of_lower(lower))


def _search(target: Float[Array, "15"], start: Float[Array, "terms 6"]) -> Float[Array, "terms 6"]:
    # the solver keeps its own numbers in the widest float there is, and mixes no two
    wide = jnp.result_type(float)
    tolerance = 1e-12 if wide == jnp.float64 else 1e-6
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    target, first = target.astype(wide), start.astype(wide)
    found = optx.least_squares(lambda x, _: _sum(x) - target, solver, first, max_steps=MAX_STEPS, throw=False)
    return found.value.astype(start.dtype)


def _collect() -> np.ndarray:
    """Adds the entries of a 3 x 3 x 3 x 3 array that belong to one monomial."""
    table = np.zeros((len(MONOMIALS), 81))
    for flat, index in enumerate(np.ndindex(3, 3, 3, 3)):
        exponent = np.bincount(index, minlength=3)
        table[int(np.argmax((MONOMIALS == exponent).all(axis=1))), flat] = 1
    return table


_COLLECT = _collect()
