"""A jaw closes on a slider from random poses: `experiment` builds on `sliders`, `outcomes` and `picture`."""

from pushjax.experiments.grasps.experiment import run as run
from pushjax.experiments.grasps.experiment import summary as summary
