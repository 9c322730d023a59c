"""Lemke's method for linear complementarity problems (LCPs): 0 <= z, 0 <= M z + q, z . (M z + q) = 0.

The method follows a path of vertices of M z + q + d z0 >= 0, with d > 0, in which one index at a time is neither in z
nor in w = M z + q + d z0, from a large z0 down to z0 = 0. If M is copositive, as that of frictional contacts is, the
path ends there, or on a ray: a z >= 0 with z . M z = 0 and q . z < 0, which shows why there may be no solution (Cottle,
Pang & Stone 2009, section 4.4).

Arrays have the batch last. All problems of a batch pivot together until the last one has ended.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Keyed by the bytes of a float: the least pivot, and the relative difference of ratios that count as equal.
LEAST_PIVOT, TIED = {4: 1e-6, 8: 1e-10}, {4: 1e-6, 8: 1e-12}
PIVOTS_PER_ROW = 20  # after this many pivots for each row, a problem counts as not solved; most take one


class LCPSolution(NamedTuple):
    """How Lemke's method ended."""

    z: Float[Array, "rows batch"]  # the solution; where it is not solved, the z at which the method ended
    solved: Bool[Array, " batch"]
    basic: Bool[Array, "rows batch"]  # of which rows z may be positive; of the others M z + q may be
    ray: Float[Array, "rows batch"]  # the z of the ray on which the method ended, or zero


class _Tableau(NamedTuple):
    """The basic variables as functions of the others: basic = last column - the other columns times the others."""

    entries: Float[Array, "rows columns batch"]
    basic: Int[Array, "rows batch"]  # numbers of the variables: w, then z, then z0
    others: Int[Array, "columns-1 batch"]

    def column(self, index: Int[Array, " batch"]) -> Float[Array, "rows batch"]:
        return jnp.take_along_axis(self.entries, index[None, None], 1)[:, 0]

    def pivot(self, row: Array, column: Array, wanted: Bool[Array, " batch"]) -> "_Tableau":
        """Exchange a basic variable and another one, where wanted."""
        entries, basic, others = self
        is_row = jnp.arange(len(basic))[:, None] == row[None]
        is_column = jnp.arange(entries.shape[1])[:, None] == column[None]
        of_column, of_row = self.column(column), jnp.take_along_axis(entries, row[None, None], 0)[0]
        pivot = jnp.where(wanted, _entry(of_row, column), 1.0)
        new_row = jnp.where(is_column, 1.0, of_row) / pivot[None]
        rest = jnp.where(is_column[None], 0.0, entries) - of_column[:, None] * new_row[None]
        entering, leaving = _entry(others, column)[None], _entry(basic, row)[None]
        return _Tableau(
            jnp.where(wanted[None, None], jnp.where(is_row[:, None], new_row[None], rest), entries),
            jnp.where(is_row & wanted[None], entering, basic),
            jnp.where(is_column[:-1] & wanted[None], leaving, others),
        )


class _State(NamedTuple):
    """State between two pivots."""

    tableau: _Tableau
    entering: Int[Array, " batch"]  # number of the variable that enters next
    ongoing: Bool[Array, " batch"]
    solved: Bool[Array, " batch"]
    ray: Float[Array, "rows batch"]
    pivots: Int[Array, ""]


def _entry(values: Array, index: Int[Array, " batch"]) -> Array:
    return jnp.take_along_axis(values, index[None], 0)[0]


def lemke(
    matrix: Float[Array, "rows rows batch"],
    q: Float[Array, "rows batch"],
    cover: Float[Array, "rows"],  # d, positive; another one takes another path
    wanted: Bool[Array, " batch"],
) -> LCPSolution:
    """Solve the wanted LCPs of a batch."""
    size, item = len(q), q.dtype.itemsize
    z0 = 2 * size
    trivial = jnp.all(q >= 0, axis=0)
    tableau = _Tableau(
        jnp.concatenate([-matrix, jnp.broadcast_to(-cover[:, None], q.shape)[:, None], q[:, None]], axis=1),
        jnp.broadcast_to(jnp.arange(size, dtype=jnp.int32)[:, None], q.shape),
        jnp.broadcast_to(jnp.arange(size, z0 + 1, dtype=jnp.int32)[:, None], (size + 1, q.shape[1])),
    )
    first, ongoing = jnp.argmin(q / cover[:, None], axis=0).astype(jnp.int32), wanted & ~trivial
    tableau = tableau.pivot(first, jnp.full_like(first, size), ongoing)

    def next_pivot(state: _State) -> _State:
        tableau, entering, ongoing, solved, ray, pivots = state
        index = jnp.argmax(tableau.others == entering[None], axis=0).astype(jnp.int32)
        column, value = tableau.column(index), jnp.maximum(tableau.entries[:, -1], 0.0)
        limits = column > LEAST_PIVOT[item]
        ratio = jnp.where(limits, value / jnp.where(limits, column, 1.0), jnp.inf)
        least = jnp.min(ratio, axis=0)
        # of rows that are equally near, z0 leaves first, and then the one with the largest pivot
        tied = ratio <= (least + TIED[item] * (1 + least))[None]
        preferred = jnp.where(tied, jnp.where(tableau.basic == z0, jnp.inf, column), -jnp.inf)
        row = jnp.argmax(preferred, axis=0).astype(jnp.int32)
        unbounded = ~jnp.any(limits, axis=0)
        direction = _values(tableau.basic, -column, size) + (entering[None] - size == jnp.arange(size)[:, None])
        ray = jnp.where((ongoing & unbounded)[None], direction, ray)
        leaving, goes_on = _entry(tableau.basic, row), ongoing & ~unbounded
        tableau = tableau.pivot(row, index, goes_on)
        ends = goes_on & (leaving == z0)
        complement = jnp.where(leaving < size, leaving + size, leaving - size)
        return _State(tableau, complement, goes_on & ~ends, solved | ends, ray, pivots + 1)

    initial = _State(tableau, first + size, ongoing, trivial, jnp.zeros_like(q), jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(
        lambda state: jnp.any(state.ongoing) & (state.pivots < PIVOTS_PER_ROW * size), next_pivot, initial
    )
    values = _values(last.tableau.basic, jnp.maximum(last.tableau.entries[:, -1], 0.0), size)
    basic = jnp.any(_is_z(last.tableau.basic, size), axis=0)
    return LCPSolution(jnp.where(trivial[None], 0.0, values), last.solved, basic & ~trivial[None], last.ray)


def _is_z(basic: Int[Array, "rows batch"], size: int) -> Bool[Array, "rows z batch"]:
    """Whether a basic variable is an entry of z."""
    return basic[:, None] == (size + jnp.arange(size))[None, :, None]


def _values(basic: Int[Array, "rows batch"], values: Float[Array, "rows batch"], size: int) -> Array:
    """The values of z, given those of the basic variables; the others are zero."""
    return jnp.sum(jnp.where(_is_z(basic, size), values[:, None], 0.0), axis=0)
