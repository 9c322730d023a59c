"""Simulation of pushes in a row under sampled friction: the problem that candidates of a search are evaluated on."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_key,
    check_type,
    checked_array,
    common_dtype,
)
from pushjax._internal.jit import jit, quick_jit
from pushjax.metrics import mean_pose
from pushjax.planning.costs import Cost, Risk
from pushjax.planning.goal import Goal
from pushjax.planning.push_batch import in_batches
from pushjax.planning.push_sequence import PushSequence
from pushjax.planning.scene import PushScene, draw_friction, mean_friction
from pushjax.planning.search import Objective
from pushjax.simulation.random_rollout import Draws, rollout_under_draws, shape_and_surface
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory

FAILURE = 1e3  # cost of a rollout that fails, such as a push that would start inside the slider
CANDIDATES_AT_A_TIME = 256  # candidates whose paths are laid out together
SAMPLES_AT_A_TIME = 2048  # samples that are simulated together, so that their data stay in the cache


class Outcomes(NamedTuple):
    """Where pushes end under sampled friction."""

    poses: Float[Array, "samples pushes+1 *sliders 3"]  # before the first push and after each, world
    failed: Bool[Array, "samples"]  # whether a rollout failed

    @property
    def pose(self) -> Float[Array, "samples 3"]:
        """Final poses of the slider, of several the first one, (samples, 3), world."""
        last = self.poses[:, -1]
        return last if last.ndim == 2 else last[:, 0]

    def success(self, goal: Goal) -> float:
        """Return the fraction of the samples that reach a goal."""
        return float(np.mean(np.asarray(goal.reached(self.pose)) & ~np.asarray(self.failed)))


class PushProblem(eqx.Module):
    """What candidates are evaluated on."""

    pushes: Any  # `PushSequence`; None where nothing is searched, as for cost and risk
    scene: PushScene
    start: Float[Array, "samples *sliders 3"]  # world, m and rad
    mean: Draws  # friction under which the slider is moved to where the path of each later push is laid out
    draws: Draws  # sampled friction, one for each start
    cost: Any  # `Cost` of one sample
    risk: Any  # `Risk` of the costs of all samples

    def lay_out(
        self, parameters: Array
    ) -> tuple[Float[Array, "pushes steps+1 dof"], Float[Array, "pushes+1 *sliders 3"]]:
        """Return the paths of all pushes, and the poses before the first and after each, under the mean friction."""
        draw = jax.tree.map(lambda leaf: leaf[0], self.mean)

        def push(pose: Array, numbers: Array) -> tuple[Array, tuple[Array, Array]]:
            path = self.pushes.path(numbers, self.scene.sliders, self.scene.hand, pose.reshape(-1, 3))
            after = self.rollout(draw, path, pose).pose[-1]
            return after, (path, after)

        start = mean_pose(self.start)
        paths, poses = jax.lax.scan(push, start, parameters.reshape(self.pushes.count, -1))[1]
        return paths, jnp.concatenate([start[None], poses])

    def rollout(self, draw: Draws, path: Array, pose: Array) -> Trajectory:
        """Push once under sampled friction."""
        (shape, _), hand, fixtures = shape_and_surface(self.scene.slider), self.scene.hand, self.scene.fixtures
        return rollout_under_draws(draw, shape, hand, path, pose, None, None, None, fixtures)

    def sample(self, paths: Array, draw: Draws, pose: Array) -> tuple[Float[Array, ""] | None, Outcomes]:
        """Push along paths, (pushes, steps + 1, dof), under sampled friction; the cost is None without a `Cost`."""

        def push(pose: Array, path: Array) -> tuple[Array, Trajectory]:
            done = self.rollout(draw, path, pose)
            return done.pose[-1], done

        done = jax.lax.scan(push, pose, paths)[1]
        outcomes = Outcomes(jnp.concatenate([pose[None], done.pose[:, -1]]), jnp.any(done.failed))
        return None if self.cost is None else self.cost(done), outcomes

    def total(self, costs: Array, failed: Array) -> Float[Array, ""]:
        """Return the cost of one candidate from its samples."""
        total = self.risk(costs) + FAILURE * jnp.mean(failed.astype(costs.dtype))
        return jnp.where(jnp.isfinite(total), total, 2 * FAILURE)


# Candidates are evaluated by two programs, with one rollout each: compiling rollouts takes most of the time of a plan.
# Both have one size, whatever the number of candidates and samples.
_lay_outs = quick_jit(jax.vmap(PushProblem.lay_out, in_axes=(None, 0)))
_samples = jit(jax.vmap(PushProblem.sample, in_axes=(None, 0, 0, 0)))
_totals = jit(jax.vmap(PushProblem.total, in_axes=(None, 0, 0)))
_simulated = quick_jit(jax.vmap(PushProblem.sample, in_axes=(None, None, 0, 0)))


def lay_out(parameters: np.ndarray, problem: PushProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the paths of candidates (candidates, pushes, ...), and the poses that they lead to; see `PushProblem`."""
    given, shared = np.asarray(parameters, problem.start.dtype), _without_samples(problem)
    return in_batches(len(given), CANDIDATES_AT_A_TIME, lambda rows: _lay_outs(shared, jnp.asarray(given[rows])))


