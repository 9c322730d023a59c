"""What carries the slider: pressure as weighted points, and the Coulomb friction they give.

A support point at r with friction limit l = mu_s p (pressure times coefficient of friction) resists a sliding
velocity v(r) with l v/|v|. Summed over the points this is the exact limit surface. A twist whose centre of rotation
lies on a support point does not slide that point: its friction may then be any vector of length up to l, and the
wrenches of that twist are a flat facet of the limit surface (Goyal, Ruina & Papadopoulos 1991).

Wrenches are those the hand applies to balance the table, so wrench . twist >= 0.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from pushjax._checks import (
    Numeric,
    as_float,
    common_dtype,
    concrete,
    finite,
    in_numpy,
    non_negative,
    on_device,
    positive,
    shaped,
    weights_of,
)
from pushjax._programs import quickly_compiled
from pushjax.shapes import Shape

FACET_SHARE = 0.1  # of the wrench-twist pairs


class WrenchTwistPairs(NamedTuple):
    """Pairs on a limit surface, ready to unpack into `fit_limit_surface`.

    wrench: (pairs, 3), N and N m. twist: (pairs, 3), of unit norm as (vx, vy, length * omega). length: m.
    """

    wrench: Float[Array, "pairs 3"]
    twist: Float[Array, "pairs 3"]
    length: Float[Array, ""]


class Support(eqx.Module):
    """Support points in the body frame and the friction limit of each.

    point: (points, 2), m. limit: (points,), N: what friction at that point can bear.
    """

    point: Float[Array, "points 2"]
    limit: Float[Array, "points"]

    def __init__(self, point: Numeric, limit: Numeric):
        dtype = common_dtype(point, limit)
        self.point, self.limit = as_float(point, dtype), as_float(limit, dtype)
        shaped("point", self.point, ("points", 2))
        shaped("limit", self.limit, (self.point.shape[0],))
        finite("point", self.point)
        finite("limit", self.limit)
        non_negative("limit", self.limit)
        known = concrete(self.limit)
        if known is not None and not known.sum() > 0:
            raise ValueError("limit: at least one support point must carry a load; all are zero")

    @staticmethod
    def points(point: Numeric, weights: Numeric | None = None, load: Numeric = 1.0) -> "Support":
        """Given points (points, 2) m that share the friction limit `load` = mu m g (N) by `weights` (default equal)."""
        dtype = common_dtype(point, weights, load)
        array, total = as_float(point, dtype), as_float(load, dtype)
        shaped("point", array, ("points", 2))
        share = weights_of(weights, array.shape[0], dtype)
        shaped("load", total, ())
        finite("load", total)
        positive("load", total)
        return Support(array, in_numpy(_shares)(total, share))

    @staticmethod
    def tripod(point: Numeric, load: Numeric = 1.0, center: Numeric = (0.0, 0.0)) -> "Support":
        """Three points (3, 2) m under a weight above `center` (2,) m: statics alone gives each point's share.

        Raises ValueError where the centre lies outside the three points (one would have to pull), or these on a line.
        """
        dtype = common_dtype(point, load, center)
        array, c = as_float(point, dtype), as_float(center, dtype)
        shaped("point", array, (3, 2))
        shaped("center", c, (2,))
        finite("point", array)
        finite("center", c)
        # each point's share is the area of the triangle between the centre and the other two
        one, two = jnp.roll(array, -1, axis=0) - c[None], jnp.roll(array, -2, axis=0) - c[None]
        opposite = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
        total = jnp.sum(opposite)
        known = concrete(total)
        side = array - jnp.roll(array, 1, axis=0)
        if known is not None and abs(known) <= 1e-6 * float(jnp.max(jnp.sum(side**2, axis=1))):
            raise ValueError("point: the three support points lie on a line")
        share = opposite / total
        known = concrete(share)
        if known is not None and not np.all(known >= -1e-6):
            raise ValueError(f"center must lie inside the three support points; it asks for shares {known.tolist()}")
        return Support.points(array, jnp.maximum(share, 0), load)

    @staticmethod
    def uniform(shape: Shape, points: int = 64, load: Numeric = 1.0) -> "Support":
        """Uniform pressure over `shape`: a point for each cell of a grid over it, as near to `points` as one gets.

        `load` = mu m g in N. The cells are nearly square. A cell the outline cuts bears its share of the load, at the
        middle of what lies inside. A rectangle whose sides are in a ratio of whole numbers gets exactly `points` where
        the ratio allows (a square with 64: 8 by 8).

        Raises ValueError for fewer than one point; the shape must not be traced.
        """
        if points < 1:
            raise ValueError(f"points must be at least 1; got {points}")
        low, high = (concrete(corner) for corner in shape.bounds)
        if low is None or high is None:
            raise ValueError("shape must be known to lay a grid over it; build the Support outside jit")
        dtype, low, high = low.dtype, low.astype(np.float64), high.astype(np.float64)
        # The area fixes the spacing but for the cut cells, which make it coarser; look around it, the nearest first.
        around = np.linspace(-0.1, 0.4, 26)
        spacings = np.sqrt(float(shape.area) / points) * (1 + around[np.argsort(np.abs(around), kind="stable")])
        grids = [_cells(low, high, spacing) for spacing in spacings]
        most = max(len(samples) for samples, _ in grids)  # all padded to one length: one compilation
        best: tuple[np.ndarray, np.ndarray] | None = None
        for samples, middles in grids:
            padded = np.concatenate([samples, np.broadcast_to(low, (most - len(samples), 2))])
            inside = np.asarray(_inside(shape, on_device(padded.astype(dtype))))[: len(samples)]
            found = _covered(samples, middles, inside)
            if best is None or abs(len(found[0]) - points) < abs(len(best[0]) - points):
                best = found
            if len(best[0]) == points:
                break
        assert best is not None
        return Support.points(best[0].astype(dtype), best[1].astype(dtype), load)

    @staticmethod
    def rim(shape: Shape, points: int = 64, load: Numeric = 1.0) -> "Support":
        """Pressure along the outline only: `points` points equally spaced on it; `load` = mu m g in N."""
        if points < 1:
            raise ValueError(f"points must be at least 1; got {points}")
        return Support.points(shape.boundary(points), load=load)

    @property
    def load(self) -> Float[Array, ""]:
        """mu m g, N: the largest force without rotation that the support resists."""
        return in_numpy(lambda xp, limit: xp.sum(limit))(self.limit)

    @property
    def center(self) -> Float[Array, "2"]:
        """Centre of pressure, m."""
        return in_numpy(_center)(self.point, self.limit)

    @property
    def radius_of_gyration(self) -> Float[Array, ""]:
        """Root mean square distance of the pressure from its centre, m."""
        return in_numpy(_gyration)(self.point, self.limit)

    def wrench(self, twist: Numeric, key: Key[Array, ""] | None = None) -> Float[Array, "3"]:
        """The wrench (3,) in N, N m with which a hand balances friction while the slider moves with `twist` (3,).

        Only the direction of the twist matters. Where the centre of rotation lies on a support point, the wrench
        is one of a facet: its middle, or with a `key` a point drawn uniformly from it. A zero twist has no wrench
        of its own; it gives the middle of all of them, zero.
        """
        v = as_float(twist, self.point.dtype)
        shaped("twist", v, (3,))
        finite("twist", v)
        moved = jnp.any(v != 0)
        v = v / jnp.where(moved, jnp.max(jnp.abs(v)), 1.0)  # squares shall neither under- nor overflow
        velocity = jnp.stack([v[0] - v[2] * self.point[:, 1], v[1] + v[2] * self.point[:, 0]], axis=1)
        speed2 = jnp.sum(velocity**2, axis=1)
        # rounding of the products above: slower than this is not sliding
        reach = jnp.abs(v[2]) * jnp.max(jnp.abs(self.point)) + jnp.max(jnp.abs(v[:2]))
        still = speed2 <= (8 * jnp.finfo(speed2.dtype).eps * reach) ** 2
        force = jnp.where(still[:, None], 0.0, velocity / jnp.sqrt(jnp.where(still, 1.0, speed2))[:, None])
        if key is not None:
            force = jnp.where((still & moved)[:, None], _in_unit_disc(key, len(self.point), v.dtype), force)
        f = self.limit[:, None] * force
        torque = self.point[:, 0] * f[:, 1] - self.point[:, 1] * f[:, 0]
        return jnp.append(jnp.sum(f, axis=0), jnp.sum(torque))

    def wrench_twist_pairs(
        self, key: Key[Array, ""], pairs: int = 400, length: Numeric | None = None
    ) -> WrenchTwistPairs:
        """Wrench-twist pairs on the exact limit surface, drawn with `key`.

        Twists are uniform on the unit sphere of (vx, vy, length * omega), but for one in ten, whose centre of rotation
        is a support point drawn by its load; its wrench is drawn from the facet. They come in random order. `length`
        (m) is the radius of gyration unless given, or where that vanishes (one point), 1 m.

        Raises ValueError for fewer than one pair, or a length that is not positive.
        """
        if pairs < 1:
            raise ValueError(f"pairs must be at least 1; got {pairs}")
        rho = in_numpy(_length)(self.point, self.limit) if length is None else as_float(length, self.point.dtype)
        shaped("length", rho, ())
        finite("length", rho)
        positive("length", rho)
        return _pairs(self, key, pairs, rho)


def _shares(xp, total, weights):
    return total * weights / xp.sum(weights)


def _center(xp, point, limit):
    return xp.sum(limit[:, None] * point, axis=0) / xp.sum(limit)


def _gyration(xp, point, limit):
    squared = xp.sum((point - _center(xp, point, limit)[None]) ** 2, axis=1)
    return xp.sqrt(xp.sum(limit * squared) / xp.sum(limit))


def _length(xp, point, limit):
    """The radius of gyration, or 1 m where that is nothing but rounding."""
    gyration = _gyration(xp, point, limit)
    rounding = 16 * xp.finfo(gyration.dtype).eps * xp.max(xp.abs(point))
    return xp.where(gyration > rounding, gyration, 1.0)


@quickly_compiled
def _pairs(support: Support, key: Key[Array, ""], pairs: int, rho: Float[Array, ""]) -> WrenchTwistPairs:
    dtype = support.point.dtype
    k_free, k_point, k_side, k_facet, k_order = jax.random.split(key, 5)
    free = jax.random.normal(k_free, (pairs, 3), dtype)
    about = jax.random.choice(k_point, support.point, (pairs,), p=support.limit / support.load)
    # a rotation about r moves the origin with (r_y, -r_x) omega
    spin = jnp.where(jax.random.bernoulli(k_side, 0.5, (pairs,)), 1.0, -1.0).astype(dtype)
    pivot = spin[:, None] * jnp.stack([about[:, 1], -about[:, 0], jnp.broadcast_to(rho, (pairs,))], axis=1)
    facets = round(FACET_SHARE * pairs)
    on_facet = jax.random.permutation(k_order, jnp.arange(pairs) < facets)
    normalized = jnp.where(on_facet[:, None], pivot, free)
    normalized = normalized / jnp.linalg.norm(normalized, axis=1, keepdims=True)
    twist = normalized / jnp.stack([jnp.ones_like(rho), jnp.ones_like(rho), rho])[None]
    wrench = jax.vmap(support.wrench)(twist, jax.random.split(k_facet, pairs))
    return WrenchTwistPairs(wrench, twist, rho)


SAMPLES = 8  # of each cell along x and along y, to find its share


def _cells(low: np.ndarray, high: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A grid that fills a box, its cells as near to `spacing` as fits: samples (cells * SAMPLES^2, 2), and middles."""
    count = np.maximum(np.round((high - low) / spacing), 1).astype(int)
    cell = (high - low) / count
    x, y = (low[k] + (np.arange(count[k]) + 0.5) * cell[k] for k in range(2))
    middles = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    offset = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    offsets = np.stack(np.meshgrid(offset * cell[0], offset * cell[1], indexing="ij"), axis=-1).reshape(-1, 2)
    return (middles[:, None] + offsets[None]).reshape(-1, 2), middles


