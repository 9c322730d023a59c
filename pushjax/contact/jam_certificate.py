"""The hand's squeeze power: a certificate that there is a motion, and a measure of how far from a jam the hand is.

Contact forces in their friction cones whose wrenches cancel are an internal equilibrium: the fingers can press through
the slider against each other. The squeeze power, in meters, is the work that they would do on it over the step, per
unit of normal force,

    power = max  sum_e alpha_e p_e   over alpha >= 0,  sum alpha_e g_e = 0,  sum alpha_e = 1,

where p_e is the pusher's displacement along edge e less the gap. If it is not positive, the problem has a solution (its
LCP is copositive). The converse is false.

A linear program in so few variables has few basic solutions, and all are tried. They are sets of four edges, and sets
of two or three edges that balance by themselves (frictionless fingers straight opposite, or fingers whose normals meet
in one point). Such sets have to balance to BALANCE.

The weights of four edges are determinants. The cross product of the two edges of one contact is 2 mu t x n. It is
written in this form, with mu taken out, so the weights are exact for the smallest friction, and no sign depends on
roundoff.
"""

import functools
from itertools import combinations, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.xla import compute_once, decide, tree_where, update_if
from pushjax._math.vec import Scalar, Vec3
from pushjax.contact.scaled_problem import ScaledProblem, dynamic_index

# The unbalanced part that two or three edges may have and still balance, relative to their sum: roundoff of the numbers
# that a user computes them from. By bytes of the number.
BALANCE = {4: 2e-6, 8: 1e-10}
NOISE = 2  # roundoff of a determinant, in roundings of its terms

Numbers = tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""], Int[Array, ""]]  # numbers of four edges


class Squeeze(NamedTuple):
    """The squeeze power.

    Attributes:
        power: Dimensionless; times `speed` it is in m. Minus infinity where no internal equilibrium exists, as for one
            contact.
        presses: Whether the power is positive for certain, and not only by roundoff.
    """

    power: Scalar
    presses: Bool[Array, ""]


