"""The limit surface of degree four: the convex quartic."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pushjax._internal.checks import ArrayLike, checked_array, concrete
from pushjax._internal.xla import compute_once
from pushjax._math.arrays import ENTRIES
from pushjax._math.directions import fibonacci_hemisphere
from pushjax._math.linalg import Symmetric3
from pushjax._math.vec import Scalar, Vec3, unstack
from pushjax.friction.limit_surface import LimitSurface

# Exponents of (x, y, z) = (fx, fy, tau / length), in the order of the coefficients.
MONOMIALS = np.array(
    [
        (4, 0, 0), (0, 4, 0), (0, 0, 4), (3, 1, 0), (3, 0, 1), (1, 3, 0), (0, 3, 1), (1, 0, 3), (0, 1, 3),
        (2, 2, 0), (2, 0, 2), (0, 2, 2), (2, 1, 1), (1, 2, 1), (1, 1, 2),
    ]
)  # fmt: skip

# For each entry of the Hessian and each product of two components of F, both in the order of `ENTRIES`: the number of
# the coefficient, and its factor.
HESSIAN_TERMS = [
    [
        (int(np.flatnonzero((MONOMIALS == exponents).all(axis=1))[0]), float(exponents[i] * (exponents[j] - (i == j))))
        for exponents in (np.bincount((i, j, *product), minlength=3) for product in ENTRIES)
    ]
    for i, j in ENTRIES
]


def monomial_sums(monomials: np.ndarray) -> np.ndarray:
    """Return the matrix (m, 3^d) that sums a flattened array of factors of F_i F_j ... to coefficients of a form."""
    # `monomials` are the exponents of the m monomials of degree d, (m, 3)
    degree = int(monomials[0].sum())
    indices = np.indices((3,) * degree).reshape(degree, -1)
    exponents = (indices == np.arange(3)[:, None, None]).sum(axis=1)
    return (monomials[:, :, None] == exponents[None]).all(axis=1).astype(float)


MONOMIAL_SUMS = monomial_sums(MONOMIALS)
# The symmetric tensors of the monomials: m_k(F) = T_k(F, F, F, F).
TENSORS = (MONOMIAL_SUMS / MONOMIAL_SUMS.sum(axis=1, keepdims=True)).reshape(15, 3, 3, 3, 3)

# How far below zero the smallest curvature may be, relative to the largest. A fitted surface may lie on the border of
# convexity, where roundoff can make its smallest curvature negative. Coefficients stored in float32 are themselves only
# this accurate.
CONVEXITY_TOLERANCE = 1e-6

MAX_NEWTON_ROUNDS = 100


class QuarticForm(NamedTuple):
    """The `Form` of a quartic H."""

    c: tuple[Scalar, ...]  # the 15 coefficients, in the order of `MONOMIALS`, 1/N^4
    length: Scalar  # m

    degree = 4

    def table(self) -> Float[Array, "6 6"]:
        return jnp.stack([jnp.stack([factor * self.c[k] for k, factor in row]) for row in HESSIAN_TERMS])

    def value(self, f: Vec3) -> Scalar:
        return f.dot(self.gradient(f)) / 4

    def gradient(self, f: Vec3) -> Vec3:
        c, (x, y, z) = self.c, f
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        gx = (
            x * (4 * c[0] * xx + 3 * (c[3] * xy + c[4] * xz) + 2 * (c[9] * yy + c[10] * zz + c[12] * yz))
            + yy * (c[5] * y + c[13] * z)
            + zz * (c[7] * z + c[14] * y)
        )
        gy = (
            y * (4 * c[1] * yy + 3 * (c[5] * xy + c[6] * yz) + 2 * (c[9] * xx + c[11] * zz + c[13] * xz))
            + xx * (c[3] * x + c[12] * z)
            + zz * (c[8] * z + c[14] * x)
        )
        gz = (
            z * (4 * c[2] * zz + 3 * z * (c[7] * x + c[8] * y) + 2 * (c[10] * xx + c[11] * yy + c[14] * x * y))
            + xx * (c[4] * x + c[12] * y)
            + yy * (c[6] * y + c[13] * x)
        )
        return Vec3(gx, gy, gz)

    def hessian(self, f: Vec3) -> Symmetric3:
        c, (x, y, z) = self.c, f
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        return Symmetric3(
            12 * c[0] * xx + 6 * (c[3] * xy + c[4] * xz) + 2 * (c[9] * yy + c[10] * zz + c[12] * yz),
            12 * c[1] * yy + 6 * (c[5] * xy + c[6] * yz) + 2 * (c[9] * xx + c[11] * zz + c[13] * xz),
            12 * c[2] * zz + 6 * (c[7] * xz + c[8] * yz) + 2 * (c[10] * xx + c[11] * yy + c[14] * xy),
            3 * (c[3] * xx + c[5] * yy) + 4 * c[9] * xy + 2 * (c[12] * xz + c[13] * yz) + c[14] * zz,
            3 * (c[4] * xx + c[7] * zz) + 4 * c[10] * xz + 2 * (c[12] * xy + c[14] * yz) + c[13] * yy,
            3 * (c[6] * yy + c[8] * zz) + 4 * c[11] * yz + 2 * (c[13] * xy + c[14] * xz) + c[12] * xx,
        )

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        """Return the five coefficients c_k of H(a + s b) = sum_k c_k s^k."""
        # H = xx A + yy B + zz C, where A, B and C are linear in the six products of two components of F. Along a + s b
        # each of these products is quadratic in s. This needs two thirds of the arithmetic of the alternative:
        # gradients and a Hessian at both ends.
        product_terms = (_products(a, a), _products(a, b, twice=True), _products(b, b))
        pairs = compute_once(tuple((products[:3], self._square_factors(products)) for products in product_terms), a.x)
        squares, factors = ([row[k] for row in pairs] for k in range(2))
        return tuple(
            sum(
                (
                    square * factor
                    for k in range(3)
                    for j in range(3)
                    if k + j == power
                    for square, factor in zip(squares[k], factors[j], strict=True)
                ),
                jnp.zeros_like(a.x),
            )
            for power in range(5)
        )

    def _square_factors(self, products: tuple[Scalar, ...]) -> tuple[Scalar, Scalar, Scalar]:
        """Return A, B and C of H = xx A + yy B + zz C, for the six products (xx, yy, zz, xy, xz, yz)."""
        c, (xx, yy, zz, xy, xz, yz) = self.c, products
        return (
            c[0] * xx + c[3] * xy + c[4] * xz + c[9] * yy + c[10] * zz + c[12] * yz,
            c[1] * yy + c[5] * xy + c[6] * yz + c[11] * zz + c[13] * xz,
            c[2] * zz + c[7] * xz + c[8] * yz + c[14] * xy,
        )


def _products(a: Vec3, b: Vec3, twice: bool = False) -> tuple[Scalar, ...]:
    """Return the products xx, yy, zz, xy, xz, yz of a and b; with `twice`, the sum of those of (a, b) and (b, a)."""
    if not twice:
        return a.x * b.x, a.y * b.y, a.z * b.z, a.x * b.y, a.x * b.z, a.y * b.z
    return (
        2 * (a.x * b.x),
        2 * (a.y * b.y),
        2 * (a.z * b.z),
        a.x * b.y + a.y * b.x,
        a.x * b.z + a.z * b.x,
        a.y * b.z + a.z * b.y,
    )


class Quartic(LimitSurface):
    """The limit surface of H(F) = sum_k coefficients[k] m_k(F), with F = (x, y, z) = (fx, fy, tau / length).

    The monomials m_k are, in this order: x⁴ y⁴ z⁴ x³y x³z xy³ y³z xz³ yz³ x²y² x²z² y²z² x²yz xy²z xyz².

    Attributes:
        coefficients: Coefficients of the monomials, shape (15,), 1/N^4.
        length: Characteristic length, m.

    Raises:
        ValueError: If the coefficients are not finite, are all zero, or are not those of a convex polynomial, or if
            `length` is not positive.
    """

    coefficients: Float[Array, "15"]
    length: Float[Array, ""]
    degree: ClassVar[int] = 4

    def __init__(self, coefficients: ArrayLike, length: ArrayLike):
        array = checked_array("coefficients", coefficients, (15,))
        known = concrete(array)
        if known is not None:
            if not known.any():
                raise ValueError("coefficients are all zero: no wrench would ever make the slider slide")
            curvature = least_curvature(known)
            if not curvature >= -CONVEXITY_TOLERANCE:
                raise ValueError(
                    "coefficients are not those of a convex polynomial: the Hessian's smallest eigenvalue over the "
                    f"unit sphere is {curvature:.3g} of its largest"
                )
        self.coefficients = array
        self.length = checked_array("length", length, (), array.dtype, positive=True)

    def form(self) -> QuarticForm:
        return QuarticForm(unstack(self.coefficients), self.length)

    def is_convex(self) -> bool:
        return least_curvature(np.asarray(self.coefficients)) >= -CONVEXITY_TOLERANCE

    def _aligned_wrench(self, v: Vec3) -> tuple[Vec3, Int[Array, ""]]:
        return _inverse(self.form().c, v)


@jax.custom_jvp
def _inverse(c: tuple[Scalar, ...], v: Vec3) -> tuple[Vec3, Int[Array, ""]]:
    """Solve grad H(F) = v by a safeguarded Newton's method: return F, and the number of rounds."""
    form = QuarticForm(c, jnp.ones_like(v.x))

    def rescaled(f: Vec3) -> Vec3:
        power = jnp.maximum(v.dot(f), 0)
        h = form.value(f)
        return f.scale(jnp.cbrt(power / jnp.where(h > 0, 4 * h, 1.0)))

    def residual(f: Vec3) -> Vec3:
        return v - form.gradient(f)

    def largest_entry(r: Vec3) -> Scalar:
        return jnp.maximum(jnp.maximum(jnp.abs(r.x), jnp.abs(r.y)), jnp.abs(r.z))

    halvings = 0.5 ** jnp.arange(10, dtype=v.x.dtype)

    def newton_round(state):
        # Each round minimizes the convex function H(F) - v . F further. It takes the best of the halvings of the Newton
        # step. H along the step is a known polynomial, so they cost nothing. The best multiple of F (in closed form, by
        # homogeneity) makes the iteration independent of the scale of H.
        f, _, rounds = state
        step = form.hessian(f).solve(residual(f))
        coefficients = form.restrict(f, step)
        power = v.dot(step)
        objective = sum(a * halvings**k for k, a in enumerate(coefficients[1:], start=1)) - power * halvings
        t = halvings[jnp.argmin(objective)]
        f_new = rescaled(f + step.scale(t))
        return f_new, largest_entry(residual(f_new)), rounds + 1

    tolerance = 32 * jnp.finfo(v.x.dtype).eps
    start = rescaled(v)
    initial_state = (start, largest_entry(residual(start)), jnp.zeros((), jnp.int32))
    f, _, rounds = jax.lax.while_loop(
        lambda s: (s[1] > tolerance) & (s[2] < MAX_NEWTON_ROUNDS), newton_round, initial_state
    )
    return f, rounds


