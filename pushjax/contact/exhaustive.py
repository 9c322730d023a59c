"""Exact solver of several contacts: it tries every set of cone edges that can make up the wrench.

The wrench has three components, so it is a positive combination of at most three linearly independent cone edges
(Caratheodory). Each such set gives as many kinematic conditions as it has edges: the normal condition of each of its
contacts, and the tangential condition of a contact that has both its edges in the set (and then sticks). So a solution
of the problem solves one of these square systems. Each system has a closed form, or takes a fixed number of Newton
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
segment. The system is skipped, because the ends of the segment are solutions of other sets. At an end where another
contact just touches, at a force of zero, the conditions and the edges belong to different contacts. Where one contact
sticks, `solve_three_edges` therefore tries the edges of every contact that touches. (Where three contacts slide, it
does not: of 20 000 random problems of four contacts, two of them fixtures, one such motion was missed.) Each solution
is checked against every condition of the problem, so a wrong answer cannot pass.

If no solution passes and the hand's squeeze power is positive (`jam_certificate`), the problem has no solution: a jam.
If no solution passes and the squeeze power is not positive, a solution exists that the floating-point type has too few
digits to represent. The same holds if every twist that passes is too fast to be an answer
(`tolerances.max_twist_ratio`). The status is then NOT_CONVERGED.

Reference: Zhou et al. 2017, section IV.B, for the problem. Deviation: this enumeration in place of its sequence of
LCPs.
"""

from collections.abc import Callable
from itertools import combinations, permutations

import jax
import jax.numpy as jnp

from pushjax._internal.autodiff import without_derivatives
from pushjax.contact.edge_sets import Incumbent, no_incumbent, solve_one_edge, solve_three_edges, solve_two_edges
from pushjax.contact.refinement import refine_and_check
from pushjax.contact.scaled_problem import ContactSolver, ScalarSolution, ScaledProblem


class Exhaustive(ContactSolver):
    """Tries every set of cone edges: exact, at a fixed cost.

    A problem that it reports as JAMMED has no solution. In float32 this is wrong for a few of 100 000 problems, at the
    border of a jam. In either type it can be wrong where three contacts with parallel or concurrent normals slide and a
    fourth just touches (see the header of this module).
    """

    def solve(self, problem: ScaledProblem) -> ScalarSolution:
        """Solve a dimensionless contact problem.

        Args:
            problem: The contact problem.

        Returns:
            The motion. Its derivatives are those of the solution, not of the search.
        """
        return refine_and_check(problem, without_derivatives(enumerate_sets, problem), proves_jams=True)


def enumerate_sets(problem: ScaledProblem) -> Incumbent:
    """Try every set of cone edges, and keep the best solution.

    The best solution has the largest power, with its wrench scaled to H = 1. Of solutions with equal power, it has the
    smallest twist. The search is not differentiable.

    Args:
        problem: The dimensionless contact problem.

    Returns:
        The set of cone edges of that solution, with the solution; `found` is False if no set passes.
    """
    incumbent = no_incumbent(problem.runtime_scalar)
    m = problem.count
    singles = [(edge,) for edge in range(2 * m)]
    incumbent = _try_sets(lambda best, edges: solve_one_edge(problem, best, *edges), incumbent, singles)
    sliding = [(2 * i + a, 2 * j + b) for i, j in combinations(range(m), 2) for a in (0, 1) for b in (0, 1)]
    sticking = [(2 * i, 2 * i + 1) for i in range(m)]
    pairs = sticking + sliding
    incumbent = _try_sets(lambda best, edges: solve_two_edges(problem, best, *edges), incumbent, pairs)
    # Each entry has the numbers of three contacts, then how many choices of edges to try. If the first two numbers are
    # the same, that contact sticks.
    triples = [(i, i, j, 2) for i, j in permutations(range(m), 2)] + [(*c, 8) for c in combinations(range(m), 3)]
    return _try_sets(lambda best, entry: solve_three_edges(problem, best, entry[:3], entry[3]), incumbent, triples)


def _try_sets(
    try_set: Callable[[Incumbent, tuple], Incumbent], incumbent: Incumbent, sets: list[tuple[int, ...]]
) -> Incumbent:
    """Call `try_set` for each set in turn, in a compiled loop.

    Unrolled, the program would take minutes to compile.
    """
    if not sets:
        return incumbent
    columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*sets, strict=True))
    return jax.lax.scan(lambda incumbent, numbers: (try_set(incumbent, numbers), None), incumbent, columns)[0]
