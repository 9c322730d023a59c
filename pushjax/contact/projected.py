"""Iterative solver of several contacts: a sequence of projected problems, then an exact finish.

Each round linearizes grad H at the last wrench: grad H(F) = A F + c (the Josephy-Newton method). Zhou et al. drop the
constant c and damp, which converges linearly. Then the round sweeps over the contacts: projected Gauss-Seidel on normal
and tangential force in turn. The result of the sweeps only has to show which cone edges carry the force. The systems of
the edges with the largest forces are then solved exactly, as in `exhaustive`, and checked against every condition.

With many contacts this is less work than trying all sets of edges, as `exhaustive` does. But finding no solution proves
nothing: the status is then NOT_CONVERGED, also in a jam.

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
from pushjax.contact.edge_sets import Incumbent, no_incumbent, solve_one_edge, solve_three_edges, solve_two_edges
from pushjax.contact.refinement import refine_and_check
from pushjax.contact.scaled_problem import ContactSolver, ScalarSolution, ScaledProblem


class Projected(ContactSolver):
    """Projected Gauss-Seidel on successive linearizations of grad H, finished exactly.

    Attributes:
        rounds: Number of rounds. Each linearizes once.
        sweeps: Number of sweeps over the contacts in each round.
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
        return refine_and_check(problem, without_derivatives(self._search, problem), proves_jams=False)

    def _search(self, problem: ScaledProblem) -> Incumbent:
        """The best set of edges that the iteration points to."""
        return _solve_heaviest_edges(problem, _iterate_forces(problem, self.rounds, self.sweeps))


class _Linearization(NamedTuple):
    """grad H(F) = A F + c near the last wrench, where A is the Hessian of H.

    The unit forces of a contact along its normal and its tangent have the wrenches a_n and a_t. The compliances are the
    diagonal of the Delassus matrix: how far a unit force moves its own contact point.

    Attributes:
        along_n: A a_n for each contact.
        along_t: A a_t for each contact.
        compliance_n: a_n . A a_n for each contact.
        compliance_t: a_t . A a_t for each contact.
        constant: c.
    """

    along_n: tuple[Vec3, ...]
    along_t: tuple[Vec3, ...]
    compliance_n: tuple[Scalar, ...]
    compliance_t: tuple[Scalar, ...]
    constant: Vec3


def _iterate_forces(problem: ScaledProblem, rounds: int, sweeps: int) -> tuple[Vec2, ...]:
    """Return the contact forces (n, t) after all rounds, in the scale in which the twist is V = grad H(F)."""
    zero = jnp.zeros_like(problem.runtime_scalar)
    start = tuple(
        Vec2(jnp.where(active & (approach.x > 0), jnp.maximum(approach.x, 0), 0.0), zero)
        for active, approach in zip(problem.active, problem.approach, strict=True)
    )

    def iterate(_, forces):
        wrench = _wrench(problem, forces)
        nonzero = decide(wrench.dot(wrench) > 0, problem.runtime_scalar)
        wrench = tree_where(nonzero, wrench, Vec3(zero + 1, zero, zero))
        linear = compute_once(_linearize(problem, wrench), problem.runtime_scalar)
        return jax.lax.fori_loop(0, sweeps, lambda _, f: _sweep(problem, linear, f), forces)

    return jax.lax.fori_loop(0, rounds, iterate, start)


def _wrench(problem: ScaledProblem, forces: tuple[Vec2, ...]) -> Vec3:
    """The sum of the contacts' wrenches."""
    rows = [row for rows in zip(problem.normal, problem.tangent, strict=True) for row in rows]
    return linear_combination(rows, [component for force in forces for component in force])


def _linearize(problem: ScaledProblem, wrench: Vec3) -> _Linearization:
    """Linearize grad H at a wrench."""
    hessian = problem.form.hessian(wrench)
    along_n = tuple(hessian.times(n) for n in problem.normal)
    along_t = tuple(hessian.times(t) for t in problem.tangent)
    compliance_n = tuple(n.dot(a) for n, a in zip(problem.normal, along_n, strict=True))
    compliance_t = tuple(t.dot(a) for t, a in zip(problem.tangent, along_t, strict=True))
    # c = grad H - hess H F, and hess H F = (d - 1) grad H by Euler's identity
    constant = problem.form.gradient(wrench).scale(float(2 - problem.form.degree))
    return _Linearization(along_n, along_t, compliance_n, compliance_t, constant)


