"""The tasks as environments of Gymnasium, one or many. Needs Gymnasium 1.1 or later: `pip install '.[gym]'`.

An import registers "pushjax/PushT-v0" and the other tasks, with which `gymnasium.make` and `gymnasium.make_vec` work.
Without the import, "pushjax.tasks.gym:pushjax/PushT-v0" does the same.

Batches are computed by one compiled step. They start, step and end as those of Gymnasium's `SyncVectorEnv` over single
environments, with the same random numbers.
"""

import os
from collections.abc import Sequence
from numbers import Integral
from operator import index
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from pushjax import tasks
from pushjax._internal.checks import ArrayLike, as_float, check_count, check_finite, check_shape, check_type
from pushjax._internal.xla import entry_at
from pushjax.tasks import episodes
from pushjax.tasks.environment import Environment, TaskState
from pushjax.tasks.spaces import Box, Dict, Space

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(f"pushjax.tasks.gym needs Gymnasium 1.1 or later: pip install '.[gym]' ({error})") from None

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}
TASKS = "PushT", "PushBox", "PushAlongWall", "PushTwoFingers", "Squeeze", "PushClutter"  # that are registered
_processes: list[int] = []  # in which an environment was made; a fork inherits the numbers


class TaskEnv(gymnasium.Env):
    """A task as an environment of Gymnasium.

    `info` has the `measures` of the task, among them the "coverage" of the goal and "is_success"; and "status", the
    number of steps of the simulator with each `Status`. After a reset the last is zero.

    An episode is truncated after the `max_episode_steps` given to `gymnasium.make`, or else after
    `max_steps_in_episode` of the parameters.

    Args:
        task: The task, or the name of one in `pushjax.tasks`.
        params: Its parameters. None: the default ones.
        render_mode: "rgb_array" if `render` shall return pictures, else None.
        render_size: Width and height of these pictures.
        **options: Options of the task, if it is given by its name, for example `observation="pixels"`.

    Raises:
        ValueError: If `render_mode` or an option has another value, or no task has this name.
        TypeError: If the task is of another type, or has no such option.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA

    def __init__(
        self,
        task: str | Environment = "PushT",
        params: Any = None,
        *,
        render_mode: str | None = None,
        render_size: int = 680,
        **options: Any,
    ):
        checked = _checked(task, params, render_mode, render_size, options)
        self.task, self.params, self.render_mode, self.render_size = checked
        self.observation_space = _space(self.task.observation_space(self.params))
        self.action_space = _space(self.task.action_space(self.params))
        self._max_episode_steps = int(self.params.max_steps_in_episode)  # read where no `TimeLimit` has it
        self._key: Any = None
        self._state: TaskState | None = None
        self._action: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of everything random from here on. None: go on with the random numbers.
            options: With "reset_to_state", where to start: a row of numbers for the task's `state_of`.

        Returns:
            The observation, and `info`.

        Raises:
            ValueError: If "reset_to_state" has another shape, is not finite, or the task has no `state_of`.
            RuntimeError: In a process that was forked after JAX had run.
        """
        _check_process()
        seed = None if seed is None else index(seed)
        super().reset(seed=seed)
        if seed is not None or self._key is None:
            self._key = _keys([int(self.np_random.integers(2**32)) if seed is None else seed])[0]
        row = _row(self.task, options)
        self._key, observation, self._state, info = episodes.start(self.task, self._key, self.params, row)
        self._action = None
        return _numpy(observation), _single_info(info)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one control step.

        Args:
            action: The action.

        Returns:
            Observation, reward, whether the episode terminated, whether it was truncated, and `info`.

        Raises:
            gymnasium.error.ResetNeeded: If there was no reset.
            ValueError: If the action has another shape.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step was called before reset")
        self._action = _actions(action, self.action_space)
        result = episodes.step(self.task, self._key, self._state, self._action, self.params)
        self._key, observation, self._state, reward, terminated, truncated, info = result
        # with a limit of `gymnasium.make` the wrapper `TimeLimit` truncates
        truncated = bool(truncated) and (self.spec is None or self.spec.max_episode_steps is None)
        return _numpy(observation), float(reward), bool(terminated), truncated, _single_info(info)

    def render(self) -> np.ndarray | None:
        """Return a picture, shape (render_size, render_size, 3), with the last action.

        None without a render mode, and before the first reset.
        """
        if self.render_mode is None or self._state is None:
            return None
        return np.array(episodes.picture(self.task, self._state, self._action, self.params, self.render_size))


