"""The hand's squeeze power: a certificate that there is a motion, and a measure of how far from a jam the hand is.

Contact forces in their friction cones whose wrenches cancel are an internal equilibrium: the fingers can press through
the slider against each other. The squeeze power, in meters, is the work that they would do on it over the step, per
unit of normal force,

    power = max  sum_e alpha_e p_e   over alpha >= 0,  sum alpha_e g_e = 0,  sum alpha_e = 1,

where p_e is the pusher's displacement along edge e less the gap. If it is not positive, the problem has a solution (its
LCP is copositive). The converse is false.

A linear program in so few variables has few basic solutions, and all are tried. They are sets of four edges, and sets
of two or three edges that balance by themselves (frictionless fingers straight opposite, or fingers whose normals meet
in one point). Such sets have to balance to BALANCE_TOLERANCE.

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
# that a user computes them from. By the size of the floating-point type in bytes.
BALANCE_TOLERANCE = {4: 2e-6, 8: 1e-10}
DETERMINANT_ROUNDOFF = 2  # bound on the roundoff of a determinant, in units of eps times its terms

Numbers = tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""], Int[Array, ""]]  # numbers of four edges


class Squeeze(NamedTuple):
    """The squeeze power.

    Attributes:
        power: Dimensionless; times `ScaledProblem.displacement_unit` it is in m. Minus infinity where no internal
            equilibrium exists, as for one contact.
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
        edge_cross: Cross product of the two edges of the edge's contact, divided by mu: 2 t x n.
    """

    wrench: tuple[Vec3, ...]
    power: tuple[Scalar, ...]
    active: tuple[Bool[Array, ""], ...]
    friction: tuple[Scalar, ...]
    edge_cross: tuple[Vec3, ...]

    @property
    def moment(self) -> int:
        """Number of the dummy edge that is a pure moment."""
        return len(self.wrench) - 2

    @property
    def across(self) -> int:
        """Number of the dummy edge orthogonal to a set's other edges."""
        return len(self.wrench) - 1

    def four(self, numbers: Numbers) -> "_FourEdges":
        """The four edges with these numbers."""
        pair_firsts = numbers[0], numbers[2]
        return _FourEdges(
            tuple(dynamic_index(self.wrench, e) for e in numbers),
            tuple(dynamic_index(self.power, e) for e in numbers),
            tuple(dynamic_index(self.friction, e) for e in pair_firsts),
            tuple(dynamic_index(self.edge_cross, e) for e in pair_firsts),
            functools.reduce(jnp.logical_and, (dynamic_index(self.active, e) for e in numbers)),
        )

    def kind(self, numbers: Numbers) -> "_SetKind":
        """What kind of set the four edges with these numbers are."""
        first, second, third, fourth = numbers
        return _SetKind(
            first // 2 == second // 2, third // 2 == fourth // 2, fourth == self.across, third == self.moment
        )


class _FourEdges(NamedTuple):
    """Four of the edges.

    Attributes:
        wrench: Wrench of each edge.
        power: Power of each edge.
        friction: Coefficients of friction of the first and the third edge.
        edge_cross: `edge_cross` of the first and the third edge.
        active: Whether all four edges are active.
    """

    wrench: tuple[Vec3, ...]
    power: tuple[Scalar, ...]
    friction: tuple[Scalar, ...]
    edge_cross: tuple[Vec3, ...]
    active: Bool[Array, ""]

    def pair_cross(self, pair: int, same_contact: Bool[Array, ""]) -> tuple[Vec3, Scalar, Scalar]:
        """Cross product of the first two edges (pair 0) or of the last two (pair 1).

        Args:
            pair: 0 or 1.
            same_contact: Whether both edges are of one contact.

        Returns:
            A vector and a factor whose product is the cross product, and the size of the vector's terms.
        """
        g, h = self.wrench[2 * pair : 2 * pair + 2]
        of_two_contacts = g.cross(h), jnp.ones_like(g.x), _norm1(g) * _norm1(h)
        edge_cross = self.edge_cross[pair]
        return tree_where(same_contact, (edge_cross, self.friction[pair], _norm1(edge_cross)), of_two_contacts)


