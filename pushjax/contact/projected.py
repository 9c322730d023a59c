"""Iterative solver of several contacts: a sequence of projected problems, then an exact finish.

Each iteration linearizes grad H at the last wrench F_t, with the constant term kept (Josephy and Newton's method). The
paper drops the constant and damps, which converges linearly. Then the iteration sweeps over the contacts: projected
Gauss-Seidel on normal and tangential force in turn. The result of the sweeps only has to show which cone edges carry
the force. The systems of the edges with the largest forces are then solved exactly, as in `exhaustive`, and checked
against every condition.

With many contacts this is less work than trying all sets. But finding no solution proves nothing: the status is then
NOT_CONVERGED, also in a jam.

Reference: Zhou et al. 2017, section IV.B, algorithm 1. Deviations: the constant term, the solver of the linear
problems, the finish.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3, linear_combination
from pushjax.contact.answer import polish_and_check
from pushjax.contact.edge_sets import Incumbent, no_incumbent, solve_one_edge, solve_three_edges, solve_two_edges
from pushjax.contact.scaled_problem import ContactSolver, ScalarSolution, ScaledProblem


class Projected(ContactSolver):
    """Projected Gauss-Seidel on successive linearizations of grad H, finished exactly.

    Attributes:
        rounds: Number of linearizations.
        sweeps: Number of sweeps over the contacts in each.
    """

    rounds: int = eqx.field(static=True, default=8)
    sweeps: int = eqx.field(static=True, default=20)

    def solve(self, problem: ScaledProblem) -> ScalarSolution:
        """Solve a dimensionless contact problem.

        Args:
            problem: The contact problem.

        Returns:
            The motion. Its derivatives are those of the solution, not of the search.
        """
        return polish_and_check(problem, without_derivatives(self._search, problem), proves_jams=False)

    def _search(self, problem: ScaledProblem) -> Incumbent:
        """The best set of edges that the iteration points to."""
        return _finished(problem, _forces(problem, self.rounds, self.sweeps))


class _Linear(NamedTuple):
    """grad H(F) = A F + c near the last wrench.

    Attributes:
        along_n: A a_n for each contact.
        along_t: A a_t for each contact.
        stiff_n: a_n . A a_n for each contact.
        stiff_t: a_t . A a_t for each contact.
        constant: c.
    """

    along_n: tuple[Vec3, ...]
    along_t: tuple[Vec3, ...]
    stiff_n: tuple[Scalar, ...]
    stiff_t: tuple[Scalar, ...]
    constant: Vec3


def _forces(problem: ScaledProblem, rounds: int, sweeps: int) -> tuple[Vec2, ...]:
    """Contact forces (n, t) with V = grad H(F), after all iterations."""
    zero = jnp.zeros_like(problem.speed)
    start = tuple(
        Vec2(jnp.where(active & (push.x > 0), jnp.maximum(push.x, 0), 0.0), zero)
        for active, push in zip(problem.active, problem.approach, strict=True)
    )

    def round_(_, forces):
        wrench = _wrench(problem, forces)
        some = decide(wrench.dot(wrench) > 0, problem.speed)
        wrench = tree_where(some, wrench, Vec3(zero + 1, zero, zero))
        linear = compute_once(_linearized(problem, wrench), problem.speed)
        return jax.lax.fori_loop(0, sweeps, lambda _, f: _sweep(problem, linear, f), forces)

    return jax.lax.fori_loop(0, rounds, round_, start)


def _wrench(problem: ScaledProblem, forces: tuple[Vec2, ...]) -> Vec3:
    """The sum of the contacts' wrenches."""
    rows = [row for rows in zip(problem.normal, problem.tangent, strict=True) for row in rows]
    return linear_combination(rows, [component for force in forces for component in force])


