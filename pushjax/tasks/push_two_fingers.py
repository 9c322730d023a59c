"""PushTwoFingers: two round fingers that move as one body push a block to a pose."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from pushjax.simulation.hand import Hand
from pushjax.tasks.table_task import HALF_WIDTH, TableParams, TableTask, draw_beside, draw_pose

RADIUS = 0.01  # m, of the fingers
SPACING = 0.05  # m, between their centers
START = 0.1  # m, half the width of the square in which a block starts
SPREAD = 0.05  # m, of the distance between hand and block at the start


@dataclass(frozen=True)
class PushTwoFingers(TableTask):
    """Two round fingers that move as one body push a block on a table to a pose in the middle.

    While both fingers touch one side of the block, it can be pushed along a curve without sliding.

    Rewards, and when an episode ends, are those of every `TableTask`.

    - Action: motion of the hand in a control step along x and y, in units of 0.02 m, and its turn, in units of 0.2 rad,
      (3,), from -1 to 1.
    - Observation: hand x and y, in the middle between the fingers, cosine and sine of its angle; block x and y, and
      cosine and sine of its angle times its `symmetry`, which is 2 for the default block, (8,).
    - Start: the block in a square of 0.2 m, at any angle, and the hand beside it, at any angle.

    Examples:
        >>> import jax, pushjax as pj
        >>> env = pj.tasks.PushTwoFingers()
        >>> observation, state = env.reset(jax.random.key(0))
        >>> observation.shape, env.num_actions
        ((8,), 3)
    """

    MOTION: ClassVar[tuple[float, ...]] = (0.02, 0.02, 0.2)
    LOWEST: ClassVar[tuple[float, ...]] = (-HALF_WIDTH, -HALF_WIDTH, -np.inf)
    HIGHEST: ClassVar[tuple[float, ...]] = (HALF_WIDTH, HALF_WIDTH, np.inf)

    @property
    def hand_model(self) -> Hand:
        return Hand((RADIUS, RADIUS), _fingers, 3)

    def draw_start(self, key: PRNGKeyArray, params: TableParams) -> tuple[Array, Array]:
        """Draw a pose of the block, and one of the hand beside it."""
        block_key, place_key, angle_key = jax.random.split(key, 3)
        dtype = params.goal.dtype
        pose = draw_pose(block_key, (-START, -START), (START, START), dtype)
        beside = draw_beside(place_key, params.radius + RADIUS + SPACING / 2, SPREAD, (-np.pi, np.pi))
        angle = jax.random.uniform(angle_key, (1,), dtype, -np.pi, np.pi)
        return pose, jnp.concatenate([pose[:2] + beside, angle])


def _fingers(configuration: Array) -> Array:
    """Return the poses of the fingers, (2, 3), at (0, ±SPACING / 2) in the hand's frame."""
    offset = SPACING / 2 * jnp.stack([-jnp.sin(configuration[2]), jnp.cos(configuration[2]), 0 * configuration[2]])
    return jnp.stack([configuration + offset, configuration - offset])
