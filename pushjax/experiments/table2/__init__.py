"""Table 2: `experiment` builds on `conditions` and `methods`."""

from pushjax.experiments.table2.experiment import run as run
from pushjax.experiments.table2.experiment import summary as summary
