"""Straight pushes of the MIT data set: `experiment` from `conditions`, `methods` and `repeats`; what its error comes
from in `causes`, predicted distributions in `spread`."""

from pushjax.experiments.table1.experiment import run as run
from pushjax.experiments.table1.experiment import summary as summary
