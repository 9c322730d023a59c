"""Degree two: the ellipsoid."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, concrete, finite, shaped
from pushjax._vec import Scalar, Vec3, settle
from pushjax.limit_surface._base import (
    InverseMap,
    LimitSurface,
    Symmetric3,
    angle_between,
    angle_tolerance,
    checked_length,
)
from pushjax.status import Status


class _EllipsoidFields(NamedTuple):
    a: Symmetric3
    length: Scalar


class EllipsoidForm(_EllipsoidFields):
    """H(F) = F' A F in scalars."""

    degree: ClassVar[int] = 2

    def scaled(self, factor: Scalar) -> "EllipsoidForm":
        return EllipsoidForm(Symmetric3(*(factor * entry for entry in self.a)), self.length)

    def gradient(self, f: Vec3) -> Vec3:
        return self.a.times(f).scale(2.0)

    def value(self, f: Vec3) -> Scalar:
        return f.dot(self.a.times(f))

    def spin(self, f: Vec3) -> Scalar:
        return 2 * (self.a.xz * f.x + self.a.yz * f.y + self.a.zz * f.z)

    def hessian(self, f: Vec3) -> Symmetric3:
        return Symmetric3(*(2 * entry for entry in self.a))

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        ga, gb = self.a.times(a), self.a.times(b)
        return a.dot(ga), 2 * b.dot(ga), b.dot(gb)


class Ellipsoid(LimitSurface):
    """H(F) = F' A F over the normalised wrench F = (fx, fy, tau / length).

    A: (3, 3), symmetric positive definite, 1/N^2. length: m.

    Raises ValueError for an A that is not finite, symmetric and positive definite, or a length that is not positive.
    """

    A: Float[Array, "3 3"]
    length: Float[Array, ""]
    degree: ClassVar[int] = 2

    def __init__(self, A: Numeric, length: Numeric):
        matrix = as_float(A)
        shaped("A", matrix, (3, 3))
        finite("A", matrix)
        known = concrete(matrix)
        if known is not None:
            if np.abs(known - known.T).max() > 1e-4 * np.abs(known).max():
                raise ValueError(f"A must be symmetric; A - A' reaches {np.abs(known - known.T).max():.3g}")
            lowest = np.linalg.eigvalsh((known + known.T).astype(np.float64) / 2)[0]
            if not lowest > 0:
                raise ValueError(f"A must be positive definite; its smallest eigenvalue is {lowest:.3g}")
        self.A = (matrix + matrix.T) / 2
        self.length = checked_length(length, matrix.dtype)

    def form(self) -> EllipsoidForm:
        m = self.A
        return EllipsoidForm(Symmetric3(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]), self.length)

    def is_convex(self) -> bool:
        return bool(np.linalg.eigvalsh(np.asarray(self.A, np.float64))[0] > 0)

    def inverse(self, twist: Numeric) -> InverseMap:
        """One linear solve, refined: the adjugate alone loses twice the digits that the condition number costs."""
        v, usable = self._normalized_twist(twist)
        form = self.form()
        f = settle(form.a.solve(v), v.x)
        for _ in range(2):
            more = form.a.solve(v - form.a.times(f))
            # one rounding of it: refined, judged and given
            f = settle(f + more, v.x)
        h = form.value(f)
        angle = angle_between(form.gradient(f), v)
        solved = usable & (h > 0) & (angle <= angle_tolerance(angle))
        scale = jnp.where(solved, 1 / jnp.sqrt(jnp.where(solved, h, 1.0)), 0.0)
        wrench = jnp.where(solved, jnp.stack([f.x, f.y, f.z * self.length]) * scale, 0.0)
        status = jnp.where(solved, Status.MOVING, Status.NOT_CONVERGED).astype(jnp.int8)
        return InverseMap(wrench, status, jnp.ones((), jnp.int32), angle)
