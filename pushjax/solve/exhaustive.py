"""Several contacts, exactly: every set of cone edges that can make up the wrench is tried.

The wrench has three components, so it is a positive combination of at most three linearly independent cone edges
(Caratheodory). Each such set brings as many kinematic conditions as it has edges: the normal condition of each of its
contacts, and the tangential one of a contact both of whose edges are in it (which then sticks). So a solution of the
problem is a solution of one of these square systems, and all of them are closed, or a fixed count of Newton rounds:

one edge      the wrench's direction is the edge's. 2 m sets.
two edges     F = (1 - s) g_1 + s g_2. grad H along F is a cubic in s (for a quartic), and the two conditions, with
              their common factor eliminated, one cubic equation: its roots in [0, 1], between its turning points. For
              the two edges of one contact there is one at most (`_contact_plane`). m + 4 C(m, 2) sets.
three edges   the conditions alone fix the twist. Its slip tells which edge of a sliding contact is meant, and the
              surface's inverse map gives the wrench, which must lie between the three. m (m - 1) + C(m, 3) twists.

A system whose three conditions depend on one another (parallel or concurrent normals) leaves a segment of solutions,
whose ends other sets have; it is skipped. Whatever a set gives is checked against every condition of the problem, so
a wrong answer cannot pass. Where none passes and the hand's squeeze power is positive (`squeeze`), there is no
solution: a jam. Where it is not, or what passes is too fast to be written down (`fastest` in `_several`), the digits do
not suffice.

Source: Zhou et al. 2017, section IV.B, for the problem; this enumeration in place of its sequence of LCPs.
"""

from collections.abc import Callable
from itertools import combinations, permutations

import jax
import jax.numpy as jnp

from pushjax._autodiff import undifferentiated
from pushjax.solve._edge_sets import Found, nothing, one_edge, three_edges, two_edges
from pushjax.solve._finish import finish
from pushjax.solve._several import ContactSolver, Several, SeveralMotion


class Exhaustive(ContactSolver):
    """Tries every set of cone edges: exact, at a fixed cost, and what it calls jammed is (in float32 but for a few
    of 100 000 at the border of a jam)."""

    def solve(self, problem: Several) -> SeveralMotion:
        return finish(problem, undifferentiated(enumerate_sets, problem), proves_jams=True)


def enumerate_sets(problem: Several) -> Found:
    """The solution of largest power on H = 1, of equal ones the smallest twist. Not differentiable."""
    found = nothing(problem.speed)
    m = problem.count
    found = _over(lambda found, e: one_edge(problem, found, *e), found, [(e,) for e in range(2 * m)])
    slides = [(2 * i + a, 2 * j + b) for i, j in combinations(range(m), 2) for a in (0, 1) for b in (0, 1)]
    sticks = [(2 * i, 2 * i + 1) for i in range(m)]
    found = _over(lambda found, e: two_edges(problem, found, *e), found, sticks + slides)
    threes = [(i, i, j, 2) for i, j in permutations(range(m), 2)] + [(*c, 8) for c in combinations(range(m), 3)]
    return _over(lambda found, c: three_edges(problem, found, c[:3], c[3]), found, threes)


def _over(body: Callable[[Found, tuple], Found], found: Found, sets: list[tuple[int, ...]]) -> Found:
    """Run `body` over all sets, in a loop: written out, the program would take minutes to compile."""
    if not sets:
        return found
    columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*sets, strict=True))
    return jax.lax.scan(lambda found, numbers: (body(found, numbers), None), found, columns)[0]
