"""PushClutter: a round finger moves one of several blocks, which push each other, to a pose, or all of them apart."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from pushjax._internal.checks import ArrayLike, as_float, check_count, checked_array
from pushjax._internal.xla import entry_at
from pushjax._math.vec import Vec3, cos_sin, norm
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry.polygon import Polygon
from pushjax.simulation.hand import Hand
from pushjax.simulation.several_sliders import SlidersFriction
from pushjax.simulation.sliders_step import mutual_depth
from pushjax.tasks.control_step import ControlStepResult, control_step_of_sliders
from pushjax.tasks.environment import TaskState
from pushjax.tasks.push_box import RADIUS
from pushjax.tasks.render import render_table
from pushjax.tasks.shared import placed, with_noise
from pushjax.tasks.spaces import Box
from pushjax.tasks.table_task import (
    HALF_WIDTH,
    PICTURE_WIDTH,
    REACHING_WEIGHT,
    REWARD_LENGTH,
    TableParams,
    TableTask,
    draw_beside,
)

BLOCK = (0.06, 0.04)  # m, sides of the default blocks
MAX_BLOCKS = 8
LOOSE, SPREAD = 0.004, 0.03  # m, of the circles around the blocks at the start, and of the finger beside them
CLEARANCE = 0.02  # m, between blocks that are apart


class ClutterParams(TableParams):
    """Parameters of `PushClutter`.

    Attributes:
        between: Coefficient of friction of the blocks with each other.
    """

    between: Float[Array, ""]


@dataclass(frozen=True)
class PushClutter(TableTask):
    """A round finger moves the first of several equal blocks to a pose, or all of them apart.

    The blocks push each other. Rewards, and when an episode ends, are those of every `TableTask`, for the first block.
    If `singulate`, an episode terminates when all blocks are 0.02 m apart, and the reward is
    -(max(1 - c / 0.02 m, 0) + b / 1 m). c is the distance of the two blocks that are nearest to each other, and b that
    of the finger from the mean of their centers.

    - Action: motion of the finger in a control step along x and y, (2,), from -1 to 1, in units of 0.02 m.
    - Observation: finger x and y; of each block x, y, and cosine and sine of its angle times its `symmetry`, which is 2
      for the default block, (2 + 4 * blocks,).
    - Start: the blocks side by side in the middle, at any angle, and the finger beside them.
    - `info` also has "clearance": the distance of the two blocks that are nearest to each other, m, along the best
      direction of an edge; negative where they overlap.
    - Friction: with a `model`, each block has a limit surface of its own.

    Attributes:
        substeps: Steps of the simulator in a control step.
        blocks: Number of blocks, at most 8.
        singulate: Whether all blocks have to be apart, in place of the first one at the goal.

    Raises:
        ValueError: If a number is not whole, or out of range.

    Examples:
        >>> import jax, pushjax as pj
        >>> env = pj.tasks.PushClutter(blocks=3)
        >>> observation, state = env.reset(jax.random.key(0))
        >>> observation.shape, env.num_actions
        ((14,), 2)
    """

    blocks: int = 3
    singulate: bool = False

    MOTION: ClassVar[tuple[float, ...]] = (0.02, 0.02)
    LOWEST: ClassVar[tuple[float, ...]] = (-HALF_WIDTH, -HALF_WIDTH)
    HIGHEST: ClassVar[tuple[float, ...]] = (HALF_WIDTH, HALF_WIDTH)
    GOAL: ClassVar[tuple[float, float, float]] = (0.15, 0.0, 0.0)
    MAX_RADIUS: ClassVar[float] = 0.045

    def __post_init__(self):
        super().__post_init__()
        check_count("blocks", self.blocks)
        if self.blocks > MAX_BLOCKS:
            raise ValueError(f"blocks must be at most {MAX_BLOCKS}; got {self.blocks}")

    @property
    def hand_model(self) -> Hand:
        return Hand.finger(RADIUS)

    def params(self, *, block: Polygon | None = None, between: ArrayLike = 0.2, **others: Any) -> ClutterParams:
        """Make parameters.

        Args:
            block: The outline of every block, m. Default: a rectangle of 0.06 by 0.04.
            between: Coefficient of friction of the blocks with each other.
            others: The other parameters of a `TableTask`.

        Returns:
            The parameters. Their method `replace` changes fields.

        Raises:
            ValueError: As for every `TableTask`.
            TypeError: As for every `TableTask`.
        """
        shape = Polygon.rectangle(*BLOCK) if block is None else block
        shared = vars(super().params(block=shape, **others))
        return ClutterParams(**shared, between=checked_array("between", between, (), non_negative=True))

    def observation_space(self, params: TableParams | None = None) -> Box:
        """Return the space of observations, m. The noise may exceed it."""
        return Box(-1.0, 1.0, (2 + 4 * self.blocks,), jnp.result_type(float))

    def draw_start(self, key: PRNGKeyArray, params: TableParams) -> tuple[Array, Array]:
        """Draw poses of the blocks, each in a cell of a grid in the middle, and a place of the finger beside them."""
        cell_key, place_key, angle_key, finger_key = jax.random.split(key, 4)
        dtype, side = params.goal.dtype, int(np.ceil(np.sqrt(self.blocks)))
        pitch = 2 * (params.radius + LOOSE)
        middle = (np.indices((side, side)).reshape(2, -1).T - (side - 1) / 2).astype(dtype)
        cells = jax.random.permutation(cell_key, jnp.asarray(middle))[: self.blocks]
        place = pitch * cells + jax.random.uniform(place_key, cells.shape, dtype, -LOOSE, LOOSE)
        angle = jax.random.uniform(angle_key, (self.blocks, 1), dtype, -np.pi, np.pi)
        outside = pitch * side / 2 * np.sqrt(2) + RADIUS
        finger = draw_beside(finger_key, outside, SPREAD, (-np.pi, np.pi))
        return jnp.concatenate([place, angle], axis=1), finger

    def draw_surface(self, key: PRNGKeyArray, params: TableParams) -> LimitSurface:
        """Draw the limit surface of each block, with a leading axis."""
        assert params.surfaces is not None
        sample = params.surfaces.sample
        return jax.vmap(lambda one: sample(one).surface)(jax.random.split(key, self.blocks))

    def goal_coverage(self, state: TaskState, params: TableParams) -> Float[Array, ""]:
        return super().goal_coverage(_of_first(state), params)

    def measures(self, state: TaskState, params: TableParams) -> dict[str, Array]:
        """Return the measures of all tasks on a table, for the first block, and "clearance"."""
        measures = super().measures(_of_first(state), params)
        if self.blocks == 1:
            return measures | {"clearance": jnp.full_like(state.pose[0, 0], jnp.inf)}
        clearance = -mutual_depth((params.slider.shape,) * self.blocks, Vec3.of(state.pose.T))
        if self.singulate:
            measures |= {"is_success": clearance > CLEARANCE}
        return measures | {"clearance": clearance}

    def reward(self, state: TaskState, measures: dict[str, Array], params: TableParams) -> Float[Array, ""]:
        """Return the reward of all tasks on a table, for the first block; or the one for `singulate`."""
        if not self.singulate:
            return super().reward(_of_first(state), measures, params)
        from_blocks = norm(state.hand[:2] - jnp.mean(state.pose[:, :2], axis=0))
        missing = jnp.maximum(1 - measures["clearance"] / CLEARANCE, 0)
        return -(missing + REACHING_WEIGHT * from_blocks / REWARD_LENGTH)

    def observe(self, key: PRNGKeyArray, state: TaskState, action: Array | None, params: TableParams) -> Array:
        position_key, angle_key = jax.random.split(key)
        position = with_noise(position_key, state.pose[:, :2], params.position_noise)
        turn = cos_sin(params.symmetry * with_noise(angle_key, state.pose[:, 2], params.angle_noise))
        return jnp.concatenate([state.hand, jnp.concatenate([position, turn.array().T], axis=1).ravel()])

    def picture(self, state: TaskState, action: Array | None, params: TableParams, size: int) -> UInt8[Array, "..."]:
        """Return a picture of the table, 0.6 m wide, with x to the right and y up."""
        first, *others = (placed(params.corners, pose) for pose in state.pose)
        goal = jnp.zeros((0, 2), first.dtype) if self.singulate else placed(params.corners, params.goal)
        return render_table(first, goal, self.hand_model, state.hand, (), PICTURE_WIDTH, size, tuple(others))

    def state_of(self, row: ArrayLike, params: TableParams | None = None) -> TaskState:
        """Return a state with the hand at rest.

        Args:
            row: Place of the finger, and x, y and angle of each block, (2 + 3 * blocks,), world, m and rad.
            params: The parameters; None for `default_params`.

        Raises:
            ValueError: For a wrong shape; where it is not traced, also for values that are not finite.
        """
        dtype = (self.default_params if params is None else params).goal.dtype
        values = checked_array("row", as_float(row, dtype, "row"), (2 + 3 * self.blocks,))
        hand = values[:2]
        return TaskState(values[2:].reshape(self.blocks, 3), hand, jnp.zeros_like(hand), jnp.zeros((), jnp.int32))

    def _push(self, state: TaskState, path: Array, params: ClutterParams) -> ControlStepResult:
        """Push along a path of the finger, (steps + 1, 2)."""
        slider, dtype, count = params.slider, state.pose.dtype, self.blocks
        hand = jax.tree.map(lambda leaf: leaf.astype(dtype), self.hand_model)
        surfaces = [slider.surface if state.surface is None else entry_at(state.surface, k) for k in range(count)]
        mu = params.friction if state.friction is None else state.friction
        constant = SlidersFriction.of(
            tuple(surfaces), jnp.broadcast_to(jnp.asarray(mu), (1,)), jnp.broadcast_to(params.between, (count, count))
        )
        return control_step_of_sliders((slider.shape,) * count, constant, hand, path, state.pose)


def _of_first(state: TaskState) -> TaskState:
    """Return the state with the pose of the first block alone."""
    return state if state.pose.ndim == 1 else state.replace(pose=state.pose[0])
