"""A convex limit surface from wrench-twist pairs.

The loss, on wrenches F_i scaled to unit mean norm and unit twists V_i (both normalised with the length), is

    mean |grad H(F_i) - s_i V_i|^2 + 2 mean (H(F_i) - 1)^2 + 1e-3 |a|^2,     s_i = max(0, grad H(F_i) . V_i),

a the coefficients of H's monomials (Zhou et al. 2016 use the same terms). H and its gradient are linear in a, so the
loss is a convex quadratic a'Qa - 2b'a + c of few coefficients, once it is known which s_i are not clipped; pairs enter
only through Q and b. Clipping is settled by a few rounds.

H itself is convex by construction, H(F) = sum_k (F' L_k L_k' F)^(d/2): one term for the ellipsoid, where that is every
ellipsoid; five for the quartic, with which it reaches the optimum over all sos-convex quartics (a semi-definite
program) to 0.4 % of the loss at worst, and mostly to all digits, on every set of pairs tried. Being a free
minimisation by gradients, fits batch; the semi-definite program does not.
"""

import warnings
from typing import Any, Literal, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, positive, shaped, weights_of
from pushjax._programs import quickly_compiled
from pushjax._vec import Vec3
from pushjax.limit_surface import MONOMIALS, Ellipsoid, LimitSurface, Quartic, angle_between
from pushjax.limit_surface.sums import TERMS, near_ball, of_lower, squared_quadratics
from pushjax.status import Status

VALUE_WEIGHT = 2.0
RIDGE = 1e-3
CLIP_ROUNDS = 4
MAX_STEPS = 500

QUADRATIC_MONOMIALS = np.array([(2, 0, 0), (0, 2, 0), (0, 0, 2), (1, 1, 0), (1, 0, 1), (0, 1, 1)])


class FitReport(eqx.Module):
    """How well a surface fits its pairs.

    angle: mean angle between predicted and given twists, rad. loss: the fit's own. clipped: pairs whose twist the
    surface opposes (s_i = 0). status: MOVING, or NOT_CONVERGED. steps: of the optimiser, all rounds together.
    """

    angle: Float[Array, ""]
    loss: Float[Array, ""]
    clipped: Int[Array, ""]
    status: Int[Array, ""]
    steps: Int[Array, ""]


class _Quadratic(NamedTuple):
    """a'Qa - 2b'a + c."""

    q: Float[Array, "m m"]
    b: Float[Array, "m"]
    c: Float[Array, ""]

    def value(self, a: Float[Array, "m"]) -> Float[Array, ""]:
        return a @ self.q @ a - 2 * self.b @ a + self.c


class _Pairs(NamedTuple):
    """Pairs in the monomial basis: H(F_i) = value[i] . a, grad H(F_i) = gradient[:, i] a; shares sum to one."""

    value: Float[Array, "pairs m"]
    gradient: Float[Array, "3 pairs m"]
    twist: Float[Array, "3 pairs"]
    share: Float[Array, "pairs"]

    @property
    def along(self) -> Float[Array, "pairs m"]:
        """grad H(F_i) . V_i = along[i] . a."""
        return jnp.sum(self.gradient * self.twist[:, :, None], axis=0)


