"""Two fingers turn a real triangle: `experiment` builds on `predictions`, `scores` and `picture`."""

from pushjax.experiments.two_finger.experiment import run as run
from pushjax.experiments.two_finger.experiment import summary as summary
