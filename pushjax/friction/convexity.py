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

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, decide
from pushjax._math.linalg import Cholesky, Column, Lower, add_scaled, congruence, entry
from pushjax._math.vec import Scalar

# The six products v are x², y², z², xy, xz, yz, with F = (x, y, z).
# The matrix of <N, adj S> in their basis. For each entry of N (xx, yy, zz, xy, xz, yz): the places in the lower
# triangle to which it contributes, and the factors.
ADJUGATE_PLACES = (
    {(2, 1): 0.5, (5, 5): -1.0},
    {(2, 0): 0.5, (4, 4): -1.0},
    {(1, 0): 0.5, (3, 3): -1.0},
    {(5, 4): 1.0, (3, 2): -1.0},
    {(5, 3): 1.0, (4, 1): -1.0},
    {(4, 3): 1.0, (5, 0): -1.0},
)
# The same for the matrix N.
ANTISYMMETRIC_PLACES = ({(0, 0): 1.0}, {(1, 1): 1.0}, {(2, 2): 1.0}, {(1, 0): 1.0}, {(2, 0): 1.0}, {(2, 1): 1.0})
# The same for the matrix of T(S, S), for each of the 15 coefficients.
COEFFICIENT_PLACES = (
    {(0, 0): 1.0},
    {(1, 1): 1.0},
    {(2, 2): 1.0},
    {(3, 0): 1 / 2},
    {(4, 0): 1 / 2},
    {(3, 1): 1 / 2},
    {(5, 1): 1 / 2},
    {(4, 2): 1 / 2},
    {(5, 2): 1 / 2},
    {(1, 0): 1 / 6, (3, 3): 2 / 3},
    {(2, 0): 1 / 6, (4, 4): 2 / 3},
    {(2, 1): 1 / 6, (5, 5): 2 / 3},
    {(5, 0): 1 / 6, (4, 3): 1 / 3},
    {(4, 1): 1 / 6, (5, 3): 1 / 3},
    {(3, 2): 1 / 6, (5, 4): 1 / 3},
)
BARRIER_PARAMETER = 9  # of the logarithmic barrier: the number of rows of both blocks together
MAX_ROUNDS = 60
# Weight of the scale relative to the barrier: initial value, and factor after each centering
BARRIER_WEIGHTS = (4.0, 16.0)
STEP_LENGTHS = (1.0, 0.7, 0.4)  # step lengths that each Newton round tries
# Candidates for the initial scale, in ascending order
INITIAL_SCALES = (-1e6, -1e4, -100.0, -10.0, -3.0, -1.0, -0.3, -0.1, 0.0)


class Gram(NamedTuple):
    """The two blocks G and N of a 9 x 9 Gram matrix (see the header of this module), as lower triangles, 1/N^4."""

    symmetric: Lower  # G, 6 x 6, with v' G v = H
    antisymmetric: Lower  # N, 3 x 3

    @staticmethod
    def of(coefficients: Column, n: Column) -> "Gram":
        """Return the Gram matrix of a quartic for a block N with the entries `n` (xx, yy, zz, xy, xz, yz)."""
        parts = (*zip(COEFFICIENT_PLACES, coefficients, strict=True), *zip(ADJUGATE_PLACES, n, strict=True))
        return Gram(_weighted_sum(6, parts), _weighted_sum(3, tuple(zip(ANTISYMMETRIC_PLACES, n, strict=True))))

    @staticmethod
    def identity(like: Scalar) -> "Gram":
        """Return the 9 x 9 identity in these blocks, with the type of the scalar `like`."""
        zero, one = 0 * like, 0 * like + 1
        six, three = (one, one, one, 2 * one, 2 * one, 2 * one), (2 * one,) * 3
        return Gram(*(tuple((zero,) * i + (d,) for i, d in enumerate(diagonal)) for diagonal in (six, three)))

    def plus(self, factor: Scalar, other: "Gram") -> "Gram":
        """Return self + factor * other."""
        return Gram(*(add_scaled(own, factor, others) for own, others in zip(self, other, strict=True)))


def coefficients_of(symmetric: Lower) -> Column:
    """Return the 15 coefficients of the quartic v' G v, for the 6 x 6 block G."""
    return tuple(
        sum(((1 if i == j else 2) * symmetric[i][j] for (i, j) in places), 0 * symmetric[0][0])
        for places in COEFFICIENT_PLACES
    )


