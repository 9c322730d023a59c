"""Outline of a closed cubic spline: closest points, second contacts, and points with a given normal.

The query point is x, and p(u) is the outline's point at the parameter u. The function phi(u) = |x - p(u)|^2 / 2 and its
derivative are evaluated at `SAMPLES` nodes per segment. Between two nodes, the cubic through their values and
derivatives has at most one minimum, which equals phi's to fourth order. Newton's method refines the two least of
all minima, and the nearer one is taken, so that two nearly equal minima cannot be confused. JAX does not differentiate
the refinement. One differentiable iteration of Halley's method follows. It is of third order, so first and second
derivatives are right.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._internal.xla import compute_once, entry_at, tree_where
from pushjax._math.roots import Proposal, bracketed_root
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, FacingPoints, Outline

SAMPLES = 4  # nodes per segment
# How far past its ends a segment, or an interval between two nodes, accepts a root; as a fraction of its width.
END_TOLERANCE = 1e-3
# The cubic between two nodes gives an initial error of less than a percent, and each of these iterations squares it.
CLOSEST_ITERATIONS = {False: 4, True: 6}  # key: whether the type is float64


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
        over, under = xp.maximum(t - 1, 0), xp.maximum(-t, 0)  # how far t lies past the end, and before the start
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


class Minima(NamedTuple):
    """Local minima of phi, at most one for each interval between two nodes."""

    position: Float[Array, "nodes"]  # in intervals from the first node; without a minimum, the interval's first node
    # phi at the minimum, m^2; without one, twice phi at the interval's first node, which is above the least minimum
    value: Float[Array, "nodes"]
    valid: Bool[Array, "nodes"]  # whether the interval has a minimum
    outer_side: Float[Array, "nodes"]  # positive if the query point lies on the outer side of the outline

    def away_from(self, position: Scalar) -> Bool[Array, "nodes"]:
        """Return which minima are valid and are not the one at `position`."""
        apart = jnp.abs(self.position - position)
        return self.valid & (jnp.minimum(apart, self.value.size - apart) > 0.5)


class SplineOutline(Outline):
    """Outline of a closed cubic spline that runs counterclockwise."""

    segments: SplineSegment
    node: Vec2  # points at the nodes, m; the outline hardly turns between two of them
    velocity: Vec2  # derivatives of the outline's point with respect to the index of the node, m
    perimeter: Scalar  # m
    convex: bool = eqx.field(static=True)

    @property
    def is_convex(self) -> bool:
        return self.convex

    def _local_minima(self, x: Vec2) -> Minima:
        """Return the local minima of phi for the query point `x`, from the cubics between the nodes."""
        rel = Vec2(x.x - self.node.x, x.y - self.node.y)
        value, slope, outer_side = rel.dot(rel) / 2, -rel.dot(self.velocity), rel.cross(self.velocity)
        value_end, slope_end, outer_side_end = (jnp.roll(field, -1) for field in (value, slope, outer_side))
        # The slope of the cubic is slope + b t + c t^2. The minimum is the root at which this slope rises.
        rise = value_end - value
        b, c = 6 * rise - 4 * slope - 2 * slope_end, 3 * (slope + slope_end) - 6 * rise
        discriminant = b * b - 4 * slope * c
        root = jnp.sqrt(jnp.maximum(discriminant, 0))
        b_is_positive = b > 0
        numerator, denominator = (
            jnp.where(b_is_positive, -2 * slope, root - b),
            jnp.where(b_is_positive, b + root, 2 * c),
        )
        t = numerator / jnp.where(denominator > 0, denominator, jnp.inf)
        valid = (discriminant >= 0) & (denominator > 0) & (t >= -END_TOLERANCE) & (t <= 1 + END_TOLERANCE)
        least = value + t * (slope + t * (b / 2 + t * (c / 3)))
        # Roundoff can leave no minimum in any interval. Then the nearest node takes its place.
        position = jnp.arange(value.size, dtype=value.dtype) + jnp.where(valid, t, 0)
        return Minima(
            position, jnp.where(valid, least, 2 * value), valid, outer_side + t * (outer_side_end - outer_side)
        )

    def _refine(self, x: Vec2, position: Scalar) -> tuple[Scalar, SplineSegment, Scalar]:
        """Return the refined position of a local minimum, its segment (differentiable) and the parameter on it."""
        # Positions are in intervals from the first node. The parameter can lie a little past the segment's ends.
        count = self.segments.c0.x.size
        index = jnp.clip(jnp.floor(position / SAMPLES).astype(int), 0, count - 1)
        segment = entry_at(self.segments, index)
        fixed_segment, x = jax.lax.stop_gradient((segment, x))
        initial = position / SAMPLES - index

        def propose(t: Scalar) -> Proposal:
            point, first, second = fixed_segment.evaluate(t)
            rel = x - point
            descent = rel.dot(first)  # minus the first derivative of phi
            curvature = first.dot(first) - rel.dot(second)  # its second derivative
            # Where the curvature is not positive, the step is half an interval downhill.
            downhill = jnp.abs(descent) * 2 * SAMPLES + jnp.finfo(t.dtype).tiny
            step = descent / jnp.where(curvature > 0, curvature, downhill)
            return Proposal(descent > 0, t + step, usable=True, is_tiny=jnp.abs(step) < 1e-4)

        ends = initial - 1 / SAMPLES, initial + 1 / SAMPLES
        t = bracketed_root(propose, initial, *ends, CLOSEST_ITERATIONS[x.x.dtype == jnp.float64])
        t = compute_once(t, x.x)
        return (index + t) * SAMPLES, segment, t

    def _find_closest(self, x: Vec2) -> tuple[Minima, Scalar, SplineSegment, Scalar]:
        """Return all minima, and the position, the segment and the parameter of the closest point."""
        fixed = jax.lax.stop_gradient(x)
        minima = jax.lax.stop_gradient(self._local_minima(fixed))
        least = minima.position[jnp.argmin(minima.value)]
        other_values = jnp.where(minima.away_from(least), minima.value, jnp.inf)
        second = jnp.argmin(other_values)
        second_guess = jnp.where(other_values[second] < jnp.inf, minima.position[second], least)
        refined, refined_second = self._refine(fixed, least), self._refine(fixed, second_guess)
        offset, offset_second = (fixed - segment.evaluate(t)[0] for _, segment, t in (refined, refined_second))
        (nearer,) = compute_once((offset_second.dot(offset_second) < offset.dot(offset),), x.x)
        return minima, *tree_where(nearer, refined_second, refined)

    def closest(self, x: Vec2) -> ClosestPoint:
        _, _, segment, t = self._find_closest(x)
        return _closest_on_segment(segment, t, x)

    def contact_candidates(self, x: Vec2) -> tuple[ClosestPoint, ...]:
        if self.is_convex:
            return (self.closest(x),)
        minima, position, segment, t = self._find_closest(x)
        first = _closest_on_segment(segment, t, x)
        others = minima.away_from(position) & (minima.outer_side > 0)
        chosen = jnp.argmin(jnp.where(others, minima.value, jnp.inf))
        _, segment, t = self._refine(x, minima.position[chosen])
        second = _closest_on_segment(segment, t, x)
        (found,) = compute_once((jnp.any(others) & (second.distance > 0),), x.x)
        none = ClosestPoint(first.distance + self.perimeter, first.point, first.normal)
        return first, tree_where(found, second, none)

    def facing(self, direction: Vec2) -> FacingPoints:
        """Return the points on which a straight edge on the side of `direction` can rest; see `Outline.facing`."""
        # There is one candidate per segment. The slope of the height direction . p(t) is a quadratic on a segment, and
        # falls through zero at most once.
        c1, c2, c3 = (direction.dot(c) for c in (self.segments.c1, self.segments.c2, self.segments.c3))
        a, b, c = jax.lax.stop_gradient((3 * c3, 2 * c2, c1))
        discriminant = b * b - 4 * a * c
        root = jnp.sqrt(jnp.maximum(discriminant, 0))
        b_is_negative = b < 0  # the root has two forms; this selects the one without cancellation
        numerator, denominator = jnp.where(b_is_negative, -2 * c, b + root), jnp.where(b_is_negative, b - root, -2 * a)
        t = numerator / jnp.where(denominator == 0, jnp.inf, denominator)
        # Roundoff may put a root at a knot past the ends of both adjacent segments. Finding it twice is harmless;
        # missing it is not.
        valid = (discriminant > 0) & (denominator != 0) & (t >= -END_TOLERANCE) & (t <= 1 + END_TOLERANCE)
        t = jnp.where(valid, t, 0.5)
        slope = c1 + t * (2 * c2 + 3 * t * c3)
        t = t + slope / jnp.where(valid, root, 1.0)  # a Newton step that gives t its derivatives
        point, velocity, _ = self.segments.evaluate(jnp.where(valid, t, 0.5))
        # In a hollow, a maximum of the height is a point whose outward normal is -direction.
        return FacingPoints(point, valid & (velocity.cross(direction) < 0))


def _closest_on_segment(segment: SplineSegment, t: Scalar, x: Vec2) -> ClosestPoint:
    """Return distance, point and normal for the query point `x` and its local minimum `t`; differentiable."""
    point, first, second = segment.evaluate(t)
    rel = x - point
    # Minus the first derivative of phi, its second derivative, and minus its third.
    descent, curvature = rel.dot(first), first.dot(first) - rel.dot(second)
    minus_third = rel.dot(segment.third_derivative(t)) - 3 * first.dot(second)
    # At a center of curvature the closest point has no derivative. Close to one, the step would only magnify roundoff.
    least_curvature = jax.lax.stop_gradient(jnp.sqrt(jnp.finfo(descent.dtype).eps) * first.dot(first))
    curvature = jnp.where(jnp.abs(curvature) > least_curvature, curvature, least_curvature)
    newton = descent / curvature
    t = t + newton / (1 - jnp.clip(newton * minus_third / (2 * curvature), -1.0, 0.5))
    point, first, _ = segment.evaluate(t)
    # where the speed is zero, the normal is zero, and neither it nor its derivative is NaN
    squared = first.dot(first)
    speed = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
    normal = Vec2(first.y / speed, -first.x / speed)
    return ClosestPoint(normal.dot(x - point), point, normal)
