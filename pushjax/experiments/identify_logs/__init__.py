"""A user's own logs: `experiment` from `setting`, `findings` and `picture`."""

from pushjax.experiments.identify_logs.experiment import run as run
from pushjax.experiments.identify_logs.experiment import summary as summary
from pushjax.experiments.identify_logs.setting import Options as Options