def samples_of(paths: np.ndarray, problem: PushProblem) -> tuple[np.ndarray, Outcomes]:
    """Push along the paths of candidates in all samples; the arrays have the leading axes (candidates, samples)."""
    draws, start = jax.tree.map(np.asarray, (problem.draws, problem.start))
    candidates, samples, shared = len(paths), len(start), _without_samples(problem)

    def simulate(rows: np.ndarray) -> Any:
        candidate, sample = rows // samples, rows % samples
        draw = jax.tree.map(lambda leaf: leaf[sample], draws)
        return _samples(shared, jnp.asarray(paths[candidate]), draw, jnp.asarray(start[sample]))

    found = in_batches(candidates * samples, SAMPLES_AT_A_TIME, simulate)
    return jax.tree.map(lambda leaf: leaf.reshape(candidates, samples, *leaf.shape[1:]), found)


def _without_samples(problem: PushProblem) -> PushProblem:
    """Return the problem without its samples, which is the same for all stages of a search."""
    return replace(problem, draws=None, start=mean_pose(problem.start)[None])


def push_outcomes(
    key: PRNGKeyArray, scene: PushScene, start: ArrayLike, path: ArrayLike, *, samples: int = 256
) -> Outcomes:
    """Simulate pushes in a row under sampled friction. Each sample keeps its friction for all pushes.

    Args:
        key: PRNG key of everything random.
        scene: Slider or several, hand, friction, and the fixtures that sliders may run into. The hand is put at the
            start of each path, wherever it was before.
        start: Pose of the slider at the start, (3,), or samples of a belief, (poses, 3), world, m and rad. Sample k
            starts at pose k modulo the number of poses. Of several sliders (sliders, 3) or (poses, sliders, 3).
        path: Paths of the hand, (pushes, steps + 1, dof), world.
        samples: Number of samples.

    Returns:
        `poses` before the first push and after each, (samples, pushes + 1, 3), of several sliders (samples, pushes + 1,
        sliders, 3), and whether a rollout `failed`, (samples,). The final ones of the first slider are `pose`, and
        `success(goal)` is the fraction that reaches a goal.

    Raises:
        ValueError: For a count below one, and for a start or paths that are not finite or of another shape.
    """
    problem = push_problem(key, scene, start, samples)
    paths = checked_array("path", path, ("pushes", "steps + 1", scene.hand.dof), problem.start.dtype)
    return _simulated(problem, paths, problem.draws, problem.start)[1]


def push_problem(
    key: PRNGKeyArray,
    scene: PushScene,
    start: ArrayLike,
    samples: int,
    criteria: tuple[PushSequence, Cost, Risk] | None = None,  # of a search; None where nothing is searched
) -> PushProblem:
    """Check the arguments that planning and simulation share, cast them to one dtype, and sample the friction."""
    check_key(key)
    check_type("scene", scene, PushScene)
    dtype = common_dtype(scene.slider, scene.hand, start)
    poses = as_float(start, dtype, "start")
    of_one, many = ((3,), "(poses, 3)")
    if not isinstance(scene.slider, Slider):
        of_one, many = (len(scene.sliders), 3), f"(poses, {len(scene.sliders)}, 3)"
    if poses.shape[-len(of_one) :] != of_one or poses.ndim > len(of_one) + 1 or not poses.size:
        raise ValueError(f"start has shape {poses.shape}; expected {of_one} or {many}")
    check_finite("start", poses)
    _, surface = shape_and_surface(scene.slider)
    draws = draw_friction(key, surface, scene.friction, samples, scene.between)
    poses = poses.reshape(-1, *of_one)
    poses = poses[np.arange(samples) % len(poses)]
    pushes, cost, risk = criteria or (None, None, None)
    mean = mean_friction(surface, scene.friction, scene.between)
    problem = PushProblem(pushes, scene, poses, mean, draws, cost, risk)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), problem)


def objective(problem: PushProblem) -> Objective:
    """Return the cost of many candidates as a function on the host."""

    def cost(parameters: np.ndarray) -> np.ndarray:
        costs, found = samples_of(lay_out(parameters, problem)[0], problem)
        shared = _without_samples(problem)

        def total(rows: np.ndarray) -> Array:
            return _totals(shared, jnp.asarray(costs[rows]), jnp.asarray(found.failed[rows]))

        return in_batches(len(parameters), CANDIDATES_AT_A_TIME, total).astype(np.float64)

    return Objective(cost, problem.pushes.scale)
