"""Closest points of a closed cubic spline.

phi(u) = |x - p(u)|^2 / 2 and its slope are known at `SAMPLES` nodes a piece; between two nodes the cubic through them
has at most one minimum, to fourth order the spline's own. The two least of all minima are refined by Newton's method,
and the nearer one is taken, so that two nearly equal ones cannot be mistaken for each other. The refinement is outside
the derivative; one differentiable round of Halley's follows, third order, so that first and second derivatives are
right.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.shapes._base import Closest, Facing, Outline
from pushjax.shapes._pieces import Piece, normal_of
from pushjax.shapes._spline_sweep import first_contact

SAMPLES = 4
KNOT = 1e-3  # of a piece, how far past its end it still answers
# The cubic through two nodes is that good a start that each of these squares an error of less than a percent.
CLOSEST_ROUNDS = {False: 4, True: 6}  # by whether it is float64


class Minima(NamedTuple):
    """For each interval between two nodes: the local minimum of the distance in it, if there is one.

    position: in intervals from the first node; value: half the squared distance, and past all others where there is
    no minimum; facing: positive where the outline's outer side is seen.
    """

    position: Float[Array, "nodes"]
    value: Float[Array, "nodes"]
    real: Bool[Array, "nodes"]
    facing: Float[Array, "nodes"]

    def away_from(self, position: Scalar) -> Bool[Array, "nodes"]:
        """Those that are real, and not the one at `position`."""
        apart = jnp.abs(self.position - position)
        return self.real & (jnp.minimum(apart, self.value.size - apart) > 0.5)


class SplineOutline(Outline):
    """pieces: of the outline; node, velocity: points between two of which it hardly turns, and derivatives there by
    the number of the node; perimeter: in m."""

    pieces: Piece
    node: Vec2
    velocity: Vec2
    perimeter: Scalar
    convex: bool = eqx.field(static=True)

    def _minima(self, x: Vec2) -> Minima:
        rel = Vec2(x.x - self.node.x, x.y - self.node.y)
        value, slope, facing = rel.dot(rel) / 2, -rel.dot(self.velocity), rel.cross(self.velocity)
        value_end, slope_end, facing_end = (jnp.roll(field, -1) for field in (value, slope, facing))
        # the cubic's slope is slope + b t + c t^2; its minimum is the root where that rises
        rise = value_end - value
        b, c = 6 * rise - 4 * slope - 2 * slope_end, 3 * (slope + slope_end) - 6 * rise
        square = b * b - 4 * slope * c
        root = jnp.sqrt(jnp.maximum(square, 0))
        forward = b > 0
        top, bottom = jnp.where(forward, -2 * slope, root - b), jnp.where(forward, b + root, 2 * c)
        t = top / jnp.where(bottom > 0, bottom, jnp.inf)
        real = (square >= 0) & (bottom > 0) & (t >= -1e-3) & (t <= 1 + 1e-3)
        least = value + t * (slope + t * (b / 2 + t * (c / 3)))
        # to rounding there may be none: then the nearest node
        position = jnp.arange(value.size, dtype=value.dtype) + jnp.where(real, t, 0)
        return Minima(position, jnp.where(real, least, 2 * value), real, facing + t * (facing_end - facing))

    def _refined(self, x: Vec2, position: Scalar) -> tuple[Scalar, Piece, Scalar]:
        """From near a local minimum of the distance to it: the position, its piece, and where on the piece."""
        count = self.pieces.c0.x.size
        index = jnp.clip(jnp.floor(position / SAMPLES).astype(int), 0, count - 1)
        piece = self.pieces.chosen(index)
        fixed, x = jax.lax.stop_gradient((piece, x))
        begin = position / SAMPLES - index

        def round_(_, carry):
            t, low, high = carry
            point, first, second = fixed.at(t)
            rel = x - point
            pull = rel.dot(first)
            stiff = first.dot(first) - rel.dot(second)
            low, high = jnp.where(pull > 0, t, low), jnp.where(pull > 0, high, t)
            # where it is no minimum: half of an interval downhill
            step = pull / jnp.where(stiff > 0, stiff, jnp.abs(pull) * 2 * SAMPLES + jnp.finfo(t.dtype).tiny)
            there = t + step
            inside = ((there >= low) & (there <= high)) | (jnp.abs(step) < 1e-4)
            return jnp.where(inside, there, (low + high) / 2), low, high

        ends = begin - 1 / SAMPLES, begin + 1 / SAMPLES
        t, *_ = jax.lax.fori_loop(0, CLOSEST_ROUNDS[x.x.dtype == jnp.float64], round_, (begin, *ends))
        (t,) = settle((t,), x.x)
        return (index + t) * SAMPLES, piece, t

    def _nearest(self, x: Vec2) -> tuple[Minima, Scalar, Piece, Scalar]:
        fixed = jax.lax.stop_gradient(x)
        minima = jax.lax.stop_gradient(self._minima(fixed))
        first = minima.position[jnp.argmin(minima.value)]
        others = jnp.where(minima.away_from(first), minima.value, jnp.inf)
        chosen = jnp.argmin(others)
        rival = jnp.where(others[chosen] < jnp.inf, minima.position[chosen], first)
        one, other = self._refined(fixed, first), self._refined(fixed, rival)
        rel_one, rel_other = (fixed - piece.at(t)[0] for _, piece, t in (one, other))
        (nearer,) = settle((rel_other.dot(rel_other) < rel_one.dot(rel_one),), x.x)
        return minima, *select(nearer, other, one)

    def closest(self, x: Vec2) -> Closest:
        _, _, piece, t = self._nearest(x)
        return _seen(piece, t, x)

    def touches(self, x: Vec2) -> tuple[Closest, ...]:
        if self.convex:
            return (self.closest(x),)
        minima, position, piece, t = self._nearest(x)
        first = _seen(piece, t, x)
        others = minima.away_from(position) & (minima.facing > 0)
        chosen = jnp.argmin(jnp.where(others, minima.value, jnp.inf))
        _, piece, t = self._refined(x, minima.position[chosen])
        second = _seen(piece, t, x)
        (found,) = settle((jnp.any(others) & (second.distance > 0),), x.x)
        none = Closest(first.distance + self.perimeter, first.point, first.normal)
        return first, select(found, second, none)

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        return first_contact(self.pieces, x, path, radius, convex=self.convex)

    def facing(self, direction: Vec2) -> Facing:
        """One place a piece: the height over `direction` has a quadratic as slope, which falls through zero once."""
        c1, c2, c3 = (direction.dot(c) for c in (self.pieces.c1, self.pieces.c2, self.pieces.c3))
        a, b, c = jax.lax.stop_gradient((3 * c3, 2 * c2, c1))
        inside = b * b - 4 * a * c
        root = jnp.sqrt(jnp.maximum(inside, 0))
        low = b < 0  # of the two ways to write that root, the one that does not cancel
        top, bottom = jnp.where(low, -2 * c, b + root), jnp.where(low, b - root, -2 * a)
        t = top / jnp.where(bottom == 0, jnp.inf, bottom)
        # at a knot, rounding may put it past the end of both its pieces: better twice than never
        real = (inside > 0) & (bottom != 0) & (t >= -KNOT) & (t <= 1 + KNOT)
        t = jnp.where(real, t, 0.5)
        slope = c1 + t * (2 * c2 + 3 * t * c3)
        t = t + slope / jnp.where(real, root, 1.0)  # its derivatives
        point, velocity, _ = self.pieces.at(jnp.where(real, t, 0.5))
        # in a hollow a height is greatest where the outline faces the other way
        return Facing(point, real & (velocity.cross(direction) < 0))


def _seen(piece: Piece, t: Scalar, x: Vec2) -> Closest:
    """The boundary as seen from `x`, whose local minimum is at `t`; differentiable."""
    point, first, second = piece.at(t)
    rel = x - point
    pull, stiff = rel.dot(first), first.dot(first) - rel.dot(second)
    bend = rel.dot(piece.third(t)) - 3 * first.dot(second)
    # At a centre of curvature the nearest point has no derivative, and close to it only rounding would be magnified
    flat = jax.lax.stop_gradient(jnp.sqrt(jnp.finfo(pull.dtype).eps) * first.dot(first))
    stiff = jnp.where(jnp.abs(stiff) > flat, stiff, flat)
    newton = pull / stiff
    t = t + newton / (1 - jnp.clip(newton * bend / (2 * stiff), -1.0, 0.5))
    point, first, _ = piece.at(t)
    normal, _ = normal_of(first)
    return Closest(normal.dot(x - point), point, normal)
