"""Fits of a convex limit surface to wrench-twist pairs.

The wrenches F_i = (fx, fy, tau / length) are divided by their mean norm, and each twist V_i = (vx, vy, length omega) by
its own norm. The loss is

    mean |grad H(F_i) - s_i V_i|^2 + 2 mean (H(F_i) - 1)^2 + 1e-3 |a|^2,     s_i = max(0, grad H(F_i) . V_i),

where a is the vector of the coefficients of the monomials of H. H and its gradient are linear in a. So the loss is a
convex quadratic a'Qa - 2b'a + c, once it is known which s_i are not clipped. The pairs enter only through Q and b. A
few rounds of minimization find which s_i are clipped.

H is convex by construction: H(F) = sum_k (F' L_k L_k' F)^(d/2). The ellipsoid has one term plus a small multiple of
F'F, which makes the limit finite in every direction, whatever the pairs. The quartic has five terms. With these the
loss came within 0.4 % of the optimum over all sos-convex quartics (a semidefinite program) on every set of pairs tried,
and for most sets it agreed to all digits. The minimization is unconstrained and uses gradients, so fits can be batched;
the semidefinite program cannot.

Reference: Zhou et al. 2016, for the terms of the loss.
"""

import functools
import warnings
from typing import Any, Literal, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_count,
    check_shape,
    checked_array,
    checked_weights,
    common_dtype,
    concrete,
    in_numpy,
    on_device,
    traced,
)
from pushjax._internal.jit import quick_jit
from pushjax._math.arrays import FULL
from pushjax._math.vec import Vec3
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.fit_loss import (
    coefficients_of_forms,
    evaluate_monomials,
    forms_of,
    leave_saddle,
    loss_of,
    minimize_loss,
)
from pushjax.friction.limit_surface import LimitSurface, angle_between
from pushjax.friction.quartic import Quartic
from pushjax.friction.sum_of_squares import TERMS, initial_factors

VALUE_WEIGHT = 2.0
RIDGE = 1e-3
CLIP_ROUNDS = 4  # largest number of rounds of minimization, to find which s_i are clipped


