"""The surface's inverse map at a fixed cost, up to the wrench's size: what the contact solvers need."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec3, settle
from pushjax.limit_surface._base import Form

CLOSE = 0.01  # a step of so much of the wrench leaves an error of about its square


def aligned_wrench(form: Form, twist: Vec3, wanted: Bool[Array, ""], tolerance: float) -> tuple[Vec3, Bool[Array, ""]]:
    """A wrench, of any size, whose grad H is along `twist`; and whether it is, to `tolerance`. wanted: False where it
    does not matter, which holds up no batch.

    Newton's method on grad H(F) = c V. By homogeneity only the direction of F counts, so F is never rescaled: c is set
    to what suits F as it is (c = d H / (V . F)), which saves a root a round. The first rounds choose the longest
    useful of a few steps by V . F / H^(1/d), whose largest value is the solution. They end with a full step shorter
    than CLOSE. (Not by the residual: where H is nearly flat, a small one may be far from the solution.) Of 20 000
    twists of random surfaces of condition up to 1e3, and of each of seven fitted ones, on two supports to a rectangle,
    every one was found, in float32 and float64.
    """
    d = form.degree
    squared = twist.dot(twist)
    v = settle(twist.scale(jax.lax.rsqrt(jnp.where(squared > 0, squared, 1.0))), squared)
    search, plain = (0, 2) if d == 2 else (5, 1 if jnp.finfo(squared.dtype).bits <= 32 else 3)

    def newton(f: Vec3):
        g = form.gradient(f)
        power = f.dot(v)
        dh = f.dot(g)
        c = dh / jnp.where(power > 0, power, 1.0)
        rest = v.scale(c) - g
        return g, power, dh / d, form.hessian(f).solve(rest)

    def searched(state):
        count, f, _ = state
        g, power, h, step = settle(newton(f), squared)
        c1, c2 = g.dot(step), form.hessian(f).times(step).dot(step) / 2
        g_step = form.gradient(step)
        c3, c4 = f.dot(g_step), step.dot(g_step) / 4
        c1, c2, c3, c4, gain = settle((c1, c2, c3, c4, step.dot(v)), squared)  # once, not for every merit

        def merit(t: float) -> Scalar:
            p = power + t * gain
            value = h + t * (c1 + t * (c2 + t * (c3 + t * c4)))
            return jnp.where((value > 0) & (p > 0), (p * p) * (p * p) / jnp.where(value > 0, value, 1.0), 0.0)

        best, top = jnp.ones_like(power), merit(1.0)
        for t in (0.5, 0.2, 0.06, 0.02, 0.005, 2.0):
            this = merit(t)
            best, top = jnp.where(this > top, t, best), jnp.maximum(this, top)
        best = settle(best, squared)
        far = (best != 1) | (step.dot(step) > CLOSE**2 * f.dot(f)) | (power <= 0)
        return count + 1, settle(f + step.scale(best), squared), far & (count + 1 < search)

    def plainly(_, f: Vec3) -> Vec3:
        return settle(f + newton(f)[3], squared)

    f = v
    if search:
        _, f, _ = jax.lax.while_loop(lambda state: state[2], searched, (jnp.zeros((), jnp.int32), v, wanted))
    f = jax.lax.fori_loop(0, plain, plainly, f)
    g = form.gradient(f)
    power = f.dot(v)
    c = f.dot(g) / jnp.where(power > 0, power, 1.0)
    rest = v.scale(c) - g
    aligned = (power > 0) & (rest.dot(rest) <= (tolerance * c) ** 2) & (squared > 0)
    return f, aligned
