"""Gram matrices of a quartic: they certify that it is convex, and one of them represents it.

H is convex if z' hess H(F) z >= 0 for all z and F, that is, if the form T(z, z, F, F) of its symmetric tensor T is
nowhere negative. Let S be the symmetric part of z F', and a = (z x F) / 2. Then the ways to write that form as a
quadratic form in (S, a), without cross terms, are

    T(S, S) + <N, adj S> + a' N a,      N symmetric, 3 x 3,

because adj S = -a a' for every z and F. So H is convex if, for some N, both N and the 6 x 6 matrix of the first two
terms are positive semi-definite. The converse holds too, because every convex form of degree four in three variables
is sos-convex (Ahmadi & Parrilo 2013).

These two blocks are the 9 x 9 Gram matrix of Zhou et al. 2017 (section V) in a basis of symmetric and antisymmetric
parts. Nine directions change that matrix but not H. N holds six of them. The other three are the cross terms, which
improve no eigenvalue, because the form does not change if z and F are exchanged.

The quartic H depends only on the 6 x 6 block G: H(F) = v' G v, where v holds the six products of two components of F.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.tiles import in_search_tiles, in_tiles
from pushjax._math.arrays import FULL
from pushjax._math.linalg import cholesky
from pushjax.friction.quartic import TENSORS

# All tables have the entries of N and of S, and the six products v, in the order xx, yy, zz, xy, xz, yz.
UNITS = (np.arange(6)[:, None, None] == FULL).astype(float)  # the matrix N for each of its entries, (6, 3, 3)
ALTERNATING = np.cross(np.eye(3)[:, None], np.eye(3))
# The matrix of <N, adj S> for each entry of N, (6, 6, 6), and that of T(S, S) for each of the 15 coefficients.
ADJUGATES = np.einsum("eij,ikm,jln,akl,bmn->eab", UNITS, ALTERNATING / 2, ALTERNATING, UNITS, UNITS, optimize=True)
COEFFICIENTS = np.einsum("cijkl,aij,bkl->cab", TENSORS, UNITS, UNITS)
# In the norm that does not depend on the frame all of them are orthogonal. So a projection of G gives N.
PROJECTIONS = ADJUGATES / np.outer(UNITS.sum(axis=(1, 2)), UNITS.sum(axis=(1, 2)))
PROJECTIONS /= np.sum(ADJUGATES * PROJECTIONS, axis=(1, 2), keepdims=True)
# Where the entries of a symmetric 7 x 7 matrix stand in its lower triangle. The type is not int64, because JAX would
# keep the type that it makes of this in one context of `enable_x64` for the next.
LOWER = np.zeros((7, 7), np.int32)
LOWER[np.tril_indices(7)] = np.arange(28)
LOWER = np.maximum(LOWER, LOWER.T)

BARRIER_PARAMETER = 9  # of the logarithmic barrier: the number of rows of both blocks together
MAX_ROUNDS = 60
FIRST_WEIGHT, WEIGHT_RATIO = 4.0, 16.0  # of the scale relative to the barrier: at first, and after each centering
STEP_LENGTHS = (1.0, 0.7, 0.4)  # step lengths that each Newton round tries
INITIAL_SCALES = (0.0, -0.1, -0.3, -1.0, -3.0, -10.0, -100.0, -1e4, -1e6)  # the largest that is feasible


class Gram(NamedTuple):
    """The two blocks G and N of a 9 x 9 Gram matrix (see the header of this module), 1/N^4."""

    symmetric: Float[Array, "6 6 *batch"]  # G, with v' G v = H
    antisymmetric: Float[Array, "3 3 *batch"]  # N

    @staticmethod
    def of(coefficients: Float[Array, "15"], n: Float[Array, "6"]) -> "Gram":
        """Return the Gram matrix of a quartic for a block N with the entries `n`."""
        matrices = jnp.asarray(np.concatenate([COEFFICIENTS, ADJUGATES]), n.dtype)
        return Gram(jnp.sum(jnp.concatenate([coefficients, n])[:, None, None] * matrices, axis=0), n[FULL])

    @staticmethod
    def ball(dtype) -> "Gram":
        """Return a Gram matrix of |F|^4; no eigenvalue is below a third."""
        return Gram.of(
            jnp.array([1, 1, 1, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 0, 0], dtype), jnp.repeat(jnp.array([2 / 3, 0], dtype), 3)
        )

    @staticmethod
    def identity(dtype) -> "Gram":
        """Return the 9 x 9 identity in these blocks, which is no Gram matrix of a quartic."""
        return Gram(jnp.diag(jnp.array([1, 1, 1, 2, 2, 2], dtype)), 2 * jnp.eye(3, dtype=dtype))

    def plus(self, factor: float | Array, other: "Gram") -> "Gram":
        """Return self + factor * other."""
        return jax.tree.map(lambda own, others: own + factor * others, self, other)


def coefficients_of(symmetric: Float[Array, "6 6"]) -> Float[Array, "15"]:
    """Return the coefficients of the quartic v' G v."""
    # the first nine coefficients have one entry each, the others two
    _, i, j = np.nonzero(np.tril(COEFFICIENTS))
    entries = symmetric[i, j] * jnp.asarray(np.where(i == j, 1, 2), symmetric.dtype)
    return jnp.concatenate([entries[:9], entries[9::2] + entries[10::2]])


