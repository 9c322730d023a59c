"""What a limit surface is, whatever its degree.

A limit surface is the level set H(F) = 1 of a convex polynomial, homogeneous of even degree d, over the normalised
wrench F = (fx, fy, tau / length). While the slider slides, its normalised twist (vx, vy, length * omega) is a positive
multiple of grad H(F) (Zhou et al. 2016; Zhou et al. 2017, section III.A). Euler's identities, used throughout:
F . grad H = d H and hess H F = (d - 1) grad H.
"""

from abc import abstractmethod
from pathlib import Path
from typing import NamedTuple, Protocol, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pushjax._checks import Numeric, as_float, concrete, finite, positive, shaped
from pushjax._vec import Scalar, Vec3


class Symmetric3(NamedTuple):
    """A symmetric 3 x 3 matrix."""

    xx: Scalar
    yy: Scalar
    zz: Scalar
    xy: Scalar
    xz: Scalar
    yz: Scalar

    def times(self, v: Vec3) -> Vec3:
        return Vec3(
            self.xx * v.x + self.xy * v.y + self.xz * v.z,
            self.xy * v.x + self.yy * v.y + self.yz * v.z,
            self.xz * v.x + self.yz * v.y + self.zz * v.z,
        )

    def solve(self, v: Vec3) -> Vec3:
        """The solution of self u = v by the adjugate; zero where the matrix is singular to rounding."""
        axx = self.yy * self.zz - self.yz * self.yz
        axy = self.xz * self.yz - self.xy * self.zz
        axz = self.xy * self.yz - self.xz * self.yy
        ayy = self.xx * self.zz - self.xz * self.xz
        ayz = self.xy * self.xz - self.xx * self.yz
        azz = self.xx * self.yy - self.xy * self.xy
        det = self.xx * axx + self.xy * axy + self.xz * axz
        scale = self.xx + self.yy + self.zz
        singular = jnp.abs(det) <= jnp.finfo(det.dtype).eps ** 2 * jnp.abs(scale) ** 3
        inverse = jnp.where(singular, 0.0, 1.0 / jnp.where(singular, 1.0, det))
        return Symmetric3(axx, ayy, azz, axy, axz, ayz).times(v).scale(inverse)

    def array(self) -> Float[Array, "3 3"]:
        return jnp.array([[self.xx, self.xy, self.xz], [self.xy, self.yy, self.yz], [self.xz, self.yz, self.zz]])


class Form(Protocol):
    """H over normalised wrenches, in scalars: what the contact solvers and rollouts compute with.

    Forms are pytrees. `length` is the surface's, in m.
    """

    @property
    def degree(self) -> int: ...

    @property
    def length(self) -> Scalar: ...

    def scaled(self, factor: Scalar) -> "Form":
        """factor * H."""
        ...

    def value(self, f: Vec3) -> Scalar: ...

    def gradient(self, f: Vec3) -> Vec3: ...

    def spin(self, f: Vec3) -> Scalar:
        """The third component of the gradient."""
        ...

    def hessian(self, f: Vec3) -> Symmetric3: ...

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        """Coefficients c_k of H(a + s b) = sum_k c_k s^k, degree + 1 of them."""
        ...


class InverseMap(NamedTuple):
    """A wrench (3,) on the level set with the given twist direction, how it was found, and how well.

    status: `Status` as int8: MOVING, or NOT_CONVERGED (a twist that is zero or not finite, or no convergence),
    where the wrench is zero. rounds: Newton rounds. angle: rad between the given twist and the wrench's own.
    """

    wrench: Float[Array, "3"]
    status: Int[Array, ""]
    rounds: Int[Array, ""]
    angle: Float[Array, ""]


