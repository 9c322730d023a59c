"""Solvers for a sticking contact: they find the force that moves the contact point parallel to the push.

The result is the force's ratio s = f_t / f_n. Two solvers find the same ratio, and the tests compare them with each
other. `ScalarRoot`, the default, is cheaper: it searches along the friction cone. `paper.HessianIteration` is the
iteration of Zhou et al. 2017.

Both have exact derivatives by the implicit function theorem. At the solution cross(motion(s), v) = 0, so one division
gives ds from the changes of h and v. The iterations are never differentiated. While a contact sticks, the solution does
not depend on the coefficient of friction: ds/dmu = 0.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp

from pushjax._internal.xla import compute_once
from pushjax._math.vec import Scalar, Vec2
from pushjax.contact.contact_plane import LimitCurve

MAX_ITERATIONS = 12  # iterations with a bracket at most; see `ScalarRoot`


class StickingSolver(eqx.Module):
    """Finds the ratio f_t / f_n of a sticking contact. It has settings only, no state."""

    @abstractmethod
    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> Scalar:
        """Search for the ratio; not differentiated.

        Args:
            curve: Limit curve of the contact.
            v: Displacement (n, t) of the pusher, the gap subtracted.
            friction: Coefficient of friction mu.

        Returns:
            The ratio. It is meaningful only where v_n > 0 and the contact sticks, and always finite.
        """

    def __call__(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Scalar]:
        """Find the ratio, with its derivatives, and its residual; the arguments are as in `iterate`.

        The residual is the sine of the angle that is left between motion and push, less roundoff.
        """
        ratio = _solve(self, curve, v, friction)
        motion = curve.motion(ratio)
        size = jnp.sqrt(motion.dot(motion) * v.dot(v))
        # The roundoff of the terms of g is subtracted, because no iteration can reduce it: where h is ill-conditioned
        # (the square of a thin ellipsoid), g is a small difference of large terms.
        absolute_terms = LimitCurve(tuple(jnp.abs(c) for c in curve.c)).motion(jnp.abs(ratio))
        roundoff = 4 * jnp.finfo(size.dtype).eps * (absolute_terms.x * jnp.abs(v.y) + absolute_terms.y * jnp.abs(v.x))
        residual = jnp.maximum(jnp.abs(motion.cross(v)) - roundoff, 0) / jnp.where(size > 0, size, 1.0)
        return ratio, jax.lax.stop_gradient(residual)


@eqx.filter_custom_jvp
def _solve(solver: StickingSolver, curve: LimitCurve, v: Vec2, friction: Scalar):
    """`StickingSolver.iterate`, with derivatives by the implicit function theorem."""
    return solver.iterate(curve, v, friction)


@_solve.def_jvp
def _solve_jvp(primals, tangents):
    solver, curve, v, friction = primals
    _, d_curve, d_v, _ = tangents
    ratio = _solve(solver, curve, v, friction)
    zero = jnp.zeros_like(ratio)
    # Equinox gives None as the tangent of what is not perturbed.
    d_curve = LimitCurve(tuple(zero if d is None else d for d in d_curve.c))
    d_v = Vec2(*(zero if d is None else d for d in d_v))
    motion, d_motion = curve.motion(ratio), d_curve.motion(ratio)
    slope = _slope(curve, v, ratio, motion)
    change = d_motion.cross(v) + motion.cross(d_v)
    usable = slope > jnp.finfo(slope.dtype).tiny
    d_ratio = jnp.where(usable, change / jnp.where(usable, slope, 1.0), 0.0)
    return ratio, d_ratio


def _slope(curve: LimitCurve, v: Vec2, s: Scalar, motion: Vec2) -> Scalar:
    """Derivative with respect to s of cross(v, motion(s)) = v_n h' - v_t (d h - s h'); `motion` is motion(s)."""
    second = curve.second_derivative(s)
    return v.x * second - v.y * ((curve.degree - 1) * motion.y - s * second)


class ScalarRoot(StickingSolver):
    """Safeguarded Newton's method for s on r(s) = cross(v, motion(s)) / h(s)^((d-2)/d), inside the friction cone.

    With this divisor r is linear for an ellipsoid and for the square of one, however badly conditioned. Newton's method
    on r is `HessianIteration` expressed in s, iteration for iteration: the division undoes what the rescaling does
    there. Only the safeguards differ. The safeguard here is a bracket, which is bisected where Newton's step fails.

    An ellipsoid needs no search, because its root has a closed form. For a quartic 12 iterations are enough: of
    53 000 random sticking contacts (`pushjax.testing.problems`: condition of the Hessian up to 1e3, friction up to 3)
    all had converged to 4e-10 after 10 safeguarded iterations alone, and 97 % after 5.

    """

    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> Scalar:
        # start with the force along v: there motion . v = d h > 0, so motion and push do not oppose each other
        forward = v.x > 0
        s = jnp.clip(v.y / jnp.where(forward, v.x, 1.0), -friction, friction)
        if curve.degree == 2:
            motion = curve.motion(s)
            slope = _slope(curve, v, s, motion)
            s = jnp.clip(s - v.cross(motion) / jnp.where(slope > 0, slope, 1.0), -friction, friction)
            return s
        eps = float(jnp.finfo(s.dtype).eps)
        # Newton's method doubles the digits, so it has converged after a step as short as `newton_tolerance`. A
        # bisection is only as exact as its own length, so that has to be as short as `bisection_tolerance`.
        newton_tolerance, bisection_tolerance = eps**0.6 * friction, eps**0.9 * friction
        unguarded, converged = 4 if eps > 1e-10 else 5, jnp.zeros_like(forward)
        # These iterations have no bracket, and are enough for nearly all contacts. A contact that has not converged
        # then continues with the bracket. In a batch that loop costs nothing if all contacts have converged.
        for _ in range(unguarded):
            next_s, power, rising, _ = _newton_step(curve, v, s)
            converged = rising & (power > 0) & (jnp.abs(next_s - s) <= newton_tolerance) & (jnp.abs(next_s) <= friction)
            s = compute_once(jnp.clip(next_s, -friction, friction), v.x)
        converged = compute_once(converged | (friction <= 0), v.x)  # without friction there is nothing to find

        def guarded_iteration(state):
            # Let phi(s) be the angle of motion(s) and phi_v that of v. The sign of phi(s) - phi_v says which end of the
            # bracket moves to s. This difference is monotone even beyond 90 degrees, where r is not. The bracket is
            # bisected where Newton's step would leave it, where motion and push oppose each other, and, from the third
            # iteration on, where they are still more than 30 degrees apart.
            s, low, high, _, k = state
            newton, power, rising, (r, angle_sign) = _newton_step(curve, v, s)
            low, high = jnp.where(angle_sign > 0, low, s), jnp.where(angle_sign < 0, high, s)
            trusted = rising & (power > 0) & (newton >= low) & (newton <= high)
            trusted &= (k < 2) | (3 * r * r < power * power)
            next_s = jnp.where(trusted, newton, (low + high) / 2)
            unfinished = jnp.abs(next_s - s) > jnp.where(trusted, newton_tolerance, bisection_tolerance)
            return next_s, low, high, unfinished, k + 1

        # a loop, because in an unrolled one the compiler would recompute each bracket from all iterations before it
        start = (s, -friction, friction, ~converged, jnp.zeros_like(s, jnp.int32))
        return jax.lax.while_loop(lambda state: state[3] & (state[4] < MAX_ITERATIONS), guarded_iteration, start)[0]


def _newton_step(curve: LimitCurve, v: Vec2, s: Scalar):
    """Return Newton's next s, v . motion(s), whether the slope is positive, and two numbers for the bracket."""
    # The two numbers are r h^((d-2)/d), and one with the sign of phi(s) - phi_v.
    motion = curve.motion(s)
    r, power = v.cross(motion), v.dot(motion)
    degree_times_h = motion.x + s * motion.y  # Euler's identity
    slope = _slope(curve, v, s, motion) * degree_times_h - (curve.degree - 2) * r * motion.y
    rising = (slope > 0) & (degree_times_h > 0)
    next_s = s - r * degree_times_h / jnp.where(rising, slope, 1.0)
    return next_s, power, rising, (r, jnp.where(motion.x > 0, r, motion.y))
