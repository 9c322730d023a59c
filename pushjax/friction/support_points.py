"""The exact limit surfaces of support points, for batches: wrenches are arrays (3, ..., batch).

The power that friction dissipates at a twist V is D(V) = sum l |v|, over the points with friction limit l and velocity
v. The limit surface is the boundary of the wrenches F with F . V <= D(V) for every V. Its gauge is

    gamma(F) = max F . V / D(V),

and the V of the maximum, with D(V) = 1, is grad gamma(F). D is not smooth where a point stands still. So |v| is made
sqrt(v^2 + e^2), with e from the mean speed down to a negligible one. For each e, one Newton step finds V and the forces
f at the points together, from f |v| = l v: this equation is smooth also where a point stands still.

Reference: Goyal, Ruina & Papadopoulos 1991; for Newton's method with the forces, Chan, Golub & Mulet 1999.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.autodiff import without_derivatives
from pushjax._math.arrays import combined, dot, dual

STANDS_STILL = {4: 1e-5, 8: 1e-10}  # speed below which a point stands still, in units of the mean one
SLOW = {4: 1e-4, 8: 1e-8}  # least speed of a point, in the same unit, where it resists in proportion to its velocity
RATE, MAX_STEPS = 0.3, 60  # by which that speed falls from one full Newton step to the next, and most steps
MAX_STEPS_NEAR = 8  # steps from a twist near by, which starts with the least of these speeds
CLOSE_STEP = 1e-3  # a step, in units of mean speeds, after which one more is enough
LENGTHS, ROUNDOFF = (1.0, 0.6, 0.3, 0.1, 0.03), 8  # of a step, that are tried; times eps, error of D


class SupportPoints(NamedTuple):
    """Support points, with coordinates in units of the length that normalizes torques."""

    point: Float[Array, "2 points *batch"]
    limit: Float[Array, "points *batch"]  # zero for padding

    def are_valid(self) -> Bool[Array, "*batch"]:
        """Whether the limit surface has an inside: whether loads are on two points at least."""
        size = jnp.max(jnp.where(self.limit > 0, jnp.max(jnp.abs(self.point), axis=0), 0.0), axis=0)
        stiffness = _viscous(self.point, self.limit)
        total, torque = stiffness[0, 0], stiffness[2, 2]
        spread = torque - (stiffness[0, 2] ** 2 + stiffness[1, 2] ** 2) / jnp.where(total > 0, total, 1.0)
        known = jnp.isfinite(jnp.sum(self.point, axis=(0, 1)) + total) & jnp.all(self.limit >= 0, axis=0)
        return known & (total > 0) & (spread > 16 * jnp.finfo(size.dtype).eps * total * size**2)

    def mean_ellipsoid(self, wrench: Float[Array, "3 *batch"]) -> Float[Array, "3 3 *batch"]:
        """The matrix of the ellipsoid of points that would resist in proportion to their velocity."""
        total = jnp.sum(self.limit, axis=0)
        stiffness = _viscous(self.point, self.limit)
        stiffness = jnp.broadcast_to(stiffness * total[None, None], (3, *wrench.shape))
        return _inverse(stiffness)

    def reweighted(self, twist: Array, ellipsoid: Array, weight: Array) -> tuple[Array, Array]:
        """The ellipsoid B and the weight s of the law V = s B F of a twist; as given for a zero twist.

        Its points resist in proportion to their velocity, each with the factor that it has at the twist.
        """
        points, total = self._points(twist)
        origin = points.place(points.slowest(twist))
        local, twist = points.about(origin), _at_frame(twist, -origin)
        power = local.power(twist, 0.0)
        moves = power > 0
        velocity = local.velocity(twist / jnp.where(moves, power, 1.0)[None])
        factor = local.limit / _speeds(velocity, SLOW[twist.dtype.itemsize])
        stiffness = _viscous(local.point, factor) * (total**2)[None, None]
        own = _turned_to(origin, _inverse(stiffness))
        return jnp.where(moves[None, None], own, ellipsoid), jnp.where(moves, total * power, weight)

    def usable(self) -> tuple["SupportPoints", Bool[Array, " batch"]]:
        """Points with numbers that can be computed with, all of one batch, and whether they are the given ones."""
        valid = jnp.all(self.are_valid(), axis=tuple(range(self.limit.ndim - 2)))
        place = jnp.arange(2 * len(self.limit), dtype=self.point.dtype).reshape(2, -1, *(1,) * (self.limit.ndim - 1))
        point, limit = (
            jnp.where(jnp.broadcast_to(valid, own.shape), own, other)
            for own, other in ((self.point, place), (self.limit, jnp.ones_like(self.limit)))
        )
        return SupportPoints(point, limit), valid

    def patch(
        self, wrench: Float[Array, "3 *rest"], near: Float[Array, "3 *rest"] | None = None
    ) -> tuple[Float[Array, "*rest"], Float[Array, "3 *rest"], Float[Array, "3 3 *rest"]]:
        """The gauge of wrenches other than zero, its gradient, and its Hessian where the gauge is one.

        Gauge and gradient can be differentiated. The search starts from gradients `near` by, where they are not zero.
        """
        points, total = self._points(wrench)
        near = jnp.zeros_like(wrench) if near is None else near
        origin, twist, scale = without_derivatives(_search, points, near)
        points, still = points.about(origin).scaled(scale), STANDS_STILL[wrench.dtype.itemsize]
        velocity = points.velocity(twist)
        force = velocity / _speeds(velocity, still)[None]
        stiffness = jax.lax.stop_gradient(points.stiffness(velocity, force, still))
        # one more step has the derivatives
        twist = twist + points.newton_step(stiffness, twist, still)
        power = total * points.power(twist, still)
        gauge = dot(points.wrench, twist) / (scale * power)
        normal = twist / power[None]
        # At V = normal, dF = K dV for wrenches of gauge one, with the second derivatives K of D. The inverse of K +
        # F F' has the same dV, and dV = V for dF = F. K falls in proportion to V.
        matrix = total[None, None] * stiffness * power[None, None]
        unit = jax.lax.stop_gradient(points.wrench / (scale * gauge)[None])
        inverse = _inverse(matrix + unit[:, None] * unit[None])
        inverse, normal = _turned_to(origin, inverse), _at_frame(normal, origin)
        curvature = jax.lax.stop_gradient(inverse - normal[:, None] * normal[None])
        return gauge, normal, curvature

    def _points(self, wrench: Float[Array, "3 *rest"]) -> tuple["_Points", Float[Array, "*rest"]]:
        """The points for wrenches, and the sum of their limits."""
        missing = wrench.ndim + 1 - self.point.ndim
        point, limit = (jnp.expand_dims(x, tuple(range(k, k + missing))) for x, k in ((self.point, 2), (self.limit, 1)))
        point = jnp.broadcast_to(point, (*point.shape[:2], *wrench.shape[1:]))
        total = jnp.sum(limit, axis=0)
        return _Points(point, jnp.broadcast_to(limit / total[None], point.shape[1:]), wrench), total


class _Points(NamedTuple):
    """Support points of total limit one, and a wrench."""

    point: Float[Array, "2 points *rest"]
    limit: Float[Array, "points *rest"]
    wrench: Float[Array, "3 *rest"]

    def about(self, origin: Float[Array, "2 *rest"]) -> "_Points":
        """The same with another origin of coordinates."""
        fx, fy, torque = self.wrench
        wrench = jnp.stack([fx, fy, torque - origin[0] * fy + origin[1] * fx])
        return _Points(self.point - origin[:, None], self.limit, wrench)

    def scaled(self, factor: Float[Array, "*rest"]) -> "_Points":
        """The same with another wrench in the same direction."""
        return self._replace(wrench=self.wrench * factor[None])

    def velocity(self, twist: Float[Array, "3 *rest"]) -> Float[Array, "2 points *rest"]:
        """The velocity of each point."""
        x, y = self.point
        return jnp.stack([twist[0][None] - y * twist[2][None], twist[1][None] + x * twist[2][None]])

    def power(self, twist: Float[Array, "3 *rest"], still: Array | float) -> Float[Array, "*rest"]:
        """D of a twist."""
        return jnp.sum(self.limit * _speeds(self.velocity(twist), still), axis=0)

    def place(self, index: Int[Array, "*rest"]) -> Float[Array, "2 *rest"]:
        """A point by its index."""
        return jnp.take_along_axis(self.point, index[None, None], 1)[:, 0]

    def slowest(self, twist: Float[Array, "3 *rest"]) -> Int[Array, "*rest"]:
        """The index of the point with a load that moves least."""
        return jnp.argmin(jnp.where(self.limit > 0, _speeds(self.velocity(twist), 0.0), jnp.inf), axis=0)

    def stiffness(self, velocity: Array, force: Array, still: Array | float) -> Float[Array, "3 3 *rest"]:
        """The derivative of the total force by the twist, given forces in units of their limits."""
        speed = _speeds(velocity, still)
        (x, y), along = force, velocity / speed[None]
        parts = 1 - x * along[0], -(x * along[1] + y * along[0]) / 2, 1 - y * along[1]
        return _summed_over_points(self.point, *(self.limit / speed * part for part in parts))

    def newton_step(self, stiffness: Array, twist: Array, still: Array | float) -> Float[Array, "3 *rest"]:
        """The Newton step for the least D, with F . V = 1."""
        velocity = self.velocity(twist)
        fx, fy = force = self.limit[None] * velocity / _speeds(velocity, still)[None]
        x, y = self.point
        total = jnp.stack([*jnp.sum(force, axis=1), jnp.sum(x * fy - y * fx, axis=0)])
        # D does not curve along V, and F . V does not change
        wrench = self.wrench
        inverse = _inverse(stiffness + jax.lax.stop_gradient(wrench[:, None] * wrench[None]))
        by_wrench, by_force = combined(inverse, wrench), combined(inverse, total)
        missing = 1 - dot(wrench, twist) + dot(wrench, by_force)
        return by_wrench * (missing / dot(wrench, by_wrench))[None] - by_force


class _Search(NamedTuple):
    """State between two steps."""

    index: Int[Array, "*rest"]  # the slowest point
    twist: Float[Array, "3 *rest"]  # about that point, where it is right to more digits
    force: Float[Array, "2 points *rest"]  # in units of the limits
    still: Float[Array, "*rest"]  # e
    ongoing: Bool[Array, "*rest"]
    number: Int[Array, ""]


def _search(
    points: _Points, near: Float[Array, "3 *rest"]
) -> tuple[Float[Array, "2 *rest"], Float[Array, "3 *rest"], Float[Array, "*rest"]]:
    """Find the largest F . V / D(V): the slowest point, V about that point with D(V) = 1, and 1 / (F . V)."""
    least, limit = STANDS_STILL[points.wrench.dtype.itemsize], points.limit
    lengths = jnp.asarray(LENGTHS, limit.dtype).reshape(-1, *(1,) * limit.ndim)

    def start(twist: Array, still: Array) -> _Search:
        index, velocity = points.slowest(twist), points.velocity(twist)
        force = velocity / jnp.maximum(_speeds(velocity, 0.0), least)[None]
        local = _at_frame(twist, -points.place(index))
        return _Search(index, local, force, still, still > 0, jnp.zeros((), jnp.int32))

    def step(state: _Search) -> _Search:
        starts_anew = is_near & (state.number == MAX_STEPS_NEAR) & state.ongoing
        state = _where(starts_anew, anew, state)
        index, twist, force, still, _, number = state
        origin = points.place(index)
        slowest = points.about(origin).slowest(twist)
        local, twist = points.about(points.place(slowest)), _at_frame(twist, origin - points.place(slowest))
        power = local.power(twist, 0.0)
        # in units of mean speeds
        local, twist = local.scaled(_ratio(power, dot(local.wrench, twist))), twist / power[None]
        velocity = local.velocity(twist)
        speed = _speeds(velocity, still)
        change = local.newton_step(local.stiffness(velocity, force, still), twist, still)
        moved, along = local.velocity(change), velocity / speed[None]
        force = along + (moved - force * jnp.sum(along * moved, axis=0)[None]) / speed[None]
        size = _speeds(force, 0.0)
        force = force / jnp.maximum(size, 1.0)[None]
        tried = _speeds(velocity[:, None] + lengths[None] * moved[:, None], still)
        powers = jnp.sum(limit[None] * tried, axis=1)
        is_full = powers[0] <= (1 + ROUNDOFF * jnp.finfo(speed.dtype).eps) * jnp.min(powers, axis=0)
        length = jnp.where(is_full, 1.0, lengths.reshape(-1)[jnp.argmin(powers, axis=0)])
        twist = twist + length[None] * change
        by = jnp.max(jnp.abs(change), axis=0)
        # of the force at any point
        error = jnp.max(jnp.where(limit > 0, jnp.maximum(_speeds(moved, 0.0) / speed, size - 1), 0.0), axis=0)
        ongoing = ~is_full | (jnp.maximum(by, error) > CLOSE_STEP) | (still > least)
        still = jnp.where(is_full, jnp.maximum(RATE * still, least), still)
        new = _Search(slowest, twist, force, still, ongoing, number + 1)
        return _where(state.ongoing, new, state)

    viscous = combined(_inverse(_viscous(points.point, limit)), points.wrench)
    is_near = dot(points.wrench, near) * points.power(viscous, 0.0) > dot(points.wrench, viscous) * points.power(
        near, 0.0
    )
    anew = start(viscous, jnp.full_like(viscous[0], RATE))
    there = start(near, jnp.full_like(viscous[0], least))
    last = jax.lax.while_loop(
        lambda state: jnp.any(state.ongoing) & (state.number < MAX_STEPS), step, _where(is_near, there, anew)
    )
    origin = points.place(last.index)
    local, power = points.about(origin), points.about(origin).power(last.twist, 0.0)
    return origin, last.twist / power[None], _ratio(power, dot(local.wrench, last.twist))


def _where(condition: Bool[Array, "*rest"], a: _Search, b: _Search) -> _Search:
    """`a` where the condition holds, else `b`, with the larger number."""
    chosen = jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
    return chosen._replace(number=jnp.maximum(a.number, b.number))


def _ratio(a: Array, b: Array) -> Array:
    """a / b, and one where b is not positive."""
    return jnp.where(b > 0, a / jnp.where(b > 0, b, 1.0), 1.0)


def _inverse(matrix: Float[Array, "3 3 *rest"]) -> Float[Array, "3 3 *rest"]:
    """Inverses of symmetric matrices, however small the determinants are."""
    return dual(matrix, 0.0)[0]


def _speeds(velocity: Float[Array, "2 *rest"], still: Array | float) -> Float[Array, "*rest"]:
    still = jnp.asarray(still, velocity.dtype)
    missing = velocity.ndim - 1 - still.ndim
    return jnp.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + jnp.expand_dims(still, tuple(range(missing))) ** 2)


def _at_frame(twist: Float[Array, "3 *rest"], origin: Float[Array, "2 *rest"]) -> Float[Array, "3 *rest"]:
    """A twist about `origin`, about the origin of coordinates."""
    return jnp.stack([twist[0] + origin[1] * twist[2], twist[1] - origin[0] * twist[2], twist[2]])


def _turned_to(origin: Float[Array, "2 *rest"], inverse: Float[Array, "3 3 *rest"]) -> Float[Array, "3 3 *rest"]:
    """A map from wrenches to twists about `origin`, about the origin of coordinates."""
    for axis in (0, 1):
        inverse = jnp.stack([_at_frame(inverse.take(k, axis), origin) for k in range(3)], axis)
    return inverse


def _viscous(point: Array, factor: Array) -> Float[Array, "3 3 *rest"]:
    """The stiffness of points that resist in proportion to their velocity."""
    return _summed_over_points(point, factor, jnp.zeros_like(factor), factor)


def _summed_over_points(point: Array, xx: Array, xy: Array, yy: Array) -> Float[Array, "3 3 *rest"]:
    """The sum of R' [[xx, xy], [xy, yy]] R over points that move with R V."""
    x, y = point
    turned = -xx * y + xy * x, -xy * y + yy * x
    entries = [xx, xy, turned[0], xy, yy, turned[1], *turned, x * turned[1] - y * turned[0]]
    total = jnp.stack([jnp.sum(entry, axis=0) for entry in entries])
    return total.reshape(3, 3, *total.shape[1:])
