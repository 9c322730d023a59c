"""Answers to contact problems, judged by the conditions themselves: numpy in float64, sharing no code with the solvers.

In normalised twist V = (vx, vy, length omega) and wrench F = (fx, fy, tau / length), contact i has two rows, a_n and
a_t, such that its point on the slider moves by (a_n . V, a_t . V) along normal and tangent, and a force (f_n, f_t)
there has the wrench f_n a_n + f_t a_t. With w = (a_n . V, a_t . V) - displacement, an answer satisfies

    V = k grad H(F),  k > 0,  F = sum of the contacts' wrenches,
    0 <= f_n  _|_  w_n + gap >= 0,   |f_t| <= mu f_n,   f_t = +mu f_n where w_t < 0,  -mu f_n where w_t > 0,

(Zhou et al. 2017, section IV; the gap is that of Stewart & Trinkle 1996). Three questions are asked of a batch:
whether given answers satisfy this (`violations`); whether a problem said to have no answer has the physical reason for
it (`squeeze_power`); and whether an answer can be found where none was (`search`).
"""

from pushjax.verify.batch import ProblemBatch as ProblemBatch
from pushjax.verify.conditions import CLEAN as CLEAN
from pushjax.verify.conditions import Violations as Violations
from pushjax.verify.conditions import closing as closing
from pushjax.verify.conditions import violations as violations
from pushjax.verify.search import Searched as Searched
from pushjax.verify.search import search as search
from pushjax.verify.squeeze import squeeze_power as squeeze_power
from pushjax.verify.squeeze import squeeze_power_enumerated as squeeze_power_enumerated
