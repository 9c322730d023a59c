"""The hand's squeeze power: a certificate that there is a motion, and a measure of how far from a jam the hand is.

Contact forces in their friction cones whose wrenches cancel are an internal equilibrium: the fingers can press through
the slider against each other. The squeeze power, in meters, is the work that they would do on it over the step, per
unit of normal force,

    power = max  sum_e alpha_e p_e   over alpha >= 0,  sum alpha_e g_e = 0,  sum alpha_e = 1,

where p_e is the pusher's displacement along edge e less the gap. If it is not positive, the problem has a solution (its
LCP is copositive). The converse is false.

A linear program in so few variables has few basic solutions, and all are tried. They are sets of four edges, and sets
of two or three edges that balance by themselves (frictionless fingers straight opposite, or fingers whose normals meet
in one point). Such sets have to balance to BALANCE_TOLERANCE. They are computed as sets of four, with two dummy edges
that carry no force: a pure moment, and the direction `across` that is orthogonal to the set's other edges.

The weights of four edges are determinants. The cross product of the two edges of one contact is 2 mu t x n. It is
written in this form, with mu taken out, so the weights are exact for the smallest friction, and no sign depends on
roundoff.
"""

from itertools import combinations, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._math.arrays import cross, dot, unit
from pushjax._math.sums import summed
from pushjax.contact.scaled_problem import ScaledProblem, selected

# The unbalanced part that two or three edges may have and still balance, relative to their sum: roundoff of the numbers
# that a user computes them from. By the size of the floating-point type in bytes.
BALANCE_TOLERANCE = {4: 2e-6, 8: 1e-10}
DETERMINANT_ROUNDOFF = 2  # bound on the roundoff of a determinant, in units of eps times its terms
SETS_AT_ONCE = 32


class Squeeze(NamedTuple):
    """The squeeze power, dimensionless; times `ScaledProblem.unit` it is in m."""

    power: Float[Array, "*batch"]  # minus infinity where no internal equilibrium exists, as for one contact
    presses: Bool[Array, "*batch"]  # whether the power is positive for certain, and not only by roundoff
    edges: Int[Array, "4 *batch"]  # numbers of the edges of the equilibrium

    @staticmethod
    def none(like: Float[Array, "*batch"]) -> "Squeeze":
        """No internal equilibrium."""
        return Squeeze(
            jnp.full_like(like, -jnp.inf), jnp.zeros(like.shape, bool), jnp.zeros((4, *like.shape), jnp.int32)
        )


def _rows(problem: ScaledProblem) -> Float[Array, "9 edges *batch"]:
    """Every cone edge, then the moment and `across`: wrench, power, friction, 2 t x n, and whether it takes part."""
    goal, mu = problem.goal, problem.friction
    power = jnp.stack([goal[0] + mu * goal[1], goal[0] - mu * goal[1]], axis=1).reshape(-1, *mu.shape[1:])
    numbers = jnp.stack([mu, *(2 * cross(problem.tangent, problem.normal)), problem.active.astype(mu.dtype)])
    rows = jnp.concatenate([problem.edges, power[None], jnp.repeat(numbers, 2, axis=1)])
    dummies = np.zeros((9, 2))
    dummies[2, 0] = dummies[4] = dummies[8] = 1  # a moment; friction one; active
    dummies = jnp.asarray(dummies, mu.dtype).reshape(9, 2, *(1,) * (mu.ndim - 1))
    return jnp.concatenate([rows, jnp.broadcast_to(dummies, (9, 2, *mu.shape[1:]))], axis=1)


def _kinds(numbers: Any, num_edges: int) -> tuple[Any, Any, Any, Any]:
    """Of sets of four edges, (4, ...): whether the first two, and the last two, are of one contact; and the dummies."""
    # whether the fourth is `across`, and whether the third is the moment
    first, second, third, fourth = numbers
    has_across = fourth == num_edges + 1
    return first >> 1 == second >> 1, (third >> 1 == fourth >> 1) & ~has_across, has_across, third == num_edges


def search_squeeze(problem: ScaledProblem) -> Squeeze:
    """Compute the squeeze power of hands, by all sets of edges; not differentiable."""
    start = Squeeze.none(problem.unit)
    if problem.count < 2:
        return start
    rows, table = _rows(problem), _sets(2 * problem.count)

    def try_sets(best: Squeeze, sets: tuple[Int[Array, "4 sets"], Bool[Array, "4 sets"]]):
        numbers, kinds = sets
        chosen = jnp.take(rows, numbers.reshape(-1), axis=1, mode="clip").reshape(9, *numbers.shape, -1)
        power, roundoff, exists = _equilibrium(chosen, kinds[..., None])
        presses = best.presses | jnp.any(exists & (power > roundoff), axis=0)
        power = jnp.where(exists, power, -jnp.inf)
        index, largest = jnp.argmax(power, axis=0), jnp.max(power, axis=0)
        better = largest > best.power
        edges = jnp.where(better[None], jnp.take(numbers, index, axis=1), best.edges)
        return Squeeze(jnp.where(better, largest, best.power), presses, edges), None

    # from the static table: the compiler would compute them again for every example
    kinds = np.stack([np.stack(_kinds(numbers, 2 * problem.count)) for numbers in table])
    return jax.lax.scan(try_sets, start, (jnp.asarray(table), jnp.asarray(kinds)))[0]


