"""PushT: a round agent pushes a T to a goal; the task of gym-pusht 0.1.8, in its units (pixels, 0.1 s control steps).

The T of gym-pusht is moved by pymunk with all velocity lost in every step. A step's motion is then the impulse divided
by mass and inertia. That is motion under the limit surface H(F) = F' F with length = sqrt(inertia / mass) = sqrt(3000)
pixels about the center of gravity. Its contacts are frictionless. So the quasi-static motion of this library is that of
gym-pusht, up to pymunk's own errors. As an alternative ("table"), the block presses evenly on the table, and the
contact of the agent has friction.

The agent is a disk whose center p follows the action a like a spring with a damper. In each 0.01 s, with its velocity
v: v += (100 (a - p) - 20 v) 0.01, then p += 0.01 v. The block does not act on it, except in a jam, where it is held
back.

Reference: Chi et al. 2023, "Diffusion Policy"; Florence et al. 2021, "Implicit Behavioral Cloning".
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, as_float, check_positive, check_type, checked_array
from pushjax._internal.jit import eager_context
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.friction_model import FrictionModel
from pushjax.geometry.intersection import intersection_area
from pushjax.geometry.polygon import Polygon
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider
from pushjax.tasks.environment import Environment, TaskParams, TaskState
from pushjax.tasks.render import render
from pushjax.tasks.shared import placed, shared_params, with_noise
from pushjax.tasks.spaces import Box, Dict, Space

Observation = Literal["state", "environment_state_agent_pos", "pixels", "pixels_agent_pos"]
Physics = Literal["pymunk", "table"]

# px, in the frame of the T's body
T_VERTICES = ((-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30))
T_CENTER = (0.0, 45.0)  # of gravity: the mean of those of the two bars, not the centroid
# The corners of the two bars, in the order of gym-pusht's observations.
T_KEYPOINTS = ((-60, 0), (60, 0), (60, 30), (-60, 30), (-15, 30), (15, 30), (15, 120), (-15, 120))
T_LENGTH = 3000**0.5  # px
GOAL = (256.0, 256.0, np.pi / 4)  # px and rad, of the T's body
SIZE = 512.0  # px, of the workspace
WALLS = (7.0, 504.0)  # px, faces of the walls
AGENT_RADIUS = 15.0  # px
STIFFNESS, DAMPING = 100.0, 20.0  # 1/s^2 and 1/s, of the spring and the damper that move the agent
PHYSICS_TIMESTEP = 0.01  # s
# Maps position relative to the action, and velocity, of the agent to those after one physics step.
SPRING_STEP = np.array(
    [
        [1 - STIFFNESS * PHYSICS_TIMESTEP**2, PHYSICS_TIMESTEP * (1 - DAMPING * PHYSICS_TIMESTEP)],
        [-STIFFNESS * PHYSICS_TIMESTEP, 1 - DAMPING * PHYSICS_TIMESTEP],
    ]
)
PHYSICS_STEPS = 10  # in a control step
TABLE_FRICTION = 0.3  # default coefficient of friction between agent and block under physics "table"


class PushTParams(TaskParams):
    """Parameters of `PushT`; `PushT.params` makes them. The length unit is the pixel, except in `slider`.

    Attributes:
        origin: Origin of the block's body, to which observed poses refer, in the slider's frame, (2,), px.
        corners: Corners of the block, in the slider's frame, (corners, 2), px.
        keypoints: Points of the observation "environment_state", in the slider's frame, (keypoints, 2), px.
        seams: Pairs of corners of the block between which images have a line.
    """

    origin: Float[Array, "2"]
    corners: Float[Array, "corners 2"]
    keypoints: Float[Array, "keypoints 2"]
    seams: tuple[tuple[int, int], ...] = eqx.field(static=True)


@dataclass(frozen=True)
class PushT(Environment):
    """The task PushT: push a T, or any other block, to a goal with a round agent.

    Observations, actions, rewards, termination and resets are those of gym-pusht 0.1.8. The action is the position to
    which the agent moves, px. The reward is the coverage of the goal divided by 0.95, at most 1. An episode terminates
    when the coverage is above 0.95, and is truncated after 300 control steps.

    The interface is that of gymnax 1.x (`Environment`).

    Attributes:
        observation: What is observed. "state": agent x and y, block x and y (of its body's origin) and angle modulo 2
            pi. "environment_state_agent_pos": a dictionary with the block's corners, 16 numbers for the T, and the
            agent's position. "pixels": an image. "pixels_agent_pos": a dictionary with the image and the agent's
            position.
        substeps: Steps of the simulator in a control step: 1, 2, 5 or 10.
        walls: Whether the workspace has walls, which hold the block and not the agent.
        image_size: Width and height of images, px.

    Raises:
        ValueError: For another value of `observation` or `substeps`, or an image size that is not positive.

    Examples:
        >>> import jax, pushjax as pj
        >>> env = pj.tasks.PushT()
        >>> observation, state = env.reset(jax.random.key(0))
        >>> observation.shape, env.num_actions
        ((5,), 2)
    """

    observation: Observation = "state"
    substeps: int = 2
    walls: bool = True
    image_size: int = 96

    METERS: ClassVar[float] = 1e-3

    def __post_init__(self):
        if self.observation not in get_args(Observation):
            raise ValueError(f"observation must be one of {', '.join(get_args(Observation))}; got {self.observation!r}")
        if self.substeps not in (1, 2, 5, 10):
            raise ValueError(f"substeps must be 1, 2, 5 or 10; got {self.substeps!r}")
        if not self.image_size >= 1:
            raise ValueError(f"image_size must be positive; got {self.image_size!r}")

    @property
    def default_params(self) -> PushTParams:
        return _default_params(jnp.result_type(float))

    def params(
        self,
        physics: Physics = "pymunk",
        *,
        block: Polygon | None = None,
        center: ArrayLike | None = None,
        length: ArrayLike | None = None,
        goal: ArrayLike = GOAL,
        friction: ArrayLike | None = None,
        model: FrictionModel | None = None,
        position_noise: ArrayLike | None = None,
        angle_noise: ArrayLike | None = None,
        action_noise: ArrayLike | None = None,
        max_steps_in_episode: int = 300,
    ) -> PushTParams:
        """Make parameters.

        Args:
            physics: "pymunk" for the motion of gym-pusht: an ellipsoid, and no friction at the agent. "table" for a
                quartic that is fitted to even pressure, and friction at the agent.
            block: The block, px. Its poses are those of the frame of its vertices. It has no holes. Default: the T.
            center: Center of gravity of the block, in the frame of its vertices, (2,), px. Default: that of gym-pusht
                for the T, the centroid of another block. For "table" it cannot be given.
            length: The square root of inertia over mass about the center of gravity, px: how hard the block is to turn.
                Default: that of gym-pusht for the T (54.8 px), the radius of gyration of another block of even
                thickness, about `center`. For "table" it cannot be given.
            goal: Pose of the block at the goal, (3,), px and rad.
            friction: Coefficient of friction between agent and block. Default: none for "pymunk", 0.3 for "table".
            model: Distribution of friction, drawn at each reset for the whole episode. The mean of the limit surfaces
                is that of `physics`; `friction` is then not used.
            position_noise: Standard deviation of the noise on observed positions, px; None for none.
            angle_noise: Standard deviation of the noise on the observed angle, rad; None for none.
            action_noise: Standard deviation of the noise on actions, px; None for none.
            max_steps_in_episode: Number of control steps after which an episode is truncated.

        Returns:
            The parameters. Their method `replace` changes fields.

        Raises:
            ValueError: For another value of `physics`, a wrong shape, a value that is not finite, a negative noise or
                friction, a `length` that is not positive, `center` or `length` with "table", or a `model` that the
                limit surface does not allow (`FrictionModel.around`).
            TypeError: If `block` is no `Polygon`, or `model` no `FrictionModel`.
        """
        if physics not in get_args(Physics):
            raise ValueError(f"physics must be one of {', '.join(get_args(Physics))}; got {physics!r}")
        if physics == "table" and not (center is None and length is None):
            raise ValueError("center and length are for physics 'pymunk'; a block of physics 'table' presses evenly")
        slider, origin, keypoints = _block(block, center, length, physics, self.METERS)
        if friction is None and physics == "table":
            friction = TABLE_FRICTION
        noise = {"position_noise": position_noise, "angle_noise": angle_noise, "action_noise": action_noise}
        return PushTParams(
            **shared_params(slider, goal, friction, model, noise, 0.95, max_steps_in_episode),
            origin=origin,
            corners=slider.shape.vertices / self.METERS,  # pyright: ignore[reportAttributeAccessIssue]
            keypoints=keypoints,
            seams=((7, 2),) if block is None else (),  # of the T, where its two bars meet
        )

    @property
    def hand_model(self) -> Hand:
        return Hand.finger(AGENT_RADIUS * self.METERS)

    def action_space(self, params: PushTParams | None = None) -> Box:
        """Return the space of actions: positions in the workspace, px."""
        return Box(0.0, SIZE, (2,), jnp.result_type(float))

    def observation_space(self, params: PushTParams | None = None) -> Space:
        """Return the space of observations, with the bounds of gym-pusht. The noise may exceed them."""
        dtype = jnp.result_type(float)
        keypoints = (self.default_params if params is None else params).keypoints
        position = Box(0.0, SIZE, (2,), dtype)
        pixels = Box(0, 255, (self.image_size, self.image_size, 3), np.uint8)
        match self.observation:
            case "state":
                return Box(0.0, np.array([SIZE, SIZE, SIZE, SIZE, 2 * np.pi], dtype), (5,), dtype)
            case "environment_state_agent_pos":
                corners = Box(0.0, SIZE, (keypoints.size,), dtype)
                return Dict({"environment_state": corners, "agent_pos": position})
            case "pixels":
                return pixels
            case "pixels_agent_pos":
                return Dict({"pixels": pixels, "agent_pos": position})

    def fixtures(self, state: TaskState, params: PushTParams) -> tuple[Wall, ...]:
        """Return the two walls of the workspace that are nearest to the block, m: one across x, and one across y."""
        if not self.walls:
            return ()
        axes = jnp.eye(2, dtype=state.pose.dtype)
        walls = []
        for axis, position in zip(axes, state.pose[:2], strict=True):
            is_low = position < SIZE / 2
            face = jnp.where(is_low, *WALLS) * self.METERS
            walls.append(Wall(face * axis, jnp.where(is_low, 1.0, -1.0) * axis))
        return tuple(walls)

    def draw_start(self, key: PRNGKeyArray, params: PushTParams) -> tuple[Array, Array]:
        """Draw a start as gym-pusht does: whole pixels, and the block's position is set before its angle."""
        agent_key, block_key, angle_key = jax.random.split(key, 3)
        dtype = params.goal.dtype
        agent = jax.random.randint(agent_key, (2,), 50, 450).astype(dtype)
        block = jax.random.randint(block_key, (2,), 100, 400).astype(dtype)
        angle = jax.random.uniform(angle_key, (1,), dtype, -jnp.pi, jnp.pi)
        return jnp.concatenate([block - params.origin, angle]), agent

    def walk(self, state: TaskState, action: Array) -> tuple[Array, Array]:
        """Return the agent's path to the action, px, and its velocity at the end, px/s."""
        action = jnp.where(jnp.all(jnp.isfinite(action)), action, state.hand)
        offset, path = state.hand - action, [state.hand]
        for k in range(1, self.substeps + 1):
            advance = np.linalg.matrix_power(SPRING_STEP, k * PHYSICS_STEPS // self.substeps)
            path.append(action + float(advance[0, 0]) * offset + float(advance[0, 1]) * state.velocity)
        velocity = float(advance[1, 0]) * offset + float(advance[1, 1]) * state.velocity
        return jnp.stack(path), velocity

    def vertices(self, state: TaskState, params: PushTParams) -> Float[Array, "vertices 2"]:
        """Return the corners of the block, world, px."""
        return placed(params.corners, state.pose)

    def goal_vertices(self, params: PushTParams) -> Float[Array, "vertices 2"]:
        """Return the corners of the block at the goal, world, px."""
        return placed(params.corners - params.origin[None], params.goal)

    def block_pose(self, state: TaskState, params: PushTParams) -> Float[Array, "3"]:
        """Return the pose of the block's own frame, world, px and rad."""
        return jnp.concatenate([placed(params.origin[None], state.pose)[0], state.pose[2:]])

    def goal_coverage(self, state: TaskState, params: PushTParams) -> Float[Array, ""]:
        """Return which fraction of the block's area lies on the goal."""
        shared = intersection_area(self.vertices(state, params), self.goal_vertices(params))
        return shared * self.METERS**2 / params.slider.shape.area

    def observe(self, key: PRNGKeyArray, state: TaskState, action: Array | None, params: PushTParams) -> Any:
        state = _as_observed(key, state, params)
        if self.observation == "state":
            pose = self.block_pose(state, params)
            return jnp.concatenate([state.hand, pose[:2], jnp.mod(pose[2:], 2 * jnp.pi)])
        if self.observation == "environment_state_agent_pos":
            return {"environment_state": placed(params.keypoints, state.pose).ravel(), "agent_pos": state.hand}
        pixels = self.picture(state, None, params, self.image_size)
        return pixels if self.observation == "pixels" else {"pixels": pixels, "agent_pos": state.hand}

    def picture(self, state: TaskState, action: Array | None, params: PushTParams, size: int) -> Array:
        """Return a picture of a state in the colors of gym-pusht, with a cross at the action."""
        block, goal = self.vertices(state, params), self.goal_vertices(params)
        return render(block, goal, state.hand, action, size=size, seams=params.seams)

    def state_of(
        self, observation: ArrayLike, params: PushTParams | None = None, *, velocity: ArrayLike = (0.0, 0.0)
    ) -> TaskState:
        """Return the state that is observed as the given row.

        Args:
            observation: Agent x and y, block x and y and angle, (5,), px and rad, as in "state" observations.
            params: The parameters; None for `default_params`.
            velocity: Velocity of the agent, (2,), px/s.

        Raises:
            ValueError: For a wrong shape; where it is not traced, also for values that are not finite.
        """
        params = self.default_params if params is None else params
        row = checked_array("observation", as_float(observation, params.goal.dtype, "observation"), (5,))
        speed = checked_array("velocity", as_float(velocity, params.goal.dtype, "velocity"), (2,))
        center = placed(-params.origin[None], row[2:])[0]
        return TaskState(jnp.concatenate([center, row[4:]]), row[:2], speed, jnp.zeros((), jnp.int32))


@cache
def _default_params(dtype: Any) -> PushTParams:
    """Return the parameters of gym-pusht in a floating dtype, which is the default one at the time of the call."""
    with eager_context():
        return PushT().params()


def _block(
    block: Polygon | None, center: ArrayLike | None, length: ArrayLike | None, physics: Physics, meters: float
) -> tuple[Slider, Array, Array]:
    """Make the slider, m, and in its frame the block's origin, (2,), and the observed points, (points, 2), px."""
    # From a block (None: the T). The other arguments are those of `PushT.params`.
    if block is None:
        vertices, middle, keypoints = np.array(T_VERTICES, float), np.array(T_CENTER), np.array(T_KEYPOINTS, float)
    else:
        check_type("block", block, Polygon)
        vertices, middle = np.asarray(block.vertices, float), np.asarray(block.centroid, float)
        keypoints = vertices
    if center is not None:
        middle = np.asarray(checked_array("center", center, (2,)), float)
    shape = Polygon(as_float((vertices - middle) * meters))
    if physics == "table":
        slider = Slider.uniform(shape)
    else:
        default = T_LENGTH if block is None else _gyration_radius(shape) / meters
        reach = checked_array("length", default if length is None else length, (), non_negative=True)
        check_positive("length", reach)
        slider = Slider(shape, Ellipsoid(as_float(np.eye(3)), reach * meters))
    return slider, as_float(-middle), as_float(keypoints - middle)


def _gyration_radius(shape: Polygon) -> float:
    """Return the radius of gyration of a polygon about the origin, m."""
    x, y = np.asarray(shape.vertices, float).T
    next_x, next_y = np.roll(x, -1), np.roll(y, -1)
    cross = x * next_y - next_x * y
    second_moment = np.sum(cross * (x * x + x * next_x + next_x**2 + y * y + y * next_y + next_y**2)) / 12
    return float(np.sqrt(second_moment / (np.sum(cross) / 2)))


def _as_observed(key: PRNGKeyArray, state: TaskState, params: PushTParams) -> TaskState:
    """Return the state with the noise of observations."""
    block_key, angle_key, hand_key = jax.random.split(key, 3)
    position = with_noise(block_key, state.pose[:2], params.position_noise)
    angle = with_noise(angle_key, state.pose[2:], params.angle_noise)
    hand = with_noise(hand_key, state.hand, params.position_noise)
    return state.replace(pose=jnp.concatenate([position, angle]), hand=hand)
