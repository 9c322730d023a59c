"""The wrenches between two cone edges, and where on the way from one to the other the motion fits both."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec3, settle
from pushjax.limit_surface import Form

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


def roots(
    c: tuple[Scalar, Scalar, Scalar, Scalar], low: Scalar, high: Scalar
) -> tuple[tuple[Scalar, Bool[Array, ""]], ...]:
    """Roots of c0 + c1 u + c2 u^2 + c3 u^3 in [low, high]: one from each piece between turning points, if it has one.

    Each piece is monotone: Laguerre's method with a bracket, a fixed count of rounds. Newton's comes by thirds from
    afar and is thrown out again where two complex roots are near.
    """
    # c1 + 2 c2 u + 3 c3 u^2 = 0, written so as not to cancel
    disc = c[2] * c[2] - 3 * c[3] * c[1]
    turns = disc > 0
    q = -(c[2] + jnp.where(c[2] < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(turns, disc, 1.0)))
    t1 = jnp.where(turns & (c[3] != 0), q / jnp.where(c[3] != 0, 3 * c[3], 1.0), low)
    t2 = jnp.where(turns & (q != 0), c[1] / jnp.where(q != 0, q, 1.0), low)
    t1, t2 = jnp.clip(jnp.minimum(t1, t2), low, high), jnp.clip(jnp.maximum(t1, t2), low, high)
    witness = c[0] + low
    c, marks = settle((c, (low, t1, t2, high)), witness)

    def value(s):
        return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]

    rounds = ROUNDS[witness.dtype.itemsize]
    levels = settle(tuple(value(mark) for mark in marks), witness)

    def body(_, pieces):
        return tuple(piece.next(c, value) for piece in pieces)

    pieces, has = [], []
    for k in range(3):
        low, high, p_low, p_high = marks[k], marks[k + 1], levels[k], levels[k + 1]
        opposite = ((p_low <= 0) & (p_high >= 0)) | ((p_low >= 0) & (p_high <= 0))
        has.append(opposite & (high > low) & (p_low != p_high))
        pieces.append(_Piece.of(c, low, high, p_low, p_high))
    pieces = jax.lax.fori_loop(0, rounds, body, tuple(pieces))
    return tuple(settle((piece.s, root), witness) for piece, root in zip(pieces, has, strict=True))


class _Piece(NamedTuple):
    """A root of a cubic, bracketed: s, between near and far. near: at first where the cubic is small, an end or zero.

    sign: of the cubic at `far`.
    """

    s: Scalar
    near: Scalar
    far: Scalar
    origin: Scalar
    sign: Scalar

    @staticmethod
    def of(c: tuple, low: Scalar, high: Scalar, p_low: Scalar, p_high: Scalar) -> "_Piece":
        """Begins as far from where the cubic is small as its derivatives there let the root be, to a factor of two:
        roots may lie a millionth of the interval from a turning point or from u = 0, where the cubic has its scale."""
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
        reach = jnp.minimum(jnp.minimum(ratios[0], jnp.sqrt(ratios[1])), jnp.cbrt(ratios[2]))
        s = place + jnp.where(upward, 1.0, -1.0) * jnp.minimum(reach, jnp.abs(far - place))
        return _Piece(*settle((s, place, far, place, jnp.where(p_far > 0, 1.0, -1.0)), c[0] + low))

    def next(self, c: tuple, value) -> "_Piece":
        s = self.s
        p = value(s)
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
        return _Piece(jnp.where(inside, laguerre, middle), near, far, self.origin, self.sign)
