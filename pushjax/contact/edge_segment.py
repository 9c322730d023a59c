"""The segment of wrenches between two cone edges, and the points on it where the motion fits both edges.

Those points are the roots of a cubic, which this module brackets and finds.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once
from pushjax._math.vec import Scalar, Vec3
from pushjax.friction.limit_surface import Form

Cubic = tuple[Scalar, Scalar, Scalar, Scalar]  # coefficients, constant first

# Iterations of the search for a cubic's root, by the size of the floating-point type in bytes.
ITERATIONS = {4: 7, 8: 8}


class WrenchSegment(NamedTuple):
    """The wrenches between two generators, and grad H on them as a polynomial.

    The wrenches are (1 - s) g1 + s g2 = center + u along with u = s - nearest. They are written about the point nearest
    to zero: two fingers that press against each other leave a small wrench, and powers of g1 and g2 themselves would
    cancel.

    Attributes:
        center: The wrench nearest to zero.
        along: g2 - g1.
        nearest: s at the center.
        motions: Coefficients of grad H as a polynomial in u, the constant first.
    """

    center: Vec3
    along: Vec3
    nearest: Scalar
    motions: tuple[Vec3, Vec3, Vec3, Vec3]

    @staticmethod
    def between(form: Form, g1: Vec3, g2: Vec3) -> "WrenchSegment":
        """The segment between two generators."""
        along = g2 - g1
        squared = along.dot(along)
        nearest = jnp.clip(-g1.dot(along) / jnp.where(squared > 0, squared, 1.0), 0, 1)
        center = g1.scale(1 - nearest) + g2.scale(nearest)
        constant, leading = form.gradient(center), form.gradient(along)
        if form.degree == 2:
            zero_vector = Vec3(*(0 * x for x in constant))
            return WrenchSegment(center, along, nearest, (constant, leading, zero_vector, zero_vector))
        middle = form.hessian(center).times(along), form.hessian(along).times(center)
        return WrenchSegment(center, along, nearest, (constant, *middle, leading))

    def at(self, u: Scalar) -> Vec3:
        """The wrench at u."""
        return self.center + self.along.scale(u)

    def motion(self, u: Scalar) -> Vec3:
        """grad H at u."""
        m0, m1, m2, m3 = self.motions
        return m0 + (m1 + (m2 + m3.scale(u)).scale(u)).scale(u)


class MonotoneInterval(NamedTuple):
    """An interval between turning points of a cubic, where it is monotone.

    Attributes:
        low: Lower end.
        high: Upper end.
        value_low: Value of the cubic at the lower end.
        value_high: Value of the cubic at the upper end.
    """

    low: Scalar
    high: Scalar
    value_low: Scalar
    value_high: Scalar


def monotone_intervals(c: Cubic, low: Scalar, high: Scalar) -> tuple[tuple[MonotoneInterval, Bool[Array, ""]], ...]:
    """Split [low, high] into the three intervals where c0 + c1 u + c2 u^2 + c3 u^3 is monotone.

    Args:
        c: Coefficients of the cubic, the constant first.
        low: Lower end of the interval.
        high: Upper end of the interval.

    Returns:
        The three intervals, some of which may be empty, each with whether the cubic has a root in it.
    """
    # turning points: the roots of c1 + 2 c2 u + 3 c3 u^2 = 0, in a form without cancellation
    discriminant = c[2] * c[2] - 3 * c[3] * c[1]
    has_turns = discriminant > 0
    q = -(c[2] + jnp.where(c[2] < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(has_turns, discriminant, 1.0)))
    turn1 = jnp.where(has_turns & (c[3] != 0), q / jnp.where(c[3] != 0, 3 * c[3], 1.0), low)
    turn2 = jnp.where(has_turns & (q != 0), c[1] / jnp.where(q != 0, q, 1.0), low)
    turn1, turn2 = jnp.clip(jnp.minimum(turn1, turn2), low, high), jnp.clip(jnp.maximum(turn1, turn2), low, high)
    ends = compute_once((low, turn1, turn2, high), c[0] + low)
    values = compute_once(tuple(_cubic_value(c, end) for end in ends), c[0] + low)
    intervals = []
    for k in range(3):
        interval = MonotoneInterval(ends[k], ends[k + 1], values[k], values[k + 1])
        value_low, value_high = interval.value_low, interval.value_high
        changes_sign = ((value_low <= 0) & (value_high >= 0)) | ((value_low >= 0) & (value_high <= 0))
        intervals.append((interval, changes_sign & (interval.high > interval.low) & (value_low != value_high)))
    return tuple(compute_once(intervals, c[0] + low))


def cubic_root(c: Cubic, interval: MonotoneInterval) -> Scalar:
    """Find the root of a cubic in an interval where it is monotone.

    The method is Laguerre's with a bracket, in a fixed number of iterations. Newton's method is not used: from afar
    each step reduces the distance by a third only, and near two complex roots a step leads far away again.

    Args:
        c: Coefficients of the cubic, the constant first.
        interval: An interval that has a root.

    Returns:
        The root.
    """
    search = _Search.of(c, interval)
    return jax.lax.fori_loop(0, ITERATIONS[search.s.dtype.itemsize], lambda _, search: search.next(c), search).s


def _cubic_value(c: Cubic, u: Scalar) -> Scalar:
    """The value of a cubic."""
    return ((c[3] * u + c[2]) * u + c[1]) * u + c[0]


class _Search(NamedTuple):
    """State of the bracketed search for a root of a cubic.

    Attributes:
        s: Estimate of the root, a value of the cubic's variable u between `near` and `far`.
        near: One end of the bracket; at first `origin`.
        far: Other end of the bracket.
        origin: Where the search began: the point where the cubic is smallest, an end of the interval or zero.
        sign: Sign of the cubic at `far`.
    """

    s: Scalar
    near: Scalar
    far: Scalar
    origin: Scalar
    sign: Scalar

    @staticmethod
    def of(c: Cubic, interval: MonotoneInterval) -> "_Search":
        """Begin at the distance from `origin` that the cubic's derivatives there imply for the root.

        That distance is right to a factor of two. It is needed because roots may lie a millionth of the interval from a
        turning point or from u = 0, where the cubic has its scale.
        """
        low, high, value_low, value_high = interval
        contains_zero = (low < 0) & (high > 0)
        value_zero = jnp.where(contains_zero, c[0], jnp.inf)
        at_low = jnp.abs(value_low) < jnp.abs(value_high)
        origin, value = jnp.where(at_low, low, high), jnp.where(at_low, value_low, value_high)
        at_zero = jnp.abs(value_zero) < jnp.abs(value)
        origin, value = jnp.where(at_zero, 0.0, origin), jnp.where(at_zero, value_zero, value)
        root_above = (value > 0) != (value_high > value_low)
        far, value_far = jnp.where(root_above, high, low), jnp.where(root_above, value_high, value_low)
        slope = (3 * c[3] * origin + 2 * c[2]) * origin + c[1]
        half_curvature = 3 * c[3] * origin + c[2]
        ratios = [
            jnp.abs(value) / jnp.where(d != 0, jnp.abs(d), jnp.finfo(value.dtype).tiny)
            for d in (slope, half_curvature, c[3])
        ]
        distance = jnp.minimum(jnp.minimum(ratios[0], jnp.sqrt(ratios[1])), _approximate_cbrt(ratios[2]))
        s = origin + jnp.where(root_above, 1.0, -1.0) * jnp.minimum(distance, jnp.abs(far - origin))
        return _Search(*compute_once((s, origin, far, origin, jnp.where(value_far > 0, 1.0, -1.0)), c[0] + low))

    def next(self, c: Cubic) -> "_Search":
        """One iteration: a Laguerre step, or a bisection where the step leaves the bracket."""
        s = self.s
        value = _cubic_value(c, s)
        slope = (3 * c[3] * s + 2 * c[2]) * s + c[1]
        curvature = 6 * c[3] * s + 2 * c[2]
        root_before_s = (value > 0) == (self.sign > 0)  # the root lies between near and s
        near, far = jnp.where(root_before_s, self.near, s), jnp.where(root_before_s, s, self.far)
        square_root = jnp.sqrt(jnp.maximum(4 * slope * slope - 6 * value * curvature, 0))
        denominator = slope + jnp.where(slope < 0, -square_root, square_root)
        laguerre = s - 3 * value / jnp.where(denominator != 0, denominator, 1.0)
        inside = ((laguerre - near) * (laguerre - far) <= 0) & (denominator != 0)
        # the middle by order of magnitude: the geometric mean of the ends' distances from the origin
        near_distance, far_distance = near - self.origin, far - self.origin
        near_distance = jnp.where(
            jnp.abs(near_distance) > 1e-3 * jnp.abs(far_distance), near_distance, 1e-3 * far_distance
        )
        middle = self.origin + jnp.where(far_distance < 0, -1.0, 1.0) * jnp.sqrt(near_distance * far_distance)
        return _Search(jnp.where(inside, laguerre, middle), near, far, self.origin, self.sign)


def _approximate_cbrt(x: Scalar) -> Scalar:
    """The cube root of x >= 0 with an error of at most 6 %, by dividing its exponent by three.

    An exact cube root takes as long as the iterations that follow.
    """
    bits = {4: jnp.int32, 8: jnp.int64}[x.dtype.itemsize]
    one, number = (jax.lax.bitcast_convert_type(v, bits) for v in (jnp.ones_like(x), x))
    three = jnp.full_like(number, 3)
    return jax.lax.bitcast_convert_type(jax.lax.div(number, three) + 2 * jax.lax.div(one, three), x.dtype)
