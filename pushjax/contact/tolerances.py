"""Tolerances of a dimensionless contact problem (`scaled_problem`): what counts as zero, as equal, and as too large."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._math.arrays import dot
from pushjax._math.sums import summed

# Up to this factor above `max_twist_ratio`, a twist still shows that a motion exists. Beyond it, rows that are
# dependent up to roundoff can give any number.
TOO_FAST = 8


def relative_tolerance(dtype) -> float:
    """Tolerance on a condition, relative to the fastest pusher or the whole force: 4e-10, or 7e-5 in float32."""
    return float(jnp.finfo(dtype).eps) ** 0.6


def ill_conditioned_tolerance(dtype) -> float:
    """Tolerance where the slider moves much faster than its pushers, which magnifies roundoff: 6e-9 in float64."""
    # in float32 it is the same as `relative_tolerance`, because there are no digits to spare
    return relative_tolerance(dtype) * (15 if jnp.finfo(dtype).bits > 32 else 1)


def kinematic_tolerance(twist: Float[Array, "3 *rest"]) -> Float[Array, "*rest"]:
    """Tolerance on the violation of a kinematic condition, in units of the fastest pusher."""
    # It is `relative_tolerance` plus the roundoff of the twist, but at most `ill_conditioned_tolerance`. The roundoff
    # matters where the slider moves much faster than its pushers, as when it escapes from a wedge. In float32 the upper
    # bound equals `relative_tolerance`, so nothing is added. For a twist that is too fast to be an answer
    # (`max_twist_ratio`), the tolerance is the roundoff alone.
    eps, size = float(jnp.finfo(twist.dtype).eps), summed(jnp.abs(twist), 0)
    usual = jnp.minimum(relative_tolerance(twist.dtype) + 64 * eps * size, ill_conditioned_tolerance(twist.dtype))
    return jnp.where(is_slow(dot(twist, twist)), usual, 8 * eps * size)


def max_twist_ratio(dtype) -> float:
    """Largest twist that can be an answer, in units of the fastest pusher: 4.5e7 in float64, 840 in float32."""
    # For a twist of this size roundoff alone violates a condition by 1e-8, or by 1e-4 in float32. `Motion` promises no
    # more than that.
    return (1e-8 if jnp.finfo(dtype).bits > 32 else 1e-4) / float(jnp.finfo(dtype).eps)


def is_slow(squared: Float[Array, "*rest"], factor: float = 1) -> Bool[Array, "*rest"]:
    """Whether a twist with this square is at most a multiple of `max_twist_ratio`."""
    return squared <= (factor * max_twist_ratio(squared.dtype)) ** 2


def same_solution_tolerance(dtype) -> float:
    """Relative difference up to which two twists are one solution: roundoff through an ill-conditioned set."""
    return max(1e-6, 10 * relative_tolerance(dtype))


def zero_wrench_tolerance(dtype) -> float:
    """Size up to which a wrench may be nothing but the roundoff of forces of order one that cancel in it."""
    return float(jnp.finfo(dtype).eps) ** 0.8


def min_determinant(dtype) -> float:
    """Smallest determinant that counts as nonzero: neither its inverse nor products with the inverse overflow."""
    return float(jnp.finfo(dtype).tiny) ** 0.5
