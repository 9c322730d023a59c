"""How hard the hand squeezes: a certificate that there is a motion, and how far from a jam it is.

Contact forces in their friction cones whose wrenches cancel are an internal equilibrium: the fingers can press
through the slider against each other. The work they would do on it over the step, per unit of normal force,

    power = max  sum_e alpha_e p_e   over alpha >= 0,  sum alpha_e g_e = 0,  sum alpha_e = 1,

with p_e the pusher's displacement along edge e less the gap, is the squeeze power, in metres. Without a positive one
the problem has a solution (its LCP is copositive); the converse is false. A linear program in so few variables has few
basic solutions, and all are tried: of four edges, and of two or three that balance by themselves (frictionless fingers
straight opposite, or whose normals meet in one point), which they do to BALANCE.

The weights of four edges are determinants. The cross product of the two edges of one contact is 2 mu t x n and is
written as such, with mu taken out: so they are exact for the smallest friction, and no sign hangs on rounding.
"""

import functools
from itertools import combinations, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._autodiff import undifferentiated
from pushjax._vec import Scalar, Vec3, select, settle, wherever
from pushjax.solve._several import Several, pick

# What may be left over of two or three edges that balance, of their sum: rounding of what a user computes them from.
BALANCE = {4: 2e-6, 8: 1e-10}
NOISE = 2  # roundings of its terms, which a determinant may be off by

Numbers = tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""], Int[Array, ""]]  # of four edges


class Squeeze(NamedTuple):
    """power: dimensionless (times `speed`: m); minus infinity where no internal equilibrium exists, as for one contact.
    presses: whether it is positive for certain, and not only by rounding."""

    power: Scalar
    presses: Bool[Array, ""]


