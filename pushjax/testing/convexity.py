"""Check of the convexity of quartics by a sweep of the Hessian, without the certificates that it tests."""

import numpy as np

from pushjax._math.arrays import ENTRIES
from pushjax._math.directions import fibonacci_hemisphere
from pushjax.testing.batch import HESSIANS, products

# Number of directions F, on the half sphere, at which the Hessian is evaluated; how many of them are refined; and the
# rounds of refinement.
DIRECTIONS, REFINED, ROUNDS = 200, 4, 12
# (entry of the Hessian, product of two coordinates of F, coefficient of the quartic)
HESSIAN_TABLE = np.stack([HESSIANS[:, i, j].T for i, j in ENTRIES])
AT_ONCE = 500  # quartics, so that their Hessians stay in the processor's cache


def least_curvatures(coefficients: np.ndarray) -> np.ndarray:
    """Return the smallest curvature that a search finds: the minimum of z' hess H(F) z over unit F and z.

    But for roundoff, the result is never below the true minimum. The search evaluates the Hessian in 200 directions F.
    From the four lowest, it improves F and z in turns: z becomes the eigenvector of the smallest eigenvalue of the
    Hessian at F, then F likewise at z (the form is symmetric in F and z). Each step can only lower the value. The
    computation is in float64.

    Args:
        coefficients: Coefficients (n, 15) in the order of `Quartic`.

    Returns:
        The smallest curvatures, (n,), each divided by the largest |coefficient| of its quartic.
    """
    c = np.asarray(coefficients, np.float64).T
    c = c / np.abs(c).max(axis=0)
    return np.concatenate([_least(c[:, k : k + AT_ONCE]) for k in range(0, c.shape[1], AT_ONCE)])


def _least(c: np.ndarray) -> np.ndarray:
    """Return the smallest curvatures (n,) of quartics with coefficients (15, n)."""
    table = np.einsum("epm,mn->epn", HESSIAN_TABLE, c)
    directions = fibonacci_hemisphere(DIRECTIONS).T
    lowest = _least_eigenvalue(np.einsum("epn,pr->ern", table, products(directions, 4)))
    f = directions[:, np.argpartition(lowest, REFINED, axis=0)[:REFINED]]  # (3, refined, n)
    least = np.full(c.shape[1], np.inf)
    for _ in range(2 * ROUNDS):
        hessian = np.einsum("epn,prn->ern", table, products(f, 4))
        f = _eigenvector(hessian, _least_eigenvalue(hessian))
        # At a double eigenvalue the root of the cubic has only half of the digits, so take the value at the vector.
        curvature = np.einsum("e,ern,ern->rn", [1.0, 1, 1, 2, 2, 2], hessian, products(f, 4))
        least = np.minimum(least, curvature.min(axis=0))
    return least


def _least_eigenvalue(matrix: np.ndarray) -> np.ndarray:
    """Return the smallest eigenvalues of symmetric matrices (6, …), by the trigonometric solution of the cubic."""
    xx, yy, zz, xy, xz, yz = matrix  # LAPACK takes ten times as long
    mean = (xx + yy + zz) / 3
    a, b, d = xx - mean, yy - mean, zz - mean
    size = np.sqrt((a * a + b * b + d * d + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    det = a * (b * d - yz * yz) - xy * (xy * d - yz * xz) + xz * (xy * yz - b * xz)
    cosine = det / np.maximum(2 * size**3, np.finfo(float).tiny)  # a multiple of the identity has no angle
    return mean + 2 * size * np.cos((np.arccos(np.clip(cosine, -1, 1)) + 2 * np.pi) / 3)


def _eigenvector(matrix: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return unit eigenvectors (3, …) of eigenvalues of symmetric matrices (6, …)."""
    xx, yy, zz, xy, xz, yz = matrix
    rows = [np.stack(row) for row in ((xx - value, xy, xz), (xy, yy - value, yz), (xz, yz, zz - value))]
    # the longest cross product of two rows
    crosses = np.stack([np.cross(rows[i], rows[j], axis=0) for i, j in ((0, 1), (0, 2), (1, 2))])
    squared = (crosses**2).sum(axis=1)
    longest = squared.argmax(axis=0)[None]
    size = np.sqrt(np.take_along_axis(squared, longest, axis=0))
    vector = np.take_along_axis(crosses, longest[None], axis=0)[0] / np.where(size > 0, size, 1.0)
    return np.where(size > 0, vector, np.array([1.0, 0, 0]).reshape(3, *(1,) * value.ndim))
