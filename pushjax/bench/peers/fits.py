"""Limit surfaces from the same pairs by a convex program: cvxpy, solver Clarabel.

As small as the program can be made: once the scales s_i of `pushjax.fit` are free, their best values follow from the
coefficients, and the loss is a quadratic of these alone; of 400 pairs 15 or 6 numbers are left. (A scale may not be
negative, which is then looked at; with the scales as variables the program takes some 15 times as long.) The quartic is
sos-convex: z' hess H(F) z = y' Q y with y = z (x) F and Q positive, a 9 x 9 matrix; the ellipsoid's own matrix is
positive. Built once, with the numbers as parameters, and solved again and again.
"""

import time
from typing import Any, NamedTuple

import numpy as np

from pushjax.fit import QUADRATIC_MONOMIALS, RIDGE, VALUE_WEIGHT
from pushjax.limit_surface import MONOMIALS


class Fitted(NamedTuple):
    """loss: of each set of pairs, as `pushjax.fit.FitReport` has it. clipped: pairs whose scale came out negative, of
    all sets: where there are any, the program is not the same one. processor: seconds of all, building left out."""

    loss: np.ndarray
    clipped: int
    processor: float


def fit(wrench: np.ndarray, twist: np.ndarray, length: np.ndarray, degree: int) -> Fitted:
    """Of sets of pairs (sets, pairs, 3) twice, SI; length: (sets,) m.

    Raises ValueError without cvxpy.
    """
    program = Program(degree)
    program.solve(*quadratic(wrench[0], twist[0], float(length[0]), degree)[:2])  # what is built at the first solve
    losses, clipped = [], 0
    busy = time.process_time()
    for each in zip(wrench, twist, length, strict=True):
        factor, slope, along = quadratic(*each, degree)
        loss, a = program.solve(factor, slope)
        clipped += int(np.sum(along @ a < 0))
        losses.append(loss + VALUE_WEIGHT)
    return Fitted(np.array(losses), clipped, time.process_time() - busy)


def cvxpy() -> Any:
    """The package. Raises ValueError without it."""
    try:
        import cvxpy
    except ImportError as missing:
        raise ValueError("--peers of fit needs cvxpy: pip install '.[bench]'") from missing
    return cvxpy


class Program:
    """The convex program: the least |factor a|^2 - 2 slope . a over convex surfaces."""

    def __init__(self, degree: int):
        cp = cvxpy()
        n = len(monomials(degree))
        self.a, self.factor, self.slope = cp.Variable(n), cp.Parameter((n, n)), cp.Parameter(n)
        matrix = cp.Variable((3, 3) if degree == 2 else (9, 9), PSD=True)
        basis = np.stack([gram(unit, degree) for unit in np.eye(n)], axis=-1)
        matching = []
        for places, coefficients in _classes(basis, degree):
            matching.append(sum(matrix[place] for place in places) == coefficients @ self.a)
        loss = cp.sum_squares(self.factor @ self.a) - 2 * self.slope @ self.a
        self.problem, self.solver = cp.Problem(cp.Minimize(loss), matching), cp.CLARABEL

    def solve(self, factor: np.ndarray, slope: np.ndarray) -> tuple[float, np.ndarray]:
        self.factor.value, self.slope.value = factor, slope
        loss: Any = self.problem.solve(solver=self.solver)
        return float(loss), np.asarray(self.a.value)


def monomials(degree: int) -> np.ndarray:
    return QUADRATIC_MONOMIALS if degree == 2 else MONOMIALS


def quadratic(wrench, twist, length: float, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The loss of `pushjax.fit` as |factor a|^2 - 2 slope . a + a constant, the scales s_i at their best; and
    grad H(F_i) . V_i by coefficient (pairs, n), which are the scales."""
    powers = monomials(degree)
    f, v = wrench / [1, 1, length], twist * [1, 1, length]
    f, v = f / np.mean(np.linalg.norm(f, axis=1)), v / np.linalg.norm(v, axis=1, keepdims=True)
    values = np.prod(f[:, None] ** powers, axis=2)
    gradients = []
    for k in range(3):
        lowered = np.maximum(powers - np.eye(3, dtype=int)[k], 0)
        gradients.append(powers[:, k] * np.prod(f[:, None] ** lowered, axis=2))
    along = np.sum([g * v[:, k : k + 1] for k, g in enumerate(gradients)], axis=0)
    misfit = np.sum([g.T @ g for g in gradients], axis=0) - along.T @ along
    hessian = (misfit + VALUE_WEIGHT * values.T @ values) / len(f) + RIDGE * np.eye(len(powers))
    return np.linalg.cholesky(hessian).T, VALUE_WEIGHT * values.mean(axis=0), along


def gram(a: np.ndarray, degree: int) -> np.ndarray:
    """The Hessian of H as a form of y: d^2/dz_i dz_j of the coefficients `a`, by the monomials of F that are left, as
    the symmetric tensor (3, 3) or (3, 3, 3, 3)."""
    tensor = np.zeros((3,) * degree)
    for index in np.ndindex(*tensor.shape):
        counts = np.bincount(index, minlength=3)
        row = int(np.flatnonzero((monomials(degree) == counts).all(axis=1))[0])
        orders = 1.0
        left = degree
        for count in counts:
            for k in range(count):
                orders *= left / (k + 1)
                left -= 1
        tensor[index] = a[row] / orders
    return tensor * (2.0 if degree == 2 else 12.0)


def _classes(basis: np.ndarray, degree: int):
    """Entries of the positive matrix whose sum is a coefficient of the form, and that coefficient by `a`: z_i z_j, or
    z_i z_j F_k F_l."""
    if degree == 2:
        return [([(i, j)], basis[i, j]) for i in range(3) for j in range(i, 3)]
    found = []
    for i, j, k, m in np.ndindex(3, 3, 3, 3):
        if i <= j and k <= m:
            places = {(i, j, k, m), (j, i, k, m), (i, j, m, k), (j, i, m, k)}
            total = sum(basis[p] for p in places)
            found.append(([(3 * p[0] + p[2], 3 * p[1] + p[3]) for p in places], total))
    return found