class FitReport(eqx.Module):
    """How well a fitted surface explains its pairs.

    Attributes:
        angle: Mean angle between predicted and given twists, normalized, rad.
        loss: Loss of the fit (see the header of this module).
        clipped: Number of pairs with s_i = 0: their predicted twist opposes the given one.
        converged: Whether the optimizer converged, and its last round left the same s_i clipped as the one before.
        steps: Number of optimizer steps, summed over all rounds.
    """

    angle: Float[Array, ""]
    loss: Float[Array, ""]
    clipped: Int[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


@overload
def fit_limit_surface(
    wrench: ArrayLike,
    twist: ArrayLike,
    length: ArrayLike,
    *,
    degree: Literal[4] = 4,
    report: Literal[False] = False,
    **loss: Any,
) -> Quartic: ...
@overload
def fit_limit_surface(
    wrench: ArrayLike,
    twist: ArrayLike,
    length: ArrayLike,
    *,
    degree: Literal[2],
    report: Literal[False] = False,
    **loss: Any,
) -> Ellipsoid: ...
@overload
def fit_limit_surface(
    wrench: ArrayLike, twist: ArrayLike, length: ArrayLike, *, degree: int, report: Literal[False] = False, **loss: Any
) -> LimitSurface: ...
@overload
def fit_limit_surface(
    wrench: ArrayLike, twist: ArrayLike, length: ArrayLike, *, degree: int = 4, report: Literal[True], **loss: Any
) -> tuple[LimitSurface, "FitReport"]: ...
def fit_limit_surface(  # pyright: ignore[reportInconsistentOverload]
    wrench: ArrayLike,
    twist: ArrayLike,
    length: ArrayLike,
    *,
    degree: int = 4,
    weights: ArrayLike | None = None,
    value_weight: ArrayLike = VALUE_WEIGHT,
    ridge: ArrayLike = RIDGE,
    terms: int = TERMS,
    report: bool = False,
):
    """Fit the convex limit surface that best explains wrench-twist pairs.

    Works under `jit` (with static `degree`, `terms` and `report`) and under `vmap`, but not under `grad`. Without
    `report`, a fit that did not converge gives a RuntimeWarning.

    Args:
        wrench: Wrenches (fx, fy, tau) that the hand applies, shape (pairs, 3), N and N m.
        twist: Twists (vx, vy, omega), shape (pairs, 3), m and rad. Only their directions matter.
        length: Characteristic length, m. The radius of gyration is a good choice; `Support.wrench_twist_pairs` returns
            it with its pairs.
        degree: 2 for an `Ellipsoid`, 4 for a `Quartic`.
        weights: Weight of each pair in the loss and in the mean norm, shape (pairs,). Equal by default. Pairs of zero
            weight are ignored, but must be finite unless they are traced.
        value_weight: Factor of the term mean (H - 1)^2 of the loss in the header of this module.
        ridge: Factor of the term |a|^2 of that loss.
        terms: Number of terms of the sum of squares, for degree 4.
        report: Whether to return a `FitReport` too.

    Returns:
        The surface; with `report=True` the surface and a `FitReport`.

    Raises:
        ValueError: If there are fewer pairs than coefficients (6 or 15), where pairs of zero weight count; if an array
            has the wrong shape or is not finite; if, among the pairs that have a weight, a twist is zero or all
            wrenches are zero; if the weights are negative or all zero; if `length`, `value_weight` or `ridge` is not
            positive; if `terms` is less than one; or if the degree is neither 2 nor 4.
    """
    dtype = common_dtype(wrench, twist, length)
    wrenches = checked_array("wrench", wrench, ("pairs", 3), dtype)
    twists = checked_array("twist", twist, (len(wrenches), 3), dtype)
    pair_weights = checked_weights(weights, len(wrenches), dtype)
    _check_pairs(wrenches, twists, pair_weights, degree)
    scalars = {"length": length, "value_weight": value_weight, "ridge": ridge}
    characteristic_length, *factors = (checked_array(*item, (), dtype, positive=True) for item in scalars.items())
    check_count("terms", terms)
    arrays = [wrenches, twists, characteristic_length, pair_weights, *factors]
    fit = _fit_in_jax if traced(arrays) else _fit_in_numpy
    coefficients, fit_report = fit(*arrays, degree=degree, terms=terms if degree == 4 else 1)
    converged = concrete(fit_report.converged)
    if not report and converged is not None and not converged:
        warnings.warn("fit_limit_surface did not converge; see its report", RuntimeWarning, stacklevel=2)
    kind, numbers = (Ellipsoid, _symmetric(coefficients)) if degree == 2 else (Quartic, coefficients)
    surface: LimitSurface = kind(numbers, characteristic_length)
    return (surface, fit_report) if report else surface


def mean_twist_angle(surface: LimitSurface, wrench: ArrayLike, twist: ArrayLike) -> Float[Array, ""]:
    """Return the mean angle between the twists that a surface predicts and the given ones.

    Args:
        surface: The limit surface.
        wrench: Wrenches (fx, fy, tau), shape (pairs, 3), N and N m.
        twist: Given twists (vx, vy, omega), shape (pairs, 3), m and rad. Only their directions matter.

    Returns:
        Mean angle between normalized twists, a scalar, rad.

    Raises:
        ValueError: If an array has the wrong shape.
    """
    wrenches, twists = as_float(wrench, surface.length.dtype, "wrench"), as_float(twist, surface.length.dtype, "twist")
    check_shape("wrench", wrenches, ("pairs", 3))
    check_shape("twist", twists, (wrenches.shape[0], 3))
    form, length = surface.form(), surface.length

    def angle(wrenches: Array, twists: Array) -> Array:
        return angle_between(
            form.gradient(Vec3(wrenches[0], wrenches[1], wrenches[2] / length)),
            Vec3(twists[0], twists[1], twists[2] * length),
        )

    return jnp.mean(jax.vmap(angle)(wrenches, twists))


def _check_pairs(wrench: Array, twist: Array, weights: Array, degree: int) -> None:
    """Raise ValueError for a degree, or pairs of finite numbers, that `fit_limit_surface` rejects."""
    if degree not in (2, 4):
        raise ValueError(f"degree must be 2 or 4; got {degree}")
    needed = 6 if degree == 2 else 15
    if wrench.shape[0] < needed:
        raise ValueError(f"wrench has {wrench.shape[0]} pairs; a surface of degree {degree} needs at least {needed}")
    known, known_weights = concrete(twist), concrete(weights)
    if known is not None and known_weights is not None:
        zero = ~known.any(axis=1) & (known_weights > 0)
        if zero.any():
            raise ValueError(f"twist must not be zero; it is for pair {int(np.argmax(zero))}")
    known = concrete(wrench)
    if known is not None and known_weights is not None and not known[known_weights > 0].any():
        raise ValueError("wrench: all pairs are zero")


def _fit(xp, wrench, twist, length, weights, value_weight, ridge, *, degree: int, terms: int):
    """Return the coefficients of H for wrenches in N, 1/N^degree, and the report; with NumPy or with JAX."""
    dtype = wrench.dtype
    share = weights / xp.sum(weights)
    has_weight = share > 0  # traced pairs without weight may hold any values, NaN included: replace them
    lengths = xp.stack([xp.ones_like(length), xp.ones_like(length), length])[None]
    f, v = (
        xp.where(has_weight[:, None], each, xp.asarray([[1, 0, 0]], dtype))
        for each in (wrench / lengths, twist * lengths)
    )
    v = v / xp.linalg.norm(v, axis=1, keepdims=True)
    scale = share @ xp.linalg.norm(f, axis=1)
    pairs = evaluate_monomials(xp, f / scale, v, share, degree)

    def is_unfinished(state):
        _, _, _, converged, rounds = state
        return ~converged & (rounds < CLIP_ROUNDS)

    def solve_round(state):
        parameters, unclipped, steps, _, rounds = state
        loss = loss_of(xp, pairs, unclipped, value_weight, ridge)
        found = minimize_loss(xp, loss, parameters, degree)
        unclipped_after = (pairs.along @ coefficients_of_forms(xp, forms_of(xp, found.x)[1], degree) > 0) | ~has_weight
        settled = found.converged & xp.all(unclipped_after == unclipped)
        x = found.x
        if degree == 2:
            moved, decrease = leave_saddle(xp, loss, x)
            at_saddle = decrease > xp.finfo(dtype).eps ** 0.5 / 100  # of a loss of order one
            x, settled = xp.where(at_saddle, moved, x), settled & ~at_saddle
        return x, unclipped_after, steps + found.steps, settled, rounds + 1

    zero = xp.zeros((), xp.int32)
    start = xp.asarray(initial_factors(degree, terms, dtype).ravel())
    state = start, xp.ones(len(f), bool), zero, xp.zeros((), bool), zero
    if xp is np:
        while is_unfinished(state):
            state = solve_round(state)
    else:
        state = jax.lax.while_loop(is_unfinished, solve_round, state)
    parameters, unclipped, steps, converged, _ = state
    a = coefficients_of_forms(xp, forms_of(xp, parameters)[1], degree)
    report = FitReport(
        angle=share @ angle_between(Vec3(*(pairs.gradient @ a)), Vec3(*pairs.twist), xp),
        loss=loss_of(xp, pairs, unclipped, value_weight, ridge).value(a),
        clipped=xp.sum(~unclipped),
        converged=converged,
        steps=steps,
    )
    return a / scale**degree, report


_fit_in_jax = quick_jit(functools.partial(_fit, jnp))


def _fit_in_numpy(*arrays: Array, degree: int, terms: int):
    """Return the results of `_fit`, computed in float64 and without compiling anything."""
    dtype = arrays[0].dtype
    with np.errstate(all="ignore"):
        found = _fit(np, *(np.asarray(array, np.float64) for array in arrays), degree=degree, terms=terms)

    def as_given(value: Any) -> Array:
        """Return floats in the dtype of the pairs, and other numbers as they are."""
        return on_device(np.asarray(value, dtype if np.issubdtype(np.asarray(value).dtype, np.floating) else None))

    return jax.tree.map(as_given, found)


@in_numpy
def _symmetric(xp, a: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """Return the matrix A of an ellipsoid, given the coefficients of its monomials."""
    return (a / xp.asarray([1, 1, 1, 2, 2, 2], a.dtype))[FULL]
