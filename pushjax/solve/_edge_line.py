"""The wrenches between two cone edges, and where on the way from one to the other the motion fits both."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec3, settle
from pushjax.limit_surface import Form


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

    Each piece is monotone: Newton's method with a bracket, a fixed count of rounds.
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

    rounds = 8 if jnp.finfo(witness.dtype).bits <= 32 else 16
    levels = settle(tuple(value(mark) for mark in marks), witness)

    def body(_, state):
        new = []
        for (s, low, high), rising in zip(state, rise, strict=True):
            p = value(s)
            slope = (3 * c[3] * s + 2 * c[2]) * s + c[1]
            left = (p > 0) != rising  # the root lies above s
            low, high = jnp.where(left, s, low), jnp.where(left, high, s)
            newton = s - p / jnp.where(slope != 0, slope, 1.0)
            inside = (newton >= low) & (newton <= high) & (slope != 0)
            new.append((jnp.where(inside, newton, (low + high) / 2), low, high))
        return tuple(new)

    def start(low, high, p_low, p_high, rising):
        """As far from a point where the cubic is small as its derivatives there let the root be, to a factor of two:
        roots may lie a millionth of the interval from a turning point or from u = 0, where the cubic has its scale."""
        between = (low < 0) & (high > 0)
        p_zero = jnp.where(between, c[0], jnp.inf)
        at_low = jnp.abs(p_low) < jnp.abs(p_high)
        place, p = jnp.where(at_low, low, high), jnp.where(at_low, p_low, p_high)
        at_zero = jnp.abs(p_zero) < jnp.abs(p)
        place, p = jnp.where(at_zero, 0.0, place), jnp.where(at_zero, p_zero, p)
        first = (3 * c[3] * place + 2 * c[2]) * place + c[1]
        second = 3 * c[3] * place + c[2]
        ratios = [jnp.abs(p) / jnp.where(d != 0, jnp.abs(d), jnp.finfo(p.dtype).tiny) for d in (first, second, c[3])]
        reach = jnp.minimum(jnp.minimum(ratios[0], jnp.sqrt(ratios[1])), jnp.cbrt(ratios[2]))
        onward = (p > 0) != rising
        return jnp.clip(place + jnp.where(onward, reach, -reach), low, high)

    state, rise, has = [], [], []
    for k in range(3):
        low, high, p_low, p_high = marks[k], marks[k + 1], levels[k], levels[k + 1]
        has.append((p_low * p_high <= 0) & (high > low) & (p_low != p_high))
        rise.append(p_high > p_low)
        state.append((start(low, high, p_low, p_high, rise[k]), low, high))
    state = jax.lax.fori_loop(0, rounds, body, tuple(state))
    return tuple(settle((s, root), witness) for (s, _, _), root in zip(state, has, strict=True))