@_inverse.defjvp
def _inverse_jvp(primals, tangents) -> Any:
    """Solve hess H dF = dv - d(grad H) at the solution: one linear solve."""
    (c, v), (dc, dv) = primals, tangents
    f, rounds = _inverse(c, v)
    unit_length = jnp.ones_like(v.x)
    gradient_change = QuarticForm(dc, unit_length).gradient(f)  # grad H is linear in the coefficients
    df = QuarticForm(c, unit_length).hessian(f).solve(dv - gradient_change)
    return (f, rounds), (df, np.zeros(rounds.shape, jax.dtypes.float0))


def least_curvature(coefficients: np.ndarray) -> float:
    """Return the smallest eigenvalue of the Hessian over the unit sphere, relative to the largest one found.

    The search alternates between the two arguments of the form z' hess H(F) z, from many starts.

    Args:
        coefficients: Coefficients of the quartic, shape (15,).

    Returns:
        The ratio, negative if the quartic is not convex.
    """
    # z' hess H(F) z is 12 times a symmetric form T(F, F, z, z). The search starts at the directions F with the smallest
    # eigenvalues out of 2000 that cover the half sphere. z becomes the eigenvector of the smallest eigenvalue of the
    # Hessian at F, then F becomes the one of the Hessian at z. Each half step can only lower the eigenvalue.
    tensor = np.tensordot(np.asarray(coefficients, np.float64), 12 * TENSORS, 1)
    direction = fibonacci_hemisphere(2000)
    values, vectors = np.linalg.eigh(np.einsum("ijkl,nk,nl->nij", tensor, direction, direction))
    worst = np.argsort(values[:, 0])[:32]
    lowest, z = values[worst, 0], vectors[worst, :, 0]
    for _ in range(50):
        found, vector = np.linalg.eigh(np.einsum("ijkl,nk,nl->nij", tensor, z, z))
        lowest, z = np.minimum(lowest, found[:, 0]), vector[:, :, 0]
    return float(lowest.min() / max(np.abs(values).max(), np.finfo(float).tiny))
