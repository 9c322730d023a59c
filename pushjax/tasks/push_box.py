"""PushBox: a round finger pushes a block to a pose."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from pushjax.simulation.hand import Hand
from pushjax.tasks.table_task import HALF_WIDTH, TableParams, TableTask, draw_beside, draw_pose

RADIUS = 0.01  # m, of the finger
START = 0.1  # m, half the width of the square in which a block starts
SPREAD = 0.05  # m, of the distance between finger and block at the start


@dataclass(frozen=True)
class PushBox(TableTask):
    """A round finger pushes a block on a table to a pose in the middle.

    Rewards, and when an episode ends, are those of every `TableTask`.

    - Action: motion of the finger in a control step along x and y, (2,), from -1 to 1, in units of 0.02 m.
    - Observation: finger x and y, block x and y, and cosine and sine of its angle times its `symmetry`, which is 2 for
      the default block, (6,).
    - Start: the block in a square of 0.2 m, at any angle, and the finger beside it.

    Examples:
        >>> import jax, pushjax as pj
        >>> env = pj.tasks.PushBox()
        >>> observation, state = env.reset(jax.random.key(0))
        >>> observation.shape, env.num_actions
        ((6,), 2)
    """

    MOTION: ClassVar[tuple[float, ...]] = (0.02, 0.02)
    LOWEST: ClassVar[tuple[float, ...]] = (-HALF_WIDTH, -HALF_WIDTH)
    HIGHEST: ClassVar[tuple[float, ...]] = (HALF_WIDTH, HALF_WIDTH)

    @property
    def hand_model(self) -> Hand:
        return Hand.finger(RADIUS)

    def draw_start(self, key: PRNGKeyArray, params: TableParams) -> tuple[Array, Array]:
        """Draw a pose of the block, and a place of the finger beside it."""
        block_key, finger_key = jax.random.split(key)
        pose = draw_pose(block_key, (-START, -START), (START, START), params.goal.dtype)
        return pose, pose[:2] + draw_beside(finger_key, params.radius + RADIUS, SPREAD, (-np.pi, np.pi))
