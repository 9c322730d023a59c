"""The pushed object, and how deep the fingers of a hand are in it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._internal.checks import check_type
from pushjax._internal.jit import quick_jit
from pushjax._math.vec import Vec3
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry.shape import Shape
from pushjax.simulation.finger_motion import finger_motions, max_penetration, unstack_finger_poses
from pushjax.simulation.hand import Hand


class Slider(eqx.Module):
    """The pushed object.

    Attributes:
        shape: Outline, in the slider's body frame.
        surface: Limit surface, in the slider's body frame.
    """

    shape: Shape
    surface: LimitSurface

    def __check_init__(self):
        check_type("shape", self.shape, Shape)
        check_type("surface", self.surface, LimitSurface)


@quick_jit
def overlaps(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> Array:
    """Depth of the deepest finger in the slider, m, for each pose."""
    where = unstack_finger_poses(hand.poses(configuration))
    grips = finger_motions(hand, jnp.zeros(len(hand.fingers), poses.dtype), where, where)
    return jax.vmap(lambda pose: max_penetration(slider.shape.outline(), grips, Vec3.of(pose), 0.0))(poses)