def squeeze_power(problem: ScaledProblem, edges: Int[Array, "4 *batch"]) -> Float[Array, "*batch"]:
    """The power of the equilibrium of four edges that `search_squeeze` found; differentiable."""
    # Whether it exists is not decided again, because with other roundoff the answer could be no.
    kinds = jnp.stack(_kinds(edges, 2 * problem.count))
    return _equilibrium(selected(_rows(problem), edges), kinds)[0]


def _sets(num_edges: int) -> np.ndarray:
    """All sets of four edges, all of three with `across`, and all of two with the moment and `across`, (n, 4, sets)."""
    # Two edges of one contact come first in their set, because their cross product is exact. The last set is repeated,
    # to fill the table.

    def pair_first(numbers: tuple[int, ...]) -> tuple[int, ...]:
        same_contact = [(a, b) for a, b in pairwise(numbers) if a // 2 == b // 2]
        return (*same_contact[0], *(e for e in numbers if e not in same_contact[0])) if same_contact else numbers

    sets = [pair_first(four) for four in combinations(range(num_edges), 4)]
    sets += [(*pair_first(three), num_edges + 1) for three in combinations(range(num_edges + 1), 3)]
    at_once = min(SETS_AT_ONCE, len(sets))
    table = np.array(sets + [sets[-1]] * (-len(sets) % at_once), np.int32)
    return table.reshape(-1, at_once, 4).transpose(0, 2, 1)


def _equilibrium(rows: Float[Array, "9 4 *rest"], kinds: Bool[Array, "4 *rest"]) -> tuple[Array, Array, Array]:
    """Power of the internal equilibrium of four edges, its roundoff, and whether there is one inside the cones."""
    # by Cramer's rule, the weight of each edge is the determinant of the other three, with alternating sign
    power, friction, edge_cross, active = rows[3], rows[4], rows[5:8], rows[8]
    same12, same34, has_across, has_moment = kinds
    g1, g2, g3, g4 = (rows[:3, k] for k in range(4))
    cross12, mu12, size12 = _pair_cross(g1, g2, edge_cross[:, 0], friction[0], same12)
    orthogonal = _orthogonal_direction(cross12, cross(g2, g3), cross(g3, g1))
    g4 = jnp.where(has_across[None], orthogonal, g4)
    cross34, mu34, size34 = _pair_cross(g3, g4, edge_cross[:, 2], friction[2], same34)
    friction_scale = jax.lax.stop_gradient(1 / jnp.maximum(jnp.maximum(mu12, mu34), jnp.finfo(g1.dtype).tiny))
    mu12, mu34 = mu12 * friction_scale, mu34 * friction_scale
    weights = jnp.stack(
        [mu34 * dot(g2, cross34), -mu34 * dot(g1, cross34), mu12 * dot(g4, cross12), -mu12 * dot(g3, cross12)]
    )
    # The dummy edges carry no force. In an equilibrium their weights are roundoff.
    no = jnp.zeros_like(has_moment)
    is_dummy = jnp.stack([no, no, has_moment, has_across])
    is_dummy = jnp.broadcast_to(is_dummy, weights.shape)
    dummy_weight = summed(jnp.where(is_dummy, jnp.abs(weights), 0.0), 0)
    weights = jnp.where(is_dummy, 0.0, weights)
    total, absolute_total = summed(weights, 0), summed(jnp.abs(weights), 0)
    eps, tolerance = jnp.finfo(total.dtype).eps, BALANCE_TOLERANCE[total.dtype.itemsize]
    term_size = mu34 * size34 * (_norm1(g1) + _norm1(g2)) + mu12 * size12 * (_norm1(g3) + _norm1(g4))
    roundoff = jax.lax.stop_gradient(DETERMINANT_ROUNDOFF * eps * term_size)
    # all weights have one sign up to roundoff, are more than roundoff, and the dummy edges carry nothing
    exists = (
        jnp.all(active > 0, axis=0)
        & (jnp.abs(total) >= absolute_total * (1 - 64 * eps))
        & (absolute_total > roundoff)
        & (dummy_weight <= tolerance * absolute_total)
    )
    per_total = 1 / jnp.where(total != 0, total, 1.0)
    roundoff = jnp.abs(per_total) * jnp.max(jnp.abs(power), axis=0) * roundoff
    return per_total * summed(weights * power, 0), jax.lax.stop_gradient(roundoff), exists


def _pair_cross(g: Array, h: Array, edge_cross: Array, friction: Array, same_contact: Array) -> tuple[Array, ...]:
    """Vector, factor and size of terms of the cross product of two edges, which may be of one contact."""
    # the cross product is the vector times the factor; the size is that of the vector's terms
    return (
        jnp.where(same_contact[None], edge_cross, cross(g, h)),
        jnp.where(same_contact, friction, 1.0),
        jnp.where(same_contact, _norm1(edge_cross), _norm1(g) * _norm1(h)),
    )


def _norm1(v: Float[Array, "3 *rest"]) -> Float[Array, "*rest"]:
    """The sum of the components' absolute values."""
    return summed(jnp.abs(v), 0)


def _orthogonal_direction(*products: Float[Array, "3 *rest"]) -> Float[Array, "3 *rest"]:
    """A unit vector along the longest product; a constant to every derivative."""
    stacked = jax.lax.stop_gradient(jnp.stack(products, axis=1))
    longest = jnp.argmax(summed(stacked * stacked, 0), axis=0)
    return unit(selected(stacked, longest[None])[:, 0])
