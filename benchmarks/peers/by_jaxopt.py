"""Limit surfaces fitted, and contact problems solved, by the general solvers of jaxopt, in batches like pushjax's.

`jaxopt.LBFGS` minimizes the loss of `benchmarks.peers.fits` over the convex parameterization of `pushjax.friction.fit`.
`jaxopt.ProjectedGradient` minimizes half the squared residual of the equations in `benchmarks.peers.contacts` over the
friction cones, from equal normal forces. That is not convex, so a search can end at another minimum than zero.

jaxopt is no longer maintained, and warns of it on import, which is silenced here.
"""

import time
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers import contacts, fits
from pushjax.friction.fit import VALUE_WEIGHT
from pushjax.friction.fit_loss import QUADRATIC_MONOMIALS
from pushjax.friction.sum_of_squares import TERMS, initial_factors, quadratic_forms, squared_quadratics

FIT_STEPS, FIT_TOLERANCE = 500, 1e-6  # limits of the steps, and of the gradient's norm
# Of the line searches tried, this is the cheapest: "zoom", the default, takes three to seven times as long.
LINE_SEARCH: dict[str, Any] = {"linesearch": "backtracking", "maxls": 15}
CONTACT_STEPS, CONTACT_TOLERANCE = 1000, 1e-10  # of the steps, and of the length of a projected step
RESIDUAL = 1e-6  # largest error of the equations at which a problem counts as solved, relative to the displacement


def jaxopt() -> Any:
    """Import and return the package jaxopt, or raise ValueError if it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            import jaxopt
    except ImportError as missing:
        raise ValueError("--peers of fit and solve needs jaxopt: pip install '.[bench]'") from missing
    return jaxopt


def fit(wrench: np.ndarray, twist: np.ndarray, length: np.ndarray, degree: int) -> fits.Fitted:
    """Fit a limit surface to each set of pairs, all sets in one batch, with arguments as in `fits.fit`."""
    rows, columns = np.array([np.repeat(np.arange(3), powers) for powers in QUADRATIC_MONOMIALS]).T

    def loss(lower, factor, slope):
        forms = quadratic_forms(lower)
        a = squared_quadratics(forms) if degree == 4 else forms[0, rows, columns] * np.where(rows == columns, 1, 2)
        return jnp.sum((factor @ a) ** 2) - 2 * slope @ a

    solver = jaxopt().LBFGS(loss, maxiter=FIT_STEPS, tol=FIT_TOLERANCE, implicit_diff=False, **LINE_SEARCH)
    start = initial_factors(degree, TERMS if degree == 4 else 1, np.float64)
    search = jax.jit(jax.vmap(lambda factor, slope: solver.run(start, factor, slope).state.value))

    def quadratics() -> list[np.ndarray]:
        each = [fits.quadratic(*one, degree)[:2] for one in zip(wrench, twist, length, strict=True)]
        return [np.stack(parts) for parts in zip(*each, strict=True)]

    least, processor = _timed(lambda: search(*quadratics()))
    return fits.Fitted(least + VALUE_WEIGHT, 0, processor)  # the loss has no pairs that could be clipped


def solve(coefficients, length, problems) -> contacts.Solved:
    """Solve a batch of contact problems, all at once, with arguments as in `contacts.solve`."""
    each = contacts.without_units(coefficients, length, problems)
    arrays = [np.stack([getattr(problem, name) for problem in each]) for name in ("rows", "away", "friction")]
    arrays.append(np.stack([problem.curvature for problem in each]))
    count = each[0].m

    def equations(force, rows, away, friction, curvature):
        """Return the residual for forces (contacts, 2), and the twist without units."""
        force = force.T.ravel()
        wrench = force @ rows
        twist = (curvature @ jnp.outer(wrench, wrench).ravel()).reshape(3, 3) @ wrench / 3
        motion, limit = rows @ twist - away, friction * force[:count]
        normal = force[:count] - jnp.maximum(0, force[:count] - motion[:count])
        tangential = force[count:] - jnp.clip(force[count:] - motion[count:], -limit, limit)
        return jnp.concatenate([normal, tangential]), twist

    def merit(force, problem):
        return jnp.sum(equations(force, *problem)[0] ** 2) / 2

    solver = jaxopt().ProjectedGradient(
        merit, jax.vmap(nearest_in_cone), maxiter=CONTACT_STEPS, tol=CONTACT_TOLERANCE, implicit_diff=False
    )

    @jax.jit
    @jax.vmap
    def search(*problem):
        start = jnp.zeros((count, 2)).at[:, 0].set(1.0)
        # the twist has the third degree in the forces: begin with one as long as the displacements
        start = start / jnp.cbrt(jnp.maximum(jnp.linalg.norm(equations(start, *problem)[1]), 1e-9))
        left, twist = equations(solver.run(start, problem[2], problem=problem).params, *problem)
        return twist, jnp.max(jnp.abs(left))

    (twist, left), processor = _timed(lambda: search(*arrays))
    twist *= np.array([[problem.size, problem.size, problem.size / problem.length] for problem in each])
    return contacts.Solved(np.where(left[:, None] < RESIDUAL, twist, np.nan), processor)


def nearest_in_cone(force, friction):
    """Return the projection of a force (normal, tangential), (2,), onto the friction cone."""
    normal, tangential = force[0], jnp.abs(force[1])
    along = jnp.maximum((normal + friction * tangential) / (1 + friction**2), 0.0)
    return jnp.where(tangential <= friction * normal, force, along * jnp.stack([1.0, jnp.sign(force[1]) * friction]))


def _timed(search) -> tuple[Any, float]:
    """Return the results of a second call, in NumPy, and its CPU time, s; the first call compiles."""
    jax.block_until_ready(search())
    busy = time.process_time()
    results = jax.block_until_ready(search())
    return jax.tree.map(np.array, results), time.process_time() - busy
