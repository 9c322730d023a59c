"""Gram matrices of a quartic: proof that it is convex, and which of them stands for it.

H is convex where z' hess H(F) z >= 0, that is where the form T(z, z, F, F) of its symmetric tensor is nowhere negative.
With S the symmetric part of z F', and a half of z x F, every way of writing that form as a quadratic one in (S, a) is

    T(S, S) + <N, adj S> + a' N a,      N symmetric, 3 x 3,

because adj S = -a a' for every z and F. So H is convex if, for some N, both N and the 6 x 6 matrix of the first two
terms are positive semi-definite; and of three variables and degree four, only if (convex means sos-convex there: Ahmadi
& Parrilo 2013). These two blocks are the 9 x 9 Gram matrix of Zhou et al. 2017 (section V) in a basis of symmetric and
antisymmetric parts; of the nine directions in which that one is not unique, three change no eigenvalue for the better,
because the form is the same with z and F exchanged.

A quartic H has only the 6 x 6 block to say: H(F) = v' G v, with v the six products of two components of F.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, settle
from pushjax.limit_surface._dense import Cholesky, Column, Lower, combined, entry, sandwiched

# The six products v: x², y², z², xy, xz, yz.
# <N, adj S> as a matrix over them: for each entry of N (xx, yy, zz, xy, xz, yz), what it adds where.
ADJUGATE = (
    {(2, 1): 0.5, (5, 5): -1.0},
    {(2, 0): 0.5, (4, 4): -1.0},
    {(1, 0): 0.5, (3, 3): -1.0},
    {(5, 4): 1.0, (3, 2): -1.0},
    {(5, 3): 1.0, (4, 1): -1.0},
    {(4, 3): 1.0, (5, 0): -1.0},
)
# The same for N itself.
ITSELF = ({(0, 0): 1.0}, {(1, 1): 1.0}, {(2, 2): 1.0}, {(1, 0): 1.0}, {(2, 0): 1.0}, {(2, 1): 1.0})
# T(S, S): for each of the 15 coefficients, how much of it is where
SPREAD = (
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
BLOCKS = 9  # rows of both blocks: the barrier's parameter
MOST_ROUNDS = 60
WEIGHTS = (4.0, 16.0)  # of the share against the barrier: at first, and how much more once centred
STRIDES = (1.0, 0.7, 0.4)
FIRST = (-1e6, -1e4, -100.0, -10.0, -3.0, -1.0, -0.3, -0.1, 0.0)


class Gram(NamedTuple):
    """The two blocks. symmetric: 6 x 6, v' symmetric v = H; antisymmetric: N, 3 x 3."""

    symmetric: Lower
    antisymmetric: Lower

    @staticmethod
    def of(coefficients: Column, n: Column) -> "Gram":
        """That of a quartic (15,), in `Quartic`'s order, with N (xx, yy, zz, xy, xz, yz)."""
        parts = (*zip(SPREAD, coefficients, strict=True), *zip(ADJUGATE, n, strict=True))
        return Gram(_assembled(6, parts), _assembled(3, tuple(zip(ITSELF, n, strict=True))))

    @staticmethod
    def identity(like: Scalar) -> "Gram":
        """The 9 x 9 identity, in these blocks."""
        zero, one = 0 * like, 0 * like + 1
        six, three = (one, one, one, 2 * one, 2 * one, 2 * one), (2 * one,) * 3
        return Gram(*(tuple((zero,) * i + (d,) for i, d in enumerate(diagonal)) for diagonal in (six, three)))

    def plus(self, factor: Scalar, other: "Gram") -> "Gram":
        return Gram(*(combined(mine, factor, its) for mine, its in zip(self, other, strict=True)))


def coefficients_of(symmetric: Lower) -> Column:
    """The quartic v' G v."""
    return tuple(
        sum(((1 if i == j else 2) * symmetric[i][j] for (i, j) in places), 0 * symmetric[0][0]) for places in SPREAD
    )


def antisymmetric_of(symmetric: Lower) -> Column:
    """N, such that `symmetric` is the 6 x 6 block of its own quartic with it."""
    found = []
    for places in ADJUGATE:
        (above, a), (below, b) = ((symmetric[i][j], value) for (i, j), value in places.items())
        found.append((4 * above - below) / 3 if b == -1.0 and a == 0.5 else (above - 2 * below) / 3)
    return tuple(found)


class Share(NamedTuple):
    """share: a Gram matrix of the quartic less so much of the reference is positive definite, and hardly any with
    more. n: its N. settled: whether the search ended."""

    share: Scalar
    n: Column
    settled: Bool[Array, ""]