def antisymmetric_of(symmetric: Float[Array, "6 6"]) -> Float[Array, "3 3"]:
    """Return the N for which `symmetric` is the block G of the Gram matrix of its quartic."""
    return _Entries.of(PROJECTIONS).traces(symmetric)[FULL]


class Certificate(NamedTuple):
    """The result of `max_feasible_scale`."""

    scale: Float[Array, ""]  # s; unless the search stopped at `enough`, no scale is larger by more than the tolerance
    change: Float[Array, "6"]  # of the entries of N; the Gram matrix with it, minus s * reference, is positive definite
    converged: Bool[Array, ""]  # whether the search ended within `MAX_ROUNDS`


def max_feasible_scale(gram: Gram, reference: Gram, *, enough: float, tolerance: float) -> Certificate:
    """Find the largest scale s for which Gram(N) - s * reference is positive semi-definite for some N.

    Gram(N) are all Gram matrices of the quartic of `gram`. If it is convex, the largest s is not below zero. The search
    follows the central path: it applies Newton's method to the logarithmic barrier, and each round takes the best of a
    few step lengths. The result lies strictly inside the feasible set. So it is a proof, whatever the roundoff of the
    search. In a batch, only examples for which zero is not `enough` or not feasible are searched.

    Args:
        gram: Gram matrix of the quartic at which the search starts.
        reference: Gram matrix to subtract.
        enough: The search stops once s is at least this.
        tolerance: The search stops once s is known to be within this of the largest.

    Returns:
        The scale `scale`, the `change` of the entries (xx, yy, zz, xy, xz, yz) of N, and whether the search
        `converged`. Where not even the least of `INITIAL_SCALES` is feasible, the scale is minus infinity.
    """
    attempt, yes = partial(_attempt, enough, tolerance), jnp.ones((), bool)
    return in_tiles(attempt, yes, yes & (enough < np.inf), gram, reference)


class _Entries(NamedTuple):
    """Six symmetric matrices E, by their entries on and below the diagonal; those on it are halved."""

    i: Int[np.ndarray, "6 entries"]
    j: Int[np.ndarray, "6 entries"]
    value: Float[np.ndarray, "6 entries"]

    @staticmethod
    def of(matrices: Float[np.ndarray, "6 n n"]) -> "_Entries":
        k, i, j = np.nonzero(np.tril(matrices))
        value = matrices[k, i, j] * np.where(i == j, 0.5, 1.0)
        return _Entries(i.reshape(6, -1), j.reshape(6, -1), value.reshape(6, -1))

    def traces(self, x: Float[Array, "n n *batch"]) -> Float[Array, "6 *batch"]:
        """Return trace(x E) for a symmetric x and every E."""
        return jnp.sum(_like(2 * self.value, x[0]) * x[self.i, self.j], axis=1)

    def double_traces(self, x: Float[Array, "n n *batch"]) -> Float[Array, "21 *batch"]:
        """Return trace(x E x E') for a symmetric x and every pair of E and E', in the order of a lower triangle."""
        first, second = np.tril_indices(6)
        i, j, value = (each[first][:, :, None] for each in self)
        k, l, others = (each[second][:, None] for each in self)
        products = (x[i, k] * x[j, l] + x[i, l] * x[j, k]).reshape(21, -1, *x.shape[2:])
        return jnp.sum(_like((2 * value * others).reshape(21, -1), x[0]) * products, axis=1)


def _like(table: np.ndarray, x: Array) -> Array:
    """Return a table with the type of x, and as many axes for the batch."""
    return jnp.asarray(table, x.dtype).reshape(*table.shape, *(1,) * (x.ndim - 1))


