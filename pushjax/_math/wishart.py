"""Random Wishart matrices, sampled by Bartlett's decomposition."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from pushjax._math.linalg import Lower, multiply_lower, times_transpose
from pushjax._math.vec import Scalar, unstack


def sample_wishart(key: PRNGKeyArray, factor: Lower, dof: Scalar) -> Lower:
    """Sample a Wishart matrix W(L L', dof), divided by dof so that its mean is L L'.

    Differentiable in `factor` and `dof`.

    Args:
        key: PRNG key.
        factor: L, lower triangular with n rows.
        dof: Degrees of freedom, above n - 1.

    Returns:
        The lower triangle of the symmetric matrix. All entries are NaN if `dof` is not above n - 1.
    """
    return times_transpose(multiply_lower(factor, bartlett(key, len(factor), dof)))


def bartlett(key: PRNGKeyArray, size: int, dof: Scalar) -> Lower:
    """Return a random lower triangular T with T T' ~ W(I, dof) / dof; NaN unless `dof` is above `size` - 1."""
    lower_key, diagonal_key = jax.random.split(key)
    normal_draws = jax.random.normal(lower_key, (size * (size - 1) // 2,), dof.dtype)
    chi_squares = 2 * jax.random.gamma(diagonal_key, (dof - jnp.arange(size, dtype=dof.dtype)) / 2, dtype=dof.dtype)
    chi_squares = jnp.where(dof > size - 1, chi_squares, jnp.nan)  # every entry of T T' has one of these as a factor
    scale = jax.lax.rsqrt(dof)
    normals, chis = iter(unstack(normal_draws * scale)), unstack(jnp.sqrt(chi_squares) * scale)
    return tuple((*(next(normals) for _ in range(i)), chis[i]) for i in range(size))


def tril(matrix: Array) -> Lower:
    """Return the lower triangle of an array (n, n)."""
    size = matrix.shape[0]
    return tuple(tuple(matrix[i, j] for j in range(i + 1)) for i in range(size))
