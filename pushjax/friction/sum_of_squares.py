"""Convex limit surfaces of degree d as sums of powers of quadratic forms: H(F) = sum_k (F' P_k F)^(d/2).

F is the normalized wrench (fx, fy, tau / length). For d = 4, H is a sum of squares. H is convex if all P_k are positive
semi-definite. So each P_k is parameterized by a lower triangular factor L_k: P_k = L_k L_k'.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.autodiff import without_derivatives
from pushjax._math.directions import fibonacci_hemisphere
from pushjax.friction.quartic import MONOMIAL_SUMS

# With this many terms, a fit is close to the optimum over all convex quartics. `pushjax.friction.fit` says how close.
TERMS = 5
MAX_STEPS = 100  # of the Levenberg-Marquardt method
_LOWER_INDICES = np.array(np.tril_indices(3), np.int32)
LOWER_ENTRIES = np.eye(9)[np.flatnonzero(np.tril(np.ones((3, 3))))]  # (6, 9), from a lower triangle to a matrix


def squared_quadratics(p: Float[Array, "terms 3 3"]) -> Float[Array, "15"]:
    """Return the coefficients of sum_k (F' P_k F)^2 in the order of `Quartic`, for symmetric P_k, `p[k]`."""
    products = jnp.einsum("kij,klm->ijlm", p, p)
    return jnp.asarray(MONOMIAL_SUMS, p.dtype) @ products.reshape(81)


def quadratic_forms(lower: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    """Return P_k = L_k L_k', given the lower triangles of L_k, row by row."""
    full = unpack_lower(lower)
    return full @ jnp.swapaxes(full, 1, 2)


def unpack_lower(lower: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    """Return the matrices L_k, given their lower triangles, row by row."""
    return jnp.zeros((lower.shape[0], 3, 3), lower.dtype).at[:, *_LOWER_INDICES].set(lower)


def initial_factors(degree: int, terms: int, dtype: Any) -> np.ndarray:
    """Return the lower triangles of the L_k at which a search begins, row by row, (terms, 6)."""
    # Each P_k is a multiple of the identity, stretched along a direction of its own, because equal terms would stay
    # equal throughout the search. A single term is not stretched.
    directions = fibonacci_hemisphere(terms)
    stretch = 0.5 if terms > 1 else 0.0
    lower = np.linalg.cholesky(np.eye(3) + stretch * (3 * directions[:, :, None] * directions[:, None] - np.eye(3)))
    scale = terms ** (-1 / degree)
    return (scale * lower[:, *_LOWER_INDICES]).astype(dtype)


class SumOfSquares(NamedTuple):
    """A quartic as a sum of squares."""

    lower: Float[Array, "terms 3 3"]  # the factors L_k
    error: Float[Array, ""]  # largest error of a coefficient of the sum, relative to the largest coefficient


def decompose(coefficients: Float[Array, "15"], terms: int = TERMS) -> SumOfSquares:
    """Write a quartic as a sum of squares of quadratic forms."""
    # The terms are not unique. The Levenberg-Marquardt method reaches these from `initial_factors`. Every result of
    # `fit_limit_surface` is such a sum. Not every convex quartic is; if it is not, `error` is large.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(coefficients)))
    target = coefficients / scale
    start = jnp.asarray(initial_factors(4, terms, coefficients.dtype))
    factors = without_derivatives(_search_factors, target, start)
    # many changes of the L_k meet a change of the coefficients; the derivative is the smallest
    jacobian = jax.lax.stop_gradient(jax.jacobian(_coefficients)(factors).reshape(target.size, -1))
    change = target - jax.lax.stop_gradient(target)
    factors = factors + (jnp.linalg.pinv(jacobian) @ change).reshape(factors.shape)
    return SumOfSquares(unpack_lower(factors) * scale**0.25, jnp.max(jnp.abs(_coefficients(factors) - target)))


def _coefficients(lower: Float[Array, "terms 6"]) -> Float[Array, "15"]:
    """Return the coefficients of the quartic whose factors L_k have these lower triangles, row by row."""
    return squared_quadratics(quadratic_forms(lower))


def _search_factors(target: Float[Array, "15"], start: Float[Array, "terms 6"]) -> Float[Array, "terms 6"]:
    """Return the lower triangles of the L_k whose quartic is nearest to the coefficients `target`."""
    # Optimistix keeps its own state in the widest float type that is enabled, and it does not mix two types.
    wide = jnp.result_type(float)
    tolerance = 1e-12 if wide == jnp.float64 else 1e-6
    import optimistix as optx  # here, because it takes half as long to import as JAX

    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    target, first = target.astype(wide), start.astype(wide)
    found = optx.least_squares(lambda x, _: _coefficients(x) - target, solver, first, max_steps=MAX_STEPS, throw=False)
    return found.value.astype(start.dtype)