class _Edges(NamedTuple):
    """Every cone edge, then two dummy edges that carry no force.

    The dummy edges have the numbers `moment` and `across`. They are a pure moment and the direction orthogonal to a
    set's other edges. With them a set of two or three edges is computed as a set of four.

    Attributes:
        wrench: Wrench of each edge, of unit normal force.
        power: Power of that wrench.
        active: Whether the edge's contact takes part.
        friction: Coefficient of friction of the edge's contact.
        turning: 2 t x n of the edge's contact.
    """

    wrench: tuple[Vec3, ...]
    power: tuple[Scalar, ...]
    active: tuple[Bool[Array, ""], ...]
    friction: tuple[Scalar, ...]
    turning: tuple[Vec3, ...]

    @property
    def moment(self) -> int:
        """Number of the dummy edge that is a pure moment."""
        return len(self.wrench) - 2

    @property
    def across(self) -> int:
        """Number of the dummy edge orthogonal to a set's other edges."""
        return len(self.wrench) - 1

    def four(self, numbers: Numbers) -> "_Four":
        """The four edges with these numbers."""
        firsts = numbers[0], numbers[2]
        return _Four(
            tuple(dynamic_index(self.wrench, e) for e in numbers),
            tuple(dynamic_index(self.power, e) for e in numbers),
            tuple(dynamic_index(self.friction, e) for e in firsts),
            tuple(dynamic_index(self.turning, e) for e in firsts),
            functools.reduce(jnp.logical_and, (dynamic_index(self.active, e) for e in numbers)),
        )

    def kind(self, numbers: Numbers) -> "_Kind":
        """What kind of set the four edges with these numbers are."""
        first, second, third, fourth = numbers
        return _Kind(first // 2 == second // 2, third // 2 == fourth // 2, fourth == self.across, third == self.moment)


class _Four(NamedTuple):
    """Four of the edges.

    Attributes:
        wrench: Wrench of each edge.
        power: Power of each edge.
        friction: Coefficients of friction of the first and the third edge.
        turning: `turning` of the first and the third edge.
        active: Whether all four edges are active.
    """

    wrench: tuple[Vec3, ...]
    power: tuple[Scalar, ...]
    friction: tuple[Scalar, ...]
    turning: tuple[Vec3, ...]
    active: Bool[Array, ""]

    def cross(self, pair: int, same: Bool[Array, ""]) -> tuple[Vec3, Scalar, Scalar]:
        """Cross product of the first two edges (pair 0) or of the last two (pair 1).

        Args:
            pair: 0 or 1.
            same: Whether both edges are of one contact.

        Returns:
            The product as a vector and a factor, and the size of the vector's terms.
        """
        g, h = self.wrench[2 * pair : 2 * pair + 2]
        apart = g.cross(h), jnp.ones_like(g.x), _size(g) * _size(h)
        turning = self.turning[pair]
        return tree_where(same, (turning, self.friction[pair], _size(turning)), apart)


def squeeze_power(problem: ScaledProblem, wanted: bool | Bool[Array, ""]) -> Squeeze:
    """Compute the squeeze power of a hand.

    Args:
        problem: The dimensionless contact problem.
        wanted: Whether to compute it. Where not, the result is that without an internal equilibrium. If it is wanted
            for no example of a batch, it takes no time.

    Returns:
        The squeeze power. It is differentiable.
    """
    m = problem.count
    lowest = jnp.full_like(problem.speed, -jnp.inf)
    if m < 2:
        return Squeeze(lowest, jnp.zeros((), bool))
    edges = _edges(problem)
    power, presses, best = without_derivatives(_wanted_best, edges, wanted, problem.speed)
    # Only the best set is differentiated. Whether it exists is not decided again, because with other roundoff the
    # answer could be no.
    again = _basic(compute_once(edges.four(best), problem.speed), edges.kind(best)).power
    return Squeeze(jnp.where(power > lowest, again, lowest), presses)


def _edges(problem: ScaledProblem) -> _Edges:
    """The edges of a problem, with the two dummy edges."""
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
    """What kind of set four edges are.

    Attributes:
        same12: Whether the first two edges are of one contact.
        same34: Whether the last two edges are of one contact.
        by_itself: Whether the first three edges have to balance by themselves; the fourth is `across`.
        twisting: Whether the third edge is `moment`.
    """

    same12: Bool[Array, ""]
    same34: Bool[Array, ""]
    by_itself: Bool[Array, ""]
    twisting: Bool[Array, ""]


def _sets(edges: int) -> list[tuple[int, ...]]:
    """All sets of four edges, all of three with `across`, and all of two with `moment` and `across`.

    Two edges of one contact come first in their set, because their cross product is exact.
    """

    def pair_first(some: tuple[int, ...]) -> tuple[int, ...]:
        twice = [(a, b) for a, b in pairwise(some) if a // 2 == b // 2]
        return (*twice[0], *(e for e in some if e not in twice[0])) if twice else some

    fours = [pair_first(four) for four in combinations(range(edges), 4)]
    return fours + [(*pair_first(three), edges + 1) for three in combinations(range(edges + 1), 3)]


def _wanted_best(edges: _Edges, wanted: bool | Bool[Array, ""], like: Scalar) -> tuple:
    """The largest power, whether any is positive for certain, and the four edges of the largest."""
    lowest = jnp.full_like(like, -jnp.inf)
    none = lowest, jnp.zeros(lowest.shape, bool), (jnp.zeros(lowest.shape, jnp.int32),) * 4
    search = functools.partial(_best, edges, like)
    return update_if(jnp.asarray(wanted), search, none)


def _best(edges: _Edges, like: Scalar, best: tuple) -> tuple:
    """`_wanted_best` over all sets of edges that may make up a squeeze, starting from `best`."""

    def body(best, four):
        largest, presses, kept = best
        # `compute_once`, or everything that uses an edge would select it again
        found = _basic(compute_once(edges.four(four), like), edges.kind(four))
        better, sure = found.exists & (found.power > largest), found.exists & (found.power > found.noise)
        better, sure = compute_once((better, sure), like)
        return (jnp.where(better, found.power, largest), presses | sure, tree_where(better, four, kept)), None

    columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*_sets(edges.moment), strict=True))
    return jax.lax.scan(body, best, columns)[0]


