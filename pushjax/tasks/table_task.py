"""Tasks on a table: a hand moves a block to a pose, in meters, with friction at the fingers and under the block.

The action says how far the hand moves in a control step of 0.1 s, as a fraction from -1 to 1 of the most that it can.

Poses between which the outline of the block is the same count as equal, in observations, rewards and success.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, as_float, check_count, check_type, checked_array
from pushjax._internal.jit import eager_context
from pushjax._math.vec import cos_sin, norm
from pushjax.friction.friction_model import FrictionModel
from pushjax.geometry.intersection import intersection_area
from pushjax.geometry.polygon import Polygon
from pushjax.simulation.slider import Slider
from pushjax.tasks.environment import Environment, TaskParams, TaskState
from pushjax.tasks.render import render_table
from pushjax.tasks.shared import placed, shared_params, with_noise
from pushjax.tasks.spaces import Box

BLOCK = (0.09, 0.06)  # m, sides of the default block
HALF_WIDTH = 0.25  # m, of the square in which the hand moves
PICTURE_WIDTH = 0.6  # m
REWARD_LENGTH, REACHING_WEIGHT = 0.1, 0.1  # m; weight of the hand's distance
MAX_SYMMETRY = 12  # largest `symmetry` that is looked for


class TableParams(TaskParams):
    """Parameters of the tasks on a table; the method `params` of a task makes them. Lengths are in m.

    Attributes:
        corners: Corners of the block, in the slider's frame, (corners, 2), m.
        wall_friction: Coefficient of friction between the block and a wall.
        symmetry: The number of angles in a full turn at which the block has the same outline: 2 for a rectangle. At
            most 12 is found.
    """

    corners: Float[Array, "corners 2"]
    wall_friction: Float[Array, ""]
    symmetry: int = eqx.field(static=True)

    @property
    def radius(self) -> Float[Array, ""]:
        """Distance of the farthest corner from the center, m."""
        return jnp.sqrt(jnp.max(jnp.sum(self.corners**2, axis=1)))


@dataclass(frozen=True)
class TableTask(Environment):
    """A hand moves a block on a table to a pose.

    An episode terminates when the block covers 0.9 of the goal, and is truncated after 100 control steps. The
    observation consists of the configuration of the hand, with the cosine and the sine of its angle, and the block's x,
    y, and cosine and sine of its angle times the block's `symmetry`. The interface is that of gymnax 1.x
    (`Environment`).

    The reward is -(a + b / 10) / 0.1 m. a is the distance of the block from the goal: that of the position, plus the
    angle times the length of the limit surface. b is the distance between the centers of hand and block. The reward is
    never positive, so an episode that ends early costs less.

    Attributes:
        substeps: Steps of the simulator in a control step.

    Raises:
        ValueError: If `substeps` is not a whole number of at least one.
    """

    substeps: int = 2

    MOTION: ClassVar[tuple[float, ...]]  # m and rad, largest changes of the hand's coordinates in a control step
    LOWEST: ClassVar[tuple[float, ...]]  # m and rad, limits of the hand's coordinates
    HIGHEST: ClassVar[tuple[float, ...]]
    GOAL: ClassVar[tuple[float, float, float]] = (0.0, 0.0, 0.0)  # m and rad, default pose at the goal
    MAX_RADIUS: ClassVar[float] = 0.08  # m, largest distance of a corner of a block from its center

    def __post_init__(self):
        check_count("substeps", self.substeps)

    @property
    def default_params(self) -> TableParams:
        return _default_params(type(self), jnp.result_type(float))

    def params(
        self,
        *,
        block: Polygon | None = None,
        goal: ArrayLike | None = None,
        friction: ArrayLike = 0.3,
        wall_friction: ArrayLike = 0.2,
        model: FrictionModel | None = None,
        position_noise: ArrayLike | None = None,
        angle_noise: ArrayLike | None = None,
        action_noise: ArrayLike | None = None,
        success_coverage: ArrayLike = 0.9,
        max_steps_in_episode: int = 100,
    ) -> TableParams:
        """Make parameters.

        Args:
            block: The block, m, which presses evenly on the table. Its centroid becomes the origin of its frame.
                Default: a rectangle of 0.09 by 0.06.
            goal: Pose of the block at the goal, (3,), m and rad. Default: that of the task.
            friction: Coefficient of friction between fingers and block.
            wall_friction: Coefficient of friction between walls and block, for tasks with a wall.
            model: Distribution of friction, drawn at each reset for the whole episode. `friction` is then not used.
            position_noise: Standard deviation of the noise on the block's observed position, m; None for none. The hand
                is observed without noise.
            angle_noise: Standard deviation of the noise on its observed angle, rad; None for none.
            action_noise: Standard deviation of the noise on actions; None for none.
            success_coverage: Coverage of the goal above which an episode terminates.
            max_steps_in_episode: Number of control steps after which an episode is truncated.

        Returns:
            The parameters. Their method `replace` changes fields.

        Raises:
            ValueError: For a wrong shape, a value that is not finite or negative, a block that is too large for the
                task, or a `model` that the limit surface does not allow (`FrictionModel.around`).
            TypeError: If `block` is no `Polygon`, or `model` no `FrictionModel`.
        """
        shape = Polygon.rectangle(*BLOCK) if block is None else block
        check_type("block", shape, Polygon)
        corners = np.asarray(shape.vertices, float) - np.asarray(shape.centroid, float)
        radius = np.hypot(*corners.T).max()
        if radius > self.MAX_RADIUS:
            raise ValueError(f"block: a corner may be {self.MAX_RADIUS} m from the center; got {radius:.3g} m")
        slider = Slider.uniform(Polygon(as_float(corners)))
        noise = {"position_noise": position_noise, "angle_noise": angle_noise, "action_noise": action_noise}
        place = self.goal_of(corners) if goal is None else goal
        return TableParams(
            **shared_params(slider, place, friction, model, noise, success_coverage, max_steps_in_episode),
            corners=as_float(corners),
            wall_friction=checked_array("wall_friction", wall_friction, (), non_negative=True),
            symmetry=_symmetry(corners),
        )

    def goal_of(self, corners: np.ndarray) -> tuple[float, float, float]:
        """Return the default pose at the goal, m and rad, of a block with these corners, (corners, 2), m."""
        return self.GOAL

    def action_space(self, params: TableParams | None = None) -> Box:
        """Return the space of actions: fractions of the largest motions of the hand."""
        return Box(-1.0, 1.0, (len(self.MOTION),), jnp.result_type(float))

    def observation_space(self, params: TableParams | None = None) -> Box:
        """Return the space of observations, m. The noise may exceed it."""
        # The hand's coordinates, of which an angle counts twice; x, y, cosine and sine of the block.
        return Box(-1.0, 1.0, (4 + len(self.MOTION) + (len(self.MOTION) > 2),), jnp.result_type(float))

    def walk(self, state: TaskState, action: Array) -> tuple[Array, Array]:
        """Return the straight path of the hand in a control step, m; it is at rest at the end."""
        dtype = state.hand.dtype
        motion, low, high = (jnp.asarray(row, dtype) for row in (self.MOTION, self.LOWEST, self.HIGHEST))
        motion = motion * jnp.clip(jnp.where(jnp.isfinite(action), action, 0), -1, 1)
        change = jnp.clip(state.hand + motion, low, high) - state.hand
        fractions = jnp.arange(self.substeps + 1, dtype=dtype)[:, None] / self.substeps
        return state.hand[None] + fractions * change[None], jnp.zeros_like(state.hand)

    def goal_coverage(self, state: TaskState, params: TableParams) -> Float[Array, ""]:
        """Return which fraction of the block's area lies on the goal."""
        shared = intersection_area(placed(params.corners, state.pose), placed(params.corners, params.goal))
        return shared / params.slider.shape.area

    def measures(self, state: TaskState, params: TableParams) -> dict[str, Array]:
        """Return "coverage", "is_success", "position_error" and "angle_error", the distances from the goal, m and rad.

        The angle is the smallest one by which the block has to turn, at most half a turn divided by its symmetry.
        """
        offset, half = state.pose - params.goal, np.pi / params.symmetry
        errors = {
            "position_error": norm(offset[:2]),
            "angle_error": jnp.abs(jnp.mod(offset[2] + half, 2 * half) - half),
        }
        return super().measures(state, params) | errors

    def reward(self, state: TaskState, measures: dict[str, Array], params: TableParams) -> Float[Array, ""]:
        """Return -(distance of the block from the goal + distance of the hand from the block / 10) / 0.1 m."""
        from_goal = measures["position_error"] + params.slider.surface.length * measures["angle_error"]
        from_block = norm(state.hand[:2] - state.pose[:2])
        return -(from_goal + REACHING_WEIGHT * from_block) / REWARD_LENGTH

    def observe(self, key: PRNGKeyArray, state: TaskState, action: Array | None, params: TableParams) -> Array:
        position_key, angle_key = jax.random.split(key)
        position = with_noise(position_key, state.pose[:2], params.position_noise)
        turn = cos_sin(params.symmetry * with_noise(angle_key, state.pose[2], params.angle_noise))
        hand = [state.hand] if len(self.MOTION) == 2 else [state.hand[:2], cos_sin(state.hand[2]).array()]
        return jnp.concatenate([*hand, state.hand[3:], position, turn.array()])

    def picture(self, state: TaskState, action: Array | None, params: TableParams, size: int) -> Array:
        """Return a picture of the table, 0.6 m wide, with x to the right and y up."""
        block, goal = placed(params.corners, state.pose), placed(params.corners, params.goal)
        walls = self.fixtures(state, params)
        return render_table(block, goal, self.hand_model, state.hand, walls, PICTURE_WIDTH, size)

    def state_of(self, row: ArrayLike, params: TableParams | None = None) -> TaskState:
        """Return a state with the hand at rest.

        Args:
            row: Configuration of the hand, and x, y and angle of the block, (dof + 3,), world, m and rad.
            params: The parameters; None for `default_params`.

        Raises:
            ValueError: For a wrong shape; where it is not traced, also for values that are not finite.
        """
        dtype = (self.default_params if params is None else params).goal.dtype
        values = checked_array("row", as_float(row, dtype, "row"), (len(self.MOTION) + 3,))
        return TaskState(values[-3:], values[:-3], jnp.zeros_like(values[:-3]), jnp.zeros((), jnp.int32))


