"""Plans of pushes that reach a goal under friction that is not known.

A plan is open loop: the hand's paths are fixed before the first push. Each push is given in the slider's frame
(`Pushes`), at the pose that the pushes before it lead to under the mean friction. The search runs in two stages:

1. under the mean friction, from many random plans: which ways there are to reach the goal at all;
2. under sampled friction, the same samples for all candidates: which of these ways does so most surely, and how to
   change it so that it does more surely still.

The search has seen its samples, so the plan's own distribution and its probability of success are computed with others.
Between two pushes the hand has to leave the slider and come back, which is not simulated.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_count,
    check_finite,
    check_key,
    check_shape,
    check_type,
    common_dtype,
)
from pushjax._internal.jit import jit
from pushjax.friction.random import FrictionModel
from pushjax.planning.costs import Cost, FinalPose, Mean, Missed, Risk
from pushjax.planning.draws import draw_friction, mean_friction
from pushjax.planning.goal import Goal
from pushjax.planning.pushes import Pushes
from pushjax.planning.search import Candidates, CrossEntropy, Objective, Search, Selection
from pushjax.simulation.arguments import check_slider_and_hand
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand
from pushjax.simulation.random_rollout import Draws, rollout_under_draws
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory

FAILURE = 1e3  # cost of a rollout that fails, such as a push that would start inside the slider
BATCH = 256  # candidates that are evaluated in one call; fewer are padded, so that one program does for all
PREDICTED = 256  # samples of the predicted outcomes
MISSED_WIDTH = 0.5  # width of the border of failure in the default cost, in tolerances
TOGETHER = 2048  # rollouts that are computed together, so that their data stay in the cache
WARM_UP = (Selection(64), CrossEntropy(iterations=6, population=16, elites=4))
SEARCH = (Selection(16), CrossEntropy(iterations=10, population=32))


class PushPlanStatus(IntEnum):
    """Whether a plan of pushes does what was asked for.

    Attributes:
        FOUND: It reaches the goal with at least the probability that was asked for.
        UNLIKELY: The best plan that was found reaches the goal less surely.
    """

    FOUND = 0
    UNLIKELY = 1


class Outcomes(NamedTuple):
    """Where pushes end under sampled friction.

    Attributes:
        pose: Final poses of the slider, (samples, 3), world.
        failed: Whether a rollout failed, (samples,).
    """

    pose: Float[Array, "samples 3"]
    failed: Bool[Array, "samples"]

    def success(self, goal: Goal) -> float:
        """Return the fraction of the samples that reach a goal."""
        return float(np.mean(np.asarray(goal.reached(self.pose)) & ~np.asarray(self.failed)))


class PushPlan(NamedTuple):
    """A plan of pushes.

    Attributes:
        status: Whether it is sure enough.
        path: Paths of the hand, (pushes, steps + 1, dof), world.
        parameters: Its parameters, as in `Pushes`, (size,).
        outcomes: Predicted final poses under friction that the search has not seen.
        success: Predicted probability of success: the fraction of these poses that reach the goal.
        cost: Its cost in the search.
        history: Least cost after each iteration of the search under sampled friction, (iterations,).
    """

    status: PushPlanStatus
    path: Float[Array, "pushes steps+1 dof"]
    parameters: np.ndarray
    outcomes: Outcomes
    success: float
    cost: float
    history: np.ndarray


class _Problem(eqx.Module):
    """What candidates are evaluated on.

    Attributes:
        pushes: What the parameters mean.
        slider: The slider.
        hand: The hand.
        start: Poses of the slider at the start, (samples, 3).
        mean: Mean friction, in which the paths of later pushes are laid out.
        draws: Sampled friction, one for each start.
        cost: Cost of one sample.
        risk: What it counts for all samples.
        fixtures: What the slider may run into.
    """

    pushes: Any  # `Pushes`; None where nothing is searched, as for cost and risk
    slider: Slider
    hand: Hand
    start: Float[Array, "samples 3"]
    mean: Draws
    draws: Draws
    cost: Any
    risk: Any
    fixtures: Fixtures

    def paths(self, parameters: Array) -> Float[Array, "pushes steps+1 dof"]:
        """Lay out the paths of all pushes under the mean friction."""
        draw = jax.tree.map(lambda leaf: leaf[0], self.mean)

        def push(pose: Array, numbers: Array) -> tuple[Array, Array]:
            path = self.pushes.path(numbers, self.slider, self.hand, pose)
            return self.roll(draw, path, pose).pose[-1], path

        return jax.lax.scan(push, jnp.mean(self.start, axis=0), parameters.reshape(self.pushes.count, -1))[1]

    def roll(self, draw: Draws, path: Array, pose: Array) -> Trajectory:
        """Push once under sampled friction."""
        return rollout_under_draws(draw, self.slider.shape, self.hand, path, pose, None, None, None, self.fixtures)

    def rolls(self, draw: Draws, paths: Array, pose: Array) -> Trajectory:
        """Push several times; the result has a leading axis of pushes."""

        def push(pose: Array, path: Array) -> tuple[Array, Trajectory]:
            done = self.roll(draw, path, pose)
            return done.pose[-1], done

        return jax.lax.scan(push, pose, paths)[1]

    def judge(self, parameters: Array) -> Float[Array, ""]:
        """Return the cost of one candidate."""
        paths = self.paths(parameters)

        def sample(draw: Draws, pose: Array) -> tuple[Array, Array]:
            done = self.rolls(draw, paths, pose)
            return self.cost(done), jnp.any(done.failed)

        costs, failed = jax.vmap(sample)(self.draws, self.start)
        total = self.risk(costs) + FAILURE * jnp.mean(failed.astype(costs.dtype))
        return jnp.where(jnp.isfinite(total), total, 2 * FAILURE)


@jit
def _costs(parameters: Array, problem: _Problem) -> Array:
    together = max(1, TOGETHER // len(problem.start))
    return jax.lax.map(problem.judge, parameters, batch_size=min(together, len(parameters)))


@jit
def _costs_and_gradients(parameters: Array, problem: _Problem) -> tuple[Array, Array]:
    return jax.lax.map(jax.value_and_grad(problem.judge), parameters)


@jit
def _paths(parameters: Array, problem: _Problem) -> Array:
    return problem.paths(parameters)


@jit
def _outcomes(paths: Array, problem: _Problem) -> Outcomes:
    def sample(draw: Draws, pose: Array) -> Outcomes:
        done = problem.rolls(draw, paths, pose)
        return Outcomes(done.pose[-1, -1], jnp.any(done.failed))

    return jax.vmap(sample)(problem.draws, problem.start)


def plan_pushes(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    start: ArrayLike,
    goal: Goal,
    *,
    model: FrictionModel,
    pushes: Pushes,
    cost: Cost | None = None,
    risk: Risk | None = None,
    samples: int = 32,
    candidates: int = 2048,
    warm_up: Sequence[Search] = WARM_UP,
    search: Sequence[Search] = SEARCH,
    success: float = 0.9,
    fixtures: Fixtures = (),
) -> PushPlan:
    """Plan pushes that bring a slider to a goal, as surely as can be under friction that is not known.

    The same arguments give the same bits. All candidates are judged under the same sampled friction.

    Args:
        key: PRNG key of everything random.
        slider: The slider.
        hand: The hand, of round fingers.
        start: Pose of the slider at the start, (3,), world, m and rad, or samples of a belief, (poses, 3). Sample k of
            the friction is that of start k, modulo their number.
        goal: The goal.
        model: Distribution of limit surface and contact friction.
        pushes: How many pushes, and what is free in each.
        cost: Cost of a push; by default, failure with a smooth border and a thousandth of the squared error.
        risk: What is minimized over the samples of the cost; by default the mean.
        samples: Number of samples of friction in the search.
        candidates: Number of random plans that the search starts from.
        warm_up: Searches under the mean friction.
        search: Searches under sampled friction, which start from the result of `warm_up`.
        success: Probability of success that is asked for.
        fixtures: Walls and fixed bodies that the slider may run into. The hand passes through them.

    Returns:
        The plan. Its status says whether it is as sure as was asked for.

    Raises:
        ValueError: For a count below one, a start that is not finite or of another shape, a success outside [0, 1], or
            a hand that does not fit `pushes`.
        TypeError: For arguments of other types, and for a hand with pads.
    """
    check_type("goal", goal, Goal)
    check_type("pushes", pushes, Pushes)
    check_count("candidates", candidates)
    if not 0 <= success <= 1:
        raise ValueError(f"success must be a probability; got {success!r}")
    check_slider_and_hand(slider, hand)
    pushes.check_hand(hand)
    cost = Missed(goal, MISSED_WIDTH) + 0.001 * FinalPose(goal) if cost is None else cost
    risk = Mean() if risk is None else risk
    problem = _problem(key, slider, hand, start, model, samples, fixtures, (pushes, cost, risk))
    mean_start = jnp.mean(problem.start, axis=0, keepdims=True)
    nominal = eqx.tree_at(lambda p: (p.draws, p.start), problem, (problem.mean, mean_start))
    keys = iter(jax.random.split(jax.random.fold_in(key, 1), 1 + len(warm_up) + len(search)))
    found, history = Candidates(pushes.sample(next(keys), candidates), np.full(candidates, np.inf)), [np.zeros(0)]
    for each in warm_up:
        found, _ = each(next(keys), _objective(nominal), found)
    for each in search:
        found, costs = each(next(keys), _objective(problem), found)
        history.append(costs)
    best = found.parameters[0]
    path = _paths(jnp.asarray(best, problem.start.dtype), problem)
    unseen = jax.random.fold_in(key, 2)
    outcomes = push_outcomes(unseen, slider, hand, start, path, model=model, samples=PREDICTED, fixtures=fixtures)
    probability = outcomes.success(goal)
    status = PushPlanStatus.FOUND if probability >= success else PushPlanStatus.UNLIKELY
    return PushPlan(status, path, best, outcomes, probability, float(found.cost[0]), np.concatenate(history))


def push_outcomes(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    start: ArrayLike,
    path: ArrayLike,
    *,
    model: FrictionModel,
    samples: int = 256,
    fixtures: Fixtures = (),
) -> Outcomes:
    """Simulate pushes in a row under sampled friction. Each sample keeps its friction for all pushes.

    Args:
        key: PRNG key of everything random.
        slider: The slider.
        hand: The hand. It is put at the start of each path, wherever it was before.
        start: Pose of the slider at the start, (3,), or samples of a belief, (poses, 3), world, m and rad.
        path: Paths of the hand, (pushes, steps + 1, dof), world.
        model: Distribution of limit surface and contact friction.
        samples: Number of samples.
        fixtures: Walls and fixed bodies that the slider may run into.

    Returns:
        The final poses.

    Raises:
        ValueError: For a count below one, and for a start or paths that are not finite or of another shape.
        TypeError: For arguments of other types.
    """
    check_slider_and_hand(slider, hand)
    problem = _problem(key, slider, hand, start, model, samples, fixtures, None)
    paths = as_float(path, problem.start.dtype, "path")
    check_shape("path", paths, ("pushes", "steps + 1", hand.dof))
    check_finite("path", paths)
    return _outcomes(paths, problem)


def _problem(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    start: ArrayLike,
    model: FrictionModel,
    samples: int,
    fixtures: Fixtures,
    search: tuple[Pushes, Cost, Risk] | None,
) -> _Problem:
    """Check the arguments that planning and simulation share, cast them to one dtype, and sample the friction."""
    check_key(key)
    dtype = common_dtype(slider, hand, start)
    poses = as_float(start, dtype, "start")
    if poses.ndim not in (1, 2) or poses.shape[-1] != 3 or not poses.size:
        raise ValueError(f"start has shape {poses.shape}; expected (3,) or (poses, 3)")
    check_finite("start", poses)
    draws = draw_friction(key, slider.surface, model, samples)
    poses = poses.reshape(-1, 3)[np.arange(samples) % (poses.size // 3)]
    pushes, cost, risk = search or (None, None, None)
    parts = (pushes, slider, hand, poses, mean_friction(slider.surface, model), draws, cost, risk, fixtures)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), _Problem(*parts))


def _objective(problem: _Problem) -> Objective:
    """Return the cost of many candidates as a function on the host, computed in batches of one size."""
    dtype = problem.start.dtype

    def cost(parameters: np.ndarray) -> np.ndarray:
        count = len(parameters)
        padded = np.resize(parameters, (-(-count // BATCH) * BATCH, parameters.shape[1]))
        parts = [_costs(jnp.asarray(part, dtype), problem) for part in np.split(padded, len(padded) // BATCH)]
        return np.concatenate([np.asarray(part, np.float64) for part in parts])[:count]

    def cost_and_gradient(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        costs, gradients = _costs_and_gradients(jnp.asarray(parameters, dtype), problem)
        return np.asarray(costs, np.float64), np.asarray(gradients, np.float64)

    return Objective(cost, cost_and_gradient, problem.pushes.scale)
