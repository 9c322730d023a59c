"""Exact solver of several contacts: it tries every set of cone edges that can make up the wrench.

The wrench has three components, so it is a positive combination of at most three linearly independent cone edges
(Caratheodory). Each such set gives as many kinematic conditions as it has edges: the normal condition of each of its
contacts, and the tangential condition of a contact that has both its edges in the set (and then sticks). So a solution
of the problem solves one of these square systems. Each system has a closed form, or takes a bounded number of
iterations. With m contacts, the systems are:

one edge      The edge gives the direction of the wrench. 2 m sets.
two edges     The wrench has the direction F(s) = (1 - s) g_1 + s g_2, where g_1 and g_2 are the wrenches of the edges.
              For a quartic H, grad H(F(s)) is a cubic in s. The size of the wrench scales both conditions by one
              factor. Eliminating it leaves one cubic equation in s. The turning points of the cubic split [0, 1] into
              intervals with at most one root each. The two edges of one contact have at most one root
              (`contact_plane`). m + 4 C(m, 2) sets.
three edges   The conditions alone fix the twist. The slip under this twist shows which edge of a sliding contact is in
              the set. The surface's inverse map gives the wrench. It must be a positive combination of the three edges.
              m (m - 1) + C(m, 3) twists.

If the three conditions of a system depend on one another (parallel or concurrent normals), its solutions form a
segment. The system is skipped, because the ends of the segment are solutions of other sets. Where two contacts are
exactly opposite on one line and move together, as the fingers of a closed gripper, those sets are not always among the
ones above: at an end where another contact just touches, or one just sticks, at a force of zero, the conditions and the
edges belong to different contacts. So if nothing passes, each such pair is searched, with an edge of both contacts:

two edges     under the normal condition of the pair and any other condition. 8 (m - 1) sets.
three edges   under the normal condition of the pair and any two others, with any third edge. C(2 m - 2, 2) twists.

Each solution is checked against every condition of the problem, so a wrong answer cannot pass.

If no solution passes and the hand's squeeze power is positive (`jam_certificate`), the problem has no solution: a jam.
If no solution passes and the squeeze power is not positive, a solution exists that the floating-point type has too few
digits to represent. The same holds if every twist that passes is too fast to be an answer
(`tolerances.max_twist_ratio`). The status is then NOT_CONVERGED.

Reference: Zhou et al. 2017, section IV.B, for the problem. Deviation: this enumeration in place of its sequence of
LCPs.
"""

from itertools import combinations, permutations
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from pushjax._internal.xla import tree_where
from pushjax._math.arrays import dot
from pushjax._math.sums import summed
from pushjax.contact.edge_sets import (
    Numbers,
    Sets,
    Solutions,
    along,
    solve_one,
    solve_three,
    solve_two,
    triples,
)
from pushjax.contact.scaled_problem import NO_EDGE, ContactSolver, EdgeSet, Found, ScaledProblem
from pushjax.contact.tolerances import TOO_FAST, is_slow, relative_tolerance, same_solution_tolerance


class Exhaustive(ContactSolver):
    """Tries every set of cone edges: exact, at a fixed cost.

    A problem that it reports as JAMMED has no solution. In float32 this is wrong for a few of 100 000 problems, at the
    border of a jam.
    """

    proves_jams: ClassVar[bool] = True

    def search(self, problem: ScaledProblem) -> Found:
        found = best_of_sets(problem, *_all_sets(problem.count))
        return _with_opposite_pairs(problem, found) if problem.count > 2 else found


class Continuing(Exhaustive):
    """The default in rollouts: one contact alone, then the cone edges of the stage before, are tried first.

    `solving` does this, because it takes no search.
    """


def _all_sets(m: int) -> tuple[Sets, Sets, np.ndarray]:
    """All sets of one edge and of two, and the contacts of all sets of three, (3, sets), for m contacts."""
    sticking = [(2 * i, 2 * i + 1) for i in range(m)]
    sliding = [(2 * i + a, 2 * j + b) for i, j in combinations(range(m), 2) for a in (0, 1) for b in (0, 1)]
    triples = [(i, i, j) for i, j in permutations(range(m), 2)] + list(combinations(range(m), 3))
    one, two = np.arange(2 * m, dtype=np.int32)[None], np.array(sticking + sliding, np.int32).T
    return Sets.of(one), Sets.of(two), np.array(triples, np.int32).reshape(-1, 3).T


