"""Rollout of one push under random friction."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_key, check_type
from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import entry_at
from pushjax.contact.problem import form_and_friction
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.surface_distributions import SurfaceDistribution
from pushjax.friction.table import Table
from pushjax.geometry.shape import Shape
from pushjax.simulation.arguments import Scene, checked_friction_range, checked_scene
from pushjax.simulation.fixtures import Fixture, Fixtures, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.rollout import friction_on_table, simulate
from pushjax.simulation.several_sliders import SlidersFriction, simulate_sliders
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory


class Draws(NamedTuple):
    """Friction that was sampled for a push.

    Attributes:
        surface: Limit surfaces, with a leading axis of draws; of several sliders, a tuple of them.
        friction: Coefficients of friction mu, (draws,).
        shrinkage: How far each surface was moved toward the mean to be convex, (draws,); as in `SurfaceSample`. Of
            several sliders, the largest.
        between: Coefficients of friction of several sliders with each other, (draws, sliders, sliders); else None.
    """

    surface: LimitSurface | tuple[LimitSurface, ...]
    friction: Float[Array, "draws"]
    shrinkage: Float[Array, "draws"]
    between: Float[Array, "draws sliders sliders"] | None = None


class RandomRollout(NamedTuple):
    """A push under random friction.

    Attributes:
        push: The push, step by step.
        draws: The friction that was sampled for it.
    """

    push: Trajectory
    draws: Draws


class Distributions(NamedTuple):
    """What the friction of a push is sampled from, besides the model."""

    surfaces: SurfaceDistribution | tuple[SurfaceDistribution, ...]
    between: Array | None  # lowest and highest friction of several sliders with each other, (2, sliders, sliders)

    @staticmethod
    def of(
        surface: LimitSurface | tuple[LimitSurface, ...], model: FrictionModel, between: Array | None
    ) -> "Distributions":
        """The distributions around the limit surface of one slider, or of several."""
        if not isinstance(surface, tuple):
            return Distributions(model.around(surface), None)
        return Distributions(tuple(model.around(one) for one in surface), between)


def draw(key: PRNGKeyArray, distributions: Distributions, model: FrictionModel, steps: int) -> Draws:
    """Sample the friction of one push of `steps` steps."""
    surfaces, between = distributions

    def sample_once(key):
        surface_key, friction_key = jax.random.split(key)
        if not isinstance(surfaces, tuple):
            sample = surfaces.sample(surface_key)
            return Draws(sample.surface, model.sample_friction(friction_key), sample.shrinkage)
        keys = jax.random.split(surface_key, len(surfaces))
        assert between is not None
        samples = [one.sample(own) for one, own in zip(surfaces, keys, strict=True)]
        (low, high), mutual_key = between, jax.random.fold_in(friction_key, 1)
        return Draws(
            tuple(sample.surface for sample in samples),
            model.sample_friction(friction_key),
            jnp.max(jnp.stack([sample.shrinkage for sample in samples])),
            low + (high - low) * jax.random.uniform(mutual_key, (), low.dtype),
        )

    # a single draw equals `model.sample(key, surface)`
    if model.resample_every is None:
        return jax.tree.map(lambda leaf: leaf[None], sample_once(key))
    indices = jnp.arange(-(-steps // model.resample_every))
    return jax.vmap(lambda k: sample_once(jax.random.fold_in(key, k)))(indices)


def rollout_under_draws(
    draws: Draws,
    shape: Shape | tuple[Shape, ...],
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
    friction = friction.astype(pose.dtype)
    surface: Any = draws.surface
    if isinstance(shape, tuple):
        all_draws = jax.vmap(SlidersFriction.of)(surface, friction, draws.between)  # pyright: ignore[reportArgumentType]
    else:
        all_draws = jax.vmap(form_and_friction)(surface, friction)

    first_draw = entry_at(all_draws, 0)

    def friction_at(step, pose=None):
        return first_draw if resample_every is None else entry_at(all_draws, step // resample_every)

    if isinstance(shape, tuple):
        return simulate_sliders(shape, hand, path, pose, friction_at, fixtures)
    return simulate(shape, hand, path, pose, solver, friction_on_table(table, friction_at), fixtures)


def random_rollout(
    key: PRNGKeyArray,
    slider: Slider | Sequence[Slider],
    hand: Hand,
    path: ArrayLike,
    *,
    pose: ArrayLike,
    model: FrictionModel,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
    between: ArrayLike | None = None,
) -> RandomRollout:
    """Push the slider, or several, along a path under friction sampled from `model` around the surface of each.

    The result is differentiable like a `rollout`, and also in the range of the model's friction and in its `dof`.
    Derivatives in `dof` are correct in the mean over keys. For a single key they are not, because its sample jumps.
    With the sampler "gram", the mean leaves out how the shrinkage of repaired samples changes.

    Use `vmap` over keys for batches. For large batches `monte_carlo` is faster and shows progress.

    Args:
        key: PRNG key of everything random.
        slider: The slider, or a tuple of several; its surface is the mean of the sampled surfaces.
        hand: The hand.
        path: Configurations of the hand, as in `rollout`.
        pose: Pose of the slider at the start, (3,), world, m and rad; of several, (sliders, 3).
        model: Distribution of limit surface and friction.
        solver: Solver of contact problems, as in `rollout`.
        table: A table whose friction depends on direction or place, as in `rollout`.
        fixtures: Walls and bodies that the slider may touch, as in `rollout`; their friction is not random.
        between: Coefficient of friction of several sliders with each other, as in `rollout`, or the range (lowest,
            highest), shape (2,), from which it is sampled, one for all.

    Returns:
        The push, and the friction that was sampled for it.

    Raises:
        ValueError: As in `rollout` and `FrictionModel.around`.
        TypeError: As in `rollout` and `FrictionModel.around`. Also for a key that is no array, or a model of another
            type.

    Reference: Zhou et al. 2017, section V.
    """
    check_key(key)
    check_type("model", model, FrictionModel)
    scene, limits = checked_random_scene(slider, hand, path, pose, between, solver, table, fixtures)
    shape, surface = shape_and_surface(scene.slider)
    distributions = Distributions.of(surface, model, limits)
    given = scene.hand, scene.path, scene.start, model, solver, scene.table, scene.fixtures
    return _random_rollout(key, distributions, shape, *given)


def checked_random_scene(
    slider, hand, path, pose, between: Any, solver, table, fixtures, pushes: int | None = None
) -> tuple[Scene, Array | None]:
    """Return the arguments of a random rollout, and the lowest and highest friction between several sliders."""
    highest = between[1] if np.shape(between) == (2,) else between  # the shape of None is ()
    scene = checked_scene(slider, hand, path, pose, 0.0, highest, solver, table, fixtures, pushes)
    if isinstance(scene.slider, Slider):
        return scene, None
    return scene, checked_friction_range(scene.slider, between, scene.start.dtype)


def shape_and_surface(slider: Slider | tuple[Slider, ...]) -> tuple[Any, Any]:
    """Return the outline and the limit surface of one slider, or of each of several."""
    if isinstance(slider, Slider):
        return slider.shape, slider.surface
    return tuple(one.shape for one in slider), tuple(one.surface for one in slider)


@quick_jit
def _random_rollout(key, distributions, shape, hand, path, pose, model, solver, table, fixtures) -> RandomRollout:
    draws = draw(key, distributions, model, len(path) - 1)
    return RandomRollout(
        rollout_under_draws(draws, shape, hand, path, pose, solver, model.resample_every, table, fixtures), draws
    )
