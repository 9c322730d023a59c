"""Compiled starts, steps and automatic resets of episodes, each with its own PRNG key, for `pushjax.tasks.gym`.

The key changes only at a start. So the start of an episode does not depend on how long those before it took.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from pushjax._internal.compaction import where_needed
from pushjax._internal.jit import jit, quick_jit
from pushjax.contact.status import Status
from pushjax.tasks.environment import Environment, TaskState


@quick_jit
def start(task: Any, key: Array, params: Any, row: Array | None) -> tuple[Any, ...]:
    """Start an episode, at `task.state_of(row)` if given, and return the next key, observation, state and info."""
    key, start_key, noise_key, _ = jax.random.split(key, 4)  # the last is that of the steps
    observation, state = task.reset_env(start_key, params)
    if row is not None:
        at_row = task.state_of(row, params)
        # only these two: friction and limit surface stay as they were drawn
        state = state.replace(pose=at_row.pose, hand=at_row.hand)
        observation = task.observe(noise_key, state, None, params)
    info = task.measures(state, params) | {"status": jnp.zeros(len(Status), jnp.int32)}
    return key, observation, state, info


@quick_jit
def step(task: Environment, key: Array, state: TaskState, action: Any, params: Any) -> tuple[Any, ...]:
    """Take a step and return the key, observation, state, reward, terminated, truncated and info."""
    step_key = jax.random.fold_in(jax.random.split(key, 4)[3], state.time)
    observation, state, reward, terminated, info = task.step_env(step_key, state, action, params)
    return key, observation, state, reward, terminated, task.is_truncated(state, params), info


@jit
def start_all(task: Environment, keys: np.ndarray, params: Any, rows: Array | None) -> tuple[Any, ...]:
    """Start all episodes, as `start` does."""
    return jax.vmap(lambda key, row: start(task, key, params, row))(keys, rows)


@jit
def step_all(
    task: Environment,
    mode: str,  # when episodes that have ended are reset: value of Gymnasium's `AutoresetMode`
    keys: Array,  # of the environments
    states: TaskState,
    ended: Any,  # (environments,), whether the step before ended the episode
    actions: Any,  # (environments, ...)
    params: Any,
) -> tuple[tuple[Any, ...], tuple[Any, Any] | None]:
    """Take a step in all environments, as `step` does, and reset those that need it."""
    # Returns also observations and info before the resets if the mode is "SameStep", else None.

    def restart(key: Array, params: Any) -> tuple[Any, ...]:
        return start(task, key, params, None)

    def one(key: Array, state: TaskState, ended: Array, action: Array) -> tuple[tuple[Any, ...], Any]:
        stepped = step(task, key, state, action, params)
        if mode == "Disabled":
            return stepped, None
        next_key, observation, state, reward, terminated, truncated, info = stepped
        otherwise = next_key, observation, state, info
        if mode == "SameStep":
            after = where_needed(terminated | truncated, restart, otherwise, next_key, params)
            return (*after[:3], reward, terminated, truncated, after[3]), (observation, info)
        after = where_needed(ended, restart, otherwise, key, params)
        reward = jnp.where(ended, 0.0, reward)
        return (*after[:3], reward, terminated & ~ended, truncated & ~ended, after[3]), None

    return jax.vmap(one)(keys, states, ended, actions)


@jit
def merged(mask: np.ndarray, new: Any, old: Any) -> Any:
    """Return the rows of `new` where `mask` holds, else those of `old`."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)


@quick_jit
def picture(task: Environment, state: TaskState, action: Array | None, params: Any, size: int) -> Array:
    """Return the picture of a state."""
    return task.picture(state, action, params, size)
