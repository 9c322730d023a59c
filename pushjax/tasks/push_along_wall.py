"""PushAlongWall: a round finger pushes a block against a wall, and along it to a place."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from pushjax.simulation.fixtures import Wall
from pushjax.tasks.environment import TaskState
from pushjax.tasks.push_box import RADIUS, SPREAD, PushBox
from pushjax.tasks.table_task import HALF_WIDTH, TableParams, draw_beside, draw_pose

FACE = -0.15  # m, y of the wall's face
GOAL_X = 0.1  # m
START_X = (-0.15, -0.05)  # m, of the block
GAP = 0.05  # m, at most, between the wall and the circle around the block at the start


@dataclass(frozen=True)
class PushAlongWall(PushBox):
    """A round finger pushes a block against a wall, and along the wall to a goal where it lies flat against it.

    The wall has the face y = -0.15 m, and friction with the block (`wall_friction`). The finger does not reach it,
    because its motion is limited. A finger that would press a block into the wall stops.

    Actions, observations and rewards are those of `PushBox`.

    - Start: the block left of the middle and at any angle, and the finger above it. The circle through the corner that
      is farthest from the block's center is up to 0.05 m away from the wall.
    - Goal: the block at x = 0.1 m, with the angle zero.

    Examples:
        >>> import jax, pushjax as pj
        >>> env = pj.tasks.PushAlongWall()
        >>> observation, state = env.reset(jax.random.key(0))
        >>> observation.shape, env.num_actions
        ((6,), 2)
    """

    LOWEST: ClassVar[tuple[float, ...]] = (-HALF_WIDTH, FACE + RADIUS)

    def goal_of(self, corners: np.ndarray) -> tuple[float, float, float]:
        return (GOAL_X, FACE - float(corners[:, 1].min()), 0.0)

    def fixtures(self, state: TaskState, params: TableParams) -> tuple[Wall, ...]:
        """Return the wall."""
        dtype = state.pose.dtype
        return (Wall(jnp.asarray([0.0, FACE], dtype), jnp.asarray([0.0, 1.0], dtype), params.wall_friction),)

    def draw_start(self, key: PRNGKeyArray, params: TableParams) -> tuple[Array, Array]:
        """Draw a pose of the block, and a place of the finger above it."""
        block_key, finger_key = jax.random.split(key)
        pose = draw_pose(block_key, (START_X[0], FACE), (START_X[1], FACE + GAP), params.goal.dtype)
        pose = pose.at[1].add(params.radius)
        return pose, pose[:2] + draw_beside(finger_key, params.radius + RADIUS, SPREAD, (0.0, np.pi))
