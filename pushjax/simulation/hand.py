"""Hands: their fingers, and the map from configurations to poses of the fingers."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_count, check_type, checked_array
from pushjax.geometry.polygon import Polygon

Kinematics = Callable[[Array], Array]


class RoundFinger(eqx.Module):
    """A finger that is a disk.

    Attributes:
        radius: Radius, m; zero for a point.

    Raises:
        ValueError: For a radius that is not a scalar, is not finite or is negative.
    """

    radius: Float[Array, ""]

    def __init__(self, radius: ArrayLike):
        self.radius = checked_array("radius", radius, (), non_negative=True)


class Pad(eqx.Module):
    """A finger that is a polygon.

    Attributes:
        shape: The polygon, in the finger's own frame, m.

    Raises:
        TypeError: For another shape than a polygon.
    """

    shape: Polygon

    def __init__(self, shape: Polygon):
        check_type("shape", shape, Polygon)
        self.shape = shape


Finger = RoundFinger | Pad


class Hand(eqx.Module):
    """A position-controlled hand: its fingers, and a map from configurations to their poses in the world.

    Args:
        fingers: The fingers: numbers (radii of disks, m), `Polygon`s (pads, in the finger's own frame, m),
            `RoundFinger`s or `Pad`s.
        kinematics: Function from a configuration (dof,) to the poses (fingers, 3) of the fingers, world, m and rad; JAX
            traces it. A new function, such as a lambda that is made in a loop, compiles every program anew. For a hand
            that never turns and has no pads, it may give centers (fingers, 2) instead. Then every finger moves in a
            straight line in each step, and two that turn while they hold something would close on it.
        dof: Number of coordinates of a configuration.
        least: Smallest allowed value of the last coordinate, the opening, m; None for no limit.

    Raises:
        ValueError: For a hand without fingers, for a `dof` that is not a whole number of at least 1, or for kinematics
            that do not give one pose for each finger.
    """

    fingers: tuple[Finger, ...]
    kinematics: Kinematics = eqx.field(static=True)
    dof: int = eqx.field(static=True)
    least: Float[Array, ""] | None

    def __init__(self, fingers: Sequence[Any], kinematics: Kinematics, dof: int, least: ArrayLike | None = None):
        if not fingers:
            raise ValueError("fingers: a hand needs at least one; got none")
        check_count("dof", dof)
        self.fingers = tuple(_finger(finger) for finger in fingers)
        self.kinematics, self.dof = kinematics, dof
        self.least = None if least is None else as_float(least, name="least")
        shape = jax.eval_shape(kinematics, jax.ShapeDtypeStruct((dof,), jnp.result_type(float))).shape
        widths = (3,) if any(isinstance(f, Pad) for f in self.fingers) else (2, 3)
        if len(shape) != 2 or shape[0] != len(self.fingers) or shape[1] not in widths:
            wanted = " or ".join(f"({len(self.fingers)}, {width})" for width in widths)
            raise ValueError(f"kinematics gives shape {shape} for a configuration of {dof} numbers; expected {wanted}")

    @property
    def radius(self) -> Float[Array, "fingers"]:
        """Radii of the fingers, (fingers,), m; only for a hand whose fingers are all round."""
        return jnp.stack([finger.radius for finger in self.fingers])  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def coordinates(self) -> str:
        """Names of the numbers of a configuration; empty for kinematics of one's own."""
        names: dict[Any, str] = {_one: "x, y", _two: "x, y, theta, d", _three: "x, y, theta, d"}
        return names.get(self.kinematics, "")

    @staticmethod
    def finger(radius: ArrayLike = 0.0) -> "Hand":
        """One round finger that does not turn; its configuration (x, y) is the position of its center, world, m.

        Args:
            radius: Radius of the finger, m.
        """
        return Hand((radius,), _one, 2)

    @staticmethod
    def two_fingers(radius: ArrayLike = 0.0) -> "Hand":
        """Two round fingers at (0, d/2) and (0, -d/2) in the hand's frame.

        The configuration is (x, y, theta, d): the pose of the hand, world, m and rad, and the distance d between the
        fingers' centers, m.

        Args:
            radius: Radius of both fingers, m.
        """
        return Hand((radius, radius), _two, 4, least=2 * as_float(radius, name="radius"))

    @staticmethod
    def three_fingers(radius: ArrayLike = 0.0) -> "Hand":
        """Three round fingers at distance d from the hand's origin, 120 degrees apart, the first on the hand's +y axis.

        The fingers are numbered clockwise. The configuration is (x, y, theta, d): the pose of the hand, world, m and
        rad, and the distance d, m.

        Args:
            radius: Radius of all fingers, m.
        """
        return Hand((radius, radius, radius), _three, 4, least=2 / 3**0.5 * as_float(radius, name="radius"))

    @staticmethod
    def parallel_jaw(width: ArrayLike, thickness: ArrayLike) -> "Hand":
        """Two rectangular pads that face each other along the hand's y axis.

        The configuration is (x, y, theta, d): the pose of the hand, world, m and rad, and the opening d between the
        faces, m. A pad's pose is at the middle of its face. The first pad is at y = d/2 in the hand's frame.

        Args:
            width: Width of the faces along the hand's x axis, m.
            thickness: Thickness of the pads behind their faces, m.
        """
        pad = Polygon.rectangle(width, thickness).vertices
        behind = jnp.stack([jnp.zeros_like(pad[0, 1]), pad[2, 1]])
        upper, lower = (Polygon(pad + sign * behind[None], convex=True) for sign in (1, -1))
        return Hand((upper, lower), _two, 4, least=0.0)

    def poses(self, path: Float[Array, "*steps dof"]) -> Float[Array, "*steps fingers width"]:
        """Poses or centers of the fingers along a path.

        Args:
            path: Configurations, (*steps, dof).

        Returns:
            Poses (*steps, fingers, 3), world, m and rad, or centers (*steps, fingers, 2), as the kinematics give them.
        """
        shape = jax.eval_shape(self.kinematics, jax.ShapeDtypeStruct((self.dof,), path.dtype)).shape
        return jax.vmap(self.kinematics)(path.reshape(-1, self.dof)).reshape(*path.shape[:-1], *shape)


def _finger(finger: Any) -> Finger:
    """Return a finger made from a radius or a polygon, or the finger that is given."""
    if isinstance(finger, RoundFinger | Pad):
        return finger
    return Pad(finger) if isinstance(finger, Polygon) else RoundFinger(finger)


def _one(q: Array) -> Array:
    return q[None]


def _placed(q: Array, offsets: list[tuple[Any, Any]]) -> Array:
    """Return the poses of fingers that turn with the hand, at `offsets` in its frame, m."""
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([jnp.stack([q[0] + c * x - s * y, q[1] + s * x + c * y, q[2]]) for x, y in offsets])


def _two(q: Array) -> Array:
    return _placed(q, [(0.0, q[3] / 2), (0.0, -q[3] / 2)])


def _three(q: Array) -> Array:
    side = 3**0.5 / 2 * q[3]
    return _placed(q, [(0.0, q[3]), (side, -q[3] / 2), (-side, -q[3] / 2)])
