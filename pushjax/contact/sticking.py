"""Solvers for a sticking contact: they find the force that moves the contact point parallel to the push.

The result is the force's ratio s = f_t / f_n. Two solvers find the same ratio, and the tests compare them with each
other. `ScalarRoot`, the default, is cheaper: it searches along the friction cone. `HessianIteration` is the iteration
of Zhou et al. 2017 ("the paper").

Both have exact derivatives by the implicit function theorem. At the solution cross(motion(s), v) = 0, so one division
gives ds from the changes of h and v. The iterations are never differentiated. While a contact sticks, the solution does
not depend on the coefficient of friction: ds/dmu = 0.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from pushjax._internal.xla import compute_once, decide
from pushjax._math.vec import Scalar, Vec2
from pushjax.contact.contact_plane import LimitCurve

MAX_ITERATIONS = 12  # iterations with a bracket at most; see `ScalarRoot`


def sticking_tolerance(dtype) -> float:
    """Largest sine of the angle between motion and push that counts as sticking: 4e-10, or 7e-5 in float32."""
    return float(jnp.finfo(dtype).eps) ** 0.6


def finest_tolerance(dtype) -> float:
    """Sine of the angle at which `HessianIteration` stops: 3e-13 in float64, 3e-6 in float32.

    It can be reached even for ill-conditioned limit surfaces.
    """
    return float(jnp.finfo(dtype).eps) ** 0.8


class Sticking(NamedTuple):
    """The result of a search for a sticking contact.

    Attributes:
        ratio: The ratio f_t / f_n.
        residual: Sine of the angle that is left between motion and push, less what is roundoff.
        iterations: Number of iterations.
    """

    ratio: Scalar
    residual: Scalar
    iterations: Int[Array, ""]


class StickingSolver(eqx.Module):
    """Finds the ratio f_t / f_n of a sticking contact. It has settings only, no state."""

    @abstractmethod
    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        """Search for the ratio; not differentiated.

        Args:
            curve: Limit curve of the contact.
            v: Displacement (n, t) of the pusher, the gap subtracted.
            friction: Coefficient of friction mu.

        Returns:
            The ratio and the number of iterations. The ratio is meaningful only where v_n > 0 and the contact sticks.
            It is always finite.
        """

    def __call__(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> Sticking:
        """Find the ratio, with its derivatives, and say how exact it is.

        Args:
            curve: Limit curve of the contact.
            v: Displacement (n, t) of the pusher, the gap subtracted.
            friction: Coefficient of friction mu.

        Returns:
            The ratio, its residual and the number of iterations.
        """
        ratio, iterations = _solve(self, curve, v, friction)
        motion = curve.motion(ratio)
        size = jnp.sqrt(motion.dot(motion) * v.dot(v))
        # The roundoff of the terms of g is subtracted, because no iteration can reduce it: where h is ill-conditioned
        # (the square of a thin ellipsoid), g is a small difference of large terms.
        absolute_terms = LimitCurve(tuple(jnp.abs(c) for c in curve.c)).motion(jnp.abs(ratio))
        roundoff = 4 * jnp.finfo(size.dtype).eps * (absolute_terms.x * jnp.abs(v.y) + absolute_terms.y * jnp.abs(v.x))
        residual = jnp.maximum(jnp.abs(motion.cross(v)) - roundoff, 0) / jnp.where(size > 0, size, 1.0)
        return Sticking(ratio, jax.lax.stop_gradient(residual), iterations)


@eqx.filter_custom_jvp
def _solve(solver: StickingSolver, curve: LimitCurve, v: Vec2, friction: Scalar):
    """`StickingSolver.iterate`, with derivatives by the implicit function theorem."""
    return solver.iterate(curve, v, friction)


@_solve.def_jvp
def _solve_jvp(primals, tangents):
    solver, curve, v, friction = primals
    _, d_curve, d_v, _ = tangents
    ratio, iterations = _solve(solver, curve, v, friction)
    zero = jnp.zeros_like(ratio)
    # Equinox gives None as the tangent of what is not perturbed.
    d_curve = LimitCurve(tuple(zero if d is None else d for d in d_curve.c))
    d_v = Vec2(*(zero if d is None else d for d in d_v))
    motion, d_motion = curve.motion(ratio), d_curve.motion(ratio)
    slope = _slope(curve, v, ratio, motion)
    change = d_motion.cross(v) + motion.cross(d_v)
    usable = slope > jnp.finfo(slope.dtype).tiny
    d_ratio = jnp.where(usable, change / jnp.where(usable, slope, 1.0), 0.0)
    return (ratio, iterations), (d_ratio, np.zeros(np.shape(iterations), jax.dtypes.float0))


def _slope(curve: LimitCurve, v: Vec2, s: Scalar, motion: Vec2) -> Scalar:
    """Derivative with respect to s of cross(v, motion(s)) = v_n h' - v_t (d h - s h'); `motion` is motion(s)."""
    second = curve.second_derivative(s)
    return v.x * second - v.y * ((curve.degree - 1) * motion.y - s * second)


class ScalarRoot(StickingSolver):
    """Safeguarded Newton's method for s on r(s) = cross(v, motion(s)) / h(s)^((d-2)/d), inside the friction cone.

    With this divisor r is linear for an ellipsoid and for the square of one, however badly conditioned. Newton's method
    on r is `HessianIteration` expressed in s, iteration for iteration: the division undoes what the rescaling does
    there. Only the safeguards differ.

    The safeguard here is a bracket. Let phi(s) be the angle of motion(s) and phi_v that of v. The sign of
    phi(s) - phi_v says which end of the bracket moves to s. This difference is monotone even beyond 90 degrees, where r
    is not. The bracket is bisected where Newton's step would leave it, where motion and push oppose each other, and,
    from the third iteration on, where they are still more than 30 degrees apart.

    Four iterations (five in float64) without a bracket come first and are enough for nearly all contacts. A contact
    that has not converged then continues with the bracket. In a batch that loop costs nothing if all contacts have
    converged.

    An ellipsoid takes none of these iterations, because its root has a closed form. For a quartic the default of 12 is
    enough: of 53 000 random sticking contacts (`pushjax.testing.problems`: condition of the Hessian up to 1e3, friction
    up to 3) all had converged to 4e-10 after 10 safeguarded iterations alone, and 97 % after 5.

    Attributes:
        rounds: Largest number of safeguarded iterations for a quartic; None for 12.
    """

    rounds: int | None = eqx.field(static=True, default=None)

    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        # start with the force along v: there motion . v = d h > 0, so motion and push do not oppose each other
        forward = v.x > 0
        s = jnp.clip(v.y / jnp.where(forward, v.x, 1.0), -friction, friction)
        if curve.degree == 2:
            motion = curve.motion(s)
            slope = _slope(curve, v, s, motion)
            s = jnp.clip(s - v.cross(motion) / jnp.where(slope > 0, slope, 1.0), -friction, friction)
            return s, jnp.ones_like(s, jnp.int32)
        eps = float(jnp.finfo(s.dtype).eps)
        # Newton's method doubles the digits, so it has converged after a step as short as `newton_tolerance`. A
        # bisection is only as exact as its own length, so that has to be as short as `bisection_tolerance`.
        newton_tolerance, bisection_tolerance = eps**0.6 * friction, eps**0.9 * friction
        unguarded, max_guarded = 4 if eps > 1e-10 else 5, MAX_ITERATIONS if self.rounds is None else self.rounds
        converged = jnp.zeros_like(forward)
        for _ in range(unguarded):
            next_s, power, rising, _ = _newton_step(curve, v, s)
            converged = rising & (power > 0) & (jnp.abs(next_s - s) <= newton_tolerance) & (jnp.abs(next_s) <= friction)
            s = compute_once(jnp.clip(next_s, -friction, friction), v.x)
        converged = decide(converged | (friction <= 0), v.x)  # without friction there is nothing to find

        def guarded_iteration(state):
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
        s, *_, guarded = jax.lax.while_loop(lambda state: state[3] & (state[4] < max_guarded), guarded_iteration, start)
        return s, unguarded + guarded


def _newton_step(curve: LimitCurve, v: Vec2, s: Scalar):
    """One step of Newton's method from s.

    Returns:
        The next s; the power v . motion(s); whether the slope has the right sign; and a pair of r h^((d-2)/d) and a
        number with the sign of phi(s) - phi_v.
    """
    motion = curve.motion(s)
    r, power = v.cross(motion), v.dot(motion)
    degree_times_h = motion.x + s * motion.y  # Euler's identity
    slope = _slope(curve, v, s, motion) * degree_times_h - (curve.degree - 2) * r * motion.y
    rising = (slope > 0) & (degree_times_h > 0)
    next_s = s - r * degree_times_h / jnp.where(rising, slope, 1.0)
    return next_s, power, rising, (r, jnp.where(motion.x > 0, r, motion.y))


class HessianIteration(StickingSolver):
    """The paper's iteration, reduced to the contact plane and damped so that it becomes Newton's method.

    The paper iterates F <- A_t^-1 D^-1 V_p with A_t = hess H(F_t), where V_p is the push and D the paper's 3 x 3
    matrix. With a sticking contact F stays in the plane F = J'f (J as in `contact_plane`), and A_t and D reduce to the
    2 x 2 Hessian J hess H J' of the limit curve's h. By Euler's identity the paper's step, damped by 1/(d - 1), is
    Newton's step on grad h(f) = v / (d - 1). It converges quadratically. The paper halves its step instead, which only
    halves the error in each iteration. Without damping the iteration diverges for d = 4.

    v - grad h is minus the gradient of the convex function h(f) - v . f, so a line search on that function makes the
    step safe. The line search tries the step and its halvings down to 1/512, and takes the one where the slope along
    the step is nearest to zero. It compares slopes because near the solution the differences of the function itself are
    lost in roundoff. Each iteration ends with the best multiple of f (closed form by homogeneity). This makes the
    number of iterations independent of the scale of H.

    Attributes:
        max_rounds: Largest number of iterations.
        tolerance: Sine of the angle between motion and push at which the iteration stops; None for `finest_tolerance`.

    Reference: Zhou et al. 2017, section IV.A, corollary 1. Deviations: the damping, the line search, the rescaling.
    """

    max_rounds: int = eqx.field(static=True, default=25)
    tolerance: float | None = eqx.field(static=True, default=None)

    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        f, iterations, _ = self.trace(curve, v)
        # where f_n <= 0 the contact does not stick, and any finite ratio will do
        forward = f.x > 0
        return jnp.where(forward, f.y / jnp.where(forward, f.x, 1.0), friction), iterations

    def trace(self, curve: LimitCurve, v: Vec2) -> tuple[Vec2, Int[Array, ""], Scalar]:
        """Find the force whose motion is along v, without the limits of a friction cone.

        Args:
            curve: Limit curve of the contact.
            v: Displacement (n, t) of the pusher, the gap subtracted.

        Returns:
            The force (f_n, f_t), the number of iterations, and the last |sin(angle)| between motion and v.
        """
        size = jnp.sqrt(v.dot(v))
        direction = v.scale(1 / jnp.where(size > 0, size, 1.0))
        tolerance = finest_tolerance(size.dtype) if self.tolerance is None else self.tolerance

        def sine_of_angle(f: Vec2) -> Scalar:
            motion = _gradient(curve, f)
            scale = jnp.sqrt(motion.dot(motion))
            return jnp.abs(motion.cross(direction)) / jnp.where(scale > 0, scale, 1.0)

        def iterate(state):
            f, _, iterations = state
            # `compute_once`, so that the angle is that of the force that is kept
            next_force = compute_once(hessian_round(curve, direction, f), direction.x)
            return next_force, sine_of_angle(next_force), iterations + 1

        start_force = _rescaled(curve, direction, direction)
        state = (start_force, sine_of_angle(start_force), jnp.zeros((), jnp.int32))
        f, residual, iterations = jax.lax.while_loop(
            lambda state: (state[1] > tolerance) & (state[2] < self.max_rounds), iterate, state
        )
        return f, iterations, residual


def hessian_round(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """One iteration of `HessianIteration`.

    Args:
        curve: Limit curve of the contact.
        v: Displacement (n, t) of the pusher.
        f: The force (f_n, f_t) before the iteration.

    Returns:
        The force after it.
    """
    gradient = _gradient(curve, f)
    h_nn, h_nt, h_tt = _hessian(curve, f)
    residual = v - gradient
    det = h_nn * h_tt - h_nt * h_nt
    singular = det <= 0
    inverse = jnp.where(singular, 0.0, 1.0 / jnp.where(singular, 1.0, det))
    step = compute_once(
        Vec2(h_tt * residual.x - h_nt * residual.y, h_nn * residual.y - h_nt * residual.x).scale(inverse), v.x
    )
    halvings = [0.5**k for k in range(10)]
    slopes = [jnp.abs((_gradient(curve, f + step.scale(t)) - v).dot(step)) for t in halvings]
    best, lowest = halvings[0] * jnp.ones_like(det), slopes[0]
    for t, slope in zip(halvings[1:], slopes[1:], strict=True):
        best = jnp.where(slope < lowest, t, best)
        lowest = jnp.minimum(lowest, slope)
    return _rescaled(curve, v, compute_once(f + step.scale(best), v.x))


def _rescaled(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """The multiple of f at which h(f) - v . f is lowest."""
    d = curve.degree
    power, h = jnp.maximum(v.dot(f), 0), d * _value(curve, f)
    return f.scale((power / jnp.where(h > 0, h, 1.0)) ** (1 / (d - 1)))


def _powers(f: Vec2, degree: int) -> tuple[list, list]:
    """Powers 0 to `degree` of each component."""
    one = jnp.ones_like(f.x)
    xs, ys = [one], [one]
    for _ in range(degree):
        xs.append(xs[-1] * f.x)
        ys.append(ys[-1] * f.y)
    return xs, ys


def _value(curve: LimitCurve, f: Vec2) -> Scalar:
    """h(f)."""
    d = curve.degree
    xs, ys = _powers(f, d)
    return sum((c * xs[d - k] * ys[k] for k, c in enumerate(curve.c)), jnp.zeros_like(f.x))


def _gradient(curve: LimitCurve, f: Vec2) -> Vec2:
    """grad h at f."""
    d = curve.degree
    xs, ys = _powers(f, d)
    zero = jnp.zeros_like(f.x)
    return Vec2(
        sum(((d - k) * c * xs[d - k - 1] * ys[k] for k, c in enumerate(curve.c) if k < d), zero),
        sum((k * c * xs[d - k] * ys[k - 1] for k, c in enumerate(curve.c) if k > 0), zero),
    )


def _hessian(curve: LimitCurve, f: Vec2) -> tuple[Scalar, Scalar, Scalar]:
    """Second derivatives (nn, nt, tt) of h at f."""
    d = curve.degree
    xs, ys = _powers(f, d)
    zero = jnp.zeros_like(f.x)
    terms = list(enumerate(curve.c))
    return (
        sum(((d - k) * (d - k - 1) * c * xs[d - k - 2] * ys[k] for k, c in terms if k < d - 1), zero),
        sum((k * (d - k) * c * xs[d - k - 1] * ys[k - 1] for k, c in terms if 0 < k < d), zero),
        sum((k * (k - 1) * c * xs[d - k] * ys[k - 2] for k, c in terms if k > 1), zero),
    )
