"""Base class of the tasks: environments with the interface of gymnax 1.x.

An environment is a frozen object without arrays; its parameters and its state are pytrees. Everything can be compiled,
batched with `vmap` and differentiated. Nothing is imported from gymnax.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8, UInt32

from pushjax._internal.checks import ArrayLike, as_float, check_shape, on_device
from pushjax._internal.compaction import where_needed
from pushjax._internal.jit import quick_jit
from pushjax.contact.status import Status
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.surface_distributions import SurfaceDistribution
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider
from pushjax.tasks.control_step import ControlStepResult, control_step
from pushjax.tasks.shared import with_noise
from pushjax.tasks.spaces import Space


class _Replaceable(eqx.Module):
    """A frozen pytree with the method `replace` of gymnax."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values of some fields.

        Raises:
            TypeError: For a name that is no field.
        """
        return replace(self, **changes)


def _as_count(number: Any) -> Array:
    """Return a whole number as an array, so that all numbers share one program."""
    return number if isinstance(number, Array) else on_device(np.asarray(number, np.int32))


class TaskParams(_Replaceable):
    """Parameters that all tasks share.

    Attributes:
        slider: The slider, m. The origin of its frame is the center of gravity.
        friction: Coefficient of friction between fingers and slider, used if `model` is None. None for no friction, in
            a smaller and faster program; the limit surface must then be an ellipsoid.
        goal: Pose at the goal, in the frame that is observed, (3,), world, length unit of the task and rad.
        model: Distribution of the friction, drawn at each reset for the whole episode; None for none.
        surfaces: Distribution of limit surfaces, of which the slider's is the mean: `model.around(slider.surface)`.
            None if `model` is None.
        position_noise: Standard deviation of the noise on observed positions, length unit of the task; None for none.
        angle_noise: Standard deviation of the noise on the observed angle, rad; None for none.
        action_noise: Standard deviation of the noise on actions, in their unit; None for none.
        success_coverage: Coverage of the goal above which an episode terminates.
        max_steps_in_episode: Number of control steps after which an episode is truncated.
    """

    slider: Slider
    friction: Float[Array, ""] | None
    goal: Float[Array, "3"]
    model: FrictionModel | None
    surfaces: SurfaceDistribution | None
    position_noise: Float[Array, ""] | None
    angle_noise: Float[Array, ""] | None
    action_noise: Float[Array, ""] | None
    success_coverage: Float[Array, ""]
    max_steps_in_episode: Int[Array, ""] = eqx.field(converter=_as_count)


class TaskState(_Replaceable):
    """State of an episode.

    Attributes:
        pose: Pose of the slider's frame, (3,), world, length unit of the task and rad; the angle is not wrapped. Of
            several sliders, (sliders, 3).
        hand: Configuration of the hand, (dof,), world.
        velocity: Its velocity, (dof,), per second.
        time: Number of control steps since the reset.
        surface: The limit surface that was drawn for this episode; None for that of the parameters.
        friction: The coefficient of friction that was drawn; None for that of the parameters.
        next_start: Raw key of the start of the next episode, (2,); None to take that of the step that ends this one.
    """

    pose: Float[Array, "3"]
    hand: Float[Array, "dof"]
    velocity: Float[Array, "dof"]
    time: Int[Array, ""]
    surface: LimitSurface | None = None
    friction: Float[Array, ""] | None = None
    next_start: UInt32[Array, "2"] | None = None


# Observation, state, reward, whether the episode terminated, whether it was truncated, and `info`.
Transition = tuple[Any, TaskState, Array, Array, Array, dict[str, Any]]


@dataclass(frozen=True)
class Environment(ABC):
    """An environment with the interface of gymnax 1.x.

    `reset` and `step` are compiled; under `jit` and `vmap` they are part of the surrounding program. A task defines
    `default_params`, `hand_model`, `draw_start`, `walk`, `goal_coverage`, `observe` and the spaces. It may also define
    `fixtures`, `measures`, `reward` and `picture`.
    """

    METERS: ClassVar[float] = 1.0  # m, length unit of the task

    @property
    def name(self) -> str:
        """Name of the environment."""
        return type(self).__name__

    @property
    def num_actions(self) -> int:
        """Number of entries of an action."""
        return int(np.prod(self.action_space(self.default_params).shape))

    @property
    @abstractmethod
    def default_params(self) -> Any:
        """The parameters that are used where None is given."""

    @property
    @abstractmethod
    def hand_model(self) -> Hand:
        """The hand, m."""

    @abstractmethod
    def draw_start(self, key: PRNGKeyArray, params: Any) -> tuple[Array, Array]:
        """Return a random pose of the slider, (3,), and configuration of the hand, (dof,)."""

    def draw_surface(self, key: PRNGKeyArray, params: Any) -> LimitSurface:
        """Return a random limit surface of the slider, with a `model`."""
        return params.surfaces.sample(key).surface

    @abstractmethod
    def walk(self, state: TaskState, action: Array) -> tuple[Array, Array]:
        """Return how an action moves the hand in a control step.

        Args:
            state: The state.
            action: The action, noise included. It may be out of bounds, or not finite.

        Returns:
            The path of the hand, (steps + 1, dof), world, in the length unit of the task and rad, and the velocity of
            the hand at its end, (dof,), per second.
        """

    @abstractmethod
    def goal_coverage(self, state: TaskState, params: Any) -> Float[Array, ""]:
        """Return which fraction of the slider's area lies on the goal."""

    @abstractmethod
    def observe(self, key: PRNGKeyArray, state: TaskState, action: Array | None, params: Any) -> Any:
        """Return the observation of a state.

        Args:
            key: PRNG key of the observation's noise.
            state: The state.
            action: The action that led to it; None after a reset. No task here uses it.
            params: The parameters.
        """

    @abstractmethod
    def action_space(self, params: Any = None) -> Any:
        """Return the space of actions."""

    @abstractmethod
    def observation_space(self, params: Any = None) -> Space:
        """Return the space of observations."""

    def fixtures(self, state: TaskState, params: Any) -> tuple[Wall, ...]:
        """Return the walls that the slider may touch in a control step, m."""
        return ()

    def measures(self, state: TaskState, params: Any) -> dict[str, Array]:
        """Return what `info` says about a state: "coverage" of the goal, and whether that "is_success"."""
        coverage = self.goal_coverage(state, params)
        return {"coverage": coverage, "is_success": coverage > params.success_coverage}

    def reward(self, state: TaskState, measures: dict[str, Array], params: Any) -> Float[Array, ""]:
        """Return the reward of a control step that ends in a state with these `measures`."""
        return jnp.clip(measures["coverage"] / params.success_coverage, 0, 1)

    def picture(self, state: TaskState, action: Array | None, params: Any, size: int) -> UInt8[Array, "size size 3"]:
        """Return a picture of a state, `size` pixels wide and high.

        Args:
            state: The state.
            action: The action that led to it; None for none.
            params: The parameters.
            size: Width and height.

        Raises:
            NotImplementedError: If the task has no pictures.
        """
        raise NotImplementedError(f"{self.name} has no pictures")

    def reset(self, key: PRNGKeyArray, params: Any = None) -> tuple[Any, TaskState]:
        """Start an episode.

        Args:
            key: PRNG key of the start, the drawn friction and the observation's noise, and of the starts that follow
                by `step`: they do not depend on the actions, nor on when episodes end.
            params: The parameters; None for `default_params`.

        Returns:
            The observation, and the state.
        """
        return _reset(self, key, self.default_params if params is None else params)

    def step(self, key: PRNGKeyArray, state: TaskState, action: ArrayLike, params: Any = None) -> Transition:
        """Take one control step, and start a new episode if it ended this one.

        Args:
            key: PRNG key of everything random in the step. A new start is random by the key of the `reset`.
            state: The state.
            action: The action, as in `action_space`. One that is not finite counts as one that leaves the hand in its
                place.
            params: The parameters; None for `default_params`.

        Returns:
            Observation, state, reward, whether the episode terminated, whether it was truncated, and a dictionary. If
            the episode ended, observation and state are those of the next one. The dictionary has that of `step_env`,
            and "final_observation", the observation before a reset, "terminated" and "truncated".

        Raises:
            ValueError: If the action has another shape than in `action_space`.
        """
        return _step(self, key, state, action, self.default_params if params is None else params)

    def reset_env(self, key: PRNGKeyArray, params: Any) -> tuple[Any, TaskState]:
        """Start an episode. `reset` is the compiled form of this method."""
        start_key, friction_key, observation_key, next_key = jax.random.split(key, 4)
        pose, hand = self.draw_start(start_key, params)
        next_start = jax.random.bits(next_key, (2,), jnp.uint32)
        state = TaskState(pose, hand, jnp.zeros_like(hand), jnp.zeros((), jnp.int32), next_start=next_start)
        if params.model is not None:
            surface_key, contact_key = jax.random.split(friction_key)
            surface = self.draw_surface(surface_key, params)
            state = state.replace(surface=surface, friction=params.model.sample_friction(contact_key))
        return self.observe(observation_key, state, None, params), state

    def step_env(
        self, key: PRNGKeyArray, state: TaskState, action: ArrayLike, params: Any
    ) -> tuple[Any, TaskState, Array, Array, dict[str, Any]]:
        """Take one control step, without a reset.

        Args:
            key: PRNG key of the noise.
            state: The state.
            action: The action, as in `action_space`.
            params: The parameters.

        Returns:
            Observation, state, reward, whether the episode terminated, and a dictionary. It has the `measures` of the
            state, among them the "coverage" of the goal and "is_success", and "status", the number of steps of the
            simulator with each `Status`, (7,). A JAMMED or GRASPED step stops the hand for the rest of its path;
            the slider stays. A control step with a step that is NOT_CONVERGED is undone: slider and hand stay where
            they were.
        """
        key_action, key_observation = jax.random.split(key)
        given = as_float(action, state.hand.dtype, "action")
        check_shape("action", given, self.action_space(params).shape)
        command = with_noise(key_action, given, params.action_noise)
        path, velocity = self.walk(state, command)
        pushed = self._push(state, path, params)
        stopped = jnp.any((pushed.status == Status.JAMMED) | (pushed.status == Status.GRASPED))
        unsolved = jnp.any(pushed.status == Status.NOT_CONVERGED)
        pose = jnp.concatenate([pushed.pose[..., :2] / self.METERS, pushed.pose[..., 2:]], axis=-1)
        hand = jnp.where(stopped, pushed.configuration / self.METERS, path[-1])
        new_state = state.replace(
            pose=jnp.where(unsolved, state.pose, pose),
            hand=jnp.where(unsolved, state.hand, hand),
            velocity=jnp.where(stopped | unsolved, 0.0, velocity),
            time=state.time + 1,
        )
        measures = self.measures(new_state, params)
        reward = self.reward(new_state, measures, params)
        counts = jnp.stack([jnp.sum(pushed.status == status, dtype=jnp.int32) for status in Status])
        observation = self.observe(key_observation, new_state, command, params)
        return observation, new_state, reward, measures["is_success"], measures | {"status": counts}

    def _push(self, state: TaskState, path: Array, params: Any) -> ControlStepResult:
        """Push along a path of the hand, (steps + 1, dof), in the task's length unit. The result is in m."""
        slider, dtype = params.slider, state.pose.dtype
        hand = jax.tree.map(lambda leaf: leaf.astype(dtype), self.hand_model)
        return control_step(
            slider.shape,
            slider.surface if state.surface is None else state.surface,
            params.friction if state.friction is None else state.friction,
            hand,
            self.fixtures(state, params),
            path * self.METERS,
            jnp.concatenate([state.pose[:2] * self.METERS, state.pose[2:]]),
        )

    def is_terminated(self, state: TaskState, params: Any) -> Bool[Array, ""]:
        """Whether the task is done."""
        return self.measures(state, params)["is_success"]

    def is_truncated(self, state: TaskState, params: Any) -> Bool[Array, ""]:
        """Whether the time limit is reached."""
        return state.time >= params.max_steps_in_episode


@quick_jit
def _reset(env: Environment, key: PRNGKeyArray, params: Any) -> tuple[Any, TaskState]:
    return env.reset_env(key, params)


@quick_jit
def _step(env: Environment, key: PRNGKeyArray, state: TaskState, action: Any, params: Any) -> Transition:
    observation, state, reward, terminated, info = env.step_env(key, state, action, params)
    truncated = env.is_truncated(state, params)

    def new_episode(key: PRNGKeyArray, next_start: Array | None, params: Any) -> tuple[Any, TaskState]:
        if next_start is None:
            first, new = env.reset_env(jax.random.fold_in(key, 1), params)
            return first, new.replace(next_start=None)
        return env.reset_env(jax.random.wrap_key_data(next_start, impl="threefry2x32"), params)

    info |= {"terminated": terminated, "truncated": truncated, "final_observation": observation}
    next_episode = where_needed(
        terminated | truncated, new_episode, (observation, state), key, state.next_start, params
    )
    return *next_episode, reward, terminated, truncated, info
