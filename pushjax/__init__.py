"""Quasi-static planar pushing in JAX."""

from pushjax import se2 as se2
from pushjax.fit import FitReport as FitReport
from pushjax.fit import fit_limit_surface as fit_limit_surface
from pushjax.fit import mean_twist_angle as mean_twist_angle
from pushjax.friction_model import FrictionModel as FrictionModel
from pushjax.hands import Hand as Hand
from pushjax.hands import line as line
from pushjax.hands import resample as resample
from pushjax.hands import through as through
from pushjax.limit_surface import Ellipsoid as Ellipsoid
from pushjax.limit_surface import InverseMap as InverseMap
from pushjax.limit_surface import LimitSurface as LimitSurface
from pushjax.limit_surface import Quartic as Quartic
from pushjax.monte_carlo import MonteCarlo as MonteCarlo
from pushjax.monte_carlo import monte_carlo as monte_carlo
from pushjax.random_rollout import random_rollout as random_rollout
from pushjax.rollout import Slider as Slider
from pushjax.rollout import Step as Step
from pushjax.rollout import Trajectory as Trajectory
from pushjax.rollout import rollout as rollout
from pushjax.rollout import step as step
from pushjax.scores import deviation as deviation
from pushjax.shapes import Curve as Curve
from pushjax.shapes import Disk as Disk
from pushjax.shapes import Ellipse as Ellipse
from pushjax.shapes import Polygon as Polygon
from pushjax.shapes import Shape as Shape
from pushjax.solve import Contacts as Contacts
from pushjax.solve import ContactSolver as ContactSolver
from pushjax.solve import Exhaustive as Exhaustive
from pushjax.solve import HessianIteration as HessianIteration
from pushjax.solve import Motion as Motion
from pushjax.solve import Projected as Projected
from pushjax.solve import ScalarRoot as ScalarRoot
from pushjax.solve import friction_cone as friction_cone
from pushjax.solve import motion_cone as motion_cone
from pushjax.solve import solve_contacts as solve_contacts
from pushjax.status import ContactMode as ContactMode
from pushjax.status import Status as Status
from pushjax.support import Support as Support
from pushjax.support import WrenchTwistPairs as WrenchTwistPairs

__version__ = "0.1.0"