class TaskVectorEnv(VectorEnv):
    """Many environments of a task, computed by one compiled step.

    `reset` and `step` return what Gymnasium's `SyncVectorEnv` returns for as many `TaskEnv`, in the same arrays, for
    all three modes of the automatic reset (`metadata["autoreset_mode"]`). With SAME_STEP, "final_obs" and "final_info"
    are what the last step of an episode returned.

    Args:
        task: The task, or the name of one in `pushjax.tasks`.
        num_envs: Number of environments.
        params: Parameters of the task. None: the default ones.
        autoreset_mode: When an environment whose episode has ended starts the next one: in the next step, whose action
            it ignores; in the same step; or never, so that `reset` with the option "reset_mask" has to be called.
        max_episode_steps: Number of steps after which an episode is truncated. None: that of the parameters.
        render_mode: "rgb_array" if `render` shall return pictures, else None.
        render_size: Width and height of these pictures.
        **options: Options of the task, if it is given by its name.

    Raises:
        ValueError: If an argument has another value, or no task has this name.
        TypeError: If the task is of another type, or has no such option.
    """

    def __init__(
        self,
        task: str | Environment = "PushT",
        num_envs: int = 1,
        params: Any = None,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        render_size: int = 680,
        **options: Any,
    ):
        checked = _checked(task, params, render_mode, render_size, options)
        self.task, self.params, self.render_mode, self.render_size = checked
        if max_episode_steps is not None:
            check_count("max_episode_steps", max_episode_steps)
            self.params = self.params.replace(max_steps_in_episode=max_episode_steps)
        check_count("num_envs", num_envs)
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = METADATA | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = _space(self.task.observation_space(self.params))
        self.single_action_space = _space(self.task.action_space(self.params))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys: Any = None
        self._states: TaskState | None = None
        self._observations: Any = None
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in all environments, or in some of them.

        Args:
            seed: Seeds of the environments. A number stands for seed, seed + 1, ... None: go on with the random
                numbers.
            options: With "reset_mask", which environments to reset, shape (num_envs,). With "reset_to_state", where to
                start: a row of numbers for the task's `state_of`, or one row for each environment.

        Returns:
            The observations of all environments, and `info` of those that were reset.

        Raises:
            gymnasium.error.ResetNeeded: If "reset_mask" leaves out an environment that had no reset yet.
            ValueError: If an option or the seeds have another shape, a value is not finite, or the task has no
                `state_of`.
        """
        _check_process()
        seed = int(seed) if isinstance(seed, Integral) else seed
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = _reset_mask(options, self.num_envs)
        if self._states is None and not mask.all():
            raise gymnasium.error.ResetNeeded("reset_mask selects some environments, but the others had no reset yet")
        rows = _row(self.task, options)
        if rows is not None:
            rows = jnp.broadcast_to(rows, (self.num_envs, *rows.shape)) if rows.ndim == 1 else rows
            check_shape("reset_to_state", rows, (self.num_envs, "numbers"))
        started = episodes.start_all(self.task, self._seeded(seed), self.params, rows)
        if not mask.all():
            started = episodes.merged(mask, started, (self._keys, self._observations, self._states, started[3]))
        self._keys, self._observations, self._states, info = started
        self._ended = self._ended & ~mask
        return _numpy(self._observations), _vector_info(info, mask)

    def step(self, actions: ArrayLike) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one control step in all environments.

        Args:
            actions: The actions, shape (num_envs, ...).

        Returns:
            Observations, rewards, which episodes terminated, which were truncated, and `info`.

        Raises:
            gymnasium.error.ResetNeeded: If there was no reset, or an episode has ended that had to be reset by hand.
            ValueError: If the actions have another shape.
        """
        if self._states is None:
            raise gymnasium.error.ResetNeeded("step was called before reset")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            named = ", ".join(map(str, ended[:8])) + (f" and {len(ended) - 8} more" if len(ended) > 8 else "")
            raise gymnasium.error.ResetNeeded(f"reset_mask: these environments ended and need a reset: {named}")
        now, last = episodes.step_all(
            self.task, self.autoreset_mode.value, self._keys, self._states, self._ended,
            _actions(actions, self.action_space), self.params,
        )  # fmt: skip
        self._keys, self._observations, self._states, reward, terminated, truncated, info = now
        terminated, truncated = np.array(terminated), np.array(truncated)
        self._ended = terminated | truncated
        infos = _vector_info(info, np.ones(self.num_envs, bool))
        if last is not None and self._ended.any():
            infos |= _final(*last, self._ended)
        return _numpy(self._observations), np.array(reward, np.float64), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of each environment, without its action.

        None without a render mode, and before the first reset.
        """
        if self.render_mode is None or self._states is None:
            return None
        states = (entry_at(self._states, i) for i in range(self.num_envs))
        return tuple(
            np.array(episodes.picture(self.task, state, None, self.params, self.render_size)) for state in states
        )

    def _seeded(self, seed: int | Sequence[int | None] | None) -> np.ndarray:
        """Return the keys of the environments after a reset with `seed`."""
        keys = self._keys
        if keys is None:
            keys = _keys(self.np_random.integers(2**32, size=self.num_envs).tolist())
        if seed is None:
            return np.asarray(keys)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected one for each of {self.num_envs} environments; got {len(seeds)}")
        given = np.array([one is not None for one in seeds])
        return np.where(given[:, None], _keys([0 if one is None else index(one) for one in seeds]), keys)


def _checked(
    task: str | Environment, params: Any, mode: str | None, size: int, options: dict[str, Any]
) -> tuple[Environment, Any, str | None, int]:
    """Return the arguments that the two classes share, with the task and its parameters, after checks."""
    _processes.append(os.getpid())
    if isinstance(task, str):
        if task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(TASKS)}; got {task!r}")
        made = getattr(tasks, task)(**options)
    else:
        check_type("task", task, Environment)
        if options:
            raise TypeError(f"{', '.join(options)}: options go with the name of a task; got the task itself")
        made = task
    if mode not in (None, *METADATA["render_modes"]):
        raise ValueError(f"render_mode must be 'rgb_array' or None; got {mode!r}")
    check_count("render_size", size)
    return made, made.default_params if params is None else params, mode, size


def _check_process() -> None:
    """Raise an error in a forked process, where JAX would wait forever."""
    # Gymnasium passes it on from a `reset`.
    if _processes and os.getpid() != _processes[0]:
        raise RuntimeError(
            "JAX cannot be used in a process that was forked after it had run: use gymnasium.make_vec without "
            "vectorization_mode, which computes all environments in one step, or AsyncVectorEnv with context='spawn'"
        )


def _space(space: Space) -> Any:
    """Return a space of a task as one of Gymnasium."""
    if isinstance(space, Dict):
        return gymnasium.spaces.Dict({name: _space(part) for name, part in space.spaces.items()})
    check_type("space", space, Box)
    low, high = (np.broadcast_to(np.asarray(bound, space.dtype), space.shape) for bound in (space.low, space.high))
    return gymnasium.spaces.Box(low, high, space.shape, np.dtype(space.dtype).type)


def _keys(seeds: Sequence[int]) -> np.ndarray:
    """Return a PRNG key for each seed modulo 2^32, as raw integers, which can be pickled."""
    return np.asarray(jax.vmap(jax.random.PRNGKey)(np.array([int(seed) % 2**32 for seed in seeds], np.uint32)))


def _row(task: Any, options: dict[str, Any] | None) -> Array | None:
    """Return the option "reset_to_state" as an array, or None."""
    given = None if options is None else options.get("reset_to_state")
    if given is None:
        return None
    if not hasattr(task, "state_of"):
        raise ValueError(f"reset_to_state: {task.name} has no state_of, so it cannot start at a given state")
    row = as_float(given, name="reset_to_state")
    check_finite("reset_to_state", row)
    return row


def _reset_mask(options: dict[str, Any] | None, num_envs: int) -> np.ndarray:
    """Return the option "reset_mask", all True if it is not given."""
    given = None if options is None else options.get("reset_mask")
    if given is None:
        return np.ones(num_envs, bool)
    mask = np.asarray(given)
    if mask.dtype != bool or mask.shape != (num_envs,) or not mask.any():
        raise ValueError(
            f"reset_mask must be boolean of shape ({num_envs},), with at least one True; "
            f"got {mask.dtype} of shape {mask.shape}, {np.count_nonzero(mask)} of them True"
        )
    return mask


def _actions(given: ArrayLike, space: Any) -> np.ndarray:
    """Return actions as an array of the shape and dtype of a space."""
    actions = np.asarray(given, space.dtype)
    if actions.shape != space.shape:
        raise ValueError(f"action has shape {actions.shape}; expected {space.shape}")
    return actions


def _numpy(tree: Any) -> Any:
    """Return arrays as NumPy arrays of their own, which may be written to."""
    return jax.tree.map(np.array, tree)


def _single_info(info: dict[str, Array]) -> dict[str, Any]:
    return {name: value.item() if value.ndim == 0 else np.array(value) for name, value in info.items()}


def _vector_info(info: dict[str, Array], mask: np.ndarray) -> dict[str, Any]:
    """Return `info` in the form of Gymnasium's vector environments."""
    # Each entry is zero where `mask` does not hold, and has the mask beside it, under the same name with "_" in front.
    result: dict[str, Any] = {}
    for name, value in info.items():
        array = np.array(value)
        if array.ndim == 1 and array.dtype != bool:  # of Python's numbers, Gymnasium makes arrays of 64 bits
            array = array.astype(np.float64 if np.issubdtype(array.dtype, np.floating) else np.int64)
        array[~mask] = 0
        result |= {name: array, f"_{name}": mask.copy()}
    return result


def _final(observations: Any, info: dict[str, Array], ended: np.ndarray) -> dict[str, Any]:
    """Return "final_obs" and "final_info" of the environments whose episodes have ended."""
    observations, final = _numpy(observations), np.full(len(ended), None, object)
    for i in np.flatnonzero(ended):
        final[i] = jax.tree.map(lambda array, i=i: array[i].copy(), observations)
    final_info = _vector_info(info, ended)
    return {"final_obs": final, "_final_obs": ended.copy(), "final_info": final_info, "_final_info": ended.copy()}


for _name in TASKS:
    gymnasium.register(
        f"pushjax/{_name}-v0",
        entry_point="pushjax.tasks.gym:TaskEnv",
        vector_entry_point="pushjax.tasks.gym:TaskVectorEnv",
        kwargs={"task": _name},
    )
