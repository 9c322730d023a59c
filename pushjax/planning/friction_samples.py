"""Friction that all candidates of a search share, so that their costs differ by the candidates and not by luck."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from pushjax._internal.checks import check_count, check_key, check_type
from pushjax._internal.jit import quick_jit
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.surface_distributions import SurfaceDistribution
from pushjax.simulation.random_rollout import Draws, draw


def draw_friction(key: PRNGKeyArray, surface: LimitSurface, model: FrictionModel, samples: int) -> Draws:
    """Sample limit surfaces of mean `surface` and contact friction, with the leading axes (samples, 1)."""
    # Each push keeps its friction.
    check_key(key)
    check_type("model", model, FrictionModel)
    check_count("samples", samples)
    if model.resample_every is not None:
        raise ValueError(f"model.resample_every must be None for a plan; got {model.resample_every}")
    return _draw(key, model.around(surface), model, jnp.arange(samples))


@quick_jit
def _draw(key: PRNGKeyArray, surfaces: SurfaceDistribution, model: FrictionModel, indices: jax.Array) -> Draws:
    return jax.vmap(lambda index: draw(jax.random.fold_in(key, index), surfaces, model, 1))(indices)


def mean_friction(surface: LimitSurface, model: FrictionModel) -> Draws:
    """Return the mean of the friction that `draw_friction` samples, with the leading axes (1, 1)."""
    mean = Draws(surface, jnp.mean(model.friction), jnp.zeros_like(surface.length))
    return jax.tree.map(lambda leaf: leaf[None, None], mean)