def _powers(problem: ScaledProblem) -> tuple[Scalar, ...]:
    """The power of each generator: the displacement along it, less the gap."""
    powers = []
    for push, mu in zip(problem.approach, problem.friction, strict=True):
        powers += [push.x + mu * push.y, push.x - mu * push.y]
    return tuple(powers)


def _size(v: Vec3) -> Scalar:
    """The sum of the components' absolute values."""
    return jnp.abs(v.x) + jnp.abs(v.y) + jnp.abs(v.z)


class _Basic(NamedTuple):
    """The internal equilibrium of four edges: a basic solution of the linear program.

    Attributes:
        power: Its power.
        noise: Roundoff of the power.
        exists: Whether there is an equilibrium.
    """

    power: Scalar
    noise: Scalar
    exists: Bool[Array, ""]


def _basic(four: _Four, kind: _Kind) -> _Basic:
    """Compute the internal equilibrium of four edges."""
    g1, g2, g3, g4 = four.wrench
    x12, mu12, s12 = four.cross(0, kind.same12)
    x34, mu34, s34 = four.cross(1, kind.same34)
    normal = _normal(x12, g2.cross(g3), g3.cross(g1))
    alone = normal, (g3.cross(normal), jnp.ones_like(g3.x), _size(g3))
    g4, (x34, mu34, s34) = tree_where(kind.by_itself, alone, (g4, (x34, mu34, s34)))
    unit = jax.lax.stop_gradient(1 / jnp.maximum(jnp.maximum(mu12, mu34), jnp.finfo(g1.x.dtype).tiny))
    mu12, mu34 = mu12 * unit, mu34 * unit
    # `compute_once`, because a weight with cancellation, rounded in two ways, would differ by more than roundoff
    weights = compute_once(
        (mu34 * g2.dot(x34), -mu34 * g1.dot(x34), mu12 * g4.dot(x12), -mu12 * g3.dot(x12)), g1.x + g2.y
    )
    # The dummy edges carry no force. In an equilibrium their weights are roundoff.
    third, fourth = weights[2:]
    idle = jnp.where(kind.twisting, jnp.abs(third), 0.0) + jnp.where(kind.by_itself, jnp.abs(fourth), 0.0)
    weights = (*weights[:2], jnp.where(kind.twisting, 0.0, third), jnp.where(kind.by_itself, 0.0, fourth))
    total = weights[0] + weights[1] + weights[2] + weights[3]
    extent = sum((jnp.abs(w) for w in weights), 0 * total)
    eps, balance = jnp.finfo(total.dtype).eps, BALANCE[total.dtype.itemsize]
    terms = mu34 * s34 * (_size(g1) + _size(g2)) + mu12 * s12 * (_size(g3) + _size(g4))
    noise = jax.lax.stop_gradient(NOISE * eps * terms)
    # all weights have one sign up to roundoff, are more than roundoff, and the dummy edges carry nothing
    exists = four.active & (jnp.abs(total) >= extent * (1 - 64 * eps)) & (extent > noise) & (idle <= balance * extent)
    share = 1 / jnp.where(total != 0, total, 1.0)
    power, most = 0 * total, 0 * total
    for w, p in zip(weights, four.power, strict=True):
        power, most = power + w * p, jnp.maximum(most, jnp.abs(p))
    return _Basic(share * power, jnp.abs(share) * most * noise, exists)


def _normal(*products: Vec3) -> Vec3:
    """A unit vector along the longest product; a constant to every derivative."""
    best = products[0]
    for x in products[1:]:
        best = tree_where(decide(x.dot(x) > best.dot(best), x.x + best.x), x, best)
    return compute_once(jax.lax.stop_gradient(best.unit()), best.x)
