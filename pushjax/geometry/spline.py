"""Outline of a closed cubic spline: closest points, second contacts, and support points.

The function phi(u) = |x - p(u)|^2 / 2 and its slope are evaluated at `SAMPLES` nodes per segment. Between two nodes,
the cubic through their values and slopes has at most one minimum, which equals that of the spline to fourth order.
Newton's method refines the two least of all minima, and the nearer one is taken, so that two nearly equal minima cannot
be confused. The refinement is outside the derivative. One differentiable iteration of Halley's method follows. It is of
third order, so first and second derivatives are right.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.roots import Proposal, bracketed_root
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, FacingPoints, Outline
from pushjax.geometry.spline_segment import SplineSegment, outward_normal
from pushjax.geometry.spline_sweep import first_contact

SAMPLES = 4
KNOT_TOLERANCE = 1e-3  # how far past its ends a segment accepts a support point, as a fraction of the segment
# The cubic between two nodes gives an initial error of less than a percent, and each of these iterations squares it.
CLOSEST_ITERATIONS = {False: 4, True: 6}  # key: whether the type is float64


class Minima(NamedTuple):
    """Local minima of the distance to a query point, at most one for each interval between two nodes.

    Attributes:
        position: Position of the minimum, in intervals from the first node; if there is none, that of the node.
        value: Half the squared distance, m^2. If there is no minimum, the squared distance of the node, which is larger
            than the least minimum.
        valid: Whether the interval has a minimum.
        facing: Positive if the query point lies on the outer side of the outline.
    """

    position: Float[Array, "nodes"]
    value: Float[Array, "nodes"]
    valid: Bool[Array, "nodes"]
    facing: Float[Array, "nodes"]

    def away_from(self, position: Scalar) -> Bool[Array, "nodes"]:
        """Mask the minima that are valid and are not the one at `position`."""
        apart = jnp.abs(self.position - position)
        return self.valid & (jnp.minimum(apart, self.value.size - apart) > 0.5)


class SplineOutline(Outline):
    """Outline of a closed cubic spline that runs counterclockwise.

    Attributes:
        pieces: Array of all segments.
        node: Points at the nodes, m, `SAMPLES` per segment. The outline hardly turns between two of them.
        velocity: Derivatives of the outline's point at the nodes with respect to the index of the node, m.
        perimeter: Length of the outline, m.
        convex: Whether the outline is convex, so that a finger touches it in one place only.
    """

    pieces: SplineSegment
    node: Vec2
    velocity: Vec2
    perimeter: Scalar
    convex: bool = eqx.field(static=True)

    def _minima(self, x: Vec2) -> Minima:
        """Find the local minima of the distance to `x` from the cubics between the nodes."""
        rel = Vec2(x.x - self.node.x, x.y - self.node.y)
        value, slope, facing = rel.dot(rel) / 2, -rel.dot(self.velocity), rel.cross(self.velocity)
        value_end, slope_end, facing_end = (jnp.roll(field, -1) for field in (value, slope, facing))
        # The slope of the cubic is slope + b t + c t^2. The minimum is the root at which this slope rises.
        rise = value_end - value
        b, c = 6 * rise - 4 * slope - 2 * slope_end, 3 * (slope + slope_end) - 6 * rise
        square = b * b - 4 * slope * c
        root = jnp.sqrt(jnp.maximum(square, 0))
        forward = b > 0
        top, bottom = jnp.where(forward, -2 * slope, root - b), jnp.where(forward, b + root, 2 * c)
        t = top / jnp.where(bottom > 0, bottom, jnp.inf)
        valid = (square >= 0) & (bottom > 0) & (t >= -1e-3) & (t <= 1 + 1e-3)
        least = value + t * (slope + t * (b / 2 + t * (c / 3)))
        # Roundoff can leave no minimum in any interval. Then the nearest node takes its place.
        position = jnp.arange(value.size, dtype=value.dtype) + jnp.where(valid, t, 0)
        return Minima(position, jnp.where(valid, least, 2 * value), valid, facing + t * (facing_end - facing))

    def _refine(self, x: Vec2, position: Scalar) -> tuple[Scalar, SplineSegment, Scalar]:
        """Refine a local minimum of the distance to `x`, starting close to it.

        Args:
            x: Query point, m.
            position: Initial position, in intervals from the first node.

        Returns:
            A tuple of the refined position, its segment (differentiable), and the parameter on that segment.
        """
        count = self.pieces.c0.x.size
        index = jnp.clip(jnp.floor(position / SAMPLES).astype(int), 0, count - 1)
        piece = self.pieces.chosen(index)
        fixed, x = jax.lax.stop_gradient((piece, x))
        begin = position / SAMPLES - index

        def propose(t: Scalar) -> Proposal:
            point, first, second = fixed.at(t)
            rel = x - point
            descent = rel.dot(first)  # minus the first derivative of phi
            curvature = first.dot(first) - rel.dot(second)  # its second derivative
            # Where the curvature is not that of a minimum, the step is half an interval downhill.
            downhill = jnp.abs(descent) * 2 * SAMPLES + jnp.finfo(t.dtype).tiny
            step = descent / jnp.where(curvature > 0, curvature, downhill)
            return Proposal(descent > 0, t + step, usable=True, is_tiny=jnp.abs(step) < 1e-4)

        ends = begin - 1 / SAMPLES, begin + 1 / SAMPLES
        t = bracketed_root(propose, begin, *ends, CLOSEST_ITERATIONS[x.x.dtype == jnp.float64])
        t = compute_once(t, x.x)
        return (index + t) * SAMPLES, piece, t

    def _nearest(self, x: Vec2) -> tuple[Minima, Scalar, SplineSegment, Scalar]:
        """Return all minima, and the position, the segment and the parameter of the closest point."""
        fixed = jax.lax.stop_gradient(x)
        minima = jax.lax.stop_gradient(self._minima(fixed))
        first = minima.position[jnp.argmin(minima.value)]
        others = jnp.where(minima.away_from(first), minima.value, jnp.inf)
        chosen = jnp.argmin(others)
        second_guess = jnp.where(others[chosen] < jnp.inf, minima.position[chosen], first)
        one, other = self._refine(fixed, first), self._refine(fixed, second_guess)
        rel_one, rel_other = (fixed - piece.at(t)[0] for _, piece, t in (one, other))
        (nearer,) = decide((rel_other.dot(rel_other) < rel_one.dot(rel_one),), x.x)
        return minima, *tree_where(nearer, other, one)

    def closest(self, x: Vec2) -> ClosestPoint:
        _, _, piece, t = self._nearest(x)
        return _closest_on_segment(piece, t, x)

    def contact_candidates(self, x: Vec2) -> tuple[ClosestPoint, ...]:
        if self.convex:
            return (self.closest(x),)
        minima, position, piece, t = self._nearest(x)
        first = _closest_on_segment(piece, t, x)
        others = minima.away_from(position) & (minima.facing > 0)
        chosen = jnp.argmin(jnp.where(others, minima.value, jnp.inf))
        _, piece, t = self._refine(x, minima.position[chosen])
        second = _closest_on_segment(piece, t, x)
        (found,) = decide((jnp.any(others) & (second.distance > 0),), x.x)
        none = ClosestPoint(first.distance + self.perimeter, first.point, first.normal)
        return first, tree_where(found, second, none)

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        return first_contact(self.pieces, x, path, radius, convex=self.convex)

    def facing(self, direction: Vec2) -> FacingPoints:
        """Find the points on which a straight edge on the side of `direction` can rest; see `Outline.facing`.

        There is one candidate per segment. The slope of the height direction . p(t) is a quadratic on a segment, and
        falls through zero at most once.
        """
        c1, c2, c3 = (direction.dot(c) for c in (self.pieces.c1, self.pieces.c2, self.pieces.c3))
        a, b, c = jax.lax.stop_gradient((3 * c3, 2 * c2, c1))
        inside = b * b - 4 * a * c
        root = jnp.sqrt(jnp.maximum(inside, 0))
        low = b < 0  # the root has two forms; this selects the one without cancellation
        top, bottom = jnp.where(low, -2 * c, b + root), jnp.where(low, b - root, -2 * a)
        t = top / jnp.where(bottom == 0, jnp.inf, bottom)
        # Roundoff may put a root at a knot past the ends of both adjacent segments. Finding it twice is harmless;
        # missing it is not.
        valid = (inside > 0) & (bottom != 0) & (t >= -KNOT_TOLERANCE) & (t <= 1 + KNOT_TOLERANCE)
        t = jnp.where(valid, t, 0.5)
        slope = c1 + t * (2 * c2 + 3 * t * c3)
        t = t + slope / jnp.where(valid, root, 1.0)  # a Newton step that gives t its derivatives
        point, velocity, _ = self.pieces.at(jnp.where(valid, t, 0.5))
        # In a hollow, a maximum of the height is a point whose outward normal is -direction.
        return FacingPoints(point, valid & (velocity.cross(direction) < 0))


def _closest_on_segment(piece: SplineSegment, t: Scalar, x: Vec2) -> ClosestPoint:
    """Return distance, point and normal for the query point `x` and its local minimum `t`; differentiable."""
    point, first, second = piece.at(t)
    rel = x - point
    # Minus the first derivative of phi, its second derivative, and minus its third.
    descent, curvature = rel.dot(first), first.dot(first) - rel.dot(second)
    minus_third = rel.dot(piece.third(t)) - 3 * first.dot(second)
    # At a center of curvature the closest point has no derivative. Close to one, the step would only magnify roundoff.
    flat = jax.lax.stop_gradient(jnp.sqrt(jnp.finfo(descent.dtype).eps) * first.dot(first))
    curvature = jnp.where(jnp.abs(curvature) > flat, curvature, flat)
    newton = descent / curvature
    t = t + newton / (1 - jnp.clip(newton * minus_third / (2 * curvature), -1.0, 0.5))
    point, first, _ = piece.at(t)
    normal, _ = outward_normal(first)
    return ClosestPoint(normal.dot(x - point), point, normal)
