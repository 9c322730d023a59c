"""One push under random friction."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._checks import Numeric
from pushjax._programs import quickly_compiled
from pushjax.friction_model import FrictionModel, RandomSurface
from pushjax.hands import Hand
from pushjax.limit_surface import LimitSurface
from pushjax.rollout import Slider, Trajectory, prepared, scan
from pushjax.shapes import Shape
from pushjax.solve import ContactSolver, StickingSolver
from pushjax.solve.contacts import ground


class Draws(NamedTuple):
    """What friction a push meets. surface: with a leading axis of draws. friction, pull: (draws,), mu, and as in
    `SurfaceSample`."""

    surface: LimitSurface
    friction: Float[Array, "draws"]
    pull: Float[Array, "draws"]


class RandomRollout(NamedTuple):
    """A push, and the friction it met."""

    push: Trajectory
    draws: Draws


def draw(key: PRNGKeyArray, around: RandomSurface, model: FrictionModel, steps: int) -> Draws:
    """The friction of one push of `steps` steps. around: `model.around(surface)`.

    The only draw is that of `model.sample(key, surface)`; of several, the one with index k that of `fold_in(key, k)`.
    """

    def one(key):
        first, second = jax.random.split(key)
        sample = around.sample(first)
        return Draws(sample.surface, model.sample_friction(second), sample.pull)

    if model.every is None:
        return jax.tree.map(lambda leaf: leaf[None], one(key))
    indices = jnp.arange(-(-steps // model.every))
    return jax.vmap(lambda k: one(jax.random.fold_in(key, k)))(indices)


def push_under(
    draws: Draws,
    shape: Shape,
    hand: Hand,
    path: Array,
    pose: Array,
    solver: ContactSolver | StickingSolver | None,
    every: int | None,
) -> Trajectory:
    """The push, under the friction drawn."""
    friction = jnp.broadcast_to(draws.friction[:, None], (len(draws.friction), len(hand.fingers)))
    forms = jax.vmap(ground)(draws.surface, friction.astype(pose.dtype))

    def drawn(index):
        return jax.tree.map(lambda leaf: leaf[index], forms)

    if every is None:
        only = drawn(0)
        return scan(shape, hand, path, pose, solver, lambda step, pose: only)
    return scan(shape, hand, path, pose, solver, lambda step, pose: drawn(step // every))


def random_rollout(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    path: Numeric,
    *,
    pose: Numeric,
    model: FrictionModel,
    solver: ContactSolver | StickingSolver | None = None,
) -> RandomRollout:
    """Push the slider along a path under friction drawn from `model` around the slider's surface.

    key: of everything random; the rest is as in `rollout`. Differentiable also in the range of the model's friction and
    in its dof, there so that the mean over keys is right (the draw of one key jumps; of "gram", but for its repairs).
    Batches come from `vmap` over keys; for large ones `monte_carlo` is faster, and shows progress.

    Raises ValueError as `rollout` and `FrictionModel.around` do.

    Source: Zhou et al. 2017, section V.
    """
    slider, hand, p, start, _ = prepared(slider, hand, path, pose, 0.0)
    return _random_rollout(key, model.around(slider.surface), slider.shape, hand, p, start, model, solver)


@quickly_compiled
def _random_rollout(key, around, shape, hand, path, pose, model, solver) -> RandomRollout:
    draws = draw(key, around, model, len(path) - 1)
    return RandomRollout(push_under(draws, shape, hand, path, pose, solver, model.every), draws)
