"""The pose that a plan shall reach, how far from it another pose is, and whether a plan reaches it."""

from enum import IntEnum
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, as_float, check_count, checked_array, common_dtype
from pushjax._math.vec import norm, wrap_to_pi

ANGLE_TOLERANCE = float(np.radians(5))  # rad


class PlanStatus(IntEnum):
    """Whether a plan does what was asked for, or why not.

    Attributes:
        FOUND: It does so, at least as surely as was asked for.
        UNLIKELY: The best plan that was found does so less surely.
        NO_TRANSIT: No plan of pushes that was found can be carried out. In the best one, the finger does not get from
            push to push without touching slider or fixtures.
        HAND_IN_FIXTURE: No plan of pushes that was found can be carried out. In the best one, the hand runs into a
            fixture in a push.
        NOT_STABLE: There is no stable push: on no edge does the contact stick for every sampled friction, not even when
            it pushes straight ahead.
        OUT_OF_REACH: There is no stable push, not even to a pose straight ahead, because no contact can turn to either
            side without slip.
    """

    FOUND = 0
    UNLIKELY = 1
    NO_TRANSIT = 2
    HAND_IN_FIXTURE = 3
    NOT_STABLE = 4
    OUT_OF_REACH = 5


class Goal(eqx.Module):
    """A pose to reach, with a tolerance of position and one of angle.

    A slider that looks the same after a turn about its body origin may reach the goal at several angles.

    Args:
        pose: Pose of the slider, (3,), world, m and rad.
        position_tolerance: Tolerance of the position of the body origin, m.
        angle_tolerance: Tolerance of the angle, rad.
        length: Length that weighs the angle in `distance`, m.
        symmetry: Number of angles in a full turn at which the slider looks the same (4 for a square), or a list of the
            turns after which it does, (turns,), rad. The list must contain zero, or else `pose` itself is no goal. The
            attribute is the list, `turns`.

    Raises:
        ValueError: For a pose or turns of a wrong shape, for a tolerance or a length that is not positive, for values
            that are not finite, and for a symmetry below one. All methods raise it for poses of another shape.

    Examples:
        >>> goal = Goal((0.1, 0.0, 0.0), symmetry=4)
        >>> print(goal.reached((0.103, 0.0, 1.6)), goal.reached((0.103, 0.0, 0.8)))
        True False
    """

    pose: Float[Array, "3"]
    position_tolerance: Float[Array, ""]
    angle_tolerance: Float[Array, ""]
    length: Float[Array, ""]
    turns: Float[Array, "turns"]

    def __init__(
        self,
        pose: ArrayLike,
        *,
        position_tolerance: ArrayLike = 0.005,
        angle_tolerance: ArrayLike = ANGLE_TOLERANCE,
        length: ArrayLike = 0.05,
        symmetry: int | ArrayLike = 1,
    ):
        dtype = common_dtype(pose, position_tolerance, angle_tolerance, length)
        self.pose = checked_array("pose", pose, (3,), dtype)
        scalars = {"position_tolerance": position_tolerance, "angle_tolerance": angle_tolerance, "length": length}
        for name, value in scalars.items():
            setattr(self, name, checked_array(name, value, (), dtype, positive=True))
        self.turns = symmetric_turns(symmetry, dtype)

    def offset(self, pose: ArrayLike) -> Float[Array, "*batch 3"]:
        """Return poses minus the goal, with the angle from the nearest of the equivalent goals.

        Args:
            pose: Poses, (..., 3), world, m and rad.

        Returns:
            Differences (x, y, theta), (..., 3), world, m and rad. The angle is at most half a turn, and its derivative
            is one everywhere. Where two equivalent goals are equally near, the angle is from one of them.
        """
        given = as_float(pose, common_dtype(pose, self.pose), "pose")
        if given.ndim == 0 or given.shape[-1] != 3:
            raise ValueError(f"pose has shape {given.shape}; expected (..., 3)")
        difference = given - jnp.broadcast_to(self.pose, given.shape)
        angles = wrap_to_pi(difference[..., 2:] - jnp.broadcast_to(self.turns, (*given.shape[:-1], len(self.turns))))
        nearest = jnp.argmin(jnp.abs(angles), axis=-1, keepdims=True)
        return jnp.concatenate([difference[..., :2], jnp.take_along_axis(angles, nearest, axis=-1)], axis=-1)

    def squared_error(self, pose: ArrayLike) -> Float[Array, "*batch"]:
        """Return the squared error in units of the tolerances, |(x, y)|^2 / p^2 + theta^2 / a^2.

        Here (x, y, theta) is the `offset`, and p and a are the tolerances of position and angle. The derivative is zero
        at the goal and finite everywhere. A pose with an error of at most one has reached the goal.

        Args:
            pose: Poses, (..., 3), world, m and rad.
        """
        offset = self.offset(pose)
        squared = offset[..., 0] ** 2 + offset[..., 1] ** 2
        return squared / self.position_tolerance**2 + (offset[..., 2] / self.angle_tolerance) ** 2

    def distance(self, pose: ArrayLike) -> Float[Array, "*batch"]:
        """Return the distance from the goal, m: that of the positions plus `length` times that of the angles.

        It is `pushjax.deviation` from the nearest of the equivalent goals. The term of the positions is not smooth
        where the positions are equal, and that of the angles where the angles are equal. Its derivative there is given
        as zero.

        Args:
            pose: Poses, (..., 3), world, m and rad.
        """
        offset = self.offset(pose)
        return norm(offset[..., :2]) + self.length * _absolute(offset[..., 2])

    def max_error(self, pose: ArrayLike) -> Float[Array, "*batch"]:
        """Return the larger of the errors of position and angle, each in units of its tolerance.

        The goal is reached if it is at most one.

        Args:
            pose: Poses, (..., 3), world, m and rad.
        """
        offset = self.offset(pose)
        return jnp.maximum(
            norm(offset[..., :2]) / self.position_tolerance, _absolute(offset[..., 2]) / self.angle_tolerance
        )

    def reached(self, pose: ArrayLike) -> Bool[Array, "*batch"]:
        """Return whether poses are within both tolerances.

        Args:
            pose: Poses, (..., 3), world, m and rad.
        """
        return self.max_error(pose) <= 1


def _absolute(angle: Array) -> Array:
    """Return |angle| with derivative zero at zero, where that of `jnp.abs` is one."""
    return angle * jnp.sign(angle)


def symmetric_turns(symmetry: int | ArrayLike, dtype: Any = None) -> Float[Array, "turns"]:
    """Return the turns after which a slider looks the same, (turns,), rad, given as such or as their number."""
    if np.ndim(symmetry) == 0:  # pyright: ignore[reportArgumentType]
        check_count("symmetry", symmetry)
        symmetry = 2 * np.pi * np.arange(symmetry) / symmetry  # pyright: ignore
    turns = checked_array("symmetry", symmetry, ("turns",), dtype)
    if not len(turns):
        raise ValueError("symmetry must have at least one turn, zero for a slider without symmetry; got none")
    return turns
