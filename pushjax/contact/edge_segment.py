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

ROUNDS = {4: 7, 8: 8}  # iterations of the search for a cubic's root, by bytes of the number


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
        first, last = form.gradient(center), form.gradient(along)
        if form.degree == 2:
            none = Vec3(*(0 * x for x in first))
            return WrenchSegment(center, along, nearest, (first, last, none, none))
        middle = form.hessian(center).times(along), form.hessian(along).times(center)
        return WrenchSegment(center, along, nearest, (first, *middle, last))

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
        For each of the three pieces, the piece and whether it has a root.
    """
    # turning points: the roots of c1 + 2 c2 u + 3 c3 u^2 = 0, in a form without cancellation
    discriminant = c[2] * c[2] - 3 * c[3] * c[1]
    turns = discriminant > 0
    q = -(c[2] + jnp.where(c[2] < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(turns, discriminant, 1.0)))
    t1 = jnp.where(turns & (c[3] != 0), q / jnp.where(c[3] != 0, 3 * c[3], 1.0), low)
    t2 = jnp.where(turns & (q != 0), c[1] / jnp.where(q != 0, q, 1.0), low)
    t1, t2 = jnp.clip(jnp.minimum(t1, t2), low, high), jnp.clip(jnp.maximum(t1, t2), low, high)
    marks = compute_once((low, t1, t2, high), c[0] + low)
    values = compute_once(tuple(_value(c, mark) for mark in marks), c[0] + low)
    found = []
    for k in range(3):
        piece = MonotoneInterval(marks[k], marks[k + 1], values[k], values[k + 1])
        a, b = piece.value_low, piece.value_high
        opposite = ((a <= 0) & (b >= 0)) | ((a >= 0) & (b <= 0))
        found.append((piece, opposite & (piece.high > piece.low) & (a != b)))
    return tuple(compute_once(found, c[0] + low))


def cubic_root(c: Cubic, piece: MonotoneInterval) -> Scalar:
    """Find the root of a cubic on a monotone piece.

    The method is Laguerre's with a bracket, in a fixed number of iterations. Newton's method is not used: from afar
    each step reduces the distance by a third only, and near two complex roots a step leads far away again.

    Args:
        c: Coefficients of the cubic, the constant first.
        piece: A piece that has a root.

    Returns:
        The root.
    """
    search = _Search.of(c, piece)
    return jax.lax.fori_loop(0, ROUNDS[search.s.dtype.itemsize], lambda _, search: search.next(c), search).s


def _value(c: Cubic, u: Scalar) -> Scalar:
    """The value of a cubic."""
    return ((c[3] * u + c[2]) * u + c[1]) * u + c[0]


class _Search(NamedTuple):
    """State of the bracketed search for a root of a cubic.

    Attributes:
        s: Estimate of the root, between `near` and `far`.
        near: One end of the bracket; at first `origin`.
        far: Other end of the bracket.
        origin: Where the search began: the point where the cubic is smallest, an end of the piece or zero.
        sign: Sign of the cubic at `far`.
    """

    s: Scalar
    near: Scalar
    far: Scalar
    origin: Scalar
    sign: Scalar

    @staticmethod
    def of(c: Cubic, piece: MonotoneInterval) -> "_Search":
        """Begin at the distance from `origin` that the cubic's derivatives there imply for the root.

        That distance is right to a factor of two. It is needed because roots may lie a millionth of the interval from a
        turning point or from u = 0, where the cubic has its scale.
        """
        low, high, p_low, p_high = piece
        between = (low < 0) & (high > 0)
        p_zero = jnp.where(between, c[0], jnp.inf)
        at_low = jnp.abs(p_low) < jnp.abs(p_high)
        place, p = jnp.where(at_low, low, high), jnp.where(at_low, p_low, p_high)
        at_zero = jnp.abs(p_zero) < jnp.abs(p)
        place, p = jnp.where(at_zero, 0.0, place), jnp.where(at_zero, p_zero, p)
        upward = (p > 0) != (p_high > p_low)  # the root lies above
        far, p_far = jnp.where(upward, high, low), jnp.where(upward, p_high, p_low)
        first = (3 * c[3] * place + 2 * c[2]) * place + c[1]
        second = 3 * c[3] * place + c[2]
        ratios = [jnp.abs(p) / jnp.where(d != 0, jnp.abs(d), jnp.finfo(p.dtype).tiny) for d in (first, second, c[3])]
        reach = jnp.minimum(jnp.minimum(ratios[0], jnp.sqrt(ratios[1])), _about_cbrt(ratios[2]))
        s = place + jnp.where(upward, 1.0, -1.0) * jnp.minimum(reach, jnp.abs(far - place))
        return _Search(*compute_once((s, place, far, place, jnp.where(p_far > 0, 1.0, -1.0)), c[0] + low))

    def next(self, c: Cubic) -> "_Search":
        """One iteration: a Laguerre step, or a bisection where the step leaves the bracket."""
        s = self.s
        p = _value(c, s)
        slope = (3 * c[3] * s + 2 * c[2]) * s + c[1]
        bend = 6 * c[3] * s + 2 * c[2]
        beyond = (p > 0) == (self.sign > 0)  # the root lies between near and s
        near, far = jnp.where(beyond, self.near, s), jnp.where(beyond, s, self.far)
        root = jnp.sqrt(jnp.maximum(4 * slope * slope - 6 * p * bend, 0))
        below = slope + jnp.where(slope < 0, -root, root)
        laguerre = s - 3 * p / jnp.where(below != 0, below, 1.0)
        inside = ((laguerre - near) * (laguerre - far) <= 0) & (below != 0)
        # the middle by order of magnitude: the geometric mean of the ends' distances from the origin
        a, b = near - self.origin, far - self.origin
        a = jnp.where(jnp.abs(a) > 1e-3 * jnp.abs(b), a, 1e-3 * b)
        middle = self.origin + jnp.where(b < 0, -1.0, 1.0) * jnp.sqrt(a * b)
        return _Search(jnp.where(inside, laguerre, middle), near, far, self.origin, self.sign)


def _about_cbrt(x: Scalar) -> Scalar:
    """The cube root of x >= 0 to 6 %, by a third of its exponent.

    An exact cube root takes as long as the iterations that follow.
    """
    bits = {4: jnp.int32, 8: jnp.int64}[x.dtype.itemsize]
    one, this = (jax.lax.bitcast_convert_type(v, bits) for v in (jnp.ones_like(x), x))
    three = jnp.full_like(this, 3)
    return jax.lax.bitcast_convert_type(jax.lax.div(this, three) + 2 * jax.lax.div(one, three), x.dtype)
