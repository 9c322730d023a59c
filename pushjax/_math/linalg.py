"""Small dense matrices as pytrees of scalars: 3 x 3 matrices, and a Cholesky factorization of any size.

For a batch of 6 x 6 matrices, the factorizations of `jax.numpy.linalg` call LAPACK once for each matrix. The same
arithmetic on scalars becomes arithmetic on whole batches under `vmap`, and takes a fiftieth of the time (see `vec`).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._math.vec import Scalar, Vec3


class Symmetric3(NamedTuple):
    """A symmetric 3 x 3 matrix."""

    xx: Scalar
    yy: Scalar
    zz: Scalar
    xy: Scalar
    xz: Scalar
    yz: Scalar

    def times(self, v: Vec3) -> Vec3:
        """Return the product of the matrix and v."""
        return Vec3(
            self.xx * v.x + self.xy * v.y + self.xz * v.z,
            self.xy * v.x + self.yy * v.y + self.yz * v.z,
            self.xz * v.x + self.yz * v.y + self.zz * v.z,
        )

    def solve(self, v: Vec3) -> Vec3:
        """Return u with self u = v, by the adjugate; zero where |det| <= eps^2 |trace|^3."""
        axx = self.yy * self.zz - self.yz * self.yz
        axy = self.xz * self.yz - self.xy * self.zz
        axz = self.xy * self.yz - self.xz * self.yy
        ayy = self.xx * self.zz - self.xz * self.xz
        ayz = self.xy * self.xz - self.xx * self.yz
        azz = self.xx * self.yy - self.xy * self.xy
        det = self.xx * axx + self.xy * axy + self.xz * axz
        scale = self.xx + self.yy + self.zz
        singular = jnp.abs(det) <= jnp.finfo(det.dtype).eps ** 2 * jnp.abs(scale) ** 3
        inverse = jnp.where(singular, 0.0, 1.0 / jnp.where(singular, 1.0, det))
        return Symmetric3(axx, ayy, azz, axy, axz, ayz).times(v).scale(inverse)

    def array(self) -> Float[Array, "3 3"]:
        return jnp.array([[self.xx, self.xy, self.xz], [self.xy, self.yy, self.yz], [self.xz, self.yz, self.zz]])


Lower = tuple[tuple[Scalar, ...], ...]  # the lower triangle of a symmetric matrix or of a factor, row by row
Column = tuple[Scalar, ...]


def entry(m: Lower, i: int, j: int) -> Scalar:
    """Return m[i, j] of a symmetric matrix."""
    return m[i][j] if j <= i else m[j][i]


def add_scaled(m: Lower, factor: Scalar, other: Lower) -> Lower:
    """Return m + factor * other."""
    return tuple(tuple(a + factor * b for a, b in zip(*rows, strict=True)) for rows in zip(m, other, strict=True))


class Cholesky(NamedTuple):
    """The Cholesky factorization m = L L' of a symmetric matrix."""

    lower: Lower  # L
    inverse_diagonal: Column  # reciprocals of the diagonal of L
    positive: Bool[Array, ""]  # whether m is positive definite up to roundoff; else the other fields are meaningless

    @staticmethod
    def of(m: Lower) -> "Cholesky":
        """Factorize a symmetric matrix, given by its lower triangle."""
        rows, inverses, positive = [], [], jnp.ones((), bool)
        for i, m_row in enumerate(m):
            row: list[Scalar] = []
            for j in range(i):
                row.append((m_row[j] - _dot(row, rows[j][:j])) * inverses[j])
            pivot = m_row[i] - _dot(row, row)
            is_positive = pivot > len(m) * jnp.finfo(pivot.dtype).eps * jnp.abs(m_row[i])
            positive &= is_positive
            inverses.append(1 / jnp.sqrt(jnp.where(is_positive, pivot, 1.0)))
            row.append(jnp.where(is_positive, pivot, 1.0) * inverses[i])
            rows.append(tuple(row))
        return Cholesky(tuple(rows), tuple(inverses), positive)

    def logdet(self) -> Scalar:
        """Return log det m."""
        total = self.inverse_diagonal[0]
        for inverse in self.inverse_diagonal[1:]:
            total = total * inverse
        return -2 * jnp.log(total)

    def solve(self, b: Column) -> Column:
        """Return m^-1 b."""
        size, y = len(b), list(b)
        for i in range(size):
            y[i] = (y[i] - _dot(y[:i], self.lower[i][:i])) * self.inverse_diagonal[i]
        for i in reversed(range(size)):
            below = [self.lower[k][i] for k in range(i + 1, size)]
            y[i] = (y[i] - _dot(y[i + 1 :], below)) * self.inverse_diagonal[i]
        return tuple(y)

    def inverse(self) -> Lower:
        """Return m^-1."""
        size = len(self.lower)
        columns = []  # columns of L^-1, each from the diagonal down
        for j in range(size):
            column = [self.inverse_diagonal[j]]
            for i in range(j + 1, size):
                column.append(-_dot(self.lower[i][j:i], column) * self.inverse_diagonal[i])
            columns.append(column)
        return tuple(tuple(_dot(columns[i], columns[j][i - j :]) for j in range(i + 1)) for i in range(size))


def multiply_lower(a: Lower, b: Lower) -> Lower:
    """Return the product a b of two lower triangular matrices."""
    return tuple(
        tuple(_dot(a[i][j : i + 1], [b[k][j] for k in range(j, i + 1)]) for j in range(i + 1)) for i in range(len(a))
    )


def times_transpose(lower: Lower) -> Lower:
    """Return L L', which is symmetric."""
    return tuple(tuple(_dot(lower[i][: j + 1], lower[j]) for j in range(i + 1)) for i in range(len(lower)))


def congruence(x: Lower, m: Lower) -> Lower:
    """Return x m x for two symmetric matrices."""
    size = range(len(x))
    xm = [[_dot([entry(x, i, k) for k in size], [entry(m, k, j) for k in size]) for j in size] for i in size]
    return tuple(tuple(_dot(xm[i], [entry(x, k, j) for k in size]) for j in range(i + 1)) for i in size)


def _dot(a, b) -> Any:
    """Return the sum of the products of two sequences of scalars, added from left to right."""
    total = 0.0  # a Python number, which does not affect the dtype
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total
