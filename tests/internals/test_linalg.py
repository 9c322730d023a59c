"""Small linear equations with the batch last, compared with NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax._math.linalg import solve


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1, 3, 12])
def test_solutions_are_those_of_numpy(size, dtype):
    """Also where a pivot on the diagonal is zero."""
    rng = np.random.default_rng(size)
    matrix, right = rng.normal(size=(200, size, size)), rng.normal(size=(200, size))
    if size > 1:
        matrix[:100, np.arange(size), np.arange(size)] = 0.0
    expected = np.linalg.solve(matrix, right[..., None])[..., 0].T
    found = jax.jit(solve)(jnp.asarray(np.moveaxis(matrix, 0, -1), dtype), jnp.asarray(right.T, dtype))
    assert found.dtype == dtype
    error = np.linalg.norm(found - expected, axis=0) / np.linalg.norm(expected, axis=0)
    assert np.max(error / np.linalg.cond(matrix)) < 10 * np.finfo(dtype).eps


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives(mode):
    """By the matrix and the right side."""
    rng = np.random.default_rng(0)
    matrix, right = rng.normal(size=(4, 4)), rng.normal(size=4)
    by_matrix, by_right = mode(lambda *args: solve(args[0][..., None], args[1][:, None])[:, 0], (0, 1))(matrix, right)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(by_right, inverse, rtol=1e-10)
    np.testing.assert_allclose(by_matrix, -np.einsum("ij,k->ijk", inverse, inverse @ right), rtol=1e-10)


def test_a_singular_matrix_of_a_batch_leaves_the_others_alone():
    matrix = jnp.stack([jnp.zeros((3, 3)), 2 * jnp.eye(3), jnp.full((3, 3), jnp.nan)], axis=-1)
    found = solve(matrix, jnp.ones((3, 3)))
    np.testing.assert_array_equal(found[:, 1], 0.5)
    assert not np.any(np.isfinite(np.asarray(found)[:, [0, 2]]))