def squeeze_power(problem: ScaledProblem, wanted: bool | Bool[Array, ""]) -> Squeeze:
    """Compute the squeeze power of a hand.

    Args:
        problem: The dimensionless contact problem.
        wanted: Whether to compute it. Where not, the result is that without an internal equilibrium. If it is wanted
            for no example of a batch, it takes no time.

    Returns:
        The squeeze power. It is differentiable.
    """
    lowest = jnp.full_like(problem.runtime_scalar, -jnp.inf)
    if problem.count < 2:
        return Squeeze(lowest, jnp.zeros((), bool))
    edges = _edges(problem)
    power, presses, best = without_derivatives(_search_if_wanted, edges, wanted, problem.runtime_scalar)
    # Only the best set is differentiated. Whether its equilibrium exists is not decided again, because with other
    # roundoff the answer could be no.
    best_edges = compute_once(edges.four(best), problem.runtime_scalar)
    differentiable = _solve_equilibrium(best_edges, edges.kind(best))
    return Squeeze(jnp.where(power > lowest, differentiable.power, lowest), presses)


def _edges(problem: ScaledProblem) -> _Edges:
    """The edges of a problem, with the two dummy edges."""
    zero = jnp.zeros_like(problem.runtime_scalar)
    one = zero + 1
    zero_vector, moment = Vec3(zero, zero, zero), Vec3(zero, zero, one)
    wrench = (*problem.generators, moment, zero_vector)
    edge_cross = tuple(t.cross(n).scale(2) for n, t in zip(problem.normal, problem.tangent, strict=True))
    edge_numbers = range(2 * problem.count)
    return _Edges(
        wrench,
        (*_powers(problem), zero, zero),
        (*(problem.active[k // 2] for k in edge_numbers), *(jnp.ones((), bool),) * 2),
        (*(problem.friction[k // 2] for k in edge_numbers), one, one),
        (*(edge_cross[k // 2] for k in edge_numbers), zero_vector, zero_vector),
    )


class _SetKind(NamedTuple):
    """What kind of set four edges are.

    Attributes:
        same12: Whether the first two edges are of one contact.
        same34: Whether the last two edges are of one contact.
        has_across: Whether the fourth edge is the dummy `across`; then the first three have to balance by themselves.
        has_moment: Whether the third edge is the dummy `moment`.
    """

    same12: Bool[Array, ""]
    same34: Bool[Array, ""]
    has_across: Bool[Array, ""]
    has_moment: Bool[Array, ""]


def _sets(num_edges: int) -> list[tuple[int, ...]]:
    """All sets of four edges, all of three with `across`, and all of two with `moment` and `across`.

    Two edges of one contact come first in their set, because their cross product is exact.
    """

    def pair_first(numbers: tuple[int, ...]) -> tuple[int, ...]:
        same_contact = [(a, b) for a, b in pairwise(numbers) if a // 2 == b // 2]
        return (*same_contact[0], *(e for e in numbers if e not in same_contact[0])) if same_contact else numbers

    fours = [pair_first(four) for four in combinations(range(num_edges), 4)]
    return fours + [(*pair_first(three), num_edges + 1) for three in combinations(range(num_edges + 1), 3)]


def _search_if_wanted(edges: _Edges, wanted: bool | Bool[Array, ""], runtime_scalar: Scalar) -> tuple:
    """Search all sets of four edges, where this is wanted.

    Returns:
        The largest power, whether any power is positive for certain, and the numbers of the edges of the largest power.
    """
    lowest = jnp.full_like(runtime_scalar, -jnp.inf)
    no_squeeze = lowest, jnp.zeros(lowest.shape, bool), (jnp.zeros(lowest.shape, jnp.int32),) * 4
    search = functools.partial(_search, edges, runtime_scalar)
    return update_if(jnp.asarray(wanted), search, no_squeeze)


def _search(edges: _Edges, runtime_scalar: Scalar, start: tuple) -> tuple:
    """The search of `_search_if_wanted` over all sets of four edges, starting from the result `start`."""

    def try_set(state, numbers):
        largest, presses, best = state
        # `compute_once`, or everything that uses an edge would select it again
        equilibrium = _solve_equilibrium(compute_once(edges.four(numbers), runtime_scalar), edges.kind(numbers))
        better = equilibrium.exists & (equilibrium.power > largest)
        positive = equilibrium.exists & (equilibrium.power > equilibrium.roundoff)
        better, positive = compute_once((better, positive), runtime_scalar)
        largest = jnp.where(better, equilibrium.power, largest)
        return (largest, presses | positive, tree_where(better, numbers, best)), None

    columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*_sets(edges.moment), strict=True))
    return jax.lax.scan(try_set, start, columns)[0]


def _powers(problem: ScaledProblem) -> tuple[Scalar, ...]:
    """The power of each generator: the pusher's displacement along it, less the gap, dimensionless."""
    powers = []
    for approach, mu in zip(problem.approach, problem.friction, strict=True):
        powers += [approach.x + mu * approach.y, approach.x - mu * approach.y]
    return tuple(powers)


def _norm1(v: Vec3) -> Scalar:
    """The sum of the components' absolute values."""
    return jnp.abs(v.x) + jnp.abs(v.y) + jnp.abs(v.z)


class _Equilibrium(NamedTuple):
    """The internal equilibrium of four edges: a basic solution of the linear program.

    Attributes:
        power: Its power.
        roundoff: Roundoff of the power.
        exists: Whether the four edges have an equilibrium with forces inside the cones.
    """

    power: Scalar
    roundoff: Scalar
    exists: Bool[Array, ""]


def _solve_equilibrium(four: _FourEdges, kind: _SetKind) -> _Equilibrium:
    """Compute the internal equilibrium of four edges.

    By Cramer's rule, the weight of each edge is the determinant of the other three, with alternating sign. In the local
    names, x is the cross product of two edges without the factor mu, and s is the size of the terms of x.
    """
    g1, g2, g3, g4 = four.wrench
    x12, mu12, s12 = four.pair_cross(0, kind.same12)
    x34, mu34, s34 = four.pair_cross(1, kind.same34)
    orthogonal = _orthogonal_direction(x12, g2.cross(g3), g3.cross(g1))
    with_across = orthogonal, (g3.cross(orthogonal), jnp.ones_like(g3.x), _norm1(g3))
    g4, (x34, mu34, s34) = tree_where(kind.has_across, with_across, (g4, (x34, mu34, s34)))
    friction_scale = jax.lax.stop_gradient(1 / jnp.maximum(jnp.maximum(mu12, mu34), jnp.finfo(g1.x.dtype).tiny))
    mu12, mu34 = mu12 * friction_scale, mu34 * friction_scale
    # `compute_once`, because a weight with cancellation, rounded in two ways, would differ by more than roundoff
    weights = compute_once(
        (mu34 * g2.dot(x34), -mu34 * g1.dot(x34), mu12 * g4.dot(x12), -mu12 * g3.dot(x12)), g1.x + g2.y
    )
    # The dummy edges carry no force. In an equilibrium their weights are roundoff.
    third, fourth = weights[2:]
    dummy_weight = jnp.where(kind.has_moment, jnp.abs(third), 0.0) + jnp.where(kind.has_across, jnp.abs(fourth), 0.0)
    weights = (*weights[:2], jnp.where(kind.has_moment, 0.0, third), jnp.where(kind.has_across, 0.0, fourth))
    total = weights[0] + weights[1] + weights[2] + weights[3]
    absolute_total = sum((jnp.abs(weight) for weight in weights), 0 * total)
    eps, tolerance = jnp.finfo(total.dtype).eps, BALANCE_TOLERANCE[total.dtype.itemsize]
    term_size = mu34 * s34 * (_norm1(g1) + _norm1(g2)) + mu12 * s12 * (_norm1(g3) + _norm1(g4))
    roundoff = jax.lax.stop_gradient(DETERMINANT_ROUNDOFF * eps * term_size)
    # all weights have one sign up to roundoff, are more than roundoff, and the dummy edges carry nothing
    exists = (
        four.active
        & (jnp.abs(total) >= absolute_total * (1 - 64 * eps))
        & (absolute_total > roundoff)
        & (dummy_weight <= tolerance * absolute_total)
    )
    per_total = 1 / jnp.where(total != 0, total, 1.0)
    power, largest_power = 0 * total, 0 * total
    for weight, edge_power in zip(weights, four.power, strict=True):
        power, largest_power = power + weight * edge_power, jnp.maximum(largest_power, jnp.abs(edge_power))
    return _Equilibrium(per_total * power, jnp.abs(per_total) * largest_power * roundoff, exists)


def _orthogonal_direction(*products: Vec3) -> Vec3:
    """A unit vector along the longest product; a constant to every derivative."""
    longest = products[0]
    for product in products[1:]:
        longest = tree_where(
            decide(product.dot(product) > longest.dot(longest), product.x + longest.x), product, longest
        )
    return compute_once(jax.lax.stop_gradient(longest.unit()), longest.x)
