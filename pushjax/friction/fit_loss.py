"""The loss of a fitted limit surface (see `fit`), as a quadratic in the coefficients of H, and its minimization.

Every function takes NumPy or `jax.numpy` as its first argument.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._math.arrays import ENTRIES
from pushjax.friction.quartic import MONOMIAL_SUMS, MONOMIALS, monomial_sums
from pushjax.friction.sum_of_squares import LOWER_ENTRIES

MAX_STEPS = 500  # of the optimizer, in each round
# Of the optimizer in NumPy, for a loss of order one: the gradient at which it stops; and the largest decrease of the
# loss that another step may promise if it has converged. On the border of convexity the loss is flat, and the gradient
# stays large for hundreds of steps that lower the loss by less than 1e-8.
GRADIENT_TOLERANCE, LARGEST_DECREASE = 1e-9, 1e-10

# Least eigenvalue of an ellipsoid's A, for wrenches in units of their mean norm. With it, the limit in any direction is
# at most 100 times the mean wrench.
LEAST_EIGENVALUE = 1e-4

# Exponents of (x, y, z) = (fx, fy, tau / length), in the order of the coefficients of an ellipsoid's H.
QUADRATIC_MONOMIALS = np.stack([np.bincount(entry, minlength=3) for entry in ENTRIES])
QUADRATIC_SUMS = monomial_sums(QUADRATIC_MONOMIALS)


class Minimum(NamedTuple):
    """Result of a minimization: the parameters, the number of steps, and whether the optimizer converged."""

    x: Any
    steps: Any
    converged: Any


class Quadratic(NamedTuple):
    """The quadratic a'Qa - 2b'a + c."""

    q: Float[Array, "m m"]
    b: Float[Array, "m"]
    c: Float[Array, ""]

    def value(self, a: Float[Array, "m"]) -> Float[Array, ""]:
        return a @ self.q @ a - 2 * self.b @ a + self.c

    def gradient(self, a: Float[Array, "m"]) -> Float[Array, "m"]:
        return 2 * (self.q @ a - self.b)


class Pairs(NamedTuple):
    """Pairs in the basis of the m monomials: H(F_i) = value[i] . a and grad H(F_i) = gradient[:, i] a."""

    value: Float[Array, "pairs m"]
    gradient: Float[Array, "3 pairs m"]
    twist: Float[Array, "3 pairs"]  # unit twists V_i
    share: Float[Array, "pairs"]  # weights that sum to one

    @property
    def along(self) -> Float[Array, "pairs m"]:
        """Components of the gradients along the twists: grad H(F_i) . V_i = along[i] . a."""
        return (self.gradient * self.twist[:, :, None]).sum(axis=0)


def evaluate_monomials(xp, f: Array, v: Array, share: Array, degree: int) -> Pairs:
    """Evaluate the monomials and their gradients at the normalized wrenches `f`."""
    exponents = MONOMIALS if degree == 4 else QUADRATIC_MONOMIALS
    powers = []  # for each component: 1, f, f^2, ...
    for column in f.T:
        powers.append([xp.ones_like(column)])
        for _ in range(degree):
            powers[-1].append(powers[-1][-1] * column)

    def product(exponent) -> Array:
        return powers[0][exponent[0]] * powers[1][exponent[1]] * powers[2][exponent[2]]

    def derivative(exponent, k: int) -> Array:
        lowered = [max(exponent[j] - (j == k), 0) for j in range(3)]
        return exponent[k] * product(lowered)

    value = xp.stack([product(exponent) for exponent in exponents.tolist()], axis=1)
    gradient = xp.stack(
        [xp.stack([derivative(exponent, k) for exponent in exponents.tolist()], axis=1) for k in range(3)]
    )
    return Pairs(value, gradient, v.T, share)


def loss_of(xp, pairs: Pairs, unclipped: Bool[Array, "pairs"], value_weight: Array, ridge: Array) -> Quadratic:
    """Return the loss as a quadratic in the coefficients a, given which pairs are not clipped."""
    # Of a pair that is not clipped, |g - s V| is the norm of the component of the gradient g perpendicular to V.
    across = pairs.gradient - (pairs.twist * unclipped[None])[:, :, None] * pairs.along[None]
    rows = xp.concatenate([across, xp.sqrt(value_weight) * pairs.value[None]])
    rows = (rows * xp.sqrt(pairs.share)[None, :, None]).reshape(-1, pairs.value.shape[1])
    q = rows.T @ rows + ridge * xp.eye(rows.shape[1], dtype=rows.dtype)
    return Quadratic(q, value_weight * pairs.share @ pairs.value, value_weight)


def forms_of(xp, parameters: Float[Array, "n"]) -> tuple[Float[Array, "terms 3 3"], Float[Array, "terms 9"]]:
    """Return the L_k and the flattened P_k = L_k L_k', given the lower triangles of the L_k."""
    lower = (parameters.reshape(-1, 6) @ xp.asarray(LOWER_ENTRIES, parameters.dtype)).reshape(-1, 3, 3)
    return lower, (lower @ xp.swapaxes(lower, 1, 2)).reshape(-1, 9)


