"""Limit surfaces as level sets of convex polynomials."""

from pushjax.limit_surface._base import Form as Form
from pushjax.limit_surface._base import InverseMap as InverseMap
from pushjax.limit_surface._base import LimitSurface as LimitSurface
from pushjax.limit_surface._base import Symmetric3 as Symmetric3
from pushjax.limit_surface._base import angle_between as angle_between
from pushjax.limit_surface.ellipsoid import Ellipsoid as Ellipsoid
from pushjax.limit_surface.ellipsoid import EllipsoidForm as EllipsoidForm
from pushjax.limit_surface.quartic import MONOMIALS as MONOMIALS
from pushjax.limit_surface.quartic import Quartic as Quartic
from pushjax.limit_surface.quartic import QuarticForm as QuarticForm
from pushjax.limit_surface.warped import WarpedForm as WarpedForm
