"""The interface that limit surfaces of all degrees share: `LimitSurface`, and its `Form` for inner loops.

A limit surface is the level set H(F) = 1 of a convex H that is homogeneous of degree d in the normalized wrench
F = (fx, fy, tau / length). H is a polynomial of even degree, or for an exact limit surface (`Feet`) its gauge, of
degree one. While the slider slides, its normalized twist (vx, vy, length * omega) is a positive multiple of grad H(F).
The code uses Euler's identities throughout: F . grad H = d H and hess H F = (d - 1) grad H.

Reference: Zhou et al. 2016; Zhou et al. 2017, section III.A.
"""

from abc import abstractmethod
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.checks import ArrayLike, checked_array, concrete
from pushjax._internal.files import load_json, save_json, to_list
from pushjax._math.arrays import cross, dot
from pushjax._math.linalg import Symmetric3
from pushjax._math.vec import Scalar, Vec3
from pushjax.friction.polynomial import Polynomial

# Kinds of surfaces in files. Their modules are named like them. They are imported when needed, because a user who loads
# a surface may not have imported them.
KINDS = ("ellipsoid", "quartic", "feet")
MAX_LENGTH = 1e8  # of a traced surface, m; its fourth power is still a number, and so is that of the inverse
# Keyed by the bytes of a float: largest factor of H, whose square is still a number; and roundoff of least minors.
MAX_SCALE, CONVEX_ROUNDOFF = {4: 1e16, 8: 1e120}, {4: 1e-5, 8: 1e-13}
FORMAT, VERSION = "pushjax limit surface", 1


class Form(Protocol):
    """H as a function of the normalized wrench, without the checks and arrays of `LimitSurface`."""

    # The contact solvers and rollouts compute with it. Its methods take and return `Vec3` and scalars instead of arrays
    # (`pushjax._math.vec` says why). Forms are pytrees. `value`, `gradient` and `hessian` are H and its derivatives by
    # the normalized wrench.

    @property
    def degree(self) -> int: ...

    @property
    def length(self) -> Scalar: ...  # m

    def table(self) -> Float[Array, "6 products"]:
        """Return H as a `polynomial.Polynomial` has it."""
        ...

    def value(self, f: Vec3) -> Scalar: ...

    def gradient(self, f: Vec3) -> Vec3: ...

    def hessian(self, f: Vec3) -> Symmetric3: ...

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        """Return the degree + 1 coefficients c_k of H on a line: H(a + s b) = sum_k c_k s^k."""
        ...


class InverseMap(NamedTuple):
    """The wrench on the level set H = 1 for a twist direction, and how accurately it was found.

    Attributes:
        wrench: Wrench (fx, fy, tau), shape (3,), N and N m. Zero if not converged.
        converged: Whether the wrench was found. False also for a twist that is zero or not finite.
        rounds: Number of Newton rounds.
        angle: Angle between the given twist and that of the wrench, both normalized, rad.
    """

    wrench: Float[Array, "3"]
    converged: Bool[Array, ""]
    rounds: Int[Array, ""]
    angle: Float[Array, ""]


