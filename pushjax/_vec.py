"""Small vectors as pytrees of scalars.

`vmap` over code written with (3,)-arrays leaves an inner axis of length three in every operation, which the
compiler cannot vectorise. The same arithmetic on separate scalars becomes arithmetic on whole batches, five to
ten times faster on a CPU. So everything below the public edge is written with `Vec2` and `Vec3`; arrays appear
where a user sees them (`of`, `array`).
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

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
        """z component of the cross product: positive where `other` lies counter-clockwise of `self`."""
        return self.x * other.y - self.y * other.x

    def perp(self) -> "Vec2":
        """Turned by +90 degrees."""
        return Vec2(-self.y, self.x)

    def rotate(self, turn: "Vec2") -> "Vec2":
        """Turned by the angle of the unit vector `turn` = (cos, sin)."""
        return Vec2(turn.x * self.x - turn.y * self.y, turn.y * self.x + turn.x * self.y)

    def unrotate(self, turn: "Vec2") -> "Vec2":
        """Turned by minus the angle of the unit vector `turn`."""
        return Vec2(turn.x * self.x + turn.y * self.y, turn.x * self.y - turn.y * self.x)

    @staticmethod
    def of(array: Float[Array, "2"]) -> "Vec2":
        return Vec2(*entries(array))

    def array(self) -> Float[Array, "2"]:
        return jnp.stack(self)


class Vec3(NamedTuple):
    """A twist, wrench or pose: linear part (x, y), angular part z."""

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

    def unit(self) -> "Vec3":
        """Of length one; zero stays zero."""
        squared = self.dot(self)
        return self.scale(jnp.where(squared > 0, jax.lax.rsqrt(jnp.where(squared > 0, squared, 1.0)), 0.0))

    @staticmethod
    def of(array: Float[Array, "3"]) -> "Vec3":
        return Vec3(*entries(array))

    def array(self) -> Float[Array, "3"]:
        return jnp.stack(self)


def entries(array: Array) -> tuple[Array, ...]:
    """array[0], array[1], ...: reverse mode puts their derivatives side by side, instead of adding up as many arrays
    of zeros with one entry each."""
    return tuple(part.reshape(array.shape[1:]) for part in jax.lax.split(array, (1,) * array.shape[0]))


def weighted(vectors: Iterable[Vec3], weights: Iterable[Scalar]) -> Vec3:
    """sum of weight_i vector_i, from left to right; of one at least."""
    first, *others = (v.scale(weight) for v, weight in zip(vectors, weights, strict=True))
    for v in others:
        first = first + v
    return first


def turn(angle: Scalar) -> Vec2:
    """The unit vector (cos, sin) of an angle in rad."""
    return Vec2(jnp.cos(angle), jnp.sin(angle))


def settle(values, witness: Scalar):
    """`values`, any pytree of scalars, each worked out exactly once.

    The compiler may fuse a value's arithmetic anew into each of its consumers, and round it differently there (fused
    multiply-add or not). For a decision at a tie that is fatal: a finger straight out from a corner is equally near to
    both edges, and fields selected by two copies of one comparison came from different edges; the slider jumped
    (seen on the CPU with JAX 0.8 to 0.10). It is slow too. An optimization barrier does not stop it there, a
    division does, because those are never done twice: so divide by a one that is not known to be one.

    Derivatives on their way back through it are settled likewise, which would otherwise be worked out anew for every
    input: `grad` of two contacts takes an eighth of the time to run, and three fifths to compile. (Not so under
    `jacrev`, whose batch of rows the witness is not part of.)

    witness: any finite scalar that is not a compile-time constant. Where it is not finite, decisions are False.
    """
    one = jax.lax.stop_gradient(witness) * 0 + 1

    def settled(value):
        if jnp.issubdtype(value.dtype, jnp.floating):
            return value / one
        if value.dtype != bool:
            raise TypeError(f"settle takes floats and booleans, not {value.dtype}")
        return value.astype(one.dtype) / one > 0.5

    return jax.tree.map(settled, values)


def wherever(condition: Bool[Array, ""], update: Callable, state):
    """`update(state)` where the condition holds, else `state`. Under `vmap` it takes no time if it holds for none of
    the batch; of `cond`, both branches would run. Not for reverse mode."""

    def once(left):
        return left[0] & False, update(left[1])

    return jax.lax.while_loop(lambda left: left[0], once, (condition, state))[1]


def select(condition, yes, no):
    """`where` over two equal pytrees of scalars."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def each_of(of: Callable, items: tuple) -> tuple:
    """(of(item), ...). Of several items that are alike in all but their numbers, `of` is written into the program
    once, in a loop over them: written out it would be compiled as often, and that is what a first call waits for."""

    def kind(item):
        leaves = jax.tree.leaves(item)
        return jax.tree.structure(item), tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)

    if len(items) == 1 or len({kind(item) for item in items}) > 1:
        return tuple(of(item) for item in items)
    found = jax.lax.map(of, jax.tree.map(lambda *leaves: jnp.stack(leaves), *items))
    return tuple(jax.tree.map(lambda leaf, k=k: leaf[k], found) for k in range(len(items)))
