"""The table that the slider lies on, with friction that depends on position or direction.

Such a table transforms the wrenches of a limit surface: H(F) becomes H(T F). T stretches the force and takes the torque
about another point. The twist becomes T' grad H(T F), which preserves power.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, checked_array, common_dtype
from pushjax._math.arrays import ENTRIES
from pushjax._math.linalg import Symmetric3
from pushjax._math.vec import Scalar, Vec2, Vec3, cos_sin, unstack
from pushjax.friction.limit_surface import Form

# Numbers that are larger have no valid steps: their exponential and their fourth power cannot be computed with.
MAX_ANISOTROPY, MAX_NUMBER = 20.0, 1e9
NEAR_ZERO = 1e-3  # squared norm r^2 of the anisotropy below which series give cosh(r) and sinh(r) / r, without 0 / 0


class WrenchTransform(NamedTuple):
    """The linear map T F = (S f, tau - c x f) of normalized wrenches F = (f, tau)."""

    xx: Scalar  # xx, yy and xy are the entries of the symmetric matrix S
    yy: Scalar
    xy: Scalar
    cx: Scalar  # center of pressure c, divided by the characteristic length
    cy: Scalar

    def times(self, f: Vec3) -> Vec3:
        """Return T f."""
        torque = f.z - self.cx * f.y + self.cy * f.x
        return Vec3(self.xx * f.x + self.xy * f.y, self.xy * f.x + self.yy * f.y, torque)

    def transposed(self, g: Vec3) -> Vec3:
        """Return T' g."""
        x = self.xx * g.x + self.xy * g.y + self.cy * g.z
        y = self.xy * g.x + self.yy * g.y - self.cx * g.z
        return Vec3(x, y, g.z)


class TransformedForm(NamedTuple):
    """The `Form` H(T F) of a limit surface on a table."""

    base: Form  # H
    transform: WrenchTransform  # T

    @property
    def degree(self) -> int:
        return self.base.degree

    @property
    def length(self) -> Scalar:
        return self.base.length

    def table(self) -> Float[Array, "6 products"]:
        t, zero = self.transform, jnp.zeros_like(self.transform.xx)
        matrix = ((t.xx, t.xy, zero), (t.xy, t.yy, zero), (t.cy, -t.cx, zero + 1))  # of T
        table = _product(_of_products(tuple(zip(*matrix, strict=True))), self.base.table())
        return table if self.degree == 2 else _product(table, _of_products(matrix))

    def value(self, f: Vec3) -> Scalar:
        return self.base.value(self.transform.times(f))

    def gradient(self, f: Vec3) -> Vec3:
        return self.transform.transposed(self.base.gradient(self.transform.times(f)))

    def hessian(self, f: Vec3) -> Symmetric3:
        base, t = self.base.hessian(self.transform.times(f)), self.transform
        zero, one = 0 * t.xx, 0 * t.xx + 1
        x, y, z = Vec3(t.xx, t.xy, t.cy), Vec3(t.xy, t.yy, -t.cx), Vec3(zero, zero, one)
        bx, by, bz = base.times(x), base.times(y), base.times(z)
        return Symmetric3(x.dot(bx), y.dot(by), z.dot(bz), x.dot(by), x.dot(bz), y.dot(bz))

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        return self.base.restrict(self.transform.times(a), self.transform.times(b))


def _of_products(matrix: tuple[tuple[Scalar, ...], ...]) -> Float[Array, "6 6"]:
    """Return the matrix that maps the six products F_i F_j to (T F)_i (T F)_j, for a 3 x 3 matrix T."""
    rows = []
    for i, j in ENTRIES:
        terms = [matrix[i][k] * matrix[j][m] + (k != m) * (matrix[i][m] * matrix[j][k]) for k, m in ENTRIES]
        rows.append(jnp.stack(terms))
    return jnp.stack(rows)


