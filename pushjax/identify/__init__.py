"""From recorded pushes to friction, limit surface, calibration and noise, with intervals."""

from pushjax.identify.engine import identify as identify
from pushjax.identify.identified import Identified as Identified
from pushjax.identify.noise import Noise as Noise
from pushjax.identify.noise import identify_noise as identify_noise
from pushjax.identify.pushes import Pushes as Pushes
from pushjax.identify.recorded import recorded as recorded
from pushjax.identify.screening import screened as screened
from pushjax.identify.uncertainty import Profile as Profile
from pushjax.identify.uncertainty import bootstrap as bootstrap
from pushjax.identify.uncertainty import normal_interval as normal_interval
from pushjax.identify.uncertainty import profile as profile
from pushjax.identify.uncertainty import profile_interval as profile_interval
from pushjax.identify.unknowns import Unknowns as Unknowns
