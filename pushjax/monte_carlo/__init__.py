"""Thousands to millions of pushes under random friction: `engine` runs them tile by tile (`tiles`), keeps what is done
(`checkpoint`) and gives a `result`."""

from pushjax.monte_carlo.checkpoint import CheckpointError as CheckpointError
from pushjax.monte_carlo.engine import monte_carlo as monte_carlo
from pushjax.monte_carlo.result import MonteCarlo as MonteCarlo
