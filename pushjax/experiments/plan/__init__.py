"""Pushes of a block from pose to pose, for a robot: `experiment` builds on `options` and `picture`."""

from pushjax.experiments.plan.experiment import run as run
from pushjax.experiments.plan.experiment import summary as summary
from pushjax.experiments.plan.options import Options as Options
