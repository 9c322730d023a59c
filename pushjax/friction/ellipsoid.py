"""The limit surface of degree two: the ellipsoid."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_finite, check_shape, concrete, in_numpy
from pushjax._internal.xla import compute_once
from pushjax._math.linalg import Symmetric3
from pushjax._math.vec import Scalar, Vec3
from pushjax.friction.limit_surface import InverseMap, LimitSurface, angle_between, angle_tolerance, checked_length


class EllipsoidForm(NamedTuple):
    """The `Form` of an ellipsoid: H(F) = F' A F."""

    a: Symmetric3  # A, 1/N^2
    length: Scalar  # m

    degree = 2

    def table(self) -> Float[Array, "6 1"]:
        return 2 * jnp.stack(self.a)[:, None]

    def gradient(self, f: Vec3) -> Vec3:
        return self.a.times(f).scale(2.0)

    def value(self, f: Vec3) -> Scalar:
        return f.dot(self.a.times(f))

    def spin(self, f: Vec3) -> Scalar:
        return 2 * (self.a.xz * f.x + self.a.yz * f.y + self.a.zz * f.z)

    def hessian(self, f: Vec3) -> Symmetric3:
        return Symmetric3(*(2 * entry for entry in self.a))

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        product_a, product_b = self.a.times(a), self.a.times(b)
        return a.dot(product_a), 2 * b.dot(product_a), b.dot(product_b)


@in_numpy
def _symmetric_part(xp, matrix: Array) -> Array:
    return (matrix + matrix.T) / 2


class Ellipsoid(LimitSurface):
    """The limit surface of H(F) = F' A F, with the normalized wrench F = (fx, fy, tau / length).

    Attributes:
        A: Symmetric positive definite matrix, shape (3, 3), 1/N^2.
        length: Characteristic length, m.

    Raises:
        ValueError: If `A` is not finite, symmetric and positive definite, or `length` is not positive.
    """

    A: Float[Array, "3 3"]
    length: Float[Array, ""]
    degree: ClassVar[int] = 2

    def __init__(self, A: ArrayLike, length: ArrayLike):
        matrix = as_float(A, name="A")
        check_shape("A", matrix, (3, 3))
        check_finite("A", matrix)
        known = concrete(matrix)
        if known is not None:
            if np.abs(known - known.T).max() > 1e-4 * np.abs(known).max():
                raise ValueError(f"A must be symmetric; A - A' reaches {np.abs(known - known.T).max():.3g}")
            lowest = np.linalg.eigvalsh((known + known.T).astype(np.float64) / 2)[0]
            if not lowest > 0:
                raise ValueError(f"A must be positive definite; its smallest eigenvalue is {lowest:.3g}")
        self.A = _symmetric_part(matrix)
        self.length = checked_length(length, matrix.dtype)

    def form(self) -> EllipsoidForm:
        m = self.A
        return EllipsoidForm(Symmetric3(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]), self.length)

    def is_convex(self) -> bool:
        return bool(np.linalg.eigvalsh(np.asarray(self.A, np.float64))[0] > 0)

    def inverse(self, twist: ArrayLike) -> InverseMap:
        """Solve A F = V, and refine the solution twice; see `LimitSurface.inverse`."""
        # Refinement is needed because the solve uses the adjugate. By itself it loses twice as many digits as the
        # condition number implies.
        v, usable = self._normalized_twist(twist)
        form = self.form()
        f = compute_once(form.a.solve(v), v.x)
        for _ in range(2):
            correction = form.a.solve(v - form.a.times(f))
            # Round it only once, so that the refinement, the check and the result use the same bits.
            f = compute_once(f + correction, v.x)
        h = form.value(f)
        angle = angle_between(form.gradient(f), v)
        converged = usable & (h > 0) & (angle <= angle_tolerance(angle))
        scale = jnp.where(converged, 1 / jnp.sqrt(jnp.where(converged, h, 1.0)), 0.0)
        wrench = jnp.where(converged, jnp.stack([f.x, f.y, f.z * self.length]) * scale, 0.0)
        return InverseMap(wrench, converged, jnp.ones((), jnp.int32), angle)
