"""Wishart matrices by Bartlett's decomposition."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from pushjax._vec import Scalar, entries
from pushjax.limit_surface._dense import Lower, product, squared


def wishart(key: PRNGKeyArray, factor: Lower, dof: Scalar) -> Lower:
    """W(L L', dof) / dof, for the lower triangular L = `factor`. Differentiable in both.

    dof: above the size less one, or nothing is a number.
    """
    return squared(product(factor, bartlett(key, len(factor), dof)))


def bartlett(key: PRNGKeyArray, size: int, dof: Scalar) -> Lower:
    """A lower triangular T with T T' ~ W(I, dof) / dof."""
    below, diagonal = jax.random.split(key)
    off = jax.random.normal(below, (size * (size - 1) // 2,), dof.dtype)
    squares = 2 * jax.random.gamma(diagonal, (dof - jnp.arange(size, dtype=dof.dtype)) / 2, dtype=dof.dtype)
    scale = jax.lax.rsqrt(dof)
    normals, chis = iter(entries(off * scale)), entries(jnp.sqrt(squares) * scale)
    return tuple((*(next(normals) for _ in range(i)), chis[i]) for i in range(size))


def lower_of(matrix: Array) -> Lower:
    """The lower triangle of an array (n, n)."""
    size = matrix.shape[0]
    return tuple(tuple(matrix[i, j] for j in range(i + 1)) for i in range(size))