def _linearized(problem: ScaledProblem, wrench: Vec3) -> _Linear:
    """Linearize grad H at a wrench."""
    hessian = problem.form.hessian(wrench)
    along_n = tuple(hessian.times(n) for n in problem.normal)
    along_t = tuple(hessian.times(t) for t in problem.tangent)
    stiff_n = tuple(n.dot(a) for n, a in zip(problem.normal, along_n, strict=True))
    stiff_t = tuple(t.dot(a) for t, a in zip(problem.tangent, along_t, strict=True))
    # hess H F = (d - 1) grad H
    constant = problem.form.gradient(wrench).scale(float(2 - problem.form.degree))
    return _Linear(along_n, along_t, stiff_n, stiff_t, constant)


def _sweep(problem: ScaledProblem, linear: _Linear, forces: tuple[Vec2, ...]) -> tuple[Vec2, ...]:
    """One projected Gauss-Seidel sweep over the contacts."""
    twist = linear.constant
    for an, at, f in zip(linear.along_n, linear.along_t, forces, strict=True):
        twist = twist + an.scale(f.x) + at.scale(f.y)
    new = []
    for i, f in enumerate(forces):
        push, mu = problem.approach[i], problem.friction[i]
        rate = problem.normal[i].dot(twist) - push.x
        fn = jnp.maximum(f.x - rate / jnp.where(linear.stiff_n[i] > 0, linear.stiff_n[i], 1.0), 0)
        fn = compute_once(jnp.where(problem.active[i], fn, 0.0), problem.speed)
        twist = twist + linear.along_n[i].scale(fn - f.x)
        rate = problem.tangent[i].dot(twist) - push.y
        ft = f.y - rate / jnp.where(linear.stiff_t[i] > 0, linear.stiff_t[i], 1.0)
        ft = compute_once(jnp.clip(ft, -mu * fn, mu * fn), problem.speed)
        twist = compute_once(twist + linear.along_t[i].scale(ft - f.y), problem.speed)
        new.append(Vec2(fn, ft))
    return tuple(new)


def _finished(problem: ScaledProblem, forces: tuple[Vec2, ...]) -> Incumbent:
    """The best solution that passes, of the exact ones on the edges that carry the most force."""
    weights = []
    for force, mu in zip(forces, problem.friction, strict=True):
        side = jnp.where(mu > 0, force.y / jnp.where(mu > 0, mu, 1.0), force.x)
        weights += [jnp.maximum((force.x + side) / 2, 0), jnp.maximum((force.x - side) / 2, 0)]
    first = _heaviest(weights, ())
    second = _heaviest(weights, (first,))
    found = solve_one_edge(problem, no_incumbent(problem.speed), first)
    found = solve_two_edges(problem, found, jnp.minimum(first, second), jnp.maximum(first, second))
    if problem.count == 1:
        return found
    least = [jnp.minimum(weights[2 * i], weights[2 * i + 1]) for i in range(problem.count)]
    whole = [weights[2 * i] + weights[2 * i + 1] for i in range(problem.count)]
    stuck = _heaviest(least, ())
    found = solve_two_edges(problem, found, 2 * stuck, 2 * stuck + 1)
    found = solve_three_edges(problem, found, (stuck, stuck, _heaviest(whole, (stuck,))), 2)
    if problem.count == 2:
        return found
    one = _heaviest(whole, ())
    two = _heaviest(whole, (one,))
    return solve_three_edges(problem, found, (one, two, _heaviest(whole, (one, two))), 8)


def _heaviest(weights: list[Scalar], others: tuple) -> jax.Array:
    """Index of the largest weight, `others` left out."""
    best, top = jnp.zeros(weights[0].shape, jnp.int32), jnp.full_like(weights[0], -1.0)
    for k, weight in enumerate(weights):
        free = jnp.ones((), bool)
        for other in others:
            free &= other != k
        larger = decide(free & (weight > top), weight)
        best, top = jnp.where(larger, k, best), jnp.where(larger, weight, top)
    return best
