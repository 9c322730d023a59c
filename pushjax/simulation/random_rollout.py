"""Rollout of one push under random friction."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_key, check_type
from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import entry_at
from pushjax.contact.problem import check_solver, form_and_friction
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.surface_distributions import SurfaceDistribution
from pushjax.friction.table import Table
from pushjax.geometry.shape import Shape
from pushjax.simulation.arguments import (
    check_start_among_fixtures,
    checked_fixtures,
    checked_rollout_arguments,
    checked_table,
)
from pushjax.simulation.fixtures import Fixture, Fixtures, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.rollout import friction_on_table, simulate
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory


class Draws(NamedTuple):
    """Friction that was sampled for a push.

    Attributes:
        surface: Limit surfaces, with a leading axis of draws.
        friction: Coefficients of friction mu, (draws,).
        shrinkage: How far each surface was moved toward the mean to be convex, (draws,); as in `SurfaceSample`.
    """

    surface: LimitSurface
    friction: Float[Array, "draws"]
    shrinkage: Float[Array, "draws"]


class RandomRollout(NamedTuple):
    """A push under random friction.

    Attributes:
        push: The push, step by step.
        draws: The friction that was sampled for it.
    """

    push: Trajectory
    draws: Draws


def draw(key: PRNGKeyArray, surfaces: SurfaceDistribution, model: FrictionModel, steps: int) -> Draws:
    """Sample the friction of one push of `steps` steps."""

    def sample_once(key):
        surface_key, friction_key = jax.random.split(key)
        sample = surfaces.sample(surface_key)
        return Draws(sample.surface, model.sample_friction(friction_key), sample.shrinkage)

    # a single draw equals `model.sample(key, surface)`
    if model.resample_every is None:
        return jax.tree.map(lambda leaf: leaf[None], sample_once(key))
    indices = jnp.arange(-(-steps // model.resample_every))
    return jax.vmap(lambda k: sample_once(jax.random.fold_in(key, k)))(indices)


def rollout_under_draws(
    draws: Draws,
    shape: Shape,
    hand: Hand,
    path: Array,
    pose: Array,
    solver: ContactSolver | StickingSolver | None,
    resample_every: int | None,
    table: Table | None,
    fixtures: Fixtures,
) -> Trajectory:
    """Return a push under friction that was sampled before."""
    friction = jnp.broadcast_to(draws.friction[:, None], (len(draws.friction), len(hand.fingers)))
    surfaces_and_frictions = jax.vmap(form_and_friction)(draws.surface, friction.astype(pose.dtype))

    first_draw = entry_at(surfaces_and_frictions, 0)

    def friction_at(step, pose):
        return first_draw if resample_every is None else entry_at(surfaces_and_frictions, step // resample_every)

    return simulate(shape, hand, path, pose, solver, friction_on_table(table, friction_at), fixtures)


def random_rollout(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    path: ArrayLike,
    *,
    pose: ArrayLike,
    model: FrictionModel,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
) -> RandomRollout:
    """Push the slider along a path under friction sampled from `model` around the slider's surface.

    The result is differentiable like a `rollout`, and also in the range of the model's friction and in its `dof`.
    Derivatives in `dof` are correct in the mean over keys. For a single key they are not, because its sample jumps.
    With the sampler "gram", the mean leaves out how the shrinkage of repaired samples changes.

    Use `vmap` over keys for batches. For large batches `monte_carlo` is faster and shows progress.

    Args:
        key: PRNG key of everything random.
        slider: The slider; its surface is the mean of the sampled surfaces.
        hand: The hand.
        path: Configurations of the hand, as in `rollout`.
        pose: Pose of the slider at the start, (3,), world, m and rad.
        model: Distribution of limit surface and friction.
        solver: Solver of contact problems, as in `rollout`.
        table: A table whose friction depends on direction or place, as in `rollout`.
        fixtures: Walls and bodies that the slider may touch, as in `rollout`; their friction is not random.

    Returns:
        The push, and the friction that was sampled for it.

    Raises:
        ValueError: As in `rollout` and `FrictionModel.around`.
        TypeError: As in `rollout` and `FrictionModel.around`. Also for a key that is no array, or a model of another
            type.

    Reference: Zhou et al. 2017, section V.
    """
    check_key(key)
    check_solver(solver)
    check_type("model", model, FrictionModel)
    slider, hand, path_array, start, _ = checked_rollout_arguments(slider, hand, path, pose, 0.0)
    table, fixed = checked_table(table, start.dtype), checked_fixtures(fixtures, start.dtype)
    check_start_among_fixtures(slider, fixed, start)
    return _random_rollout(
        key, model.around(slider.surface), slider.shape, hand, path_array, start, model, solver, table, fixed
    )


@quick_jit
def _random_rollout(key, surfaces, shape, hand, path, pose, model, solver, table, fixtures) -> RandomRollout:
    draws = draw(key, surfaces, model, len(path) - 1)
    return RandomRollout(
        rollout_under_draws(draws, shape, hand, path, pose, solver, model.resample_every, table, fixtures), draws
    )
