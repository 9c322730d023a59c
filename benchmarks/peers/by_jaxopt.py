"""Limit surfaces fitted, and contact problems solved, by the general solvers of jaxopt, in batches like pushjax's.

The fit has the same convex parameterization as `pushjax.friction.fit`, and the loss of `benchmarks.peers.fits`, which
has no clipped pairs. `jaxopt.LBFGS` minimizes it.

A contact problem is the minimum, zero, of half the squared residual of the equations in `benchmarks.peers.contacts`.
`jaxopt.ProjectedGradient` searches for it over the friction cones of the contacts. It starts once, from normal forces
that are all equal. The squared residual is not convex, so a search can end at another minimum.

jaxopt is no longer maintained, and warns of it on import. The warning is silenced here: jaxopt is only compared with.
"""

import time
import warnings
from functools import cache
from typing import Any, NamedTuple

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


class Fitted(NamedTuple):
    """Results of the fits."""

    loss: np.ndarray  # of each set of pairs, (sets,), as in `pushjax.friction.fit.FitReport`
    steps: np.ndarray  # number of steps of each fit, (sets,)
    processor: float  # CPU time of all fits together, s, without compiling


def jaxopt() -> Any:
    """Import and return the package jaxopt, or raise ValueError if it is not installed."""
    try:
        with warnings.catch_warnings():
            # jaxopt warns on import that it is no longer maintained, which whoever measures it knows
            warnings.simplefilter("ignore", DeprecationWarning)
            import jaxopt
    except ImportError as missing:
        raise ValueError("--peers of fit and solve needs jaxopt: pip install '.[bench]'") from missing
    return jaxopt


def fit(wrench: np.ndarray, twist: np.ndarray, length: np.ndarray, degree: int) -> Fitted:
    """Fit a limit surface to each set of pairs, all sets in one batch."""
    # wrench and twist: (sets, pairs, 3), SI units; length: (sets,), m; degree: 2 for ellipsoids, 4 for quartics
    search = _fits(degree)
    jax.block_until_ready(search(*_quadratics(wrench, twist, length, degree)))  # compiles at the first call
    busy = time.process_time()
    loss, steps = jax.block_until_ready(search(*_quadratics(wrench, twist, length, degree)))
    return Fitted(np.asarray(loss) + VALUE_WEIGHT, np.asarray(steps), time.process_time() - busy)


def solve(coefficients, length, problems) -> contacts.Solved:
    """Solve a batch of contact problems, all at once."""
    # coefficients: of quartics, (n, 15); length: (n,), m; problems: batched `pj.Contacts`, all contacts active
    point = jnp.asarray(problems.point)
    friction, gap = (jnp.broadcast_to(jnp.asarray(part), point.shape[:2]) for part in (problems.friction, problems.gap))
    args = jnp.asarray(coefficients), jnp.asarray(length), point, problems.normal, problems.displacement, friction, gap
    search = _contacts()
    jax.block_until_ready(search(*args))
    busy = time.process_time()
    twist, residual = jax.block_until_ready(search(*args))
    busy = time.process_time() - busy
    return contacts.Solved(np.where(np.asarray(residual)[:, None] < RESIDUAL, twist, np.nan), busy)


def nearest_in_cone(force, friction):
    """Return the projection of a force (normal, tangential), (2,), onto the friction cone."""
    normal, tangential = force[0], jnp.abs(force[1])
    along = jnp.maximum((normal + friction * tangential) / (1 + friction**2), 0.0)
    inside = tangential <= friction * normal
    return jnp.where(inside, force, jnp.stack([along, jnp.sign(force[1]) * friction * along]))