def draw_beside(key: PRNGKeyArray, nearest: Array, spread: float, angles: tuple[float, float]) -> Array:
    """Draw a vector, (2,), of a length from `nearest` to `nearest` + `spread`, m, in a direction between two angles."""
    length_key, angle_key = jax.random.split(key)
    length = nearest + jax.random.uniform(length_key, (), nearest.dtype, 0.0, spread)
    return length * cos_sin(jax.random.uniform(angle_key, (), nearest.dtype, *angles)).array()


def draw_pose(key: PRNGKeyArray, low: tuple[float, float], high: tuple[float, float], dtype: Any) -> Array:
    """Draw a pose, (3,), whose position is between two corners, m, at any angle."""
    low_pose, high_pose = (jnp.asarray(row, dtype) for row in ((*low, -np.pi), (*high, np.pi)))
    return jax.random.uniform(key, (3,), dtype, low_pose, high_pose)


@cache
def _default_params(task: type[TableTask], dtype: Any) -> TableParams:
    """Return the default parameters of a task in a floating dtype, the default one at the time of the call."""
    with eager_context():
        return task().params()


def _symmetry(corners: np.ndarray) -> int:
    """Return the number of angles in a full turn at which a polygon about its centroid has the same outline."""
    tolerance = 1e-5 * np.hypot(*corners.T).max()
    points = corners[:, 0] + 1j * corners[:, 1]
    for order in range(MAX_SYMMETRY, 1, -1):
        gaps = np.abs(points[:, None] * np.exp(2j * np.pi / order) - points[None])
        if np.all(gaps.min(axis=1) < tolerance):
            return order
    return 1
