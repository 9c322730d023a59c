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

from itertools import combinations, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._autodiff import undifferentiated
from pushjax._vec import Scalar, Vec3, select, settle
from pushjax.solve._several import Index, Several, pick

# What may be left over of two or three edges that balance, of their sum: rounding of what a user computes them from.
BALANCE = {4: 2e-6, 8: 1e-10}
NOISE = 2  # roundings of its terms, which a determinant may be off by


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

    def cross(self, a: Index, b: Index, same: bool | Bool[Array, ""]) -> tuple[Vec3, Scalar | float, Scalar]:
        """The product of edges a < b, as a vector and a factor, and the size of the vector's terms.

        same: whether both are of one contact.
        """
        g, h = pick(self.wrench, a), pick(self.wrench, b)
        apart = g.cross(h), 1.0, _size(g) * _size(h)
        if same is False:
            return apart
        turning = pick(self.turning, a)
        return _where(same, (turning, pick(self.friction, a), _size(turning)), apart)


def _where(condition: bool | Bool[Array, ""], yes, no):
    """`select`, also of what is known without numbers."""
    if isinstance(condition, bool):
        return yes if condition else no
    return select(condition, yes, no)


def squeeze(problem: Several) -> Squeeze:
    """The squeeze power."""
    m = problem.count
    lowest = jnp.full_like(problem.speed, -jnp.inf)
    if m < 2:
        return Squeeze(lowest, jnp.zeros((), bool))
    edges = _edges(problem)
    power, presses, *best = undifferentiated(_best, edges, problem.speed)
    # Only the best is differentiated. That it exists is not decided again: another rounding could deny it.
    first, second, third, fourth = best
    same = first // 2 == second // 2, third // 2 == fourth // 2
    again = _basic(edges, (first, second, third, fourth), *same, fourth == edges.across).power
    return Squeeze(jnp.where(power > lowest, again, lowest), presses)


