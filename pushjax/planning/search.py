"""Searches for parameters of least cost. Each is a frozen record of settings, and they follow one another.

A search starts from several candidates and improves each of them by itself, so that different ways to solve a problem
stay in the race. It returns the best parameters that were ever evaluated for each candidate, and so never makes one
worse. The cost of many parameter vectors is evaluated at once, in one compiled program.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from pushjax._internal.checks import check_count, check_positive


class Objective(NamedTuple):
    """What a search minimizes."""

    cost: Callable[[np.ndarray], np.ndarray]  # of parameters (n, size), (n,)
    scale: np.ndarray  # (size,), change of each parameter that matters


class Candidates(NamedTuple):
    """Parameters and their costs, the best first."""

    parameters: Float[np.ndarray, "candidates size"]
    cost: Float[np.ndarray, "candidates"]

    @staticmethod
    def sorted(parameters: np.ndarray, cost: np.ndarray) -> "Candidates":
        """Make candidates of parameters in any order."""
        order = np.argsort(cost, kind="stable")
        return Candidates(parameters[order], cost[order])


class Search(eqx.Module):
    """A search for parameters of least cost."""

    @abstractmethod
    def __call__(
        self, key: PRNGKeyArray, objective: Objective, start: Candidates
    ) -> tuple[Candidates, Float[np.ndarray, "iterations"]]:
        """Return the best candidates that were found, and the least cost after each iteration."""


class Selection(Search):
    """No search: evaluate the candidates and keep the best.

    Attributes:
        keep: How many to keep.

    Raises:
        ValueError: If `keep` is less than one.
    """

    keep: int = 16

    def __check_init__(self):
        check_count("keep", self.keep)

    def __call__(self, key, objective, start):
        found = Candidates.sorted(start.parameters, objective.cost(start.parameters))
        return Candidates(found.parameters[: self.keep], found.cost[: self.keep]), found.cost[:1]


class CrossEntropy(Search):
    """The cross-entropy method: the next samples have mean and standard deviation of the best of the last ones.

    Attributes:
        iterations: Number of iterations.
        population: Number of samples around each candidate in each iteration.
        elites: Number of the best samples.
        width: Standard deviation of the first samples, in units of the objective's scale.
        smoothing: Weight of the last standard deviation in the next one, so that it does not shrink too soon.

    Raises:
        ValueError: If a number is not positive, there are more elites than samples, or the smoothing is outside [0, 1).

    Reference: Rubinstein & Kroese 2004.
    """

    iterations: int = 10
    population: int = 32
    elites: int = 8
    width: float = 0.5
    smoothing: float = 0.3

    def __check_init__(self):
        for name in ("iterations", "population", "elites"):
            check_count(name, getattr(self, name))
        check_positive("width", self.width)
        if self.elites > self.population:
            raise ValueError(f"elites must be at most the population of {self.population}; got {self.elites}")
        if not 0 <= self.smoothing < 1:
            raise ValueError(f"smoothing must be at least 0 and below 1; got {self.smoothing!r}")

    def __call__(self, key, objective, start):
        count, size = start.parameters.shape
        best, cost = start.parameters, objective.cost(start.parameters)
        mean, deviation = best, np.broadcast_to(self.width * objective.scale, best.shape)
        shape = (self.iterations, count, self.population, size)
        noise, history = np.asarray(jax.random.normal(key, shape), np.float64), []
        for each in noise:
            samples = mean[:, None] + deviation[:, None] * each
            costs = objective.cost(samples.reshape(-1, size)).reshape(count, self.population)
            order = np.argsort(costs, axis=1, kind="stable")[:, : self.elites]
            elites = np.take_along_axis(samples, order[:, :, None], axis=1)
            least = np.take_along_axis(costs, order[:, :1], axis=1)[:, 0]
            best = np.where((least < cost)[:, None], elites[:, 0], best)
            cost = np.minimum(least, cost)
            history.append(cost.min())
            mean, deviation = (
                elites.mean(axis=1),
                (1 - self.smoothing) * elites.std(axis=1) + self.smoothing * deviation,
            )
        return Candidates.sorted(best, cost), np.array(history)