def _quadratics(wrench, twist, length, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the loss of each set as factors (sets, n, n) and slopes (sets, n): see `fits.quadratic`."""
    each = [fits.quadratic(*one, degree)[:2] for one in zip(wrench, twist, length, strict=True)]
    factors, slopes = zip(*each, strict=True)
    return np.stack(factors), np.stack(slopes)


@cache
def _fits(degree: int):
    """Return the compiled batch of searches for the best surface."""
    pairs = [tuple(np.repeat(np.arange(3), powers)) for powers in QUADRATIC_MONOMIALS]

    def loss(lower, factor, slope):
        forms = quadratic_forms(lower)
        if degree == 4:
            a = squared_quadratics(forms)
        else:
            a = jnp.stack([forms[0, i, j] * (1 if i == j else 2) for i, j in pairs])
        return jnp.sum((factor @ a) ** 2) - 2 * slope @ a

    solver = jaxopt().LBFGS(loss, maxiter=FIT_STEPS, tol=FIT_TOLERANCE, implicit_diff=False, **LINE_SEARCH)

    def search(factor, slope):
        start = initial_factors(degree, TERMS if degree == 4 else 1, factor.dtype)
        state = solver.run(start, factor, slope).state
        return state.value, state.iter_num

    return jax.jit(jax.vmap(search))


@cache
def _contacts():
    """Return the compiled batch of searches for the forces of contact problems."""

    def merit(force, problem):
        return jnp.sum(_residual(force, problem)[0] ** 2) / 2

    solver = jaxopt().ProjectedGradient(
        merit, jax.vmap(nearest_in_cone), maxiter=CONTACT_STEPS, tol=CONTACT_TOLERANCE, implicit_diff=False
    )

    def search(coefficients, length, *geometry):
        problem, size = _without_units(coefficients, length, *geometry)
        start = jnp.zeros_like(problem.away).at[:, 0].set(1.0)
        # the twist has the third degree in the forces: begin with one as long as the displacements
        start = start / jnp.cbrt(jnp.maximum(jnp.linalg.norm(_residual(start, problem)[1]), 1e-9))
        found = solver.run(start, problem.friction, problem=problem).params
        left, twist = _residual(found, problem)
        return twist.at[2].divide(length) * size, jnp.max(jnp.abs(left))

    return jax.jit(jax.vmap(search))


class _Problem(NamedTuple):
    """One contact problem without units, as `contacts.Problem`."""

    curvature: jax.Array  # second derivatives of the quartic, (9, 9): see `contacts.CURVATURE`
    rows: jax.Array  # wrenches of unit normal and tangential forces, (contacts, 2, 3)
    away: jax.Array  # displacements of the hand along the same directions, the first less the gap, (contacts, 2)
    friction: jax.Array  # coefficients of friction, (contacts,)


def _without_units(coefficients, length, point, normal, displacement, friction, gap) -> tuple[_Problem, jax.Array]:
    """Return the problem with displacements scaled to one and torques divided by the length, and the scale, m."""
    size = jnp.maximum(jnp.maximum(jnp.abs(displacement).max(), jnp.abs(gap).max()), 1e-12)
    axes = jnp.stack([normal, jnp.stack([-normal[:, 1], normal[:, 0]], axis=1)], axis=1)
    arm = (point[:, None, 0] * axes[:, :, 1] - point[:, None, 1] * axes[:, :, 0]) / length
    away = jnp.einsum("cax,cx->ca", axes, displacement).at[:, 0].add(-gap) / size
    curvature = jnp.asarray(contacts.CURVATURE, away.dtype) @ coefficients
    return _Problem(curvature, jnp.concatenate([axes, arm[:, :, None]], axis=2), away, friction), size


def _residual(force, problem: _Problem):
    """Return the residual of the equations, (contacts, 2), and the twist without units, (3,)."""
    # force: normal and tangential force of each contact, (contacts, 2)
    wrench = jnp.einsum("ca,cax->x", force, problem.rows)
    twist = (problem.curvature @ jnp.outer(wrench, wrench).ravel()).reshape(3, 3) @ wrench / 3
    motion = problem.rows @ twist - problem.away
    limit = problem.friction * force[:, 0]
    normal = force[:, 0] - jnp.maximum(0, force[:, 0] - motion[:, 0])
    tangential = force[:, 1] - jnp.clip(force[:, 1] - motion[:, 1], -limit, limit)
    return jnp.stack([normal, tangential], axis=1), twist
