"""Table 1, straight pushes of the MIT data set: `experiment` builds on `conditions`, `methods` and `repeats`."""

from pushjax.experiments.table1.experiment import run as run
from pushjax.experiments.table1.experiment import summary as summary