def _edges(problem: Several) -> _Edges:
    zero = jnp.zeros_like(problem.speed)
    one = zero + 1
    still, moment = Vec3(zero, zero, zero), Vec3(zero, zero, one)
    wrench = (*problem.generators(), moment, still)
    turning = tuple(t.cross(n).scale(2) for n, t in zip(problem.normal, problem.tangent, strict=True))
    each = range(2 * problem.count)
    return _Edges(
        wrench,
        (*_powers(problem), zero, zero),
        (*(problem.active[k // 2] for k in each), *(jnp.ones((), bool),) * 2),
        (*(problem.friction[k // 2] for k in each), one, one),
        (*(turning[k // 2] for k in each), still, still),
    )


class _Sets(NamedTuple):
    """Sets of one form. same: whether the first two, and the last two, are of one contact, as far as all agree.
    by_itself: whether three balance, the fourth being `across`."""

    fours: list[tuple[int, ...]]
    same: tuple[bool, bool | None]
    by_itself: bool


def _sets(edges: int) -> list[_Sets]:
    """All fours, with the two edges of a contact first; all threes, and twos with the moment."""
    pairs, others = [], []
    for four in combinations(range(edges), 4):
        twice = [(a, b) for a, b in pairwise(four) if a // 2 == b // 2]
        if twice:
            pairs.append((*twice[0], *(e for e in four if e not in twice[0])))
        else:
            others.append(four)
    threes = [(*three, edges + 1) for three in combinations(range(edges + 1), 3)]
    apart = False, False
    return [_Sets(pairs, (True, None), False), _Sets(others, apart, False), _Sets(threes, apart, True)]


def _best(edges: _Edges, witness: Scalar) -> tuple:
    """The largest power, whether any is positive for certain, and the four edges of the largest."""
    lowest = jnp.full_like(witness, -jnp.inf)
    best = (lowest, jnp.zeros(lowest.shape, bool), *(jnp.zeros(lowest.shape, jnp.int32),) * 4)
    for sets in _sets(edges.moment):

        def body(best, four, sets=sets):
            largest, presses, *kept = best
            first, last = sets.same
            same = four[2] // 2 == four[3] // 2 if last is None else last
            found = _basic(edges, four, first, same, sets.by_itself)
            exists = found.exists
            for edge in four:
                exists &= pick(edges.active, edge)
            better, sure = settle((exists & (found.power > largest), exists & (found.power > found.noise)), witness)
            kept = (jnp.where(better, e, b) for e, b in zip(four, kept, strict=True))
            return (jnp.where(better, found.power, largest), presses | sure, *kept), None

        if sets.fours:
            columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*sets.fours, strict=True))
            best = jax.lax.scan(body, best, columns)[0]
    return best


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


def _basic(
    edges: _Edges,
    four: tuple,
    same12: bool | Bool[Array, ""],
    same34: bool | Bool[Array, ""],
    by_itself: bool | Bool[Array, ""],
) -> _Basic:
    """Of the edges with these numbers; what they are, see `_Sets`."""
    g1, g2, g3 = (pick(edges.wrench, e) for e in four[:3])
    x12, mu12, s12 = edges.cross(four[0], four[1], same12)
    if by_itself is False:
        g4 = pick(edges.wrench, four[3])
        x34, mu34, s34 = edges.cross(four[2], four[3], same34)
    else:
        g4 = _normal(x12, g2.cross(g3), g3.cross(g1))
        x34, mu34, s34 = g3.cross(g4), 1.0, _size(g3)
        if by_itself is not True:
            two = edges.cross(four[2], four[3], same34)
            g4, (x34, mu34, s34) = select(by_itself, (g4, (x34, mu34, s34)), (pick(edges.wrench, four[3]), two))
    unit = jax.lax.stop_gradient(1 / jnp.maximum(jnp.maximum(mu12, mu34), jnp.finfo(g1.x.dtype).tiny))
    mu12, mu34 = mu12 * unit, mu34 * unit
    # settled: two roundings of a weight that cancels would differ by more than rounding
    weights = settle((mu34 * g2.dot(x34), -mu34 * g1.dot(x34), mu12 * g4.dot(x12), -mu12 * g3.dot(x12)), g1.x + g2.y)
    idle = 0 * weights[0]
    if by_itself is not False:
        carries = [True, True, four[2] < edges.moment, jnp.logical_not(by_itself)]
        idle = sum((jnp.where(c, 0.0, jnp.abs(w)) for w, c in zip(weights, carries, strict=True)), idle)
        weights = tuple(jnp.where(c, w, 0.0) for w, c in zip(weights, carries, strict=True))
    total = weights[0] + weights[1] + weights[2] + weights[3]
    extent = sum((jnp.abs(w) for w in weights), 0 * total)
    eps, balance = jnp.finfo(total.dtype).eps, BALANCE[total.dtype.itemsize]
    terms = mu34 * s34 * (_size(g1) + _size(g2)) + mu12 * s12 * (_size(g3) + _size(g4))
    noise = jax.lax.stop_gradient(NOISE * eps * terms)
    # all of one sign, to rounding, not all rounding, and nothing left over
    exists = (jnp.abs(total) >= extent * (1 - 64 * eps)) & (extent > noise) & (idle <= balance * extent)
    share = 1 / jnp.where(total != 0, total, 1.0)
    power, most = 0 * total, 0 * total
    for w, e in zip(weights, four, strict=True):
        p = pick(edges.power, e)
        power, most = power + w * p, jnp.maximum(most, jnp.abs(p))
    return _Basic(share * power, jnp.abs(share) * most * noise, exists)


def _normal(*products: Vec3) -> Vec3:
    """A unit vector along the longest; a constant to every derivative."""
    best = products[0]
    for x in products[1:]:
        best = select(settle(x.dot(x) > best.dot(best), x.x + best.x), x, best)
    return settle(jax.lax.stop_gradient(best.unit()), best.x)
