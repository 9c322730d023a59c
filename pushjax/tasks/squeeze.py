"""Squeeze: a parallel jaw grasps a block and carries it to a pose."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from pushjax.contact.status import Status
from pushjax.simulation.hand import Hand
from pushjax.tasks.control_step import ControlStepResult
from pushjax.tasks.environment import TaskState
from pushjax.tasks.shared import placed
from pushjax.tasks.table_task import HALF_WIDTH, TableParams, TableTask, draw_beside, draw_pose

WIDTH, THICKNESS = 0.06, 0.012  # m, of the pads
OPENING = 0.14  # m, of the open jaw
START = 0.1  # m, half the width of the square in which a block starts
HELD_GAP = 1e-3  # m, between a pad and a block that is held


@dataclass(frozen=True)
class Squeeze(TableTask):
    """A parallel jaw closes on a block, and carries it to a pose.

    The jaw has been lowered around the block, and the block turns and slides as the pads close. In a control step the
    jaw first closes or opens, and stops closing where it grasps the block. Then it moves. A block that it has squeezed
    in this control step moves with it as one body; otherwise the pads push the block.

    Rewards, and when an episode ends, are those of every `TableTask`; it terminates only while the block is held.

    - Action: motion of the jaw in a control step along x and y, in units of 0.02 m, its turn, in units of 0.2 rad, and
      how much it opens, in units of 0.02 m, (4,), from -1 to 1.
    - Observation: jaw x and y, cosine and sine of its angle, its opening; block x and y, and cosine and sine of its
      angle times its `symmetry`, which is 2 for the default block, (9,).
    - Start: the block in a square of 0.2 m, at any angle, and the open jaw around it, at any angle.
    - `info` also has "is_held": whether the mean of the block's corners is between the pads, and both pads are within
      1 mm of the block.

    Attributes:
        substeps: Steps of the simulator in each of the two parts of a control step.

    Raises:
        ValueError: If `substeps` is not a whole number of at least one.

    Examples:
        >>> import jax, pushjax as pj
        >>> env = pj.tasks.Squeeze()
        >>> observation, state = env.reset(jax.random.key(0))
        >>> observation.shape, env.num_actions
        ((9,), 4)
    """

    MOTION: ClassVar[tuple[float, ...]] = (0.02, 0.02, 0.2, 0.02)
    LOWEST: ClassVar[tuple[float, ...]] = (-HALF_WIDTH, -HALF_WIDTH, -np.inf, 0.0)
    HIGHEST: ClassVar[tuple[float, ...]] = (HALF_WIDTH, HALF_WIDTH, np.inf, OPENING)
    MAX_RADIUS: ClassVar[float] = 0.065

    @property
    def hand_model(self) -> Hand:
        return Hand.parallel_jaw(WIDTH, THICKNESS)

    def draw_start(self, key: PRNGKeyArray, params: TableParams) -> tuple[Array, Array]:
        """Draw a pose of the block, and one of the open jaw around it."""
        block_key, place_key, angle_key = jax.random.split(key, 3)
        dtype = params.goal.dtype
        pose = draw_pose(block_key, (-START, -START), (START, START), dtype)
        # So near to the block's center that the pads are clear of the block at any angle.
        beside = draw_beside(place_key, jnp.zeros((), dtype), 1.0, (-np.pi, np.pi)) * (OPENING / 2 - params.radius)
        angle = jax.random.uniform(angle_key, (1,), dtype, -np.pi, np.pi)
        return pose, jnp.concatenate([pose[:2] + beside, angle, jnp.full((1,), OPENING, dtype)])

    def measures(self, state: TaskState, params: TableParams) -> dict[str, Array]:
        """Return the measures of all tasks on a table, and "is_held"."""
        in_jaw = placed(placed(params.corners, state.pose) - state.hand[None, :2], jnp.pad(-state.hand[2:3], (2, 0)))
        gap = state.hand[3] / 2 - jnp.minimum(jnp.max(in_jaw[:, 1]), jnp.max(-in_jaw[:, 1]))
        held = (gap < HELD_GAP) & (jnp.abs(jnp.mean(in_jaw[:, 0])) < WIDTH / 2)
        measures = super().measures(state, params)
        return measures | {"is_success": measures["is_success"] & held, "is_held": held}

    def _push(self, state: TaskState, path: Array, params: TableParams) -> ControlStepResult:
        """Push along a path of the jaw in two parts: first only its opening changes, then only its pose."""
        is_opening = jnp.array([False, False, False, True])

        def part(carry: tuple[Array, Array], changes: Array) -> tuple[tuple[Array, Array], ControlStepResult]:
            """Change those coordinates of the jaw for which `changes` holds."""
            pose, hand = carry
            change = jnp.where(changes[None], path - path[:1], 0)
            result = super(Squeeze, self)._push(state.replace(pose=pose), hand[None] + change, params)
            return (result.pose, result.configuration), result

        _, parts = jax.lax.scan(part, (state.pose, path[0]), jnp.stack([is_opening, ~is_opening]))
        closed, pushed = (ControlStepResult(*(leaf[k] for leaf in parts)) for k in (0, 1))
        # The other result of the second part: the jaw carries the block, as one body, to the end of the path.
        jaw = jnp.where(is_opening, closed.configuration, path[-1])
        turn = jaw[2:3] - closed.configuration[2:3]
        position = placed(closed.pose[None, :2] - closed.configuration[None, :2], jnp.concatenate([jaw[:2], turn]))[0]
        carried_pose = jnp.concatenate([position, closed.pose[2:] + turn])
        carried = ControlStepResult(carried_pose, jaw, jnp.full_like(pushed.status, Status.MOVING))
        squeezed = jnp.any(closed.status == Status.GRASPED)
        last = ControlStepResult(*(jnp.where(squeezed, a, b) for a, b in zip(carried, pushed, strict=True)))
        return last._replace(status=jnp.concatenate([closed.status, last.status]))