def antisymmetric_of(symmetric: Lower) -> Column:
    """Return the entries of the N for which `symmetric` is the 6 x 6 block of the Gram matrix of its quartic."""
    found = []
    for places in ADJUGATE_PLACES:
        (above, a), (below, b) = ((symmetric[i][j], value) for (i, j), value in places.items())
        found.append((4 * above - below) / 3 if b == -1.0 and a == 0.5 else (above - 2 * below) / 3)
    return tuple(found)


class Certificate(NamedTuple):
    """The result of `max_feasible_scale`."""

    scale: Scalar  # s; unless the search stopped at `enough`, no scale is larger by more than the tolerance
    n: Column  # entries (xx, yy, zz, xy, xz, yz) of N; Gram(N) - s * reference is positive definite
    converged: Bool[Array, ""]  # whether the search ended within `MAX_ROUNDS`


def max_feasible_scale(
    coefficients: Column, n: Column, reference: Gram, *, enough: float, tolerance: float
) -> Certificate:
    """Find the largest scale s for which Gram(N) - s * reference is positive semi-definite for some N.

    Gram(N) stands for `Gram.of(coefficients, N)`. If the quartic is convex, the largest s is not below zero. The search
    follows the central path: it applies Newton's method to the logarithmic barrier, and each round takes the best of a
    few step lengths. The result lies strictly inside the feasible set. So it is a proof, whatever the roundoff of the
    search.

    Args:
        coefficients: The 15 coefficients of the quartic, in the order of `Quartic`.
        n: Entries (xx, yy, zz, xy, xz, yz) of the N at which the search starts.
        reference: Gram matrix to subtract.
        enough: The search stops once s is at least this.
        tolerance: The search stops once s is known to be within this of the largest.

    Returns:
        The scale `scale`, the entries `n` of its N, and whether the search `converged`.
    """
    start = _initial_scale(coefficients, n, reference)
    zero = 0 * start
    state = (start, n, zero + BARRIER_WEIGHTS[0], jnp.zeros((), jnp.int32), start >= enough)

    def newton_round(state):
        s, n, weight, rounds, done = state
        s_new, n_new, decrement = _newton_step(coefficients, n, s, reference, weight)
        centered = decrement < 1
        # Close to the border of the feasible set, roundoff may make the result of a round NaN or infinite. Then the
        # search ends with the previous one.
        is_invalid = ~jnp.isfinite(s_new + sum(n_new))
        done_new = is_invalid | (s_new >= enough) | (centered & (BARRIER_PARAMETER / weight < tolerance))
        weight_new = jnp.where(centered, BARRIER_WEIGHTS[1] * weight, weight)

        def keep_if(new, old, condition):  # `old` where the condition holds, else `new`
            return jax.tree.map(lambda a, b: jnp.where(condition, b, a), new, old)

        s_new, n_new = keep_if((s_new, n_new), (s, n), is_invalid)
        return keep_if((s_new, n_new, weight_new, rounds + 1, done_new), state, done)

    s, n, _, _, done = jax.lax.while_loop(lambda state: ~state[4] & (state[3] < MAX_ROUNDS), newton_round, state)
    return Certificate(s, n, done)


def _initial_scale(coefficients: Column, n: Column, reference: Gram) -> Scalar:
    """Return the largest of `INITIAL_SCALES` for which Gram(n) - scale * reference is positive definite."""
    gram = Gram.of(coefficients, n)

    def keep_feasible(largest, scale):
        return jnp.where(_barrier(gram.plus(-scale, reference)).positive, scale, largest), None

    return jax.lax.scan(keep_feasible, 0 * n[0] + INITIAL_SCALES[0], jnp.asarray(INITIAL_SCALES, n[0].dtype))[0]


class _Barrier(NamedTuple):
    """The logarithmic barrier at a Gram matrix."""

    logdet: Scalar  # sum of the log determinants of both blocks; it has no meaning unless `positive`
    positive: Bool[Array, ""]  # whether both blocks are positive definite


def _barrier(gram: Gram) -> _Barrier:
    """Evaluate the logarithmic barrier."""
    six, three = (Cholesky.of(block) for block in gram)
    return _Barrier(six.logdet() + three.logdet(), six.positive & three.positive)


