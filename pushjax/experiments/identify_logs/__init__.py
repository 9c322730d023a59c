"""Identification from a user's own logs: `experiment` builds on `options`, `findings`, `picture` and `report`."""

from pushjax.experiments.identify_logs.experiment import run as run
from pushjax.experiments.identify_logs.options import Options as Options
from pushjax.experiments.identify_logs.report import summary as summary
