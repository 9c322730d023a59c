"""PushT of the package `gym-pusht`, solved by a planner: `experiment` builds on `player` and `setting`."""

from pushjax.experiments.pusht_mpc.experiment import run as run
from pushjax.experiments.pusht_mpc.experiment import summary as summary
