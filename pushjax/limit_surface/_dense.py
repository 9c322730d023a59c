"""Small symmetric matrices as rows of scalars: what `Symmetric3` is to three, for six or seven.

For a batch of 6 x 6 matrices the factorisations of `jax.numpy.linalg` call LAPACK once for each; the same arithmetic on
scalars, which `vmap` turns into arithmetic on whole batches, takes a fiftieth of the time (see `_vec`).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar

Lower = tuple[tuple[Scalar, ...], ...]  # the lower triangle, row by row: of a symmetric matrix, or of a factor
Column = tuple[Scalar, ...]


def entry(m: Lower, i: int, j: int) -> Scalar:
    """m[i, j] of a symmetric matrix."""
    return m[i][j] if j <= i else m[j][i]


def combined(m: Lower, factor: Scalar, other: Lower) -> Lower:
    """m + factor * other."""
    return tuple(tuple(a + factor * b for a, b in zip(*rows, strict=True)) for rows in zip(m, other, strict=True))


class Cholesky(NamedTuple):
    """m = L L'. positive: whether m is positive definite to rounding; where not, the rest means nothing."""

    lower: Lower
    inverse_diagonal: Column
    positive: Bool[Array, ""]

    @staticmethod
    def of(m: Lower) -> "Cholesky":
        rows, inverses, positive = [], [], jnp.ones((), bool)
        for i, given in enumerate(m):
            row: list[Scalar] = []
            for j in range(i):
                row.append((given[j] - _dot(row, rows[j][:j])) * inverses[j])
            pivot = given[i] - _dot(row, row)
            ahead = pivot > len(m) * jnp.finfo(pivot.dtype).eps * jnp.abs(given[i])
            positive &= ahead
            inverses.append(1 / jnp.sqrt(jnp.where(ahead, pivot, 1.0)))
            row.append(jnp.where(ahead, pivot, 1.0) * inverses[i])
            rows.append(tuple(row))
        return Cholesky(tuple(rows), tuple(inverses), positive)

    def logdet(self) -> Scalar:
        total = self.inverse_diagonal[0]
        for inverse in self.inverse_diagonal[1:]:
            total = total * inverse
        return -2 * jnp.log(total)

    def solve(self, b: Column) -> Column:
        """m^-1 b."""
        size, y = len(b), list(b)
        for i in range(size):
            y[i] = (y[i] - _dot(y[:i], self.lower[i][:i])) * self.inverse_diagonal[i]
        for i in reversed(range(size)):
            below = [self.lower[k][i] for k in range(i + 1, size)]
            y[i] = (y[i] - _dot(y[i + 1 :], below)) * self.inverse_diagonal[i]
        return tuple(y)

    def inverse(self) -> Lower:
        """m^-1."""
        size = len(self.lower)
        columns = []  # of L^-1, each from its diagonal down
        for j in range(size):
            column = [self.inverse_diagonal[j]]
            for i in range(j + 1, size):
                column.append(-_dot(self.lower[i][j:i], column) * self.inverse_diagonal[i])
            columns.append(column)
        return tuple(tuple(_dot(columns[i], columns[j][i - j :]) for j in range(i + 1)) for i in range(size))


def product(a: Lower, b: Lower) -> Lower:
    """L M of two lower triangular factors."""
    return tuple(
        tuple(_dot(a[i][j : i + 1], [b[k][j] for k in range(j, i + 1)]) for j in range(i + 1)) for i in range(len(a))
    )


def squared(lower: Lower) -> Lower:
    """L L', symmetric."""
    return tuple(tuple(_dot(lower[i][: j + 1], lower[j]) for j in range(i + 1)) for i in range(len(lower)))


def sandwiched(x: Lower, m: Lower) -> Lower:
    """x m x of two symmetric matrices."""
    size = range(len(x))
    xm = [[_dot([entry(x, i, k) for k in size], [entry(m, k, j) for k in size]) for j in size] for i in size]
    return tuple(tuple(_dot(xm[i], [entry(x, k, j) for k in size]) for j in range(i + 1)) for i in size)


def _dot(a, b) -> Any:
    total = 0.0  # of no dtype of its own
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total
