"""The exact limit surface of support points."""

from typing import ClassVar, NamedTuple, NoReturn

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.checks import ArrayLike, checked_array, concrete
from pushjax._math.arrays import ENTRIES
from pushjax._math.linalg import Symmetric3
from pushjax._math.vec import Scalar, Vec3
from pushjax.friction.coulomb import wrenches
from pushjax.friction.limit_surface import MAX_LENGTH, LimitSurface
from pushjax.friction.support import Support
from pushjax.friction.support_points import SupportPoints


class FeetForm(NamedTuple):
    """The `Form` of support points, with H = gamma, the gauge of the limit surface."""

    point: Float[Array, "2 points"]  # in units of the length
    limit: Float[Array, "points"]
    length: Scalar

    degree = 1

    @property
    def points(self) -> SupportPoints:
        """For batches."""
        return SupportPoints(self.point, self.limit)

    def value(self, f: Vec3) -> Scalar:
        return self.points.patch(jnp.stack(f))[0]

    def gradient(self, f: Vec3) -> Vec3:
        return Vec3.of(self.points.patch(jnp.stack(f))[1])

    def hessian(self, f: Vec3) -> Symmetric3:
        gauge, _, curvature = self.points.patch(jnp.stack(f))
        return Symmetric3(*(curvature[i, j] / gauge for i, j in ENTRIES))

    def table(self) -> NoReturn:
        raise TypeError(
            "surface: this is for a polynomial limit surface; got the exact one of support points, which rollouts take "
            "without `solver` and `table`. Slider.on(shape, support) fits a polynomial to it"
        )

    def restrict(self, a: Vec3, b: Vec3) -> NoReturn:
        self.table()


class Feet(LimitSurface):
    """The exact limit surface of support points, under Coulomb friction at each of them.

    H is the gauge of the limit surface: the factor by which a wrench exceeds what friction can resist, of degree one.
    A slider that rotates about a support point resists every wrench of a flat facet of the limit surface.

    Attributes:
        point: Support points in the body frame, shape (points, 2), m.
        limit: Largest friction force at each point, shape (points,), N.
        length: Length that normalizes torques, m. Default: the radius of gyration of the support.

    Raises:
        ValueError: As `Support`; also if all loads are on one point, or if the length is not positive.

    Reference: Goyal, Ruina & Papadopoulos 1991.
    """

    point: Float[Array, "points 2"]
    limit: Float[Array, "points"]
    length: Float[Array, ""]
    degree: ClassVar[int] = 1

    def __init__(self, point: ArrayLike, limit: ArrayLike, length: ArrayLike | None = None):
        support = Support(point, limit)
        self.point, self.limit = support.point, support.limit
        known_point, known_limit = concrete(self.point), concrete(self.limit)
        if known_point is not None and known_limit is not None:
            if len(np.unique(known_point[known_limit > 0], axis=0)) < 2:
                raise ValueError(f"point: all loads are on one point; got limits {known_limit.tolist()}")
        gyration = support.radius_of_gyration if length is None else length
        if concrete(gyration) is not None:
            gyration = checked_array("length", gyration, (), self.point.dtype, positive=True)
        self.length = jnp.asarray(gyration, self.point.dtype)

    def form(self) -> FeetForm:
        length = self.length
        return FeetForm(self.point.T / length, self.limit, length)

    def is_valid(self) -> Bool[Array, ""]:
        valid = self.form().points.are_valid()
        return valid & (self.length >= 1 / MAX_LENGTH) & (self.length <= MAX_LENGTH)

    def is_convex(self) -> bool:
        return True

    def _aligned_wrench(self, v: Vec3) -> tuple[Vec3, Int[Array, ""]]:
        form = self.form()
        nowhere = jnp.zeros((1, len(form.limit), 2), self.point.dtype)
        wrench = wrenches(jnp, form.point.T, form.limit, jnp.stack(v)[None], nowhere)[0]
        return Vec3.of(wrench), jnp.zeros((), jnp.int32)

    def _wrench_of(self, v: Vec3) -> tuple[Vec3, Bool[Array, ""], Int[Array, ""], Scalar]:
        f, rounds = self._aligned_wrench(v)  # in closed form
        return f, jnp.ones((), bool), rounds, jnp.zeros_like(f.x)
