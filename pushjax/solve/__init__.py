"""From contacts to motion."""

from pushjax.solve._contact_plane import Contact as Contact
from pushjax.solve._contact_plane import LimitCurve as LimitCurve
from pushjax.solve._several import ContactSolver as ContactSolver
from pushjax.solve._several import SeveralMotion as SeveralMotion
from pushjax.solve.contacts import Contacts as Contacts
from pushjax.solve.contacts import Motion as Motion
from pushjax.solve.contacts import friction_cone as friction_cone
from pushjax.solve.contacts import motion_cone as motion_cone
from pushjax.solve.contacts import solve_contacts as solve_contacts
from pushjax.solve.exhaustive import Exhaustive as Exhaustive
from pushjax.solve.projected import Projected as Projected
from pushjax.solve.single import SingleMotion as SingleMotion
from pushjax.solve.single import solve_single as solve_single
from pushjax.solve.sticking import HessianIteration as HessianIteration
from pushjax.solve.sticking import ScalarRoot as ScalarRoot
from pushjax.solve.sticking import StickingSolver as StickingSolver