def largest_share(coefficients: Column, n: Column, reference: Gram, *, enough: float, tolerance: float) -> Share:
    """How much of a reference's Gram matrix can be taken off a quartic's, by choice of N, that both stay positive
    definite; to `tolerance`, and the search ends at `enough`. Not below zero where the quartic is convex.

    Follows the central path of: the largest s with Gram(N) - s reference >= 0, by Newton's method on the logarithmic
    barrier from the N given, each round with the best of a few strides. What comes back is strictly inside, so it is
    a proof whatever the rounding of the search.
    """
    start = _begin(coefficients, n, reference)
    zero = 0 * start
    state = (start, n, zero + WEIGHTS[0], jnp.zeros((), jnp.int32), start >= enough)

    def body(state):
        s, n, weight, rounds, done = state
        s_new, n_new, moved = _newton(coefficients, n, s, reference, weight)
        centred = moved < 1
        # near the border a round may come to nothing in so few digits: what was found before stands
        lost = ~jnp.isfinite(s_new + sum(n_new))
        done_now = lost | (s_new >= enough) | (centred & (BLOCKS / weight < tolerance))
        weight_new = jnp.where(centred, WEIGHTS[1] * weight, weight)

        def kept(new, old, held):
            return jax.tree.map(lambda a, b: jnp.where(held, b, a), new, old)

        s_new, n_new = kept((s_new, n_new), (s, n), lost)
        return kept((s_new, n_new, weight_new, rounds + 1, done_now), state, done)

    s, n, _, _, done = jax.lax.while_loop(lambda state: ~state[4] & (state[3] < MOST_ROUNDS), body, state)
    return Share(s, n, done)


def _begin(coefficients: Column, n: Column, reference: Gram) -> Scalar:
    """A share, zero if that will do, with which it is positive definite."""
    gram = Gram.of(coefficients, n)

    def nearer(start, share):
        return jnp.where(_barrier(gram.plus(-share, reference)).positive, share, start), None

    return jax.lax.scan(nearer, 0 * n[0] + FIRST[0], jnp.asarray(FIRST, n[0].dtype))[0]


class _Barrier(NamedTuple):
    """logdet: of both blocks. positive: whether they are positive definite; where not, it means nothing."""

    logdet: Scalar
    positive: Bool[Array, ""]


def _barrier(gram: Gram) -> _Barrier:
    six, three = (Cholesky.of(block) for block in gram)
    return _Barrier(six.logdet() + three.logdet(), six.positive & three.positive)


def _newton(coefficients: Column, n: Column, s: Scalar, reference: Gram, weight: Scalar):
    """One round for weight s + logdet of both blocks of Gram(N) - s reference: s, N, and the Newton decrement."""
    gram = Gram.of(coefficients, n).plus(-s, reference)
    slopes = [0 * s] * 6 + [weight]
    bends = [[0 * s] * (i + 1) for i in range(7)]
    value = weight * s
    for block, ref, table in zip(gram, reference, (ADJUGATE, ITSELF), strict=True):
        factor = Cholesky.of(block)
        value = value + factor.logdet()
        x = settle(factor.inverse(), s)
        across = settle(sandwiched(x, ref), s)
        for i, mine in enumerate(table):
            slopes[i] = slopes[i] + _trace(x, mine)
            for j in range(i + 1):
                bends[i][j] = bends[i][j] + _twice(x, mine, table[j])
            bends[6][i] = bends[6][i] - _trace(across, mine)
        slopes[6] = slopes[6] - _product_trace(x, ref)
        bends[6][6] = bends[6][6] + _product_trace(across, ref)
    slopes, bends = settle((tuple(slopes), tuple(tuple(row) for row in bends)), s)
    step = settle(Cholesky.of(bends).solve(slopes), s)
    squared = sum((a * b for a, b in zip(slopes, step, strict=True)), 0 * s)
    decrement = jnp.sqrt(jnp.maximum(squared, 0))
    strides = jnp.stack([*(0 * s + stride for stride in STRIDES), 1 / (1 + decrement)])

    def longer(state, stride):
        best, most = state
        at_s, at_n = _along(s, n, step, stride)
        reached = _barrier(Gram.of(coefficients, at_n).plus(-at_s, reference))
        value = weight * at_s + reached.logdet
        better = settle(reached.positive & (value > most), s)
        return (jnp.where(better, stride, best), jnp.where(better, value, most)), None

    best = jax.lax.scan(longer, (0 * s, value), strides)[0][0]
    s, n = settle(_along(s, n, step, best), weight)
    return s, n, decrement


def _along(s: Scalar, n: Column, step: Column, stride):
    return s + stride * step[6], tuple(a + stride * b for a, b in zip(n, step, strict=False))


def _assembled(size: int, parts) -> Lower:
    rows = [[None] * (i + 1) for i in range(size)]
    zero = 0 * parts[0][1]
    for places, scale in parts:
        for (i, j), value in places.items():
            term = scale if value == 1.0 else value * scale
            rows[i][j] = term if rows[i][j] is None else rows[i][j] + term
    return tuple(tuple(zero if e is None else e for e in row) for row in rows)


def _both(places):
    """Entries of the whole symmetric matrix."""
    for (i, j), value in places.items():
        yield i, j, value
        if i != j:
            yield j, i, value


def _trace(x: Lower, places) -> Scalar:
    """trace(x E)."""
    return sum((value * entry(x, i, j) for i, j, value in _both(places)), 0 * x[0][0])


def _twice(x: Lower, first, second) -> Scalar:
    """trace(x E x E')."""
    total = 0 * x[0][0]
    for i, j, a in _both(first):
        for k, l, b in _both(second):
            total = total + a * b * entry(x, j, k) * entry(x, l, i)
    return total


def _product_trace(x: Lower, m: Lower) -> Scalar:
    total = 0 * x[0][0]
    for i, row in enumerate(m):
        for j, value in enumerate(row):
            total = total + (1 if i == j else 2) * x[i][j] * value
    return total
