"""The wrenches between two cone edges, and where on the way from one to the other the motion fits both."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec3, settle
from pushjax.limit_surface import Form

Cubic = tuple[Scalar, Scalar, Scalar, Scalar]  # coefficients, the constant first

ROUNDS = {4: 7, 8: 8}  # of the search for a cubic's root


class Line(NamedTuple):
    """The wrenches (1 - s) g1 + s g2 = center + u along, u = s - nearest, and grad H on them, a polynomial in u.

    Written about the point nearest to zero: two fingers that press against each other leave a small wrench, and powers
    of g1 and g2 themselves would cancel.
    """

    center: Vec3
    along: Vec3
    nearest: Scalar
    motions: tuple[Vec3, Vec3, Vec3, Vec3]

    @staticmethod
    def between(form: Form, g1: Vec3, g2: Vec3) -> "Line":
        along = g2 - g1
        squared = along.dot(along)
        nearest = jnp.clip(-g1.dot(along) / jnp.where(squared > 0, squared, 1.0), 0, 1)
        center = g1.scale(1 - nearest) + g2.scale(nearest)
        first, last = form.gradient(center), form.gradient(along)
        if form.degree == 2:
            none = Vec3(*(0 * x for x in first))
            return Line(center, along, nearest, (first, last, none, none))
        middle = form.hessian(center).times(along), form.hessian(along).times(center)
        return Line(center, along, nearest, (first, *middle, last))

    def at(self, u: Scalar) -> Vec3:
        return self.center + self.along.scale(u)

    def motion(self, u: Scalar) -> Vec3:
        m0, m1, m2, m3 = self.motions
        return m0 + (m1 + (m2 + m3.scale(u)).scale(u)).scale(u)


class Piece(NamedTuple):
    """A stretch of a cubic between turning points, where it is monotone. value_low, value_high: of the cubic."""

    low: Scalar
    high: Scalar
    value_low: Scalar
    value_high: Scalar


def pieces(c: Cubic, low: Scalar, high: Scalar) -> tuple[tuple[Piece, Bool[Array, ""]], ...]:
    """The three pieces in [low, high] of c0 + c1 u + c2 u^2 + c3 u^3, and whether each has a root."""
    # c1 + 2 c2 u + 3 c3 u^2 = 0, written so as not to cancel
    disc = c[2] * c[2] - 3 * c[3] * c[1]
    turns = disc > 0
    q = -(c[2] + jnp.where(c[2] < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(turns, disc, 1.0)))
    t1 = jnp.where(turns & (c[3] != 0), q / jnp.where(c[3] != 0, 3 * c[3], 1.0), low)
    t2 = jnp.where(turns & (q != 0), c[1] / jnp.where(q != 0, q, 1.0), low)
    t1, t2 = jnp.clip(jnp.minimum(t1, t2), low, high), jnp.clip(jnp.maximum(t1, t2), low, high)
    marks = settle((low, t1, t2, high), c[0] + low)
    values = settle(tuple(_value(c, mark) for mark in marks), c[0] + low)
    found = []
    for k in range(3):
        piece = Piece(marks[k], marks[k + 1], values[k], values[k + 1])
        a, b = piece.value_low, piece.value_high
        opposite = ((a <= 0) & (b >= 0)) | ((a >= 0) & (b <= 0))
        found.append((piece, opposite & (piece.high > piece.low) & (a != b)))
    return tuple(settle(found, c[0] + low))


def root(c: Cubic, piece: Piece) -> Scalar:
    """Its root: Laguerre's method with a bracket, a fixed count of rounds. Newton's comes by thirds from afar and is
    thrown out again where two complex roots are near."""
    search = _Search.of(c, piece)
    return jax.lax.fori_loop(0, ROUNDS[search.s.dtype.itemsize], lambda _, search: search.next(c), search).s


def _value(c: Cubic, u: Scalar) -> Scalar:
    return ((c[3] * u + c[2]) * u + c[1]) * u + c[0]


class _Search(NamedTuple):
    """A root of a cubic, bracketed: s, between near and far. near: at first where the cubic is small, an end or zero.

    sign: of the cubic at `far`.
    """

    s: Scalar
    near: Scalar
    far: Scalar
    origin: Scalar
    sign: Scalar

    @staticmethod
    def of(c: Cubic, piece: Piece) -> "_Search":
        """Begins as far from where the cubic is small as its derivatives there let the root be, to a factor of two:
        roots may lie a millionth of the interval from a turning point or from u = 0, where the cubic has its scale."""
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
        return _Search(*settle((s, place, far, place, jnp.where(p_far > 0, 1.0, -1.0)), c[0] + low))

    def next(self, c: Cubic) -> "_Search":
        s = self.s
        p = _value(c, s)
        slope = (3 * c[3] * s + 2 * c[2]) * s + c[1]
        bend = 6 * c[3] * s + 2 * c[2]
        beyond = (p > 0) == (self.sign > 0)  # the root lies nearer
        near, far = jnp.where(beyond, self.near, s), jnp.where(beyond, s, self.far)
        root = jnp.sqrt(jnp.maximum(4 * slope * slope - 6 * p * bend, 0))
        below = slope + jnp.where(slope < 0, -root, root)
        laguerre = s - 3 * p / jnp.where(below != 0, below, 1.0)
        inside = ((laguerre - near) * (laguerre - far) <= 0) & (below != 0)
        # else the middle, by order of magnitude
        a, b = near - self.origin, far - self.origin
        a = jnp.where(jnp.abs(a) > 1e-3 * jnp.abs(b), a, 1e-3 * b)
        middle = self.origin + jnp.where(b < 0, -1.0, 1.0) * jnp.sqrt(a * b)
        return _Search(jnp.where(inside, laguerre, middle), near, far, self.origin, self.sign)


def _about_cbrt(x: Scalar) -> Scalar:
    """The cube root of x >= 0 to 6 %: a third of its exponent. An exact one takes as long as the rounds that follow."""
    bits = {4: jnp.int32, 8: jnp.int64}[x.dtype.itemsize]
    one, this = (jax.lax.bitcast_convert_type(v, bits) for v in (jnp.ones_like(x), x))
    three = jnp.full_like(this, 3)
    return jax.lax.bitcast_convert_type(jax.lax.div(this, three) + 2 * jax.lax.div(one, three), x.dtype)
