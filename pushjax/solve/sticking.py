"""Where on the limit curve a sticking contact lies: the ratio s = f_t / f_n whose motion is parallel to the push.

Two ways to the same point, each the other's test. `ScalarRoot`, the default, is cheaper: it walks along the friction
cone. `HessianIteration` is the paper's.

Both give exact derivatives through the implicit function theorem: at the solution cross(motion(s), v) = 0, so one
division gives ds from the changes of h and v; the iterations are never differentiated. While sticking, the solution
does not depend on the coefficient of friction: ds/dmu = 0.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from pushjax._vec import Scalar, Vec2, settle
from pushjax.solve._contact_plane import LimitCurve

MOST_ROUNDS = 12  # with a bracket; see `ScalarRoot`


def tolerance(dtype) -> float:
    """Largest sine of the angle between motion and push that counts as sticking: 4e-10 in float64, 7e-5 in float32."""
    return float(jnp.finfo(dtype).eps) ** 0.6


def finest(dtype) -> float:
    """The sine of the angle that even badly conditioned forms reach: 3e-13 in float64, 3e-6 in float32."""
    return float(jnp.finfo(dtype).eps) ** 0.8


class Sticking(NamedTuple):
    """The ratio f_t / f_n, the sine of the angle still between motion and push beyond rounding, and the rounds."""

    ratio: Scalar
    residual: Scalar
    rounds: Int[Array, ""]


class StickingSolver(eqx.Module):
    """Finds the ratio of a sticking contact. Settings only; it has no state."""

    @abstractmethod
    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        """The ratio and the rounds. Only meaningful where v_n > 0 and the contact sticks; always finite."""

    def __call__(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> Sticking:
        ratio, rounds = _solve(self, curve, v, friction)
        g = curve.motion(ratio)
        size = jnp.sqrt(g.dot(g) * v.dot(v))
        # What the rounding of the terms of g leaves is no fault of the iteration: where h is ill-conditioned (the
        # square of a thin ellipsoid), g is a small difference of large terms.
        terms = LimitCurve(tuple(jnp.abs(c) for c in curve.c)).motion(jnp.abs(ratio))
        rounding = 4 * jnp.finfo(size.dtype).eps * (terms.x * jnp.abs(v.y) + terms.y * jnp.abs(v.x))
        residual = jnp.maximum(jnp.abs(g.cross(v)) - rounding, 0) / jnp.where(size > 0, size, 1.0)
        return Sticking(ratio, jax.lax.stop_gradient(residual), rounds)


@eqx.filter_custom_jvp
def _solve(solver: StickingSolver, curve: LimitCurve, v: Vec2, friction: Scalar):
    return solver.iterate(curve, v, friction)


@_solve.def_jvp
def _solve_jvp(primals, tangents):
    solver, curve, v, friction = primals
    _, d_curve, d_v, _ = tangents
    ratio, rounds = _solve(solver, curve, v, friction)
    zero = jnp.zeros_like(ratio)
    # anything not perturbed comes as None
    d_curve = LimitCurve(tuple(zero if d is None else d for d in d_curve.c))
    d_v = Vec2(*(zero if d is None else d for d in d_v))
    g, dg = curve.motion(ratio), d_curve.motion(ratio)
    slope = _slope(curve, v, ratio, g)
    change = dg.cross(v) + g.cross(d_v)
    usable = slope > jnp.finfo(slope.dtype).tiny
    d_ratio = jnp.where(usable, change / jnp.where(usable, slope, 1.0), 0.0)
    return (ratio, rounds), (d_ratio, np.zeros(np.shape(rounds), jax.dtypes.float0))


def _slope(curve: LimitCurve, v: Vec2, s: Scalar, g: Vec2) -> Scalar:
    """d/ds of v_n h' - v_t (d h - s h')."""
    bend = curve.bend(s)
    return v.x * bend - v.y * ((curve.degree - 1) * g.y - s * bend)


class ScalarRoot(StickingSolver):
    """Safeguarded Newton for s on r(s) = cross(v, motion(s)) / h(s)^((d-2)/d), inside the friction cone.

    Divided so, r is linear for an ellipsoid and for the square of one, however badly conditioned; and Newton on it is
    `HessianIteration` seen along the cone, round for round (the division undoes what the rescaling does there). Only
    the safeguards differ. Here a bracket, moved by the sign of the angle phi(s) - phi_v, which is monotone where r is
    not (beyond 90 degrees); it is bisected where Newton would leave it, where motion and push oppose each other,
    and, from the third round on, where they are still more than 30 degrees apart.

    Four rounds (five in float64) without a bracket come first and are enough for nearly all; whatever has not landed
    then goes on from there with one. In a batch that costs nothing unless some have not.

    rounds: at most so many of the safeguarded ones. None takes none for an ellipsoid, whose root is closed, and for
    the quartic 12: of 53 000 random sticking contacts (`pushjax.problems`: condition of the Hessian up to 1e3,
    friction up to 3) all were converged to 4e-10 after 10 of these alone, 97 % after 5.
    """

    rounds: int | None = eqx.field(static=True, default=None)

    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        # f along v: there motion . v = d h > 0, so the start is on the right side
        forward = v.x > 0
        s = jnp.clip(v.y / jnp.where(forward, v.x, 1.0), -friction, friction)
        if curve.degree == 2:
            g = curve.motion(s)
            slope = _slope(curve, v, s, g)
            s = jnp.clip(s - v.cross(g) / jnp.where(slope > 0, slope, 1.0), -friction, friction)
            return s, jnp.ones_like(s, jnp.int32)
        eps = float(jnp.finfo(s.dtype).eps)
        # Newton doubles the digits: after a step as short as this it has landed; a bisection only to its own length
        near, fine = eps**0.6 * friction, eps**0.9 * friction
        straight, most = 4 if eps > 1e-10 else 5, MOST_ROUNDS if self.rounds is None else self.rounds
        landed = jnp.zeros_like(forward)
        for _ in range(straight):
            new, power, steep, _ = _newton(curve, v, s)
            landed = steep & (power > 0) & (jnp.abs(new - s) <= near) & (jnp.abs(new) <= friction)
            s = settle(jnp.clip(new, -friction, friction), v.x)
        landed = settle(landed | (friction <= 0), v.x)  # without friction there is no room, and nothing to find

        def body(state):
            s, low, high, _, k = state
            newton, power, steep, (r, side) = _newton(curve, v, s)
            low, high = jnp.where(side > 0, low, s), jnp.where(side < 0, high, s)
            trusted = steep & (power > 0) & (newton >= low) & (newton <= high)
            trusted &= (k < 2) | (3 * r * r < power * power)
            new = jnp.where(trusted, newton, (low + high) / 2)
            return new, low, high, jnp.abs(new - s) > jnp.where(trusted, near, fine), k + 1

        # a loop, not written out: the compiler would work out each round's bracket anew from all rounds before it
        begin = (s, -friction, friction, ~landed, jnp.zeros_like(s, jnp.int32))
        s, *_, rounds = jax.lax.while_loop(lambda state: state[3] & (state[4] < most), body, begin)
        return s, straight + rounds


def _newton(curve: LimitCurve, v: Vec2, s: Scalar):
    """Where Newton goes from s; the power there; whether the slope has the right sign; and r h^((d-2)/d), and a number
    with the sign of phi(s) - phi_v."""
    g = curve.motion(s)
    r, power = v.cross(g), v.dot(g)
    dh = g.x + s * g.y  # Euler: d h
    slope = _slope(curve, v, s, g) * dh - (curve.degree - 2) * r * g.y
    steep = (slope > 0) & (dh > 0)
    return s - r * dh / jnp.where(steep, slope, 1.0), power, steep, (r, jnp.where(g.x > 0, r, g.y))


class HessianIteration(StickingSolver):
    """The paper's iteration, F <- A_t^-1 D^-1 V_p with A_t = hess H(F_t), in the contact plane and as Newton's method.

    With a sticking contact F stays in the plane F = J'f, and A_t and D reduce to the 2 x 2 Hessian J hess H J' of the
    limit curve's h. By Euler's identity the paper's step, damped by 1/(d - 1), is Newton's on grad h(f) = v / (d - 1):
    quadratic, where the paper's halving contracts by one half and no damping diverges for d = 4.

    v - grad h is minus the gradient of the convex h(f) - v . f, so the step is made safe by a line search on that: of
    the step and its halvings down to 1/512, the one where the slope along the step is nearest to zero (the slope,
    because near the solution the function's own differences drown in rounding). Each round ends with the best
    multiple of f (closed form by homogeneity), which makes the count independent of the scale of H.

    Source: Zhou et al. 2017, section IV.A, corollary 1; deviations: the damping, the line search, the rescaling.
    """

    max_rounds: int = eqx.field(static=True, default=25)
    tolerance: float | None = eqx.field(static=True, default=None)  # of sin(angle); None: `finest`

    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        f, rounds, _ = self.trace(curve, v)
        # outside the cone's half plane the contact does not stick, and any finite ratio will do
        forward = f.x > 0
        return jnp.where(forward, f.y / jnp.where(forward, f.x, 1.0), friction), rounds

    def trace(self, curve: LimitCurve, v: Vec2) -> tuple[Vec2, Int[Array, ""], Scalar]:
        """The force (f_n, f_t) whose motion is along v, free of any cone; the rounds; the last |sin(angle)|."""
        size = jnp.sqrt(v.dot(v))
        unit = v.scale(1 / jnp.where(size > 0, size, 1.0))
        stop = finest(size.dtype) if self.tolerance is None else self.tolerance

        def error(f: Vec2) -> Scalar:
            g = _gradient(curve, f)
            scale = jnp.sqrt(g.dot(g))
            return jnp.abs(g.cross(unit)) / jnp.where(scale > 0, scale, 1.0)

        def body(state):
            f, _, rounds = state
            new = settle(hessian_round(curve, unit, f), unit.x)  # the error is to be that of what is kept
            return new, error(new), rounds + 1

        start = _rescaled(curve, unit, unit)
        begin = (start, error(start), jnp.zeros((), jnp.int32))
        f, residual, rounds = jax.lax.while_loop(
            lambda state: (state[1] > stop) & (state[2] < self.max_rounds), body, begin
        )
        return f, rounds, residual


def hessian_round(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """One round of `HessianIteration`."""
    g = _gradient(curve, f)
    hnn, hnt, htt = _hessian(curve, f)
    r = v - g
    det = hnn * htt - hnt * hnt
    singular = det <= 0
    inverse = jnp.where(singular, 0.0, 1.0 / jnp.where(singular, 1.0, det))
    step = settle(Vec2(htt * r.x - hnt * r.y, hnn * r.y - hnt * r.x).scale(inverse), v.x)
    halvings = [0.5**k for k in range(10)]
    slopes = [jnp.abs((_gradient(curve, f + step.scale(t)) - v).dot(step)) for t in halvings]
    best, lowest = halvings[0] * jnp.ones_like(det), slopes[0]
    for t, slope in zip(halvings[1:], slopes[1:], strict=True):
        best = jnp.where(slope < lowest, t, best)
        lowest = jnp.minimum(lowest, slope)
    return _rescaled(curve, v, settle(f + step.scale(best), v.x))


def _rescaled(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """The multiple of f that is lowest on h(f) - v . f."""
    d = curve.degree
    power, h = jnp.maximum(v.dot(f), 0), d * _value(curve, f)
    return f.scale((power / jnp.where(h > 0, h, 1.0)) ** (1 / (d - 1)))


def _powers(f: Vec2, degree: int) -> tuple[list, list]:
    one = jnp.ones_like(f.x)
    xs, ys = [one], [one]
    for _ in range(degree):
        xs.append(xs[-1] * f.x)
        ys.append(ys[-1] * f.y)
    return xs, ys


def _value(curve: LimitCurve, f: Vec2) -> Scalar:
    d = curve.degree
    xs, ys = _powers(f, d)
    return sum((c * xs[d - k] * ys[k] for k, c in enumerate(curve.c)), jnp.zeros_like(f.x))


def _gradient(curve: LimitCurve, f: Vec2) -> Vec2:
    d = curve.degree
    xs, ys = _powers(f, d)
    zero = jnp.zeros_like(f.x)
    return Vec2(
        sum(((d - k) * c * xs[d - k - 1] * ys[k] for k, c in enumerate(curve.c) if k < d), zero),
        sum((k * c * xs[d - k] * ys[k - 1] for k, c in enumerate(curve.c) if k > 0), zero),
    )


def _hessian(curve: LimitCurve, f: Vec2) -> tuple[Scalar, Scalar, Scalar]:
    d = curve.degree
    xs, ys = _powers(f, d)
    zero = jnp.zeros_like(f.x)
    terms = list(enumerate(curve.c))
    return (
        sum(((d - k) * (d - k - 1) * c * xs[d - k - 2] * ys[k] for k, c in terms if k < d - 1), zero),
        sum((k * (d - k) * c * xs[d - k - 1] * ys[k - 1] for k, c in terms if 0 < k < d), zero),
        sum((k * (k - 1) * c * xs[d - k] * ys[k - 2] for k, c in terms if k > 1), zero),
    )