class LimitSurface(eqx.Module):
    """A limit surface: the boundary H = 1, for a convex H, of the wrenches that friction can resist.

    Attributes:
        length: Characteristic length that normalizes torques and angular velocities, m.
        degree: Degree of H.
    """

    length: eqx.AbstractVar[Float[Array, ""]]
    degree: eqx.AbstractClassVar[int]

    @abstractmethod
    def form(self) -> Form:
        """Return H as a `Form`, for computations below the public interface."""

    def is_valid(self) -> Bool[Array, ""]:
        """Return whether a surface that was made of traced numbers can be computed with."""
        # An ellipsoid must be convex. A quartic must be convex at three wrenches only, because more takes too long.
        form = jax.lax.stop_gradient(self.form())
        hessians = Polynomial.of(form.table()).hessian(jnp.eye(3, dtype=self.length.dtype))  # (3, 3, wrench)
        sizes = hessians[0, 0] + hessians[1, 1] + hessians[2, 2]
        largest, roundoff = MAX_SCALE[sizes.dtype.itemsize], CONVEX_ROUNDOFF[sizes.dtype.itemsize]
        valid = jnp.isfinite(sum(jax.tree.leaves(form))) & jnp.all((sizes >= 1 / largest) & (sizes <= largest))
        # all principal minors, with the traces scaled to one
        scaled = hessians / jnp.where(sizes > 0, sizes, 1.0)[None, None]
        diagonal, crosses = scaled[np.arange(3), np.arange(3)], cross(scaled[1], scaled[2])
        pairs = [diagonal[i] * diagonal[j] - scaled[i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
        minors = jnp.concatenate([diagonal, jnp.stack(pairs), dot(scaled[0], crosses)[None]])
        curvature = hessians[np.arange(3), np.arange(3), np.arange(3)]
        valid &= jnp.all(minors >= -roundoff)
        valid &= jnp.min(curvature) > jnp.finfo(curvature.dtype).eps * jnp.max(curvature)
        return valid & (self.length >= 1 / MAX_LENGTH) & (self.length <= MAX_LENGTH)

    @abstractmethod
    def is_convex(self) -> bool:
        """Return whether H is convex, up to roundoff. The surface must not be traced."""

    @abstractmethod
    def _aligned_wrench(self, v: Vec3) -> tuple[Vec3, Int[Array, ""]]:
        """Return a normalized wrench of any scale whose twist is `v`, of norm one, and the number of Newton rounds."""

    def _wrench_of(self, v: Vec3) -> tuple[Vec3, Bool[Array, ""], Int[Array, ""], Scalar]:
        """Return the normalized wrench on H = 1 whose twist is along `v`, and the other fields of `InverseMap`."""
        form = self.form()
        f, rounds = self._aligned_wrench(v)
        h = form.value(f)
        angle = angle_between(form.gradient(f), v)
        # some 1e-3 rad in float32 and 1e-12 rad in float64
        converged = (h > 0) & (angle <= 1e4 * float(jnp.finfo(angle.dtype).eps))
        positive = jnp.where(converged, h, 1.0)
        scale = jnp.where(converged, 1 / jnp.sqrt(positive) if self.degree == 2 else positive**-0.25, 0.0)
        return f.scale(scale), converged, rounds, angle

    def inverse(self, twist: ArrayLike) -> InverseMap:
        """Find the wrench on H = 1 whose twist has the direction of `twist`.

        Differentiable, by the implicit function theorem.

        Args:
            twist: Body twist (vx, vy, omega), shape (3,). Only its direction matters.

        Returns:
            The wrench, and whether it was found.

        Raises:
            ValueError: If the twist has another shape, or is known and zero or not finite.
        """
        given = checked_array("twist", twist, (3,), self.length.dtype)
        known = concrete(given)
        if known is not None and not known.any():
            raise ValueError("twist is zero: every wrench inside the limit surface has it, none is singled out")
        normalized = jnp.stack([given[0], given[1], given[2] * self.length])
        size = jnp.max(jnp.abs(normalized))  # scale to order one first, so that squares neither underflow nor overflow
        usable = jnp.isfinite(size) & (size > 0)
        # otherwise +x, to avoid NaN downstream
        normalized = jnp.where(
            usable, normalized / jnp.where(usable, size, 1.0), jnp.array([1.0, 0.0, 0.0], normalized.dtype)
        )
        v = Vec3.of(normalized / jnp.sqrt(jnp.sum(normalized * normalized)))
        f, found, rounds, angle = self._wrench_of(v)
        converged = usable & found
        wrench = jnp.where(converged, jnp.stack([f.x, f.y, f.z * self.length]), 0.0)
        return InverseMap(wrench, converged, rounds, angle)

    def _normalized_wrench(self, wrench: ArrayLike) -> Vec3:
        """Return (fx, fy, tau / length), N; raise ValueError unless `wrench` has shape (3,) and is finite."""
        w = checked_array("wrench", wrench, (3,), self.length.dtype)
        return Vec3(w[0], w[1], w[2] / self.length)

    def value(self, wrench: ArrayLike) -> Float[Array, ""]:
        """Return H of a wrench: friction holds the slider where H < 1, and the slider slides where H = 1.

        Args:
            wrench: Wrench (fx, fy, tau) in the body frame, shape (3,), N and N m.

        Returns:
            H, a scalar.

        Raises:
            ValueError: If the wrench has another shape, or is known and not finite.
        """
        return self.form().value(self._normalized_wrench(wrench))

    def twist(self, wrench: ArrayLike) -> Float[Array, "3"]:
        """Return the direction of the body twist under a wrench, from grad H.

        Args:
            wrench: Wrench (fx, fy, tau) in the body frame, shape (3,), N and N m.

        Returns:
            Twist (vx, vy, omega), shape (3,). Its norm has no meaning. Zero for a zero wrench.

        Raises:
            ValueError: If the wrench has another shape, or is known and not finite.
        """
        g = self.form().gradient(self._normalized_wrench(wrench))
        return jnp.stack([g.x, g.y, g.z / self.length])

    def hessian(self, wrench: ArrayLike) -> Float[Array, "3 3"]:
        """Return the second derivatives of H by the wrench.

        Args:
            wrench: Wrench (fx, fy, tau) in the body frame, shape (3,), N and N m.

        Returns:
            Hessian, shape (3, 3). It is positive semi-definite if the surface is convex.

        Raises:
            ValueError: If the wrench has another shape, or is known and not finite.
        """
        scale = jnp.stack([jnp.ones_like(self.length), jnp.ones_like(self.length), 1 / self.length])
        return self.form().hessian(self._normalized_wrench(wrench)).array() * (scale[:, None] * scale[None])

    def wrench(self, twist: ArrayLike) -> Float[Array, "3"]:
        """Return the wrench on H = 1 whose twist has the direction of `twist`.

        `inverse` also returns whether the wrench was found.

        Args:
            twist: Body twist (vx, vy, omega), shape (3,). Only its direction matters.

        Returns:
            Wrench (fx, fy, tau), shape (3,), N and N m. Zero if it was not found.

        Raises:
            ValueError: If the twist has another shape, or is known and zero or not finite.
        """
        return self.inverse(twist).wrench

    def on_level_set(self, wrench: ArrayLike) -> Float[Array, "3"]:
        """Scale a wrench along its ray to H = 1.

        Args:
            wrench: Wrench (fx, fy, tau) in the body frame, shape (3,), N and N m.

        Returns:
            The scaled wrench, shape (3,). A zero wrench stays zero.

        Raises:
            ValueError: If the wrench has another shape, or is known and not finite.
        """
        w = checked_array("wrench", wrench, (3,), self.length.dtype)
        # Scale the wrench to order one first, because powers of a small wrench underflow. Neither the result nor its
        # derivative depends on this scale.
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(jnp.stack([w[0], w[1], w[2] / self.length]))))
        w = w / jnp.where(size > 0, size, 1.0)
        h = self.value(w)
        return jnp.where(h > 0, w * jnp.where(h > 0, h, 1.0) ** (-1 / self.degree), 0.0)

    def save(self, path: str | Path) -> None:
        """Write the surface to a JSON file, from which `load` reads the same bits.

        Args:
            path: File to write.
        """
        record = {field.name: to_list(getattr(self, field.name)) for field in fields(self)}
        save_json(path, FORMAT, VERSION, self.length.dtype, record | {"kind": type(self).__name__.lower()})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a surface that `save` wrote.

        Args:
            path: File to read.

        Returns:
            The surface, an instance of the class it is called on.

        Raises:
            ValueError: If the file does not contain a surface of this class.
            OSError: If the file cannot be read.
        """
        surface = load_json(path, "a limit surface file", FORMAT, VERSION, _surface_from_record)
        if not isinstance(surface, cls):
            raise ValueError(f"{path} holds a {type(surface).__name__}, not a {cls.__name__}")
        return surface


def _surface_from_record(record: dict[str, Any], dtype: Any) -> LimitSurface:
    """Return the limit surface that the record of a JSON file describes."""
    if record["kind"] not in KINDS:
        raise ValueError(f"{record['kind']!r} is no kind of surface; there are {', '.join(KINDS)}")
    kind: Any = getattr(import_module(f"pushjax.friction.{record['kind']}"), record["kind"].capitalize())
    return kind(**{field.name: jnp.asarray(record[field.name], dtype) for field in fields(kind)})


def angle_between(a: Vec3, b: Vec3, xp: Any = jnp) -> Scalar:
    """Return the angle between two vectors, rad, also accurate if small; zero if a vector is zero."""
    cross, cosine = a.cross(b), a.dot(b)
    squared = cross.dot(cross)
    sine = xp.where(squared > 0, xp.sqrt(xp.where(squared > 0, squared, 1.0)), 0.0)  # also differentiable at zero
    # arctan2(0, 0) is zero, but its derivative is NaN
    return xp.arctan2(sine, xp.where((sine == 0) & (cosine == 0), 1.0, cosine))