def _sums(xp, degree: int, dtype: Any) -> Float[Array, "m entries"]:
    """Return the matrix from the sum of all P_k x P_k (degree 4), or from P_0 (degree 2), to the coefficients of H."""
    return xp.asarray(MONOMIAL_SUMS if degree == 4 else QUADRATIC_SUMS, dtype)


def coefficients_of_forms(xp, p: Float[Array, "terms 9"], degree: int) -> Float[Array, "m"]:
    """Return the coefficients of H, given the flattened P_k."""
    # degree 4: H = sum_k (F' P_k F)^2; degree 2: H = F' (P_0 + LEAST_EIGENVALUE I) F
    floor = xp.asarray(LEAST_EIGENVALUE * np.eye(3).ravel(), p.dtype)
    return _sums(xp, degree, p.dtype) @ ((p.T @ p).reshape(81) if degree == 4 else p[0] + floor)


def minimize_loss(xp, loss: Quadratic, parameters: Array, degree: int) -> Minimum:
    """Minimize the loss over the factors of the terms, by BFGS."""
    # The steps of BFGS are small matrix products, which can be batched. Levenberg-Marquardt needs fewer steps, but each
    # needs a factorization, and it slows down where the optimum lies on the border of convexity. NumPy saves the
    # compilation, which takes longer than the minimization.

    def objective(parameters):
        lower, p = forms_of(xp, parameters)
        a = coefficients_of_forms(xp, p, degree)
        slope = loss.gradient(a) @ _sums(xp, degree, p.dtype)  # symmetric in the indices of each P_k
        slope = 2 * p @ slope.reshape(9, 9) if degree == 4 else slope
        by_factor = 2 * slope.reshape(-1, 3, 3) @ lower
        return loss.value(a), (by_factor.reshape(-1, 9) @ xp.asarray(LOWER_ENTRIES.T, parameters.dtype)).ravel()

    # imported here, because both take as long to import as NumPy or longer
    if xp is np:
        from scipy.optimize import minimize

        options = {"gtol": GRADIENT_TOLERANCE, "maxiter": MAX_STEPS}
        found = minimize(objective, parameters, jac=True, method="BFGS", options=options)
        # also where roundoff has ended the line search, or after the last step
        converged = found.jac @ found.hess_inv @ found.jac < LARGEST_DECREASE
        return Minimum(found.x, np.int32(found.nit), converged)
    import optimistix as optx

    tolerance = 1e-7 if parameters.dtype == jnp.float64 else 1e-4
    solver = optx.BFGS(rtol=tolerance, atol=tolerance)
    solution = optx.minimise(lambda x, _: objective(x)[0], solver, parameters, max_steps=MAX_STEPS, throw=False)
    return Minimum(solution.value, solution.stats["num_steps"], solution.result == optx.RESULTS.successful)


def leave_saddle(xp, loss: Quadratic, parameters: Array) -> tuple[Array, Float[Array, ""]]:
    """Move the factor L of an ellipsoid, (6,), off a saddle; return it and the decrease of the loss."""
    # The gradient by L is zero at a saddle, but the loss of P = L L' is not least. There L is singular, and the loss
    # decreases along P + t v v', with v in the null space of L'. The step t minimizes the loss along that line. The
    # decrease is zero if there is no such direction, and NaN if the loss is not finite.
    lower, p = forms_of(xp, parameters)
    sums = _sums(xp, 2, parameters.dtype)
    slope = (loss.gradient(coefficients_of_forms(xp, p, 2)) @ sums).reshape(3, 3)
    # NumPy's `eigh` raises an error for NaN, which wrenches give whose squares underflow
    eigenvalues, eigenvectors = xp.linalg.eigh(xp.where(xp.isfinite(slope), slope, 0.0))
    v = eigenvectors[:, 0]
    change = sums @ xp.outer(v, v).ravel()
    step = xp.maximum(-eigenvalues[0], 0) / (2 * change @ loss.q @ change)
    # [L, sqrt(t) v] has one column too many; its triangular factor has the same product with its transpose
    columns = xp.concatenate([lower[0], xp.sqrt(step) * v[:, None]], axis=1)
    return xp.linalg.qr(columns.T)[1].T[np.tril_indices(3)], xp.maximum(-eigenvalues[0], 0) * step / 2
