"""Costs of a push, and the risk of a cost that is random.

A `Cost` is a function of a `Trajectory`. Costs add up and are multiplied by numbers:

    cost = Missed(goal, width=0.5) + 0.001 * FinalPose(goal)

The trajectory of several pushes in a row has a leading axis of pushes, and every cost takes it as it is. Of several
sliders, the goal is that of the first one. A cost is a pure function. Its derivatives are finite wherever those of the
trajectory are.

The friction of a push is random, and so is the pose from which it starts. Samples of both give samples of the cost,
which a `Risk` reduces to one number.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, checked_array
from pushjax._internal.xla import smallest
from pushjax._math.vec import Vec2
from pushjax.geometry import se2
from pushjax.planning.goal import Goal
from pushjax.simulation.fixtures import Fixture, Fixtures, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.trajectory import Trajectory


class Cost(eqx.Module):
    """A cost of a push. Costs are added, and multiplied by numbers."""

    @abstractmethod
    def __call__(self, push: Trajectory) -> Float[Array, ""]:
        """Return the cost of a push, or of several pushes in a row with a leading axis of pushes."""

    def __add__(self, other: "Cost") -> "Cost":
        return Sum((self, other)) if isinstance(other, Cost) else NotImplemented

    def __mul__(self, factor: ArrayLike) -> "Cost":
        return Scaled(self, as_float(factor, name="factor"))

    __rmul__ = __mul__


class Sum(Cost):
    """The sum of several costs."""

    costs: tuple[Cost, ...]

    def __call__(self, push: Trajectory) -> Float[Array, ""]:
        return sum((cost(push) for cost in self.costs), jnp.zeros((), push.pose.dtype))


class Scaled(Cost):
    """A cost times a number."""

    cost: Cost
    factor: Float[Array, ""]

    def __call__(self, push: Trajectory) -> Float[Array, ""]:
        value = self.cost(push)
        return self.factor.astype(value.dtype) * value


def _final_pose(push: Trajectory) -> Float[Array, "3"]:
    """Return the final pose of a push, or of the last of several pushes in a row; that of the first slider."""
    of_several = push.pose.ndim > push.status.ndim + 1
    return (push.pose[..., 0, :] if of_several else push.pose).reshape(-1, 3)[-1]


class FinalPose(Cost):
    """Squared error of the final pose in units of the goal's tolerances, `Goal.squared_error`.

    Attributes:
        goal: The goal.
    """

    goal: Goal

    def __call__(self, push: Trajectory) -> Float[Array, ""]:
        return self.goal.squared_error(_final_pose(push))


class Missed(Cost):
    """Whether the final pose misses the goal: its mean over samples is the probability of failure.

    Attributes:
        goal: The goal.
        width: Zero for a step from 0 to 1 at the tolerance. Otherwise the width of a smooth transition, in tolerances;
            its value at the tolerance is a half.

    Raises:
        ValueError: For a width that is negative, not finite or not a single number.
    """

    goal: Goal
    width: Float[Array, ""]

    def __init__(self, goal: Goal, width: ArrayLike = 0.0):
        self.goal, self.width = goal, checked_array("width", width, (), non_negative=True)

    def __call__(self, push: Trajectory) -> Float[Array, ""]:
        beyond = self.goal.max_error(_final_pose(push)) - 1
        smooth = self.width > 0
        transition = jax.nn.sigmoid(beyond / jnp.where(smooth, self.width, 1.0).astype(beyond.dtype))
        return jnp.where(smooth, transition, jnp.where(beyond > 0, 1.0, 0.0).astype(beyond.dtype))


class HandClearance(Cost):
    """Penalty for a hand of round fingers that comes nearer to walls and fixtures than a distance."""

    # The cost is ((distance - clearance) / distance)^2, where the clearance is the smallest along the path. So it is
    # zero from `distance` on, and above one if the hand runs into a wall or fixture.

    hand: Hand
    fixtures: Fixtures
    distance: Float[Array, ""]  # to keep, m

    def __init__(self, hand: Hand, fixtures: Fixtures, distance: ArrayLike):
        self.hand, self.fixtures = hand, tuple(fixtures)
        self.distance = checked_array("distance", distance, (), positive=True)

    def __call__(self, push: Trajectory) -> Float[Array, ""]:
        centers = self.hand.poses(push.configuration)[..., :2].reshape(-1, len(self.hand.fingers), 2)
        clearances = [jnp.asarray(jnp.inf, centers.dtype)]
        for each in self.fixtures:
            for finger, radius in enumerate(self.hand.radius):
                clearances.append(_fixture_distance(each, centers[:, finger]) - radius)
        return (jnp.maximum(self.distance - smallest(jnp.stack(clearances)), 0) / self.distance) ** 2


def _fixture_distance(fixture: Wall | Fixture, points: Float[Array, "points 2"]) -> Float[Array, ""]:
    """Return the smallest distance of points from a wall or fixture, m, negative inside."""
    if isinstance(fixture, Wall):
        return smallest((points - fixture.point[None]) @ fixture.normal)
    outline, points = fixture.shape.outline(), se2.transform(se2.inverse(fixture.pose), points)
    return smallest(jax.vmap(lambda point: outline.closest(Vec2.of(point)).distance)(points))


class Risk(eqx.Module):
    """Reduces samples of a random cost to one number."""

    @abstractmethod
    def __call__(self, costs: Float[Array, "samples"]) -> Float[Array, ""]:
        """Return the risk from equally probable samples of a cost."""


class Mean(Risk):
    """The mean. Of `Missed`, it is the probability of failure."""

    def __call__(self, costs: Float[Array, "samples"]) -> Float[Array, ""]:
        return jnp.mean(costs)


class CVaR(Risk):
    """Conditional value at risk: the mean of the worst fraction of the samples.

    If the fraction is not a whole number of samples, the best of them counts in part. A fraction of one gives the mean.
    A fraction of one sample or less gives the worst sample.

    Args:
        fraction: The fraction, above 0 and at most 1.

    Raises:
        ValueError: If the fraction is outside.

    Reference: Rockafellar & Uryasev 2000.
    """

    fraction: float = eqx.field(static=True)

    def __init__(self, fraction: float = 0.1):
        if not 0 < fraction <= 1:
            raise ValueError(f"fraction must be above 0 and at most 1; got {fraction!r}")
        self.fraction = float(fraction)

    def __call__(self, costs: Float[Array, "samples"]) -> Float[Array, ""]:
        count = max(self.fraction * len(costs), 1.0)
        weights = np.minimum(count - np.arange(int(np.ceil(count))), 1) / count
        worst = jnp.sort(costs, descending=True)[: len(weights)]
        return jnp.sum(worst * jnp.asarray(weights, costs.dtype))