class LimitSurface(eqx.Module):
    """The set of wrenches with which friction can resist, as a convex polynomial's level set H = 1."""

    length: eqx.AbstractVar[Float[Array, ""]]
    degree: eqx.AbstractClassVar[int]

    @abstractmethod
    def form(self) -> Form:
        """H in scalars."""

    @abstractmethod
    def is_convex(self) -> bool:
        """Whether H is convex, to rounding. The surface must not be traced."""

    @abstractmethod
    def inverse(self, twist: Numeric) -> InverseMap:
        """The wrench of a twist (3,), with a status. Differentiable, by the implicit function theorem."""

    def _normalized(self, wrench: Numeric) -> Vec3:
        w = as_float(wrench, self.length.dtype)
        shaped("wrench", w, (3,))
        finite("wrench", w)
        return Vec3(w[0], w[1], w[2] / self.length)

    def value(self, wrench: Numeric) -> Float[Array, ""]:
        """H of a wrench (3,) in N, N m: below one friction holds, at one the slider slides."""
        return self.form().value(self._normalized(wrench))

    def twist(self, wrench: Numeric) -> Float[Array, "3"]:
        """grad H of a wrench (3,): the body twist's direction (its length has no meaning); zero for a zero wrench."""
        g = self.form().gradient(self._normalized(wrench))
        return jnp.stack([g.x, g.y, g.z / self.length])

    def hessian(self, wrench: Numeric) -> Float[Array, "3 3"]:
        """Second derivatives of H by the wrench (3,) in N, N m; positive semi-definite for a convex surface."""
        scale = jnp.stack([jnp.ones_like(self.length), jnp.ones_like(self.length), 1 / self.length])
        return self.form().hessian(self._normalized(wrench)).array() * (scale[:, None] * scale[None])

    def wrench(self, twist: Numeric) -> Float[Array, "3"]:
        """The wrench (3,) on H = 1 whose twist has the direction of `twist` (3,); see `inverse` for its status.

        Raises ValueError for a zero twist or one that is not finite; where traced, gives zero.
        """
        return self.inverse(twist).wrench

    def on_level_set(self, wrench: Numeric) -> Float[Array, "3"]:
        """The wrench (3,) scaled along its ray to H = 1; a zero wrench stays zero."""
        w = as_float(wrench, self.length.dtype)
        shaped("wrench", w, (3,))
        # To order one first: powers of a small wrench underflow. The result does not depend on it, nor its derivative
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(jnp.stack([w[0], w[1], w[2] / self.length]))))
        w = w / jnp.where(size > 0, size, 1.0)
        h = self.value(w)
        return jnp.where(h > 0, w * jnp.where(h > 0, h, 1.0) ** (-1 / self.degree), 0.0)

    def save(self, path: str | Path) -> None:
        """Write the surface to a JSON file that `load` reads back to the same bits."""
        from pushjax.limit_surface._io import save_surface

        save_surface(self, path)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a surface that `save` wrote. Raises ValueError for a file that holds none of this kind."""
        from pushjax.limit_surface._io import load_surface

        return load_surface(path, cls)

    def _normalized_twist(self, twist: Numeric) -> tuple[Vec3, Array]:
        """The unit normalised twist, and whether there is one (else it is +x, to compute on without NaN)."""
        v = as_float(twist, self.length.dtype)
        shaped("twist", v, (3,))
        finite("twist", v)
        known = concrete(v)
        if known is not None and not known.any():
            raise ValueError("twist is zero: every wrench inside the limit surface has it, none is singled out")
        n = jnp.stack([v[0], v[1], v[2] * self.length])
        size = jnp.max(jnp.abs(n))  # first to order one, so that squares neither under- nor overflow
        usable = jnp.isfinite(size) & (size > 0)
        n = jnp.where(usable, n / jnp.where(usable, size, 1.0), jnp.array([1.0, 0.0, 0.0], n.dtype))
        return Vec3.of(n / jnp.sqrt(jnp.sum(n * n))), usable


def checked_length(length: Numeric, dtype) -> Float[Array, ""]:
    value = as_float(length, dtype)
    shaped("length", value, ())
    finite("length", value)
    positive("length", value)
    return value


def angle_between(a: Vec3, b: Vec3) -> Scalar:
    """Angle of two vectors in rad, accurate also when it is small; zero with a zero vector."""
    return jnp.arctan2(norm(a.cross(b)), a.dot(b))


def angle_tolerance(angle: Scalar) -> float:
    """The angle in rad up to which an inverse map has converged: some 1e-3 in float32, 1e-12 in float64."""
    return 1e4 * float(jnp.finfo(angle.dtype).eps)


def norm(a: Vec3) -> Scalar:
    squared = a.dot(a)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
