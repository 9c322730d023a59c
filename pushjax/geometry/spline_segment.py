"""Segments of a closed cubic spline."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._math.vec import Scalar, Vec2


class SplineSegment(NamedTuple):
    """One segment p(t) = c0 + c1 t + c2 t^2 + c3 t^3 for t from 0 to 1, or an array of segments, in m."""

    # At a knot, the spline has continuous second derivatives, so the cubics of two neighbors differ by a multiple of
    # (t - knot)^3 only: the jump of c3. With these jumps a segment also represents its neighbors, for t from -1 to 2.

    c0: Vec2
    c1: Vec2
    c2: Vec2
    c3: Vec2
    left_jump: Vec2  # of c3, from the previous segment to this one
    right_jump: Vec2  # of c3, from this segment to the next

    def evaluate(self, t: Scalar, xp: Any = jnp) -> tuple[Vec2, Vec2, Vec2]:
        """Return the point and its first and second derivative with respect to t, for t from -1 to 2, m."""
        # How far t lies past the end of the segment, and how far before its start.
        over, under = xp.maximum(t - 1, 0), xp.maximum(-t, 0)
        point = self.c0 + (self.c1 + (self.c2 + self.c3.scale(t)).scale(t)).scale(t)
        first = self.c1 + (self.c2.scale(2) + self.c3.scale(3 * t)).scale(t)
        second = self.c2.scale(2) + self.c3.scale(6 * t)
        return (
            point + self.right_jump.scale(over * over * over) + self.left_jump.scale(under * under * under),
            first + self.right_jump.scale(3 * over * over) - self.left_jump.scale(3 * under * under),
            second + self.right_jump.scale(6 * over) + self.left_jump.scale(6 * under),
        )

    def third_derivative(self, t: Scalar) -> Vec2:
        """Return the third derivative with respect to t, for t from -1 to 2, m."""
        right, left = jnp.where(t > 1, 6.0, 0.0), jnp.where(t < 0, 6.0, 0.0)
        return self.c3.scale(6) + self.right_jump.scale(right) - self.left_jump.scale(left)

    def select(self, index: Any) -> "SplineSegment":
        """Return the segment, or the segments, at an index of the array."""
        return jax.tree.map(lambda field: field[index], self)


def spline_segments(control: Float[Array, "controls 2"], xp: Any = jnp) -> SplineSegment:
    """Return the segments of a closed uniform cubic B-spline; segment k starts near control point k."""
    before, here, after, next_ = (xp.roll(control, k, axis=0) for k in (1, 0, -1, -2))
    c3 = (next_ - before) / 6 + (here - after) / 2
    coefficients = (
        (before + 4 * here + after) / 6,
        (after - before) / 2,
        (before - 2 * here + after) / 2,
        c3,
        c3 - xp.roll(c3, 1, axis=0),
        xp.roll(c3, -1, axis=0) - c3,
    )
    return SplineSegment(*(Vec2(field[:, 0], field[:, 1]) for field in coefficients))


def outward_normal(velocity: Vec2) -> tuple[Vec2, Scalar]:
    """Return the outward unit normal of a counterclockwise outline and the norm of `velocity`, m."""
    # Where the speed is zero, the normal is zero, and neither it nor its derivative is NaN.
    squared = velocity.dot(velocity)
    speed = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
    return Vec2(velocity.y / speed, -velocity.x / speed), speed
