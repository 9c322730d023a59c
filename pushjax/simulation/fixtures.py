"""Fixtures: bodies that do not move, which the slider touches while the hand pushes it.

In the contact problem a fixture is like a finger that does not move: it has gaps, friction and forces. There are three
differences. A fixture does not start a push, because only the hand moves. A slider that rests against a fixture within
roundoff is not pushed out of it. A jam in which the slider touches a fixture is no grasp, because the hand alone does
not hold the slider.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, check_type, checked_array, common_dtype, concrete
from pushjax._math.vec import Vec2
from pushjax.geometry.disk import Disk
from pushjax.geometry.polygon import Polygon
from pushjax.simulation.hand import Pad, RoundFinger


class Wall(eqx.Module):
    """A straight wall without ends: the slider cannot enter the half plane behind it.

    The hand passes through walls; only the slider touches them.

    Args:
        point: A point on the wall, (2,), world, m.
        normal: Direction from the wall into the free space, (2,), world. It is scaled to unit length.
        friction: Coefficient of friction mu between wall and slider.

    Raises:
        ValueError: For a wrong shape; where they are not traced, also for values that are not finite, a normal of
            length zero or a negative friction.
    """

    point: Float[Array, "2"]
    normal: Float[Array, "2"]
    friction: Float[Array, ""]

    def __init__(self, point: ArrayLike, normal: ArrayLike, friction: ArrayLike = 0.0):
        dtype = common_dtype(point, normal, friction)
        self.point = checked_array("point", point, (2,), dtype)
        direction = checked_array("normal", normal, (2,), dtype)
        known = concrete(direction)
        if known is not None and not np.any(known):
            raise ValueError("normal must not be zero; it is the direction from the wall into the free space")
        # a traced normal without a direction becomes NaN, which makes every step INVALID, but its derivative is zero
        squared = jax.lax.stop_gradient(jnp.sum(direction**2))
        usable = (squared > 0) & jnp.isfinite(squared)
        safe = jnp.where(usable, direction, 1.0)
        self.normal = jnp.where(usable, safe / jnp.sqrt(jnp.sum(safe**2)), jnp.nan)
        self.friction = checked_array("friction", friction, (), dtype, non_negative=True)


class Fixture(eqx.Module):
    """A body that does not move.

    The hand passes through fixtures; only the slider touches them.

    Args:
        shape: A `Polygon` or a `Disk`, in its own frame, m.
        pose: Pose of the body's frame, (3,), world, m and rad.
        friction: Coefficient of friction mu between body and slider.

    Raises:
        TypeError: For another kind of shape.
        ValueError: For a wrong shape of an array; where they are not traced, also for values that are not finite or a
            negative friction.
    """

    shape: Polygon | Disk
    pose: Float[Array, "3"]
    friction: Float[Array, ""]

    def __init__(self, shape: Polygon | Disk, pose: ArrayLike = (0.0, 0.0, 0.0), friction: ArrayLike = 0.0):
        check_type("shape", shape, Polygon, Disk)
        dtype = common_dtype(shape, pose, friction)
        self.shape, self.pose = shape, checked_array("pose", pose, (3,), dtype)
        self.friction = checked_array("friction", friction, (), dtype, non_negative=True)

    @property
    def body(self) -> RoundFinger | Pad:
        """Return the body as a finger, for contact detection."""
        return RoundFinger(self.shape.radius) if isinstance(self.shape, Disk) else Pad(self.shape)

    @property
    def center(self) -> Vec2:
        """Return the origin of `body`, world, m."""
        origin = Vec2.of(self.pose[:2])
        if not isinstance(self.shape, Disk):
            return origin
        return origin + Vec2.of(self.shape.center).rotate(Vec2(jnp.cos(self.pose[2]), jnp.sin(self.pose[2])))


Fixtures = tuple[Wall | Fixture, ...]
