"""What the tasks share: the check of their common parameters, noise, and the corners of bodies in the world."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_type, checked_array
from pushjax._math.vec import Vec2, cos_sin
from pushjax.friction.friction_model import FrictionModel
from pushjax.simulation.slider import Slider


def shared_params(
    slider: Slider,
    goal: ArrayLike,  # (3,), pose of the slider at the goal
    friction: ArrayLike | None,  # coefficient at the fingers; None for no friction
    model: FrictionModel | None,  # distribution of the friction; None for none
    noise: dict[str, ArrayLike | None],  # standard deviations by the name of their field; None for none
    success_coverage: ArrayLike,  # coverage of the goal above which an episode terminates
    max_steps_in_episode: int,  # control steps after which an episode is truncated
) -> dict[str, Any]:
    """Return the fields of `TaskParams`, checked."""
    check_count("max_steps_in_episode", max_steps_in_episode)
    if model is not None:
        check_type("model", model, FrictionModel)
    return {
        "slider": slider,
        "friction": None if friction is None else checked_array("friction", friction, (), non_negative=True),
        "goal": checked_array("goal", goal, (3,)),
        "model": model,
        "surfaces": None if model is None else model.around(slider.surface),
        "success_coverage": checked_array("success_coverage", success_coverage, (), non_negative=True),
        "max_steps_in_episode": max_steps_in_episode,
    } | {
        name: None if value is None else checked_array(name, value, (), non_negative=True)
        for name, value in noise.items()
    }


def with_noise(key: PRNGKeyArray, values: Array, deviation: Array | None) -> Array:
    """Return values with normal noise of this standard deviation; None for no noise."""
    return values if deviation is None else values + deviation * jax.random.normal(key, values.shape, values.dtype)


def placed(points: Float[Array, "points 2"], pose: Float[Array, "3"]) -> Float[Array, "points 2"]:
    """Return points of a body at a pose, world."""
    x, y = Vec2(points[:, 0], points[:, 1]).rotate(cos_sin(pose[2]))
    return jnp.stack([pose[0] + x, pose[1] + y], axis=1)
