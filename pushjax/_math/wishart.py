"""Random Wishart matrices, sampled by Bartlett's decomposition."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray


def sample_wishart(key: PRNGKeyArray, factor: Float[Array, "n n"], dof: Float[Array, ""]) -> Float[Array, "n n"]:
    """Sample a Wishart matrix W(L L', dof) / dof, whose mean is L L', for a lower triangular `factor` L.

    Differentiable in `factor` and `dof`. All entries are NaN if `dof` is not above n - 1.
    """
    # sums, because a matrix product of single precision is rounded to ten bits on some accelerators
    root = jnp.sum(factor[:, :, None] * bartlett(key, len(factor), dof)[None], axis=1)
    return jnp.sum(root[:, None] * root[None], axis=2)


def bartlett(key: PRNGKeyArray, size: int, dof: Float[Array, ""]) -> Float[Array, "n n"]:
    """Return a random lower triangular T with T T' ~ W(I, dof) / dof; NaN unless `dof` is above `size` - 1."""
    lower_key, diagonal_key = jax.random.split(key)
    normals = jax.random.normal(lower_key, (size * (size - 1) // 2,), dof.dtype)
    chi_squares = 2 * jax.random.gamma(diagonal_key, (dof - jnp.arange(size, dtype=dof.dtype)) / 2, dtype=dof.dtype)
    chi_squares = jnp.where(dof > size - 1, chi_squares, jnp.nan)  # every entry of T T' has one of these as a factor
    # where each entry of T stands among the normals, the roots of the chi-squares, and a zero
    place = np.full((size, size), -1)
    place[np.tril_indices(size, -1)] = np.arange(normals.size)
    np.fill_diagonal(place, normals.size + np.arange(size))
    return jnp.concatenate([normals, jnp.sqrt(chi_squares), jnp.zeros_like(dof)[None]])[place] * jax.lax.rsqrt(dof)
