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
import optax
from jaxtyping import Float, PRNGKeyArray

from pushjax._internal.checks import check_count


class Objective(NamedTuple):
    """What a search minimizes."""

    cost: Callable[[np.ndarray], np.ndarray]  # of parameters (n, size), (n,)
    cost_and_gradient: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # also the gradients, (n, size)
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
        """Improve candidates.

        Args:
            key: PRNG key of everything random.
            objective: What to minimize.
            start: Candidates to start from.

        Returns:
            The best candidates that were found, and the least cost after each iteration.
        """


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


class _Sampling(Search):
    """A search that samples around a mean, once for each candidate.

    Attributes:
        iterations: Number of iterations.
        population: Number of samples around each candidate in each iteration.
        width: Standard deviation of the first samples, in units of the objective's scale.
    """

    iterations: eqx.AbstractVar[int]
    population: eqx.AbstractVar[int]
    width: eqx.AbstractVar[float]

    @abstractmethod
    def update(self, parameters: np.ndarray, cost: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of the next samples.

        Args:
            parameters: The samples, (candidates, population, size).
            cost: Their costs, (candidates, population).
            deviation: Their standard deviation, (candidates, size).

        Returns:
            Mean and standard deviation, (candidates, size).
        """

    def __call__(self, key, objective, start):
        count, size = start.parameters.shape
        best, cost = start.parameters, objective.cost(start.parameters)
        mean, deviation = best, np.broadcast_to(self.width * objective.scale, best.shape)
        shape = (self.iterations, count, self.population, size)
        noise, history = np.asarray(jax.random.normal(key, shape), np.float64), []
        for each in noise:
            samples = mean[:, None] + deviation[:, None] * each
            costs = objective.cost(samples.reshape(-1, size)).reshape(count, self.population)
            best_sample = np.argmin(costs, axis=1)
            better = costs[np.arange(count), best_sample] < cost
            best = np.where(better[:, None], samples[np.arange(count), best_sample], best)
            cost = np.where(better, costs[np.arange(count), best_sample], cost)
            history.append(cost.min())
            mean, deviation = self.update(samples, costs, deviation)
        return Candidates.sorted(best, cost), np.array(history)


class CrossEntropy(_Sampling):
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
        _check_sampling(self)
        check_count("elites", self.elites)
        if self.elites > self.population:
            raise ValueError(f"elites must be at most the population of {self.population}; got {self.elites}")
        if not 0 <= self.smoothing < 1:
            raise ValueError(f"smoothing must be at least 0 and below 1; got {self.smoothing!r}")

    def update(self, parameters, cost, deviation):
        order = np.argsort(cost, axis=1, kind="stable")[:, : self.elites]
        elites = np.take_along_axis(parameters, order[:, :, None], axis=1)
        return elites.mean(axis=1), (1 - self.smoothing) * elites.std(axis=1) + self.smoothing * deviation


class MPPI(_Sampling):
    """Model predictive path integral: the mean of the samples with weights exp(-cost / temperature).

    Attributes:
        iterations: Number of iterations.
        population: Number of samples around each candidate in each iteration.
        temperature: Temperature, in units of the standard deviation of the costs of the samples.
        width: Standard deviation of the first samples, in units of the objective's scale.
        decay: Factor of the standard deviation from one iteration to the next.

    Raises:
        ValueError: If a number is not positive.

    Reference: Williams, Aldrich & Theodorou 2017.
    """

    iterations: int = 20
    population: int = 32
    temperature: float = 0.3
    width: float = 0.3
    decay: float = 0.85

    def __check_init__(self):
        _check_sampling(self)
        _check_positive(self, "temperature", "decay")

    def update(self, parameters, cost, deviation):
        above = cost - cost.min(axis=1, keepdims=True)
        spread = above.std(axis=1, keepdims=True)
        weights = np.exp(-above / np.where(spread > 0, self.temperature * spread, 1.0))
        weights /= weights.sum(axis=1, keepdims=True)
        return np.einsum("cp,cps->cs", weights, parameters), self.decay * deviation


class GradientRefinement(Search):
    """Gradient descent by Adam from the best candidates.

    Its history has one more entry than iterations, because the first one is that of the start.

    Attributes:
        iterations: Number of iterations.
        rate: Learning rate of Adam: about how far a parameter moves in an iteration, in units of the objective's scale.
        keep: Number of candidates that are refined; the others are dropped.

    Raises:
        ValueError: If a number is not positive.

    Reference: Kingma & Ba 2015.
    """

    iterations: int = 30
    rate: float = 0.03
    keep: int = 4

    def __check_init__(self):
        check_count("iterations", self.iterations)
        check_count("keep", self.keep)
        _check_positive(self, "rate")

    def __call__(self, key, objective, start):
        parameters = start.parameters[: self.keep]
        best, cost, history = parameters, np.full(len(parameters), np.inf), []
        optimizer = optax.adam(self.rate)
        state = optimizer.init(parameters)
        for _ in range(self.iterations + 1):
            costs, gradients = objective.cost_and_gradient(parameters)
            better = costs < cost
            best, cost = np.where(better[:, None], parameters, best), np.where(better, costs, cost)
            history.append(cost.min())
            update, state = optimizer.update(gradients * objective.scale, state)
            parameters = parameters + np.asarray(update, np.float64) * objective.scale
        return Candidates.sorted(best, cost), np.array(history)


def _check_sampling(search: _Sampling) -> None:
    check_count("iterations", search.iterations)
    check_count("population", search.population)
    _check_positive(search, "width")


def _check_positive(search: Search, *names: str) -> None:
    for name in names:
        value = getattr(search, name)
        if not (value > 0 and np.isfinite(value)):
            raise ValueError(f"{name} must be positive and finite; got {value!r}")
