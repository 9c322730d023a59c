"""Support points under the slider, which represent its pressure distribution, and their exact Coulomb friction.

A support point at r carries a part p of the weight. Its friction limit is l = mu_s p, where mu_s is the coefficient of
friction with the table. All forces and wrenches are applied by the hand, to balance the friction of the table, so
wrench . twist >= 0. A point that slides with velocity v(r) takes the force l v/|v|. The sum over the points gives the
exact limit surface.

A twist whose center of rotation lies on a support point does not slide that point. The force there may then be any
vector of length up to l. The wrenches of that twist form a flat facet of the limit surface (Goyal, Ruina &
Papadopoulos 1991).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from pushjax._internal.checks import (
    ArrayLike,
    check_count,
    checked_array,
    checked_weights,
    common_dtype,
    concrete,
    in_numpy,
)
from pushjax.friction.coulomb import draw, draw_uniform, in_unit_disk, pairs_of, wrenches
from pushjax.friction.support_grid import covered_cells
from pushjax.geometry.shape import Shape


class WrenchTwistPairs(NamedTuple):
    """Wrench-twist pairs on a limit surface. The fields are in the order of the arguments of `fit_limit_surface`.

    Attributes:
        wrench: Wrenches (fx, fy, tau), shape (pairs, 3), N and N m.
        twist: Twists (vx, vy, omega), shape (pairs, 3). Each has unit norm as (vx, vy, length * omega).
        length: Characteristic length, m.
    """

    wrench: Float[Array, "pairs 3"]
    twist: Float[Array, "pairs 3"]
    length: Float[Array, ""]


class Support(eqx.Module):
    """Support points in the body frame, with the friction limit of each.

    Attributes:
        point: Support points in the body frame, shape (points, 2), m.
        limit: Largest friction force at each point, shape (points,), N.

    Raises:
        ValueError: If an array has the wrong shape or is not finite, or if the limits are negative or all zero.
    """

    point: Float[Array, "points 2"]
    limit: Float[Array, "points"]

    def __init__(self, point: ArrayLike, limit: ArrayLike):
        dtype = common_dtype(point, limit)
        self.point = checked_array("point", point, ("points", 2), dtype)
        self.limit = checked_array("limit", limit, (len(self.point),), dtype, non_negative=True)
        known = concrete(self.limit)
        if known is not None and not known.sum() > 0:
            raise ValueError("limit: at least one support point must carry a load; all are zero")

    @staticmethod
    def points(point: ArrayLike, weights: ArrayLike | None = None, load: ArrayLike = 1.0) -> "Support":
        """Distribute a total friction limit over given points, in proportion to `weights`.

        Args:
            point: Support points in the body frame, shape (points, 2), m.
            weights: Relative share of each point in the load, shape (points,). Equal by default.
            load: Total friction limit mu_s m g, N.

        Returns:
            The support.

        Raises:
            ValueError: If an array has the wrong shape or is not finite, the weights are negative or all zero, or the
                load is not positive.
        """
        dtype = common_dtype(point, weights, load)
        array = checked_array("point", point, ("points", 2), dtype)
        relative = checked_weights(weights, len(array), dtype)
        total = checked_array("load", load, (), dtype, positive=True)
        return Support(array, in_numpy(lambda xp, total, share: total * share / xp.sum(share))(total, relative))

    @staticmethod
    def tripod(point: ArrayLike, load: ArrayLike = 1.0, center: ArrayLike = (0.0, 0.0)) -> "Support":
        """Distribute the load over three points by statics, with the weight above `center`.

        Args:
            point: Support points in the body frame, shape (3, 2), m.
            load: Total friction limit mu_s m g, N.
            center: Point in the body frame above which the weight acts, shape (2,), m.

        Returns:
            The support.

        Raises:
            ValueError: If an array has the wrong shape or is not finite, the load is not positive, the center lies
                outside the triangle (one point would have to pull), or the points lie on a line. For traced arguments
                only shapes are checked.
        """
        dtype = common_dtype(point, load, center)
        array = checked_array("point", point, (3, 2), dtype)
        center_point = checked_array("center", center, (2,), dtype)
        # The share of a point is proportional to the area of the triangle of the center and the other two points.
        to_next, to_previous = (jnp.roll(array, -k, axis=0) - center_point[None] for k in (1, 2))
        double_area = to_next[:, 0] * to_previous[:, 1] - to_next[:, 1] * to_previous[:, 0]
        total = jnp.sum(double_area)
        known = concrete(total)
        side = array - jnp.roll(array, 1, axis=0)
        if known is not None and abs(known) <= 1e-6 * float(jnp.max(jnp.sum(side**2, axis=1))):
            raise ValueError("point: the three support points lie on a line")
        share = double_area / total
        known = concrete(share)
        if known is not None and not np.all(known >= -1e-6):
            raise ValueError(f"center must lie inside the three support points; it asks for shares {known.tolist()}")
        return Support.points(array, jnp.maximum(share, 0), load)

    @staticmethod
    def uniform(shape: Shape, points: int = 64, load: ArrayLike = 1.0) -> "Support":
        """Represent uniform pressure over a shape by one support point for each cell of a grid.

        The cells are nearly square. A cell's load is in proportion to its area inside the outline, and its support
        point is the center of that area. Of several spacings, the method takes the one whose number of cells is closest
        to `points`. A rectangle gets exactly `points` if it divides into that many squares: a square with 64 points
        gets 8 by 8.

        Args:
            shape: Shape of the slider's base. It must not be traced.
            points: Desired number of support points.
            load: Total friction limit mu_s m g, N.

        Returns:
            The support.

        Raises:
            ValueError: If `points` is less than one, the shape is traced or covers too little of the box around it (for
                64 points, less than about 1/3000), or the load is not positive.
        """
        check_count("points", points)
        centers, areas = covered_cells(shape, points)
        return Support.points(centers, areas, load)

    @staticmethod
    def rim(shape: Shape, points: int = 64, load: ArrayLike = 1.0) -> "Support":
        """Represent pressure on the outline only, by equally spaced support points.

        Args:
            shape: Shape of the slider's base.
            points: Number of support points on the outline.
            load: Total friction limit mu_s m g, N.

        Returns:
            The support.

        Raises:
            ValueError: If `points` is less than one, or the load is not positive.
        """
        check_count("points", points)
        return Support.points(shape.boundary(points), load=load)

    @property
    def load(self) -> Float[Array, ""]:
        """Total friction limit mu_s m g, N: the force that slides the support without rotation."""
        return in_numpy(lambda xp, limit: xp.sum(limit))(self.limit)

    @property
    def center(self) -> Float[Array, "2"]:
        """Center of pressure in the body frame, shape (2,), m."""
        return in_numpy(_center)(self.point, self.limit)

    @property
    def radius_of_gyration(self) -> Float[Array, ""]:
        """Root mean square distance of the pressure from its center, m."""
        return in_numpy(_radius_of_gyration)(self.point, self.limit)

    def wrench(self, twist: ArrayLike, key: Key[Array, ""] | None = None) -> Float[Array, "3"]:
        """Return the wrench with which a hand balances friction while the slider moves with `twist`.

        If the center of rotation lies on a support point, every wrench of a facet balances friction. Then the result is
        the center of the facet, or a uniform sample of it if a `key` is given. A zero twist gives a zero wrench.

        Args:
            twist: Body twist (vx, vy, omega), shape (3,), m and rad. Only its direction matters.
            key: PRNG key to sample from a facet, or None for its center.

        Returns:
            Wrench (fx, fy, tau) in the body frame, shape (3,), N and N m.

        Raises:
            ValueError: If the twist has the wrong shape or is not finite.
        """
        v = checked_array("twist", twist, (3,), self.point.dtype)
        in_disk = jnp.zeros_like(self.point)
        if key is not None:
            in_disk = in_unit_disk(jnp, draw_uniform(key, len(self.point), v.dtype))
        return wrenches(jnp, self.point, self.limit, v[None], in_disk[None])[0]

    def wrench_twist_pairs(
        self, key: Key[Array, ""], pairs: int = 400, length: ArrayLike | None = None
    ) -> WrenchTwistPairs:
        """Sample wrench-twist pairs on the exact limit surface.

        Nine in ten twists are uniform on the unit sphere of (vx, vy, length * omega). One in ten rotates about a
        support point, chosen with a probability in proportion to its load; the wrench is then a sample of the facet.
        The pairs are in random order.

        Args:
            key: PRNG key.
            pairs: Number of pairs.
            length: Characteristic length, m. By default the radius of gyration, or 1 m if that vanishes (one point).

        Returns:
            The pairs, and the length.

        Raises:
            ValueError: If `pairs` is less than one, or the length is not positive.
        """
        check_count("pairs", pairs)
        given = in_numpy(_characteristic_length)(self.point, self.limit) if length is None else length
        checked_length = checked_array("length", given, (), self.point.dtype, positive=True)
        draws = draw(key, self.point, self.limit, pairs)
        wrench, twist = pairs_of(self.point, self.limit, checked_length, *draws)
        return WrenchTwistPairs(wrench, twist, checked_length)


def _center(xp, point, limit):
    """Return the center of pressure, shape (2,), m."""
    return xp.sum(limit[:, None] * point, axis=0) / xp.sum(limit)


def _radius_of_gyration(xp, point, limit):
    """Return the root mean square distance of the pressure from its center, m."""
    squared = xp.sum((point - _center(xp, point, limit)[None]) ** 2, axis=1)
    return xp.sqrt(xp.sum(limit * squared) / xp.sum(limit))


def _characteristic_length(xp, point, limit):
    """Return the radius of gyration, or 1 m if it is only roundoff."""
    gyration = _radius_of_gyration(xp, point, limit)
    rounding = 16 * xp.finfo(gyration.dtype).eps * xp.max(xp.abs(point))
    return xp.where(gyration > rounding, gyration, 1.0)
