"""Limit surfaces fitted to the same pairs by a convex program: cvxpy with the solver Clarabel.

The program is as small as it can be made. If the scales s_i of `pushjax.friction.fit` are free, their optimal values
follow from the coefficients. The loss is then a quadratic function of the coefficients alone, so that 400 pairs reduce
to a program in 15 or 6 numbers. A scale must not be negative; this is checked afterwards. With the scales as variables
the program takes about 15 times as long.

The quartic is sos-convex: z' hess H(F) z = y' Q y with y = z (x) F, where Q is a positive semidefinite 9 x 9 matrix.
For the ellipsoid, its own matrix is positive semidefinite. The program is built once, with the data as parameters, and
then solved for each set of pairs.
"""

import math
import time
from typing import Any, NamedTuple

import numpy as np

from pushjax.friction.fit import RIDGE, VALUE_WEIGHT
from pushjax.friction.fit_loss import QUADRATIC_MONOMIALS
from pushjax.friction.quartic import MONOMIALS


class Fitted(NamedTuple):
    """Results of the fits."""

    loss: np.ndarray  # of each set of pairs, (sets,), as in `pushjax.friction.fit.FitReport`
    # Number of pairs, over all sets, whose scale came out negative. If there are any, the program is not the one that
    # `pushjax.friction.fit` solves.
    clipped: int
    processor: float  # CPU time of all fits together, s, without building the program


def fit(wrench: np.ndarray, twist: np.ndarray, length: np.ndarray, degree: int) -> Fitted:
    """Fit a limit surface to each set of pairs, one after another."""
    # wrench and twist: (sets, pairs, 3), SI units; length: (sets,), m; degree: 2 for ellipsoids, 4 for quartics
    program = Program(degree)
    program.solve(*quadratic(wrench[0], twist[0], float(length[0]), degree)[:2])  # compiles at the first solve
    losses, clipped = [], 0
    busy = time.process_time()
    for each in zip(wrench, twist, length, strict=True):
        factor, slope, along = quadratic(*each, degree)
        loss, a = program.solve(factor, slope)
        clipped += int(np.sum(along @ a < 0))
        losses.append(loss + VALUE_WEIGHT)
    return Fitted(np.array(losses), clipped, time.process_time() - busy)


def cvxpy() -> Any:
    """Import and return the package cvxpy, or raise ValueError if it is not installed."""
    try:
        import cvxpy
    except ImportError as missing:
        raise ValueError("this needs the package cvxpy: pip install '.[bench]'") from missing
    return cvxpy


class Program:
    """The convex program: minimize |factor a|^2 - 2 slope . a over the coefficients `a` of convex surfaces."""

    def __init__(self, degree: int):
        cp = cvxpy()
        n = len(monomials(degree))
        self.a, self.factor, self.slope = cp.Variable(n), cp.Parameter((n, n)), cp.Parameter(n)
        loss = cp.sum_squares(self.factor @ self.a) - 2 * self.slope @ self.a
        self.problem, self.solver = cp.Problem(cp.Minimize(loss), convexity(self.a, degree)), cp.CLARABEL

    def solve(self, factor: np.ndarray, slope: np.ndarray) -> tuple[float, np.ndarray]:
        """Solve the program for these parameters, (n, n) and (n,); return the minimum and the coefficients, (n,)."""
        self.factor.value, self.slope.value = factor, slope
        loss: Any = self.problem.solve(solver=self.solver)
        return float(loss), np.asarray(self.a.value)


def monomials(degree: int) -> np.ndarray:
    """Return the exponents of the monomials of H, (n, 3): 6 for degree 2, 15 for degree 4."""
    return QUADRATIC_MONOMIALS if degree == 2 else MONOMIALS


def quadratic(wrench, twist, length: float, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the loss of `pushjax.friction.fit` at the optimal scales s_i, as a quadratic of the n coefficients a."""
    # The loss is |factor a|^2 - 2 slope . a + constant. Returned are factor, (n, n), slope, (n,), and a matrix, (pairs,
    # n), whose product with a gives the scales s_i = grad H(F_i) . V_i. Wrenches and twists, (pairs, 3), are in SI
    # units.
    powers = monomials(degree)
    f, v = wrench / [1, 1, length], twist * [1, 1, length]
    f, v = f / np.mean(np.linalg.norm(f, axis=1)), v / np.linalg.norm(v, axis=1, keepdims=True)
    values, gradients = values_and_gradients(f, degree)
    along = np.sum([g * v[:, k : k + 1] for k, g in enumerate(gradients)], axis=0)
    misfit = np.sum([g.T @ g for g in gradients], axis=0) - along.T @ along
    hessian = (misfit + VALUE_WEIGHT * values.T @ values) / len(f) + RIDGE * np.eye(len(powers))
    return np.linalg.cholesky(hessian).T, VALUE_WEIGHT * values.mean(axis=0), along


def values_and_gradients(f: np.ndarray, degree: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the monomials of H at wrenches without units, (pairs, 3), and their three derivatives, each (pairs, n)."""
    powers, gradients = monomials(degree), []
    for k in range(3):
        lowered = np.maximum(powers - np.eye(3, dtype=int)[k], 0)
        gradients.append(powers[:, k] * np.prod(f[:, None] ** lowered, axis=2))
    return np.prod(f[:, None] ** powers, axis=2), gradients


def gram(a: np.ndarray, degree: int) -> np.ndarray:
    """Return the Hessian of H, given its n coefficients, as a symmetric tensor, (3, 3) or (3, 3, 3, 3)."""
    # It is a form in y = z (x) F. Its first two indices are those of the second derivative, the rest those of the
    # products of F that remain.
    tensor = np.zeros((3,) * degree)
    for index in np.ndindex(*tensor.shape):
        counts = np.bincount(index, minlength=3)
        row = int(np.flatnonzero((monomials(degree) == counts).all(axis=1))[0])
        orders = math.factorial(degree) // math.prod(map(math.factorial, counts.tolist()))
        tensor[index] = a[row] / orders
    return tensor * (2.0 if degree == 2 else 12.0)


def convexity(a: Any, degree: int) -> list[Any]:
    """Return the constraints of cvxpy that tie the coefficients `a`, a variable, to a positive semidefinite matrix."""
    # In each, the sum of some entries of the matrix is the coefficient of one monomial of the form, z_i z_j or
    # z_i z_j F_k F_l.
    matrix = cvxpy().Variable((3, 3) if degree == 2 else (9, 9), PSD=True)
    basis = np.stack([gram(unit, degree) for unit in np.eye(len(monomials(degree)))], axis=-1)
    if degree == 2:
        return [matrix[i, j] == basis[i, j] @ a for i in range(3) for j in range(i, 3)]
    found = []
    for i, j, k, m in np.ndindex(3, 3, 3, 3):
        if i <= j and k <= m:
            places = {(i, j, k, m), (j, i, k, m), (i, j, m, k), (j, i, m, k)}
            entries = sum(matrix[3 * p[0] + p[2], 3 * p[1] + p[3]] for p in places)
            found.append(entries == sum(basis[p] for p in places) @ a)
    return found