def _product(a: Float[Array, "6 n"], b: Float[Array, "n m"]) -> Float[Array, "6 m"]:
    """Return the matrix product, not in the lower precision that accelerators use for it."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)


class Table(eqx.Module):
    """Anisotropic, position-dependent friction between slider and table, in the world frame.

    If all attributes are zero, friction is uniform. Only ratios of friction matter, not its magnitude.

    Friction that rises to one side moves the center of pressure to that side, by length^2 / 2 times the gradient at the
    slider's origin, where length is that of the limit surface. This is exact to first order for pressure on a ring
    whose radius is that length. For other pressure distributions it differs by a factor. Friction that depends on
    direction stretches the forces of the limit surface. This is exact for translations.

    Attributes:
        anisotropy: Dependence of friction on direction, shape (2,). Friction along x is exp(2 anisotropy[0]) times that
            along y. Friction along the diagonal is exp(2 anisotropy[1]) times that across it.
        log_gradient: Gradient of the logarithm of friction along x and y at `origin`, shape (2,), 1/m: the relative
            increase of friction per meter.
        log_hessian: Second derivatives xx, yy, xy of the logarithm of friction, shape (3,), 1/m^2.
        origin: Point of the table at which `log_gradient` is given, shape (2,), m.

    Raises:
        ValueError: If an array has the wrong shape or is not finite.
        TypeError: If an array does not consist of real numbers.

    Reference: Extends Zhou et al. 2017, where the table is uniform.
    """

    anisotropy: Float[Array, "2"]
    log_gradient: Float[Array, "2"]
    log_hessian: Float[Array, "3"]
    origin: Float[Array, "2"]

    def __init__(
        self,
        anisotropy: ArrayLike = (0.0, 0.0),
        log_gradient: ArrayLike = (0.0, 0.0),
        log_hessian: ArrayLike = (0.0, 0.0, 0.0),
        origin: ArrayLike = (0.0, 0.0),
    ):
        dtype = common_dtype(anisotropy, log_gradient, log_hessian, origin)
        self.anisotropy = checked_array("anisotropy", anisotropy, (2,), dtype)
        self.log_gradient = checked_array("log_gradient", log_gradient, (2,), dtype)
        self.log_hessian = checked_array("log_hessian", log_hessian, (3,), dtype)
        self.origin = checked_array("origin", origin, (2,), dtype)

    def is_valid(self) -> Bool[Array, ""]:
        """Return whether numbers that were traced when the table was made can be computed with."""
        others = jnp.concatenate([self.log_gradient, self.log_hessian, self.origin])
        return jnp.all(jnp.abs(self.anisotropy) <= MAX_ANISOTROPY) & jnp.all(jnp.abs(others) <= MAX_NUMBER)

    def wrench_transform(self, pose: Vec3, length: Scalar) -> WrenchTransform:
        """Return the map T of the wrenches of a slider at a pose (world, m and rad), in its body frame."""
        heading = cos_sin(pose.z)
        # The entries (a, b) of the symmetric matrix [[a, b], [b, -a]] rotate by twice the angle.
        a, b = unstack(self.anisotropy)
        cos_2, sin_2 = heading.x * heading.x - heading.y * heading.y, 2 * heading.x * heading.y
        a, b = cos_2 * a + sin_2 * b, cos_2 * b - sin_2 * a
        squared = a * a + b * b
        small = squared < NEAR_ZERO
        r = jnp.sqrt(jnp.where(small, 1.0, squared))
        cosh_r = jnp.where(small, 1 + squared / 2 * (1 + squared / 12 * (1 + squared / 30)), jnp.cosh(r))
        sinh_r_by_r = jnp.where(small, 1 + squared / 6 * (1 + squared / 20 * (1 + squared / 42)), jnp.sinh(r) / r)
        gradient_x, gradient_y = unstack(self.log_gradient)
        hessian_xx, hessian_yy, hessian_xy = unstack(self.log_hessian)
        origin_x, origin_y = unstack(self.origin)
        x, y = pose.x - origin_x, pose.y - origin_y
        slope = Vec2(gradient_x + hessian_xx * x + hessian_xy * y, gradient_y + hessian_xy * x + hessian_yy * y)
        c = slope.unrotate(heading).scale(length / 2)  # length^2 / 2, divided by the length, because c is normalized
        # S = exp(-M) for the symmetric matrix M = [[a, b], [b, -a]] of the anisotropy in the body frame, and
        # exp(-M) = cosh(r) I - sinh(r) / r M with r^2 = a^2 + b^2. Where friction is higher along x, S shrinks fx.
        return WrenchTransform(cosh_r - sinh_r_by_r * a, cosh_r + sinh_r_by_r * a, -sinh_r_by_r * b, *c)
