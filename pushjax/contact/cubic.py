"""The roots of cubics in an interval, for arrays."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Iterations of the search for a root, by the size of the floating-point type in bytes.
ITERATIONS = {4: 7, 8: 8}


class Roots(NamedTuple):
    """The intervals between turning points of c0 + c1 u + c2 u^2 + c3 u^3, or of c0 + c1 u, where it is monotone."""

    c: Float[Array, "terms *rest"]  # coefficients, the constant first: four or two
    ends: Float[Array, "ends *rest"]  # of the intervals: four or two
    values: Float[Array, "ends *rest"]  # at the ends

    @staticmethod
    def of(c: Float[Array, "terms *rest"], low: Float[Array, "*rest"], high: Float[Array, "*rest"]) -> "Roots":
        """The intervals between `low` and `high`."""
        if len(c) == 2:
            ends = jnp.stack([low, high])
            return Roots(c, ends, c[:1] + c[1:] * ends)
        # turning points: the roots of c1 + 2 c2 u + 3 c3 u^2 = 0, in a form without cancellation
        discriminant = c[2] * c[2] - 3 * c[3] * c[1]
        turns = discriminant > 0
        q = -(c[2] + jnp.where(c[2] < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(turns, discriminant, 1.0)))
        turn1 = jnp.where(turns & (c[3] != 0), q / jnp.where(c[3] != 0, 3 * c[3], 1.0), low)
        turn2 = jnp.where(turns & (q != 0), c[1] / jnp.where(q != 0, q, 1.0), low)
        turn1, turn2 = jnp.clip(jnp.minimum(turn1, turn2), low, high), jnp.clip(jnp.maximum(turn1, turn2), low, high)
        ends = jnp.stack([low, turn1, turn2, high])
        return Roots(c, ends, _value(c[:, None], ends))

    def exist(self) -> Bool[Array, "intervals *rest"]:
        """Whether there is a root in each interval."""
        low, high, value_low, value_high = self.ends[:-1], self.ends[1:], self.values[:-1], self.values[1:]
        changes_sign = ((value_low <= 0) & (value_high >= 0)) | ((value_low >= 0) & (value_high <= 0))
        return changes_sign & (high > low) & (value_low != value_high)

    def find(self) -> Float[Array, "intervals *rest"]:
        """The root in each interval, where it exists."""
        if len(self.c) == 2:
            return jnp.clip(-self.c[0] / jnp.where(self.c[1] != 0, self.c[1], 1.0), *self.ends)[None]
        c = self.c[:, None]
        search = _Search.of(c, self.ends[:-1], self.ends[1:], self.values[:-1], self.values[1:])
        iterations = ITERATIONS[c.dtype.itemsize]
        return jax.lax.fori_loop(0, iterations, lambda _, state: state.next(c), search).u


def _value(c: Array, u: Array) -> Array:
    """The value of a cubic."""
    return ((c[3] * u + c[2]) * u + c[1]) * u + c[0]


class _Search(NamedTuple):
    """State of the bracketed search for a root, by Laguerre's method with bisection as the safeguard."""

    # Newton's method is not used: from afar each step reduces the distance by a third only, and near two complex roots
    # a step leads far away again.

    u: Array  # estimate of the root, between `near` and `far`
    near: Array  # one end of the bracket; at first `origin`
    far: Array
    origin: Array  # where the search began: where the cubic is smallest, an end of the interval or zero
    sign: Array  # of the cubic at `far`

    @staticmethod
    def of(c: Array, low: Array, high: Array, value_low: Array, value_high: Array) -> "_Search":
        """Begin at the distance from `origin` that the cubic's derivatives there imply for the root."""
        # That distance is right to a factor of two. It is needed because roots may lie a millionth of the interval from
        # a turning point or from u = 0, where the cubic has its scale.
        contains_zero = (low < 0) & (high > 0)
        value_zero = jnp.where(contains_zero, c[0], jnp.inf)
        at_low = jnp.abs(value_low) < jnp.abs(value_high)
        origin, value = jnp.where(at_low, low, high), jnp.where(at_low, value_low, value_high)
        at_zero = jnp.abs(value_zero) < jnp.abs(value)
        origin, value = jnp.where(at_zero, 0.0, origin), jnp.where(at_zero, value_zero, value)
        root_above = (value > 0) != (value_high > value_low)
        far, value_far = jnp.where(root_above, high, low), jnp.where(root_above, value_high, value_low)
        slope = (3 * c[3] * origin + 2 * c[2]) * origin + c[1]
        derivatives = slope, 3 * c[3] * origin + c[2], c[3] + 0 * origin
        tiny = jnp.finfo(value.dtype).tiny
        ratios = [jnp.abs(value) / jnp.where(d != 0, jnp.abs(d), tiny) for d in derivatives]
        distance = jnp.minimum(jnp.minimum(ratios[0], jnp.sqrt(ratios[1])), _approximate_cbrt(ratios[2]))
        u = origin + jnp.where(root_above, 1.0, -1.0) * jnp.minimum(distance, jnp.abs(far - origin))
        return _Search(u, origin, far, origin, jnp.where(value_far > 0, 1.0, -1.0))

    def next(self, c: Array) -> "_Search":
        """One iteration: a Laguerre step, or a bisection where the step leaves the bracket."""
        u = self.u
        value = _value(c, u)
        slope = (3 * c[3] * u + 2 * c[2]) * u + c[1]
        curvature = 6 * c[3] * u + 2 * c[2]
        root_before_u = (value > 0) == (self.sign > 0)  # the root lies between near and u
        near, far = jnp.where(root_before_u, self.near, u), jnp.where(root_before_u, u, self.far)
        square_root = jnp.sqrt(jnp.maximum(4 * slope * slope - 6 * value * curvature, 0))
        denominator = slope + jnp.where(slope < 0, -square_root, square_root)
        laguerre = u - 3 * value / jnp.where(denominator != 0, denominator, 1.0)
        inside = ((laguerre - near) * (laguerre - far) <= 0) & (denominator != 0)
        # the middle by order of magnitude: the geometric mean of the ends' distances from the origin
        near_distance, far_distance = near - self.origin, far - self.origin
        near_distance = jnp.where(
            jnp.abs(near_distance) > 1e-3 * jnp.abs(far_distance), near_distance, 1e-3 * far_distance
        )
        middle = self.origin + jnp.where(far_distance < 0, -1.0, 1.0) * jnp.sqrt(near_distance * far_distance)
        return _Search(jnp.where(inside, laguerre, middle), near, far, self.origin, self.sign)


def _approximate_cbrt(x: Array) -> Array:
    """The cube root of x >= 0 with an error of at most 6 %, by dividing its exponent by three."""
    # an exact cube root takes as long as the iterations that follow
    bits = {4: jnp.int32, 8: jnp.int64}[x.dtype.itemsize]
    one, number = (jax.lax.bitcast_convert_type(v, bits) for v in (jnp.ones_like(x), x))
    three = jnp.full_like(number, 3)
    return jax.lax.bitcast_convert_type(jax.lax.div(number, three) + 2 * jax.lax.div(one, three), x.dtype)
