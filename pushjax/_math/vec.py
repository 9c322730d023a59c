"""Small vectors as pytrees of scalars.

`vmap` puts the batch first, so arrays of shape (3,) keep an inner axis of length three in every operation, which the
compiler cannot vectorize. Separate scalars become arrays over the batch, which it can. `of` and `array` convert from
and to arrays. The problem of several contacts (`pushjax.contact`) uses arrays with the batch last instead
(`pushjax._math.arrays`). They are as fast and compile faster, but such code has to be written for a batch.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


class Vec2(NamedTuple):
    """A point, displacement or force in the plane."""

    x: Scalar
    y: Scalar

    def __add__(self, other: "Vec2") -> "Vec2":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Vec2(self.x + other.x, self.y + other.y)

    def __sub__(self, other: "Vec2") -> "Vec2":
        return Vec2(self.x - other.x, self.y - other.y)

    def __neg__(self) -> "Vec2":
        return Vec2(-self.x, -self.y)

    def scale(self, factor: Scalar | float) -> "Vec2":
        return Vec2(factor * self.x, factor * self.y)

    def dot(self, other: "Vec2") -> Scalar:
        return self.x * other.x + self.y * other.y

    def cross(self, other: "Vec2") -> Scalar:
        """Return the z component of the cross product: positive if `other` is counterclockwise of `self`."""
        return self.x * other.y - self.y * other.x

    def perp(self) -> "Vec2":
        """Return the vector rotated by +90 degrees."""
        return Vec2(-self.y, self.x)

    def rotate(self, turn: "Vec2") -> "Vec2":
        """Return the vector rotated by the angle of the unit vector `turn` = (cos, sin)."""
        return Vec2(turn.x * self.x - turn.y * self.y, turn.y * self.x + turn.x * self.y)

    def unrotate(self, turn: "Vec2") -> "Vec2":
        """Return the vector rotated by minus the angle of the unit vector `turn`."""
        return Vec2(turn.x * self.x + turn.y * self.y, turn.x * self.y - turn.y * self.x)

    @staticmethod
    def of(array: Float[Array, "2"]) -> "Vec2":
        return Vec2(*unstack(array))

    def array(self) -> Float[Array, "2"]:
        return jnp.stack(self)


class Vec3(NamedTuple):
    """A twist, wrench or pose with linear part (x, y) and angular part z."""

    x: Scalar
    y: Scalar
    z: Scalar

    def __add__(self, other: "Vec3") -> "Vec3":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vec3") -> "Vec3":
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    @property
    def xy(self) -> Vec2:
        return Vec2(self.x, self.y)

    def scale(self, factor: Scalar | float) -> "Vec3":
        return Vec3(factor * self.x, factor * self.y, factor * self.z)

    def dot(self, other: "Vec3") -> Scalar:
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vec3") -> "Vec3":
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    @staticmethod
    def of(array: Float[Array, "3"]) -> "Vec3":
        return Vec3(*unstack(array))

    def array(self) -> Float[Array, "3"]:
        return jnp.stack(self)


def unstack(array: Array) -> tuple[Array, ...]:
    """Return `(array[0], array[1], ...)`."""
    # Reverse mode then concatenates the cotangents. With indexing it would add up as many arrays that are zero but for
    # one entry.
    return tuple(part.reshape(array.shape[1:]) for part in jax.lax.split(array, (1,) * array.shape[0]))


def cos_sin(angle: Scalar) -> Vec2:
    """Return the unit vector (cos, sin) of an angle in rad."""
    return Vec2(jnp.cos(angle), jnp.sin(angle))


def sinc(angle: Scalar) -> Scalar:
    """Return sin(angle) / angle for an angle of at most a quarter of a turn, rad; smooth at zero."""
    # the Taylor series, to an error of 2e-16
    square, result = angle * angle, jnp.ones_like(angle)
    for k in range(20, 0, -2):
        result = 1 - square / (k * (k + 1)) * result
    return result


def wrap_to_pi(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return an angle, rad, reduced by whole turns to at most half a turn. Its derivative is one everywhere."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def norm(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm along the last axis. Its derivative at the zero vector is zero."""
    squared = jnp.sum(vector**2, axis=-1)
    nonzero = squared > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1.0)), 0.0)