class _Problem(NamedTuple):
    """The matrices of `max_feasible_scale`, for a batch; its unknowns x are the change of N, and then s."""

    gram: Gram
    reference: Gram

    def at(self, x: Float[Array, "7 *batch"]) -> Gram:
        """Return Gram(N) - s * reference."""
        change = (jnp.sum(_like(m, x) * x[:6, None, None], axis=0) for m in (ADJUGATES, UNITS))
        return self.gram.plus(1.0, Gram(*change)).plus(-x[None, None, 6], self.reference)

    def barrier(self, x: Float[Array, "7 trials batch"]) -> tuple[Array, Bool[Array, "trials batch"]]:
        """Return the log determinant of both blocks at several x each, and whether they are positive definite."""
        six, three = (cholesky(block) for block in jax.tree.map(lambda m: m[:, :, None], self).at(x))
        return six.logdet() + three.logdet(), six.positive & three.positive

    def newton_step(self, x: Float[Array, "7 batch"], weight: Float[Array, " batch"]) -> tuple[Array, Array, Array]:
        """Return the step toward the maximum of weight * s + logdet, the Newton decrement, and the value at x."""
        value, gradient, hessian = weight * x[6], jnp.zeros_like(x).at[6].set(weight), jnp.zeros((), x.dtype)
        for block, reference, matrices in zip(self.at(x), self.reference, (ADJUGATES, UNITS), strict=True):
            factor, entries = cholesky(block, jnp.eye(len(block), dtype=x.dtype)[..., None]), _Entries.of(matrices)
            inverse = jnp.sum(factor.solved[:, :, None] * factor.solved[:, None], axis=0)
            product = jnp.sum(inverse[:, :, None] * reference[None], axis=1)
            between = jnp.sum(product[:, :, None] * inverse[None], axis=1)
            by_scale, twice_by_scale = (jnp.sum(m * reference, axis=(0, 1))[None] for m in (inverse, between))
            value += factor.logdet()
            gradient += jnp.concatenate([entries.traces(inverse), -by_scale])
            hessian += jnp.concatenate([entries.double_traces(inverse), -entries.traces(between), twice_by_scale])
        identity = jnp.broadcast_to(jnp.eye(7, dtype=x.dtype)[..., None], (7, *x.shape))
        solved = cholesky(hessian[LOWER], jnp.concatenate([identity, gradient[:, None]], axis=1)).solved
        return jnp.sum(solved[:, :7] * solved[:, 7:], axis=0), jnp.sqrt(jnp.sum(solved[:, 7] ** 2, axis=0)), value

    def newton_round(self, x: Float[Array, "7 batch"], weight: Float[Array, " batch"]) -> tuple[Array, Array, Array]:
        """Return x after a round, the Newton decrement, and whether the value has increased."""
        step, decrement, value = self.newton_step(x, weight)
        lengths = jnp.stack([*(jnp.full_like(weight, length) for length in STEP_LENGTHS), 1 / (1 + decrement)])
        trials = x[:, None] + lengths[None] * step[:, None]
        logdet, positive = self.barrier(trials)
        values = jnp.where(positive, weight[None] * trials[6] + logdet, -jnp.inf)
        length = jnp.zeros_like(value)
        for k in range(len(lengths)):
            better = values[k] > value
            length, value = jnp.where(better, lengths[k], length), jnp.where(better, values[k], value)
        return x + length[None] * step, decrement, length > 0


def _attempt(
    enough: float, tolerance: float, again: Int[Array, ""], gram: Gram, reference: Gram
) -> tuple[Certificate, Bool[Array, " batch"]]:
    """Find out whether the scale zero is enough, and in the second attempt search."""
    problem, zero = _Problem(gram, reference), 0 * (gram.symmetric[0, 0] + reference.symmetric[0, 0])
    known = problem.barrier(jnp.zeros((7, 1, zero.size), zero.dtype))[1][0] & (enough <= 0)
    blank = Certificate(zero, jnp.zeros((6, zero.size), zero.dtype), known)
    return in_search_tiles(partial(_search, enough, tolerance), again, problem, blank), ~known


def _search(enough: float, tolerance: float, problem: _Problem) -> Certificate:
    """Search the largest scales of a batch."""
    like = problem.gram.symmetric[0, 0] + problem.reference.symmetric[0, 0]
    scales = jnp.asarray(INITIAL_SCALES, like.dtype)[:, None]
    at_scales = problem.barrier(jnp.zeros((7, len(scales), like.size), like.dtype).at[6].set(scales))
    start = jnp.max(jnp.where(at_scales[1], scales, -jnp.inf), axis=0)
    known = start >= enough

    def next_round(state):
        rounds, x, weight, going, converged = state
        new, decrement, has_moved = problem.newton_round(x, weight)
        centered = decrement < 1
        # Close to the border of the feasible set, roundoff may make the result of a round NaN or infinite. Then the
        # search ends with the previous one.
        is_invalid = ~jnp.isfinite(jnp.sum(new, axis=0))
        done = is_invalid | (new[6] >= enough) | (centered & (BARRIER_PARAMETER / weight < tolerance))
        weight = jnp.where(centered, WEIGHT_RATIO * weight, weight)
        x = jnp.where((going & ~is_invalid)[None], new, x)
        # a round that changes nothing would be repeated for ever
        return rounds + 1, x, weight, going & ~done & (centered | has_moved), converged | (going & done)

    x = jnp.zeros((7, like.size), like.dtype).at[6].set(start)
    state = jnp.zeros((), jnp.int32), x, jnp.full_like(like, FIRST_WEIGHT), ~known & (start > -jnp.inf), known
    state = jax.lax.while_loop(lambda state: (state[0] < MAX_ROUNDS) & jnp.any(state[3]), next_round, state)
    return Certificate(state[1][6], state[1][:6], state[4])
