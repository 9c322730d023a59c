"""Identification from a user's own logs: `experiment` builds on `setting`, `findings` and `picture`."""

from pushjax.experiments.identify_logs.experiment import run as run
from pushjax.experiments.identify_logs.experiment import summary as summary
from pushjax.experiments.identify_logs.setting import Options as Options
