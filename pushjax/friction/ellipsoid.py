"""The limit surface of degree two: the ellipsoid."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pushjax._internal.checks import ArrayLike, checked_array, concrete, in_numpy
from pushjax._internal.xla import compute_once
from pushjax._math.linalg import Symmetric3
from pushjax._math.vec import Scalar, Vec3
from pushjax.friction.limit_surface import LimitSurface


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

    def hessian(self, f: Vec3) -> Symmetric3:
        return Symmetric3(*(2 * entry for entry in self.a))

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        product_a, product_b = self.a.times(a), self.a.times(b)
        return a.dot(product_a), 2 * b.dot(product_a), b.dot(product_b)


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
        matrix = checked_array("A", A, (3, 3))
        known = concrete(matrix)
        if known is not None:
            if np.abs(known - known.T).max() > 1e-4 * np.abs(known).max():
                raise ValueError(f"A must be symmetric; A - A' reaches {np.abs(known - known.T).max():.3g}")
            lowest = np.linalg.eigvalsh((known + known.T).astype(np.float64) / 2)[0]
            if not lowest > 0:
                raise ValueError(f"A must be positive definite; its smallest eigenvalue is {lowest:.3g}")
        self.A = in_numpy(lambda xp, matrix: (matrix + matrix.T) / 2)(matrix)
        self.length = checked_array("length", length, (), matrix.dtype, positive=True)

    def form(self) -> EllipsoidForm:
        m = self.A
        return EllipsoidForm(Symmetric3(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]), self.length)

    def is_convex(self) -> bool:
        return bool(np.linalg.eigvalsh(np.asarray(self.A, np.float64))[0] > 0)

    def _aligned_wrench(self, v: Vec3) -> tuple[Vec3, Int[Array, ""]]:
        """Solve A F = v, and refine the solution twice."""
        # Refinement is needed because the solve uses the adjugate. By itself it loses twice as many digits as the
        # condition number implies.
        form = self.form()
        f = compute_once(form.a.solve(v), v.x)
        for _ in range(2):
            correction = form.a.solve(v - form.a.times(f))
            # Round it only once, so that the refinement, the check and the result use the same bits.
            f = compute_once(f + correction, v.x)
        return f, jnp.ones((), jnp.int32)