def _sweep(problem: ScaledProblem, linear: _Linearization, forces: tuple[Vec2, ...]) -> tuple[Vec2, ...]:
    """One projected Gauss-Seidel sweep over the contacts."""
    twist = linear.constant
    for along_n, along_t, f in zip(linear.along_n, linear.along_t, forces, strict=True):
        twist = twist + along_n.scale(f.x) + along_t.scale(f.y)
    new = []
    for i, f in enumerate(forces):
        approach, mu = problem.approach[i], problem.friction[i]
        normal_residual = problem.normal[i].dot(twist) - approach.x
        fn = jnp.maximum(f.x - normal_residual / jnp.where(linear.compliance_n[i] > 0, linear.compliance_n[i], 1.0), 0)
        fn = compute_once(jnp.where(problem.active[i], fn, 0.0), problem.runtime_scalar)
        twist = twist + linear.along_n[i].scale(fn - f.x)
        slip = problem.tangent[i].dot(twist) - approach.y
        ft = f.y - slip / jnp.where(linear.compliance_t[i] > 0, linear.compliance_t[i], 1.0)
        ft = compute_once(jnp.clip(ft, -mu * fn, mu * fn), problem.runtime_scalar)
        twist = compute_once(twist + linear.along_t[i].scale(ft - f.y), problem.runtime_scalar)
        new.append(Vec2(fn, ft))
    return tuple(new)


def _solve_heaviest_edges(problem: ScaledProblem, forces: tuple[Vec2, ...]) -> Incumbent:
    """Solve the sets of the edges that carry the most force exactly, and keep the best solution that passes."""
    weights = []
    for force, mu in zip(forces, problem.friction, strict=True):
        # without friction both edges are the normal, and the left one gets the whole force
        tangential = jnp.where(mu > 0, force.y / jnp.where(mu > 0, mu, 1.0), force.x)
        weights += [jnp.maximum((force.x + tangential) / 2, 0), jnp.maximum((force.x - tangential) / 2, 0)]
    edge1 = _heaviest(weights, ())
    edge2 = _heaviest(weights, (edge1,))
    incumbent = solve_one_edge(problem, no_incumbent(problem.runtime_scalar), edge1)
    incumbent = solve_two_edges(problem, incumbent, jnp.minimum(edge1, edge2), jnp.maximum(edge1, edge2))
    if problem.count == 1:
        return incumbent
    lighter_edge = [jnp.minimum(weights[2 * i], weights[2 * i + 1]) for i in range(problem.count)]
    contact_weight = [weights[2 * i] + weights[2 * i + 1] for i in range(problem.count)]
    sticking = _heaviest(lighter_edge, ())
    incumbent = solve_two_edges(problem, incumbent, 2 * sticking, 2 * sticking + 1)
    contacts = sticking, sticking, _heaviest(contact_weight, (sticking,))
    incumbent = solve_three_edges(problem, incumbent, contacts, num_choices=2)
    if problem.count == 2:
        return incumbent
    contact1 = _heaviest(contact_weight, ())
    contact2 = _heaviest(contact_weight, (contact1,))
    contacts = contact1, contact2, _heaviest(contact_weight, (contact1, contact2))
    return solve_three_edges(problem, incumbent, contacts, num_choices=8)


def _heaviest(weights: list[Scalar], excluded: tuple) -> jax.Array:
    """Index of the largest weight, the indices in `excluded` left out."""
    heaviest, largest = jnp.zeros(weights[0].shape, jnp.int32), jnp.full_like(weights[0], -1.0)
    for k, weight in enumerate(weights):
        allowed = jnp.ones((), bool)
        for index in excluded:
            allowed &= index != k
        larger = decide(allowed & (weight > largest), weight)
        heaviest, largest = jnp.where(larger, k, heaviest), jnp.where(larger, weight, largest)
    return heaviest
