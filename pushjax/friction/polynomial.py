"""H of a limit surface as a table, for batches: wrenches are arrays (3, ..., batch).

The Hessian of H is linear in the six products F_i F_j, so it is a table (6, 6) times these products. Gradient and value
follow from it by Euler's identities. Of a quadratic H the Hessian is constant, and the table has one column.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._math.arrays import ENTRIES, FULL, dot
from pushjax._math.sums import repeated, summed


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


def _pairs(f: Float[Array, "3 *rest"]) -> Float[Array, "6 *rest"]:
    """The six products F_i F_j."""
    return jnp.stack([f[i] * f[j] for i, j in ENTRIES])
