"""Independent checks of solutions of contact problems, against the conditions that define a solution.

The checks use NumPy and SciPy in float64 and share no code with the solvers.

Let V = (vx, vy, length omega) be the normalized twist and F = (fx, fy, tau / length) the normalized wrench. Contact i
has two rows, a_n and a_t. Its point on the slider moves by (a_n . V, a_t . V) along normal and tangent, and a force
(f_n, f_t) there has the wrench f_n a_n + f_t a_t. With w = (a_n . V, a_t . V) - displacement, a solution satisfies

    V = k grad H(F),  k > 0,  F = sum of the contacts' wrenches,
    0 <= f_n  _|_  w_n + gap >= 0,   |f_t| <= mu f_n,   f_t = +mu f_n where w_t < 0,  -mu f_n where w_t > 0,

(Zhou et al. 2017, section IV; the gap as in Stewart & Trinkle 1996). There are three checks of a batch:
`violations` measures how far given solutions violate these conditions; `squeeze_power` shows whether a problem that is
said to have no solution has the physical reason for that; and `search` looks for a solution where a solver found none.

Two more modules: `testing.problems` generates random problems with JAX, and `testing.convexity` checks whether quartics
are convex.
"""

from pushjax.testing.batch import ProblemBatch as ProblemBatch
from pushjax.testing.condition_violations import CLEAN as CLEAN
from pushjax.testing.condition_violations import Violations as Violations
from pushjax.testing.condition_violations import closing as closing
from pushjax.testing.condition_violations import violations as violations
from pushjax.testing.independent_search import SearchResult as SearchResult
from pushjax.testing.independent_search import search as search
from pushjax.testing.squeeze import squeeze_power as squeeze_power
from pushjax.testing.squeeze import squeeze_power_enumerated as squeeze_power_enumerated
