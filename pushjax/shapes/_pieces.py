"""Pieces of a closed cubic spline."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._vec import Scalar, Vec2


class Piece(NamedTuple):
    """One piece, or an array of them: p(t) = c0 + c1 t + c2 t^2 + c3 t^3 for t from 0 to 1.

    left, right: the jumps of c3 to the neighbours, with which a piece also answers for them, as far as one beyond.
    """

    c0: Vec2
    c1: Vec2
    c2: Vec2
    c3: Vec2
    left: Vec2
    right: Vec2

    def at(self, t: Scalar) -> tuple[Vec2, Vec2, Vec2]:
        """The point, and its first and second derivative by t."""
        over, under = jnp.maximum(t - 1, 0), jnp.maximum(-t, 0)
        point = self.c0 + (self.c1 + (self.c2 + self.c3.scale(t)).scale(t)).scale(t)
        first = self.c1 + (self.c2.scale(2) + self.c3.scale(3 * t)).scale(t)
        second = self.c2.scale(2) + self.c3.scale(6 * t)
        return (
            point + self.right.scale(over * over * over) + self.left.scale(under * under * under),
            first + self.right.scale(3 * over * over) - self.left.scale(3 * under * under),
            second + self.right.scale(6 * over) + self.left.scale(6 * under),
        )

    def third(self, t: Scalar) -> Vec2:
        right, left = jnp.where(t > 1, 6.0, 0.0), jnp.where(t < 0, 6.0, 0.0)
        return self.c3.scale(6) + self.right.scale(right) - self.left.scale(left)

    def chosen(self, index) -> "Piece":
        return jax.tree.map(lambda field: field[index], self)


def pieces_of(control: Float[Array, "controls 2"]) -> Piece:
    """The pieces of the closed uniform cubic B-spline over `control`, the first about the first control point."""
    before, here, after, next_ = (jnp.roll(control, k, axis=0) for k in (1, 0, -1, -2))
    c3 = (next_ - before) / 6 + (here - after) / 2
    fields = (
        (before + 4 * here + after) / 6,
        (after - before) / 2,
        (before - 2 * here + after) / 2,
        c3,
        c3 - jnp.roll(c3, 1, axis=0),
        jnp.roll(c3, -1, axis=0) - c3,
    )
    return Piece(*(Vec2(field[:, 0], field[:, 1]) for field in fields))


def normal_of(velocity: Vec2) -> tuple[Vec2, Scalar]:
    """Outward unit normal of an outline that runs counter-clockwise with `velocity`, and its speed."""
    squared = velocity.dot(velocity)
    speed = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
    return Vec2(velocity.y / speed, -velocity.x / speed), speed
