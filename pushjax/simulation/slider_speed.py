"""How far a slider may move while the hand moves by a given distance.

Without friction, a slider squirts out of a narrow wedge, such as one between a finger and a wall, much faster than the
finger closes it. On the way out it loses the contacts that drive it. A step that is computed as a whole ignores this
loss, and takes the slider as far as the contacts would if they lasted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._math.vec import Scalar, Vec2, Vec3

MAX_RATIO = 4.0  # a slider may move by this multiple of the largest displacement of a finger
ALWAYS_ALLOWED = 0.1  # it may always move by this fraction of the limit surface's length
# In the smallest part of a step it may move by this fraction. Where a wedge closes and is about to hold the slider, the
# slider may be fast even then.
ALLOWED_IN_SMALLEST = 1.0


class SpeedJudgment(NamedTuple):
    """Whether a slider moved no farther than it may."""

    allowed: Bool[Array, ""]  # in the part of the step that was computed
    allowed_in_double: Bool[Array, ""]  # in a part of twice the size, at the same speed


def judge_speed(
    twist: Vec3,
    middle: Vec2,  # of the slider, where the forces act in the mean, m
    displacement: Scalar,  # largest displacement of a finger in this part, m
    length: Scalar,
    is_smallest: Bool[Array, ""],  # whether the part cannot be divided any more
) -> SpeedJudgment:
    """Return whether a slider moved no farther in a part of a step than it may."""
    twist, middle, length = jax.lax.stop_gradient((twist, middle, length))
    at_middle = twist.xy + middle.perp().scale(twist.z)
    # how far the slider moved where forces act on it, and how far it turned; the limit surface's length, m, makes the
    # angle a distance
    motion = jnp.sqrt(at_middle.dot(at_middle)) + length * jnp.abs(twist.z)

    def is_allowed(multiple: int, fraction: Scalar | float) -> Bool[Array, ""]:
        return multiple * motion <= jnp.maximum(multiple * MAX_RATIO * displacement, fraction * length)

    fraction = jnp.where(is_smallest, ALLOWED_IN_SMALLEST, ALWAYS_ALLOWED)
    return SpeedJudgment(is_allowed(1, fraction), is_allowed(2, ALWAYS_ALLOWED))
