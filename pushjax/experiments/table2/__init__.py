"""Table 2: `experiment` from `conditions` and `methods`."""

from pushjax.experiments.table2.experiment import run as run
from pushjax.experiments.table2.experiment import summary as summary
