"""Small dense matrices: 3 x 3 matrices as pytrees of scalars, and factorizations of batches of any size.

For a batch of 6 x 6 matrices, the factorizations of `jax.numpy.linalg` call LAPACK once for each matrix. With the batch
last, the same arithmetic on whole batches takes a fiftieth of the time.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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


class Cholesky(NamedTuple):
    """The Cholesky factorization m = L L' of symmetric matrices, and the solution of L x = right."""

    upper: Float[Array, "n n *batch"]  # L', below whose diagonal there is roundoff
    solved: Float[Array, "n k *batch"]  # x
    positive: Bool[Array, "*batch"]  # whether m is positive definite up to roundoff; else the other fields mean nothing

    def lower(self) -> Float[Array, "n n *batch"]:
        """Return L; NaN if m is not positive definite."""
        below = np.tri(len(self.upper), dtype=bool).reshape(*self.upper.shape[:2], *(1,) * (self.upper.ndim - 2))
        return jnp.where(self.positive[None, None], jnp.where(below, jnp.swapaxes(self.upper, 0, 1), 0.0), jnp.nan)

    def logdet(self) -> Float[Array, "*batch"]:
        """Return log det m."""
        diagonal = np.arange(len(self.upper))
        return 2 * jnp.log(jnp.prod(self.upper[diagonal, diagonal], axis=0))


def cholesky(m: Float[Array, "n n *batch"], right: Float[Array, "n k *_"] | None = None) -> Cholesky:
    """Factorize symmetric matrices; it can be differentiated."""
    # `right` goes through the same elimination. A loop over rows takes as long to run as rows that are written out, and
    # half as long to compile.
    size, rows = len(m), m
    if right is not None:
        rows = jnp.concatenate([m, jnp.broadcast_to(right, (*right.shape[:2], *m.shape[2:]))], axis=1)

    def next_row(k, state):
        found, positive = state  # rows that are not found yet are zero
        row = rows[k] - jnp.sum(found[:, k][:, None] * found, axis=0)
        is_positive = row[k] > size * jnp.finfo(m.dtype).eps * jnp.abs(rows[k, k])
        row = row / jnp.sqrt(jnp.where(is_positive, row[k], 1.0))[None]
        return found.at[k].set(row), positive & is_positive

    initial = jnp.zeros_like(rows), jnp.ones(m.shape[2:], bool)
    found, positive = jax.lax.fori_loop(0, size, next_row, initial)
    return Cholesky(found[:, :size], found[:, size:], positive)


def solve(matrix: Float[Array, "n n batch"], right: Float[Array, "n batch"]) -> Float[Array, "n batch"]:
    """Solve linear equations by Gauss-Jordan elimination; it can be differentiated."""

    def times(x: Array) -> Array:
        return jnp.sum(matrix * x[None], axis=1)

    return jax.lax.custom_linear_solve(
        times,
        right,
        solve=lambda _, right: _eliminated(matrix, right),
        transpose_solve=lambda _, right: _eliminated(jnp.swapaxes(matrix, 0, 1), right),
    )


def _eliminated(matrix: Float[Array, "n n batch"], right: Float[Array, "n batch"]) -> Float[Array, "n batch"]:
    """Solve linear equations, with the largest entry of each column in a row that has no pivot yet as the next one."""
    size = len(matrix)
    numbers = jnp.arange(size, dtype=jnp.int32)[:, None]

    def next_pivot(k, state):
        entries, column_of = state  # the column whose pivot is in each row, or `size`
        column = entries[:, k]
        candidates = jnp.where(column_of == size, jnp.abs(column), -1.0)
        is_largest = candidates == jnp.max(candidates, axis=0)[None]
        is_row = numbers == jnp.min(jnp.where(is_largest, numbers, size), axis=0)[None]
        row = jnp.sum(jnp.where(is_row[:, None], entries, 0.0), axis=0)
        factors = (column - is_row) / row[k][None]
        return entries - factors[:, None] * row[None], jnp.where(is_row, k, column_of)

    first = jnp.concatenate([matrix, right[:, None]], axis=1), jnp.full(right.shape, size, jnp.int32)
    entries, column_of = jax.lax.fori_loop(0, size, next_pivot, first)
    return jnp.sum((column_of[None] == numbers[:, :, None]) * entries[:, -1][None], axis=1)  # what is NaN remains so
