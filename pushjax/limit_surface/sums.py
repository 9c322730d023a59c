"""Convex surfaces as sums: H(F) = sum_k (F' P_k F)^(d/2) is convex for any positive semi-definite P_k."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax.limit_surface.quartic import MONOMIALS


def squared_quadratics(p: Float[Array, "terms 3 3"]) -> Float[Array, "15"]:
    """Coefficients of sum_k (F' P_k F)^2, in `Quartic`'s order. P_k symmetric, (terms, 3, 3)."""
    products = jnp.einsum("kij,klm->ijlm", p, p)
    return jnp.asarray(_COLLECT, p.dtype) @ products.reshape(81)


def _collect() -> np.ndarray:
    """Adds the entries of a 3 x 3 x 3 x 3 array that belong to one monomial."""
    table = np.zeros((len(MONOMIALS), 81))
    for flat, index in enumerate(np.ndindex(3, 3, 3, 3)):
        exponent = np.bincount(index, minlength=3)
        table[int(np.argmax((MONOMIALS == exponent).all(axis=1))), flat] = 1
    return table


_COLLECT = _collect()
