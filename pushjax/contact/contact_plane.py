"""One contact in its contact plane, where the limit surface reduces to a curve.

J maps a twist of the slider to the motion of the contact point. Its transpose J' maps a contact force to its wrench.
The wrenches that one contact can apply, F = J'(f_n n + f_t t), form a plane. On it H becomes the binary form
h(f_n, f_t) = H(J'(f_n n + f_t t)), convex and homogeneous of the same degree d. The contact point of the slider moves,
in (n, t), along grad h. So a single contact is a limit curve h = 1 in the plane of contact forces, whatever the limit
surface: a force f moves the contact point along the curve's normal at f.

Along the friction cone let f = (1, s) and h(s) = h(1, s). Then the motion is (d h - s h', h'). Its angle
phi(s) = atan2(h', d h - s h') stays within 90 degrees of the angle of f, because f . grad h = d h > 0. By convexity the
angle increases with s:

    (d h - s h') h'' - h' (d h - s h')' = d h h'' - (d - 1) h'^2 >= 0.

Let v be a pushing motion with v_n > 0. Beyond phi(mu) the pusher slides left, and beyond phi(-mu) it slides right.
Between them it sticks, at the s with phi(s) = phi_v. The edge of the motion cone may open beyond 90 degrees from the
normal; then no push slides past that edge. Hence the pusher slides left if and only if, at s = mu,

    motion_n > 0  and  cross(motion, v) > 0.

The condition for right is its mirror image. Neither needs an arctangent. (Zhou et al. 2017, section IV.A, tests the
cross product only.)
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.friction.limit_surface import Form


class Contact(NamedTuple):
    """One contact in the body frame, in scalars; or several, as arrays with one axis."""

    point: Vec2  # m
    normal: Vec2  # of unit length, into the slider
    displacement: Vec2  # of the pusher's material point over the step, m
    friction: Scalar  # coefficient mu
    gap: Scalar  # distance still to close along the normal, m

    def where(self, condition: Bool[Array, ""]) -> "Contact":
        """Return this contact where the condition holds, else a contact out of reach whose numbers are constants."""
        # Call this before anything is computed from the numbers: a NaN that is only masked afterwards comes back in the
        # gradient.
        zero, one = jnp.zeros_like(self.gap), jnp.ones_like(self.gap)
        zero_vector = Vec2(zero, zero)
        return tree_where(condition, self, Contact(zero_vector, Vec2(one, zero), zero_vector, zero, one))

    def approach(self) -> Vec2:
        """Displacement (n, t) of the slider's contact point that keeps it with the pusher, m."""
        normal, tangent = self.normal, self.normal.perp()
        return Vec2(self.displacement.dot(normal) - self.gap, self.displacement.dot(tangent))

    def wrench(self, force: Vec2, length: Scalar) -> Vec3:
        """The normalized wrench (fx, fy, tau / length) of a contact force along (normal, tangent)."""
        f = self.normal.scale(force.x) + self.normal.perp().scale(force.y)
        return Vec3(f.x, f.y, self.point.cross(f) / length)


class LimitCurve(NamedTuple):
    """h along the friction cone, h(s) = sum_k c_k s^k."""

    c: tuple[Scalar, ...]  # the d + 1 coefficients c_k

    @staticmethod
    def of(form: Form, contact: Contact) -> "LimitCurve":
        """The limit curve of a contact, of the same degree as H."""
        one, zero = jnp.ones_like(contact.gap), jnp.zeros_like(contact.gap)
        along_normal = contact.wrench(Vec2(one, zero), form.length)
        along_tangent = contact.wrench(Vec2(zero, one), form.length)
        return LimitCurve(form.restrict(along_normal, along_tangent))

    @property
    def degree(self) -> int:
        """The degree d."""
        return len(self.c) - 1

    def motion(self, s: Scalar) -> Vec2:
        """grad h at (1, s), the motion of the contact point in (n, t): two polynomials of degree d - 1."""
        return Vec2(_horner(by_normal(self.c), s), _horner(by_tangential(self.c), s))

    def second_derivative(self, s: Scalar) -> Scalar:
        """h''(s)."""
        return _horner([k * (k - 1) * c for k, c in enumerate(self.c)][2:], s)

    def value(self, s: Scalar) -> Scalar:
        """h(s)."""
        return _horner(self.c, s)


def by_normal(c: Sequence[Scalar]) -> list[Scalar]:
    """The derivative by f_n of the form sum_k c_k f_n^(d - k) f_t^k, a form of degree d - 1."""
    return [(len(c) - 1 - k) * each for k, each in enumerate(c[:-1])]


def by_tangential(c: Sequence[Scalar]) -> list[Scalar]:
    """The derivative by f_t of the form sum_k c_k f_n^(d - k) f_t^k."""
    return [k * each for k, each in enumerate(c)][1:]


def _horner(coefficients, s: Scalar) -> Scalar:
    """The value of a polynomial, its coefficients given with the constant first."""
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * s + c
    return total
