"""H of a limit surface as a table, for batches: wrenches are arrays (3, ..., batch).

The Hessian of H is linear in the six products F_i F_j, so it is a table (6, 6) times these products. Gradient and value
follow from it by Euler's identities. Of a quadratic H the Hessian is constant, and the table has one column.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._math.arrays import ENTRIES, FULL, dot
from pushjax._math.sums import repeated, summed

# Directions of wrenches: along the axes and the diagonals.
DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [1, 1, -1], [1, -1, -1]])


class Polynomial(NamedTuple):
    """H, homogeneous of degree two or four."""

    table: Float[Array, "3 3 products *batch"]  # coefficients of the products F_i F_j in each entry of the Hessian

    @staticmethod
    def of(entries: Float[Array, "6 products *batch"]) -> "Polynomial":
        """H, given the rows of the table for the six entries of a symmetric matrix (`Form.table`)."""
        return Polynomial(entries[FULL])

    def squared(self) -> "Polynomial":
        """The square of a quadratic H, which is a quartic with the same limit surface."""
        a = self.table[:, :, 0]
        terms = [
            a * a[i, j][None, None] + a[:, i][:, None] * a[j][None] + a[:, j][:, None] * a[i][None] for i, j in ENTRIES
        ]
        return Polynomial(
            jnp.stack([term if i == j else 2 * term for term, (i, j) in zip(terms, ENTRIES, strict=True)], 2)
        )

    @property
    def degree(self) -> int:
        """Degree of H."""
        return 2 if self.table.shape[2] == 1 else 4

    def hessian(self, f: Float[Array, "3 *rest"]) -> Float[Array, "3 3 *rest"]:
        """The Hessian at wrenches."""
        if self.degree == 2:
            return jnp.broadcast_to(self._table(f)[:, :, 0], (3, 3, *f.shape[1:]))
        return summed(self._table(f) * repeated(repeated(_pairs(f), 0, 3), 0, 3), 2)

    def gradient(self, f: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
        """grad H at wrenches."""
        # one sum, because XLA fuses a sum into a sum, which is slow
        if self.degree == 2:
            return summed(self._table(f)[:, :, 0] * repeated(f, 0, 3), 1)
        return summed(self._table(f) * repeated(repeated(f, 1, 6) * repeated(_pairs(f), 0, 3), 0, 3), (1, 2)) / 3

    def _table(self, f: Float[Array, "3 *rest"]) -> Float[Array, "3 3 products *rest"]:
        """The table with axes between its own and the batch, to broadcast against wrenches."""
        missing = f.ndim + 2 - self.table.ndim
        return jnp.expand_dims(self.table, tuple(range(3, 3 + missing)))

    def value(self, f: Float[Array, "3 *rest"]) -> Float[Array, "*rest"]:
        """H of wrenches."""
        return dot(f, self.gradient(f)) / self.degree

    def scale(self) -> Float[Array, "*batch"]:
        """The sum of H at the three unit wrenches; one where that is not positive."""
        last = self.table.shape[2] - 1
        total = sum(self.table[k, k, min(k, last)] for k in range(3)) / (self.degree * (self.degree - 1))
        return jnp.where(total > 0, total, 1.0)

    def root(self, h: Float[Array, "*rest"]) -> Float[Array, "*rest"]:
        """h^(1/d) for h > 0: the factor by which a wrench with H = h exceeds H = 1."""
        return jnp.sqrt(h) if self.degree == 2 else jnp.sqrt(jnp.sqrt(h))

    def patch(
        self, wrench: Float[Array, "3 *rest"], near: Array | None = None
    ) -> tuple[Float[Array, "*rest"], Float[Array, "3 *rest"], Float[Array, "3 3 *rest"]]:
        """The gauge gamma(F) = H(F)^(1/d) of wrenches other than zero, its gradient, and its Hessian at gamma = 1.

        There is no search, which could start `near`.
        """
        degree, gauge = self.degree, self.root(self.value(wrench))
        unit = wrench / gauge[None]
        normal = self.gradient(unit) / degree
        return gauge, normal, self.hessian(unit) / degree - (degree - 1) * normal[:, None] * normal[None]

    def mean_ellipsoid(self, wrench: Float[Array, "3 *batch"]) -> Float[Array, "3 3 *batch"]:
        """The mean matrix of ellipsoids that agree with the limit surface at some wrenches, shaped as those given."""
        directions = jnp.asarray(DIRECTIONS.T, wrench.dtype).reshape(3, -1, *(1,) * (wrench.ndim - 1))
        _, normal, curvature = self.patch(jnp.broadcast_to(directions, (*directions.shape[:2], *wrench.shape[1:])))
        return jnp.mean(curvature + normal[:, None] * normal[None], axis=2)

    def reweighted(self, twist: Array, ellipsoid: Array, weight: Array) -> tuple[Array, Array]:
        """As given: `SupportPoints` have a law of their own for a twist."""
        return ellipsoid, weight

    def usable(self) -> tuple["Polynomial", Bool[Array, " batch"]]:
        """H without numbers that cannot be computed with, all of one batch, and whether there were none."""
        finite = jnp.all(jnp.isfinite(self.table), axis=tuple(range(self.table.ndim - 1)))
        return Polynomial(jnp.where(jnp.broadcast_to(finite, self.table.shape), self.table, 1.0)), finite


def _pairs(f: Float[Array, "3 *rest"]) -> Float[Array, "6 *rest"]:
    """The six products F_i F_j."""
    return jnp.stack([f[i] * f[j] for i, j in ENTRIES])