@overload
def fit_limit_surface(
    wrench: Numeric,
    twist: Numeric,
    length: Numeric,
    *,
    degree: Literal[4] = 4,
    report: Literal[False] = False,
    **loss: Any,
) -> Quartic: ...
@overload
def fit_limit_surface(
    wrench: Numeric, twist: Numeric, length: Numeric, *, degree: Literal[2], report: Literal[False] = False, **loss: Any
) -> Ellipsoid: ...
@overload
def fit_limit_surface(
    wrench: Numeric, twist: Numeric, length: Numeric, *, degree: int, report: Literal[False] = False, **loss: Any
) -> LimitSurface: ...
@overload
def fit_limit_surface(
    wrench: Numeric, twist: Numeric, length: Numeric, *, degree: int = 4, report: Literal[True], **loss: Any
) -> tuple[LimitSurface, "FitReport"]: ...
def fit_limit_surface(  # pyright: ignore[reportInconsistentOverload]
    wrench: Numeric,
    twist: Numeric,
    length: Numeric,
    *,
    degree: int = 4,
    weights: Numeric | None = None,
    value_weight: Numeric = VALUE_WEIGHT,
    ridge: Numeric = RIDGE,
    terms: int = TERMS,
    report: bool = False,
):
    """The convex surface of `degree` 2 (`Ellipsoid`) or 4 (`Quartic`) that best explains wrench-twist pairs.

    wrench: (pairs, 3), N and N m, applied by the hand. twist: (pairs, 3), m and rad; only directions matter. length: m,
    as `Support.wrench_twist_pairs` gives with its pairs: the radius of gyration is a good one. weights: (pairs,), how
    much each pair counts, in the mean norm too; pairs with zero are left out. value_weight, ridge: of the loss in this
    module's header. terms: for degree 4.

    Returns the surface, with a RuntimeWarning if the fit did not converge; with `report=True` the surface and a
    `FitReport`. Works under `jit` (degree, terms and report
    static) and `vmap`; not under `grad`.

    Raises ValueError for fewer pairs than coefficients (6 or 15), arrays of the wrong shape or not finite, a zero
    twist, wrenches that are all zero, a length that is not positive, negative or zero weights, a degree other than 2
    and 4.
    """
    dtype = common_dtype(wrench, twist, length)
    w, v, rho = as_float(wrench, dtype), as_float(twist, dtype), as_float(length, dtype)
    shaped("wrench", w, ("pairs", 3))
    share = weights_of(weights, w.shape[0], dtype)
    _check(w, v, rho, share, degree)
    for name, value in (("value_weight", value_weight), ("ridge", ridge)):
        finite(name, value)
        positive(name, value)
    if terms < 1:
        raise ValueError(f"terms must be at least 1; got {terms}")
    factors = as_float(value_weight, dtype), as_float(ridge, dtype)
    coefficients, found = _fit(w, v, rho, share, *factors, degree=degree, terms=terms if degree == 4 else 1)
    if not report and concrete(found.status) == Status.NOT_CONVERGED:
        warnings.warn("fit_limit_surface did not converge; see its report", RuntimeWarning, stacklevel=2)
    surface: LimitSurface
    if degree == 2:
        surface = Ellipsoid(_symmetric(coefficients), rho)
    else:
        surface = Quartic(coefficients, rho)
    return (surface, found) if report else surface


def mean_twist_angle(surface: LimitSurface, wrench: Numeric, twist: Numeric) -> Float[Array, ""]:
    """Mean angle, rad, between the surface's twists under wrenches (pairs, 3) and given twists (pairs, 3)."""
    w, v = as_float(wrench, surface.length.dtype), as_float(twist, surface.length.dtype)
    shaped("wrench", w, ("pairs", 3))
    shaped("twist", v, (w.shape[0], 3))
    form, rho = surface.form(), surface.length

    def angle(w: Array, v: Array) -> Array:
        return angle_between(form.gradient(Vec3(w[0], w[1], w[2] / rho)), Vec3(v[0], v[1], v[2] * rho))

    return jnp.mean(jax.vmap(angle)(w, v))


def _check(wrench: Array, twist: Array, length: Array, weights: Array, degree: int) -> None:
    if degree not in (2, 4):
        raise ValueError(f"degree must be 2 or 4; got {degree}")
    shaped("twist", twist, (wrench.shape[0], 3))
    shaped("length", length, ())
    needed = 6 if degree == 2 else 15
    if wrench.shape[0] < needed:
        raise ValueError(f"wrench has {wrench.shape[0]} pairs; a surface of degree {degree} needs at least {needed}")
    for name, value in (("wrench", wrench), ("twist", twist), ("length", length)):
        finite(name, value)
    positive("length", length)
    known, counts = concrete(twist), concrete(weights)
    if known is not None and counts is not None:
        zero = ~known.any(axis=1) & (counts > 0)
        if zero.any():
            raise ValueError(f"twist must not be zero; it is for pair {int(np.argmax(zero))}")
    known = concrete(wrench)
    if known is not None and counts is not None and not known[counts > 0].any():
        raise ValueError("wrench: all pairs are zero")