def _covered(samples: np.ndarray, middles: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each cell that has a sample inside: the mean of those, and their share of the cell."""
    inside = inside.reshape(len(middles), -1)
    share = inside.mean(axis=1)
    mean = (
        np.sum(samples.reshape(*inside.shape, 2) * inside[..., None], axis=1)
        / np.maximum(inside.sum(axis=1), 0.5)[:, None]
    )
    mean = np.where((share == 1)[:, None], middles, mean)
    return mean[share > 0], share[share > 0]


@quickly_compiled
def _inside(shape: Shape, points: Float[Array, "points 2"]) -> Float[Array, "points"]:
    """1 inside, 0 outside, and one half on the outline, where rounding would decide."""
    low, high = shape.bounds
    border = 64 * jnp.finfo(points.dtype).eps * jnp.max(jnp.maximum(jnp.abs(low), jnp.abs(high)))

    def share(point):
        distance = shape.signed_distance(point)
        return jnp.where(distance < -border, 1.0, jnp.where(distance <= border, 0.5, 0.0))

    return jax.lax.map(share, points, batch_size=4096)  # in parts: points times edges may be many


def _in_unit_disc(key: Key[Array, ""], count: int, dtype) -> Float[Array, "{count} 2"]:
    k_r, k_angle = jax.random.split(key)
    radius = jnp.sqrt(jax.random.uniform(k_r, (count, 1), dtype))
    angle = jax.random.uniform(k_angle, (count, 1), dtype, maxval=2 * jnp.pi)
    return radius * jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], axis=1)
