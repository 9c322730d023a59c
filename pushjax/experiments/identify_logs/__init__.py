"""A user's own logs: `experiment` from `setting`, `findings` and `picture`."""

from pushjax.experiments.identify_logs.experiment import Options as Options
from pushjax.experiments.identify_logs.experiment import run as run
from pushjax.experiments.identify_logs.experiment import summary as summary
