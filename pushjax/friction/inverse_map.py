"""The inverse map of limit surfaces, from twists to wrenches, in a bounded number of rounds; for contact solvers."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._math.arrays import dot, solve, times
from pushjax.friction.polynomial import Polynomial

CLOSE_STEP = 0.01  # step relative to the wrench; the relative error after such a step is about its square
LENGTHS = (1.0, 0.5, 0.2, 0.06, 0.02, 0.005, 2.0)  # of a step, that are tried


def aligned_wrenches(
    surface: Polynomial,
    twist: Float[Array, "3 batch"],
    wanted: Bool[Array, " batch"],  # the others do not keep the loop running
    tolerance: float,
) -> tuple[Float[Array, "3 batch"], Bool[Array, " batch"]]:
    """Find wrenches of any scale whose grad H is along `twist` to `tolerance`, rad, and whether that succeeded."""
    # Newton's method on grad H(F) = c V, where V is the unit twist. By homogeneity only the direction of F matters. So
    # F is never rescaled to the level set, which would need a d-th root in each round. Instead the factor
    # c = d H / (V . F) is fitted to the current F; d is the degree of H.
    # The first rounds are a line search: each takes, out of a few step lengths, the one with the largest merit V . F /
    # H^(1/d), whose maximum is the solution. It ends after a full step shorter than `CLOSE_STEP`. The residual would
    # not be a safe criterion: where H is nearly flat, a wrench with a small residual may be far from the solution. A
    # fixed number of full Newton steps follows.
    # It converged for all twists tried, in float32 and float64: 20 000 twists of random surfaces with condition numbers
    # up to 1e3, and 20 000 of each of seven fitted surfaces, whose supports range from two points to a rectangle.
    degree, squared = surface.degree, dot(twist, twist)
    unit_twist = twist * jax.lax.rsqrt(jnp.where(squared > 0, squared, 1.0))[None]
    max_searches, full_steps = (0, 2) if degree == 2 else (5, 1 if jnp.finfo(squared.dtype).bits <= 32 else 3)
    lengths = jnp.asarray(LENGTHS, twist.dtype).reshape(-1, *(1,) * squared.ndim)

    def newton_step(f: Array) -> tuple[Array, Array, Array, Array]:
        """Return the Hessian, grad H, the power V . f and the Newton step."""
        hessian = surface.hessian(f)
        gradient = times(hessian, f) / (degree - 1)
        power = dot(f, unit_twist)
        factor = dot(f, gradient) / jnp.where(power > 0, power, 1.0)
        return hessian, gradient, power, solve(hessian, unit_twist * factor[None] - gradient)

    def line_search_round(state):
        count, f, _ = state
        hessian, gradient, power, step = newton_step(f)
        g_step = surface.gradient(step)
        # H(f + t step), by its coefficients in t
        h, c1, c2 = dot(f, gradient) / 4, dot(gradient, step), dot(times(hessian, step), step) / 2
        c3, c4 = dot(f, g_step), dot(step, g_step) / 4
        value = h[None] + lengths * (c1[None] + lengths * (c2[None] + lengths * (c3[None] + lengths * c4[None])))
        p = power[None] + lengths * dot(step, unit_twist)[None]
        # (V . F)^4 / H, the fourth power of the merit; only surfaces of degree four are searched
        merit = jnp.where((value > 0) & (p > 0), (p * p) * (p * p) / jnp.where(value > 0, value, 1.0), 0.0)
        length = lengths.reshape(-1)[jnp.argmax(merit, axis=0)]
        is_far = (length != 1) | (dot(step, step) > CLOSE_STEP**2 * dot(f, f)) | (power <= 0)
        new = jnp.where(state[2][None], f + step * length[None], f)
        return count + 1, new, state[2] & is_far & (count + 1 < max_searches)

    f = unit_twist
    if max_searches:
        start = jnp.zeros((), jnp.int32), unit_twist, wanted
        _, f, _ = jax.lax.while_loop(lambda state: jnp.any(state[2]), line_search_round, start)
    f = jax.lax.fori_loop(0, full_steps, lambda _, f: f + newton_step(f)[3], f)
    gradient = surface.gradient(f)
    power = dot(f, unit_twist)
    factor = dot(f, gradient) / jnp.where(power > 0, power, 1.0)
    residual = unit_twist * factor[None] - gradient
    return f, (power > 0) & (dot(residual, residual) <= (tolerance * factor) ** 2) & (squared > 0)
