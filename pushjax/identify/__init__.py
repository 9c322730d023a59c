"""From recorded pushes to friction, limit surface and calibration, with intervals."""

from pushjax.identify.engine import identify as identify
from pushjax.identify.identified import Identified as Identified
from pushjax.identify.pushes import Pushes as Pushes
from pushjax.identify.unknowns import Unknowns as Unknowns