@quickly_compiled
def _fit(wrench, twist, length, weights, value_weight, ridge, *, degree: int, terms: int):
    """Coefficients in wrench units, and the report."""
    share = weights / jnp.sum(weights)
    counts = share > 0  # what has no weight has no say, whatever it is: it may be padding
    f, v = wrench.at[:, 2].divide(length), twist.at[:, 2].multiply(length)
    f, v = (jnp.where(counts[:, None], each, jnp.array([[1.0, 0.0, 0.0]], each.dtype)) for each in (f, v))
    v = v / jnp.linalg.norm(v, axis=1, keepdims=True)
    scale = share @ jnp.linalg.norm(f, axis=1)
    pairs = _in_monomials(f / scale, v, share, degree)
    start = near_ball(degree, terms, pairs.value.dtype)

    def again(state):
        _, _, _, good, rounds = state
        return ~good & (rounds < CLIP_ROUNDS)

    def solve(state):
        parameters, along, steps, _, rounds = state
        parameters, taken, solved = _minimise(_loss(pairs, along, value_weight, ridge), parameters, degree)
        after = (pairs.along @ _coefficients(parameters, degree) > 0) | ~counts
        return parameters, after, steps + taken, solved & jnp.all(after == along), rounds + 1

    zero = jnp.zeros((), jnp.int32)
    begin = (start, jnp.ones(f.shape[0], bool), zero, jnp.zeros((), bool), zero)
    parameters, along, steps, good, _ = jax.lax.while_loop(again, solve, begin)
    a = _coefficients(parameters, degree)
    angles = angle_between(Vec3(*(pairs.gradient @ a)), Vec3(*pairs.twist))
    report = FitReport(
        angle=share @ angles,
        loss=_loss(pairs, along, value_weight, ridge).value(a),
        clipped=jnp.sum(~along),
        status=jnp.where(good, Status.MOVING, Status.NOT_CONVERGED).astype(jnp.int8),
        steps=steps,
    )
    return a / scale**degree, report


def _in_monomials(f: Array, v: Array, share: Array, degree: int) -> _Pairs:
    exponents = MONOMIALS if degree == 4 else QUADRATIC_MONOMIALS
    powers = []  # of each component: 1, f, f^2, ...
    for column in f.T:
        powers.append([jnp.ones_like(column)])
        for _ in range(degree):
            powers[-1].append(powers[-1][-1] * column)

    def product(e) -> Array:
        return powers[0][e[0]] * powers[1][e[1]] * powers[2][e[2]]

    def derivative(e, k: int) -> Array:
        lowered = [max(e[j] - (j == k), 0) for j in range(3)]
        return e[k] * product(lowered)

    value = jnp.stack([product(e) for e in exponents.tolist()], axis=1)
    gradient = jnp.stack([jnp.stack([derivative(e, k) for e in exponents.tolist()], axis=1) for k in range(3)])
    return _Pairs(value, gradient, v.T, share)


def _loss(pairs: _Pairs, along: Bool[Array, "pairs"], value_weight: Array, ridge: Array) -> _Quadratic:
    """The loss, given which pairs are not clipped; there |g - s V| is the part of g across V."""
    across = pairs.gradient - (pairs.twist * along[None])[:, :, None] * pairs.along[None]
    rows = jnp.concatenate([across, jnp.sqrt(value_weight) * pairs.value[None]])
    rows = (rows * jnp.sqrt(pairs.share)[None, :, None]).reshape(-1, pairs.value.shape[1])
    q = rows.T @ rows + ridge * jnp.eye(rows.shape[1], dtype=rows.dtype)
    return _Quadratic(q, value_weight * pairs.share @ pairs.value, value_weight)


def _coefficients(parameters: Float[Array, "terms 6"], degree: int) -> Float[Array, "m"]:
    p = of_lower(parameters)
    if degree == 4:
        return squared_quadratics(p)
    a = p[0]
    return jnp.stack([a[0, 0], a[1, 1], a[2, 2], 2 * a[0, 1], 2 * a[0, 2], 2 * a[1, 2]])


def _symmetric(a: Float[Array, "6"]) -> Float[Array, "3 3"]:
    xy, xz, yz = a[3] / 2, a[4] / 2, a[5] / 2
    return jnp.stack([jnp.stack([a[0], xy, xz]), jnp.stack([xy, a[1], yz]), jnp.stack([xz, yz, a[2]])])


def _minimise(loss: _Quadratic, parameters: Array, degree: int) -> tuple[Array, Array, Array]:
    """BFGS over the free parameters: its steps are small products, which batch; Levenberg-Marquardt needs fewer, but
    each with a factorisation, and slows down where the optimum lies on the border of convexity."""

    def objective(parameters, _):
        return loss.value(_coefficients(parameters, degree))

    tolerance = 1e-7 if parameters.dtype == jnp.float64 else 1e-4
    solver = optx.BFGS(rtol=tolerance, atol=tolerance)
    solution = optx.minimise(objective, solver, parameters, max_steps=MAX_STEPS, throw=False)
    return solution.value, solution.stats["num_steps"], solution.result == optx.RESULTS.successful