def _with_opposite_pairs(problem: ScaledProblem, found: Found) -> Found:
    """Search the sets of opposite contacts where nothing is found yet."""
    dtype = problem.unit.dtype
    unfound = problem.pushes & ~found.best.exists() & ~found.too_fast

    def try_pair(found: Found, tables: tuple[Array, ...]) -> tuple[Found, None]:
        pair, edges, conditions, three, choices = tables
        row, goal, active = (jnp.take(x, pair, axis=-2) for x in (problem.normal, problem.goal[0], problem.active))
        row, goal = summed(row, 1), jnp.abs(summed(goal, 0))
        opposite = (dot(row, row) <= float(jnp.finfo(dtype).eps)) & (goal <= relative_tolerance(dtype))
        wanted = unfound & ~found.best.exists() & opposite & jnp.all(active, axis=0)

        def search(found: Found) -> Found:
            solutions = [solve_two(problem, Sets(edges, conditions)), solve_three(problem, three, choices)]
            return tree_where(wanted, _best(solutions), found)

        return jax.lax.cond(jnp.any(wanted), search, lambda found: found, found), None

    tables = zip(*(_sets_of_pair(i, j, problem.count) for i, j in combinations(range(problem.count), 2)), strict=True)
    return jax.lax.scan(try_pair, found, tuple(jnp.asarray(np.stack(table), jnp.int32) for table in tables))[0]


def _sets_of_pair(i: int, j: int, m: int) -> tuple[np.ndarray, ...]:
    """Two opposite contacts of m, edges and conditions of sets of two, conditions and choices of edges of three."""
    edges = [(a, b) for a in (2 * i, 2 * i + 1) for b in (2 * j, 2 * j + 1)]
    rows = [row for row in range(2 * m) if row not in (2 * i, 2 * j)]
    two = [((*own, NO_EDGE), (2 * i, row, NO_EDGE)) for own in edges for row in rows]
    three = [(2 * i, *others) for others in combinations(rows, 2)]
    choices = [[(a,), (b,), (edge,)] for a, b in edges for edge in range(2 * m) if edge not in (a, b)]
    return np.array([i, j]), *np.array(two).transpose(1, 2, 0), np.array(three).T, np.array(choices)


def best_of_sets(problem: ScaledProblem, one: Sets, two: Sets, three: Numbers) -> Found:
    """The best solution of each problem with these sets of one edge, of two, and of three, given by their contacts.

    The best solution has the largest power, with its wrench scaled to H = 1. Of solutions with equal power, it has the
    smallest twist. Twists that differ by roundoff are the same motion. The set with fewer edges, which comes first, is
    better conditioned.
    """
    solutions = [solve_one(problem, one), solve_two(problem, two)]
    solutions += [solve_three(problem, *triples(three, problem.count))] if three.shape[1] else []
    return _best(solutions)


def _best(kinds: list[Solutions]) -> Found:
    """The best solution: most power on H = 1, of those with equal power the smallest twist, of those the first."""
    solutions = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2), *kinds)
    dtype = solutions.power.dtype
    tolerance = relative_tolerance(dtype)
    squared = dot(solutions.twist, solutions.twist)
    slow, too_fast = is_slow(squared), is_slow(squared, TOO_FAST)
    passes = solutions.passes & (solutions.power > 0)
    accepted = passes & slow
    power = jnp.where(accepted, solutions.power, 0.0)
    ties = accepted & (power >= (1 - 4 * tolerance) * jnp.max(power, axis=0, keepdims=True))
    smallest = jnp.min(jnp.where(ties, squared, jnp.inf), axis=0, keepdims=True)
    index = jnp.argmax(ties & ((1 - 8 * tolerance) * squared <= smallest), axis=0, keepdims=True)
    best = jax.tree.map(lambda x: along(x, index.reshape(*(1,) * (x.ndim - 2), *index.shape), -2)[..., 0, :], solutions)
    difference = solutions.twist - best.twist[:, None]
    far = same_solution_tolerance(dtype) ** 2 * (squared + dot(best.twist, best.twist)[None])
    found = jnp.any(accepted, axis=0)
    edges, conditions = (jnp.where(found[None], x, NO_EDGE) for x in best.chosen[:2])
    chosen = EdgeSet(edges, conditions, best.chosen.weight)
    second_found = jnp.any(accepted & (dot(difference, difference) > far), axis=0) & found
    return Found(chosen, second_found, jnp.any(passes & ~slow & too_fast, axis=0))