def _newton_step(coefficients: Column, n: Column, s: Scalar, reference: Gram, weight: Scalar):
    """Take a Newton step toward the maximum of weight * s + logdet; return s, N and the Newton decrement."""
    gram = Gram.of(coefficients, n).plus(-s, reference)
    # the unknowns are the six entries of N, then s
    gradient = [0 * s] * 6 + [weight]
    hessian = [[0 * s] * (i + 1) for i in range(7)]
    value = weight * s
    for block, reference_block, places in zip(gram, reference, (ADJUGATE_PLACES, ANTISYMMETRIC_PLACES), strict=True):
        factor = Cholesky.of(block)
        value = value + factor.logdet()
        inverse = compute_once(factor.inverse(), s)
        inverse_reference = compute_once(congruence(inverse, reference_block), s)
        for i, places_i in enumerate(places):
            gradient[i] = gradient[i] + _trace(inverse, places_i)
            for j in range(i + 1):
                hessian[i][j] = hessian[i][j] + _double_trace(inverse, places_i, places[j])
            hessian[6][i] = hessian[6][i] - _trace(inverse_reference, places_i)
        gradient[6] = gradient[6] - _product_trace(inverse, reference_block)
        hessian[6][6] = hessian[6][6] + _product_trace(inverse_reference, reference_block)
    gradient, hessian = compute_once((tuple(gradient), tuple(tuple(row) for row in hessian)), s)
    step = compute_once(Cholesky.of(hessian).solve(gradient), s)
    decrement_squared = sum((a * b for a, b in zip(gradient, step, strict=True)), 0 * s)
    decrement = jnp.sqrt(jnp.maximum(decrement_squared, 0))
    step_lengths = jnp.stack([*(0 * s + step_length for step_length in STEP_LENGTHS), 1 / (1 + decrement)])

    def try_length(state, step_length):
        best_length, best_value = state
        trial_s, trial_n = _after_step(s, n, step, step_length)
        trial = _barrier(Gram.of(coefficients, trial_n).plus(-trial_s, reference))
        value = weight * trial_s + trial.logdet
        better = decide(trial.positive & (value > best_value), s)
        return (jnp.where(better, step_length, best_length), jnp.where(better, value, best_value)), None

    best_length = jax.lax.scan(try_length, (0 * s, value), step_lengths)[0][0]
    s, n = compute_once(_after_step(s, n, step, best_length), weight)
    return s, n, decrement


def _after_step(s: Scalar, n: Column, step: Column, step_length):
    """Return s and N after a step of length `step_length`."""
    return s + step_length * step[6], tuple(a + step_length * b for a, b in zip(n, step, strict=False))


def _weighted_sum(size: int, parts) -> Lower:
    """Return the lower triangle of a weighted sum of matrices, given as pairs of (entries by place, weight)."""
    rows = [[None] * (i + 1) for i in range(size)]
    zero = 0 * parts[0][1]
    for places, weight in parts:
        for (i, j), value in places.items():
            term = weight if value == 1.0 else value * weight
            rows[i][j] = term if rows[i][j] is None else rows[i][j] + term
    return tuple(tuple(zero if e is None else e for e in row) for row in rows)


def _symmetric_entries(places):
    """Yield all entries (i, j, value) of the symmetric matrix whose lower triangle is `places`."""
    for (i, j), value in places.items():
        yield i, j, value
        if i != j:
            yield j, i, value


def _trace(x: Lower, places) -> Scalar:
    """Return trace(x E) for the symmetric matrix E whose lower triangle is `places`."""
    return sum((value * entry(x, i, j) for i, j, value in _symmetric_entries(places)), 0 * x[0][0])


def _double_trace(x: Lower, first, second) -> Scalar:
    """Return trace(x E x E') for the symmetric matrices E and E' whose lower triangles are `first` and `second`."""
    total = 0 * x[0][0]
    for i, j, a in _symmetric_entries(first):
        for k, l, b in _symmetric_entries(second):
            total = total + a * b * entry(x, j, k) * entry(x, l, i)
    return total


def _product_trace(x: Lower, m: Lower) -> Scalar:
    """Return trace(x m) of two symmetric matrices."""
    total = 0 * x[0][0]
    for i, row in enumerate(m):
        for j, value in enumerate(row):
            total = total + (1 if i == j else 2) * x[i][j] * value
    return total