class _Edges(NamedTuple):
    """Every cone edge. wrench: of unit normal force, and power: its; active: whether its contact counts.

    friction: of its contact. turning: t x n of its contact, twice. After them come two that carry nothing, of the
    numbers `moment` and `across`: a pure moment, and the direction at right angles to a set's others.
    """

    wrench: tuple[Vec3, ...]
    power: tuple[Scalar, ...]
    active: tuple[Bool[Array, ""], ...]
    friction: tuple[Scalar, ...]
    turning: tuple[Vec3, ...]

    @property
    def moment(self) -> int:
        return len(self.wrench) - 2

    @property
    def across(self) -> int:
        return len(self.wrench) - 1

    def four(self, numbers: Numbers) -> "_Four":
        firsts = numbers[0], numbers[2]
        return _Four(
            tuple(pick(self.wrench, e) for e in numbers),
            tuple(pick(self.power, e) for e in numbers),
            tuple(pick(self.friction, e) for e in firsts),
            tuple(pick(self.turning, e) for e in firsts),
            functools.reduce(jnp.logical_and, (pick(self.active, e) for e in numbers)),
        )

    def kind(self, numbers: Numbers) -> "_Kind":
        first, second, third, fourth = numbers
        return _Kind(first // 2 == second // 2, third // 2 == fourth // 2, fourth == self.across, third == self.moment)


class _Four(NamedTuple):
    """Four of the edges. friction, turning: of the first and the third. active: whether all are."""

    wrench: tuple[Vec3, ...]
    power: tuple[Scalar, ...]
    friction: tuple[Scalar, ...]
    turning: tuple[Vec3, ...]
    active: Bool[Array, ""]

    def cross(self, pair: int, same: Bool[Array, ""]) -> tuple[Vec3, Scalar, Scalar]:
        """The product of the first two (pair 0) or the last two (1), as a vector and a factor, and the size of the
        vector's terms.

        same: whether both are of one contact.
        """
        g, h = self.wrench[2 * pair : 2 * pair + 2]
        apart = g.cross(h), jnp.ones_like(g.x), _size(g) * _size(h)
        turning = self.turning[pair]
        return select(same, (turning, self.friction[pair], _size(turning)), apart)


def squeeze(problem: Several, wanted: bool | Bool[Array, ""]) -> Squeeze:
    """The squeeze power; where it is not wanted, as if there were no internal equilibrium. Not wanted by any of a batch
    it takes no time."""
    m = problem.count
    lowest = jnp.full_like(problem.speed, -jnp.inf)
    if m < 2:
        return Squeeze(lowest, jnp.zeros((), bool))
    edges = _edges(problem)
    power, presses, best = undifferentiated(_wanted_best, edges, wanted, problem.speed)
    # Only the best is differentiated. That it exists is not decided again: another rounding could deny it.
    again = _basic(settle(edges.four(best), problem.speed), edges.kind(best)).power
    return Squeeze(jnp.where(power > lowest, again, lowest), presses)


def _edges(problem: Several) -> _Edges:
    zero = jnp.zeros_like(problem.speed)
    one = zero + 1
    still, moment = Vec3(zero, zero, zero), Vec3(zero, zero, one)
    wrench = (*problem.generators, moment, still)
    turning = tuple(t.cross(n).scale(2) for n, t in zip(problem.normal, problem.tangent, strict=True))
    each = range(2 * problem.count)
    return _Edges(
        wrench,
        (*_powers(problem), zero, zero),
        (*(problem.active[k // 2] for k in each), *(jnp.ones((), bool),) * 2),
        (*(problem.friction[k // 2] for k in each), one, one),
        (*(turning[k // 2] for k in each), still, still),
    )


class _Kind(NamedTuple):
    """Which four edges they are.

    same12, same34: whether the first two, and the last two, are of one contact. by_itself: whether the first three
    are to balance, the fourth being `across`. twisting: whether the third is `moment`.
    """

    same12: Bool[Array, ""]
    same34: Bool[Array, ""]
    by_itself: Bool[Array, ""]
    twisting: Bool[Array, ""]


def _sets(edges: int) -> list[tuple[int, ...]]:
    """All fours; all threes, and twos with the moment. Two edges of a contact, whose product is exact, come first."""

    def pair_first(some: tuple[int, ...]) -> tuple[int, ...]:
        twice = [(a, b) for a, b in pairwise(some) if a // 2 == b // 2]
        return (*twice[0], *(e for e in some if e not in twice[0])) if twice else some

    fours = [pair_first(four) for four in combinations(range(edges), 4)]
    return fours + [(*pair_first(three), edges + 1) for three in combinations(range(edges + 1), 3)]


def _wanted_best(edges: _Edges, wanted: bool | Bool[Array, ""], witness: Scalar) -> tuple:
    """The largest power, whether any is positive for certain, and the four edges of the largest."""
    lowest = jnp.full_like(witness, -jnp.inf)
    none = lowest, jnp.zeros(lowest.shape, bool), (jnp.zeros(lowest.shape, jnp.int32),) * 4
    search = functools.partial(_best, edges, witness)
    return wherever(jnp.asarray(wanted), search, none)


def _best(edges: _Edges, witness: Scalar, best: tuple) -> tuple:
    """The same, from `best` on, over all sets of edges that may make up a squeeze."""

    def body(best, four):
        largest, presses, kept = best
        # settled, or everything that uses an edge would pick it again
        found = _basic(settle(edges.four(four), witness), edges.kind(four))
        better, sure = found.exists & (found.power > largest), found.exists & (found.power > found.noise)
        better, sure = settle((better, sure), witness)
        return (jnp.where(better, found.power, largest), presses | sure, select(better, four, kept)), None

    columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*_sets(edges.moment), strict=True))
    return jax.lax.scan(body, best, columns)[0]


def _powers(problem: Several) -> tuple[Scalar, ...]:
    powers = []
    for push, mu in zip(problem.approach, problem.friction, strict=True):
        powers += [push.x + mu * push.y, push.x - mu * push.y]
    return tuple(powers)


def _size(v: Vec3) -> Scalar:
    return jnp.abs(v.x) + jnp.abs(v.y) + jnp.abs(v.z)


class _Basic(NamedTuple):
    """Four edges' internal equilibrium: its power, what rounding may make of that, and whether there is one."""

    power: Scalar
    noise: Scalar
    exists: Bool[Array, ""]


def _basic(four: _Four, kind: _Kind) -> _Basic:
    g1, g2, g3, g4 = four.wrench
    x12, mu12, s12 = four.cross(0, kind.same12)
    x34, mu34, s34 = four.cross(1, kind.same34)
    normal = _normal(x12, g2.cross(g3), g3.cross(g1))
    alone = normal, (g3.cross(normal), jnp.ones_like(g3.x), _size(g3))
    g4, (x34, mu34, s34) = select(kind.by_itself, alone, (g4, (x34, mu34, s34)))
    unit = jax.lax.stop_gradient(1 / jnp.maximum(jnp.maximum(mu12, mu34), jnp.finfo(g1.x.dtype).tiny))
    mu12, mu34 = mu12 * unit, mu34 * unit
    # settled: two roundings of a weight that cancels would differ by more than rounding
    weights = settle((mu34 * g2.dot(x34), -mu34 * g1.dot(x34), mu12 * g4.dot(x12), -mu12 * g3.dot(x12)), g1.x + g2.y)
    # the moment and what stands in for a fourth carry nothing: of an equilibrium they are rounding
    third, fourth = weights[2:]
    idle = jnp.where(kind.twisting, jnp.abs(third), 0.0) + jnp.where(kind.by_itself, jnp.abs(fourth), 0.0)
    weights = (*weights[:2], jnp.where(kind.twisting, 0.0, third), jnp.where(kind.by_itself, 0.0, fourth))
    total = weights[0] + weights[1] + weights[2] + weights[3]
    extent = sum((jnp.abs(w) for w in weights), 0 * total)
    eps, balance = jnp.finfo(total.dtype).eps, BALANCE[total.dtype.itemsize]
    terms = mu34 * s34 * (_size(g1) + _size(g2)) + mu12 * s12 * (_size(g3) + _size(g4))
    noise = jax.lax.stop_gradient(NOISE * eps * terms)
    # all of one sign, to rounding, not all rounding, and nothing left over
    exists = four.active & (jnp.abs(total) >= extent * (1 - 64 * eps)) & (extent > noise) & (idle <= balance * extent)
    share = 1 / jnp.where(total != 0, total, 1.0)
    power, most = 0 * total, 0 * total
    for w, p in zip(weights, four.power, strict=True):
        power, most = power + w * p, jnp.maximum(most, jnp.abs(p))
    return _Basic(share * power, jnp.abs(share) * most * noise, exists)


def _normal(*products: Vec3) -> Vec3:
    """A unit vector along the longest; a constant to every derivative."""
    best = products[0]
    for x in products[1:]:
        best = select(settle(x.dot(x) > best.dot(best), x.x + best.x), x, best)
    return settle(jax.lax.stop_gradient(best.unit()), best.x)
