"""The motion under the forces along a given set of cone edges, to the last digit; it is not differentiated.

A search (`exhaustive`, `paper`) or the stage of a rollout before gives the set. Its wrench F = Q beta and its
conditions R V = b make a square system R grad H(Q beta) = b in three slots, one for each edge that a set can have. A
slot without an edge has zero axis, row and right-hand side, and a one on the Jacobian's diagonal. Newton's method
solves the system; then every condition of the problem is checked. For a guess, this is the only check.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.xla import tree_where
from pushjax._math.arrays import combined, cross, dot, dual, products, solve, times, unit
from pushjax._math.sums import repeated, summed
from pushjax.contact.scaled_problem import NO_EDGE, EdgeSet, ScaledProblem, selected, violation_per_weight
from pushjax.contact.status import ContactMode
from pushjax.contact.tolerances import (
    ill_conditioned_tolerance,
    is_slow,
    kinematic_tolerance,
    relative_tolerance,
    zero_wrench_tolerance,
)
from pushjax.friction.polynomial import Polynomial

NEWTON_ITERATIONS = {4: 3, 8: 4}  # by the bytes of a float; each is kept only if it makes the residual smaller


class Refined(NamedTuple):
    """The solution of a set's equations, dimensionless."""

    twist: Float[Array, "3 *batch"]
    gradient: Float[Array, "3 *batch"]  # grad H of the wrench, before the twist was corrected
    wrench: Float[Array, "3 *batch"]
    weight: Float[Array, "3 *batch"]  # of the set's edges
    start: Float[Array, "3 *batch"]  # the shortest y whose products with the edges are their weights
    h: Float[Array, "*batch"]  # H of the wrench
    is_wrench: Bool[Array, "*batch"]  # whether the weights make up the wrench, and it is more than roundoff


class Equations(NamedTuple):
    """The square system R grad H(Q beta) = b of a set of cone edges; vectors are (slot, component, batch)."""

    surface: Polynomial
    used: Bool[Array, "3 *batch"]  # whether the slot has an edge
    edges: Float[Array, "3 3 *batch"]
    axes: Float[Array, "3 3 *batch"]  # Q: orthonormal axes of the first edge, of the plane of two, of space
    conditioned: Bool[Array, "3 *batch"]  # whether the slot has a condition
    rows: Float[Array, "3 3 *batch"]  # R
    b: Float[Array, "3 *batch"]

    @staticmethod
    def of(
        problem: ScaledProblem, chosen: EdgeSet, moves: Bool[Array, "*batch"]
    ) -> tuple["Equations", Float[Array, "3 3 *batch"], Float[Array, "3 3 *batch"]]:
        """The equations of a set, none where not `moves`; and its edges completed to a basis, and the dual basis."""
        used, conditioned = moves[None] & (chosen.edges >= 0), moves[None] & (chosen.conditions >= 0)
        rows, goal = problem.numbered_rows()
        numbered = selected(jnp.concatenate([rows, goal[None]]), jnp.where(conditioned, chosen.conditions, NO_EDGE))
        edges = selected(problem.edges, jnp.where(used, chosen.edges, NO_EDGE))
        edges, rows = jnp.moveaxis(edges, 1, 0), jnp.moveaxis(numbered[:3], 1, 0)
        full, basis = completed(edges, used, 0.01 * float(jnp.finfo(edges.dtype).eps))
        q1, q3 = unit(full[0]), unit(cross(full[0], full[1]))
        axes = jnp.where(used[:, None], jnp.stack([q1, cross(q3, q1), q3]), 0.0)
        return Equations(problem.surface, used, edges, axes, conditioned, rows, numbered[3]), full, basis

    def evaluate(self, beta: Array) -> tuple[Array, Array, Array]:
        """The Hessian and grad H at Q beta, and the residual R grad H - b."""
        f = combined(self.axes, beta)
        hessian = self.surface.hessian(f)
        gradient = times(hessian, f) / (self.surface.degree - 1)
        return hessian, gradient, products(self.rows, gradient) - self.b

    def newton_step(self, hessian: Array, residual: Array) -> Array:
        """Newton step -J^-1 residual with J = R hess H Q; zero where J is singular."""
        moved = times(hessian[:, :, None], jnp.moveaxis(self.axes, 1, 0))  # (component, axis, batch)
        jacobian = summed(
            repeated(jnp.moveaxis(self.rows, 1, 0), 1, 3) * repeated(moved, 2, 3), 0
        )  # (axis, row, batch)
        diagonal = jnp.eye(3, dtype=bool).reshape(3, 3, *(1,) * (residual.ndim - 1)) & ~self.used[None]
        jacobian = jnp.where(diagonal, 1.0, jacobian)
        sizes = summed(jacobian * jacobian, 1)
        least = jnp.finfo(residual.dtype).eps * 1e-2 * jnp.sqrt(sizes[0] * sizes[1] * sizes[2])
        return products(dual(jacobian, least)[0], -residual)


def _root(equations: Equations, beta: Array) -> Array:
    """Solve the system by Newton's method from beta."""

    def iterate(_, state):
        beta, (hessian, gradient, residual) = state
        candidate = beta + equations.newton_step(hessian, residual)
        new = equations.evaluate(candidate)
        better = (dot(new[2], new[2]) < dot(residual, residual))[None]
        return jnp.where(better, candidate, beta), tree_where(better, new, (hessian, gradient, residual))

    return jax.lax.fori_loop(0, NEWTON_ITERATIONS[beta.dtype.itemsize], iterate, (beta, equations.evaluate(beta)))[0]


def refine(problem: ScaledProblem, chosen: EdgeSet, moves: Bool[Array, "*batch"]) -> Refined:
    """Solve the equations of a set of cone edges; where not `moves`, the numbers are finite but have no meaning."""
    equations, full_edges, edge_basis = Equations.of(problem, chosen, moves)
    _, used, edges, axes, conditioned, rows, b = equations
    # the rows' residual is roundoff, which nearly dependent rows would magnify
    _, row_basis = completed(rows, conditioned, float(jnp.finfo(b.dtype).eps) ** 0.5)
    beta = _root(equations, _rescaled(equations, products(axes, combined(edges, chosen.weight))))
    f = combined(axes, beta)
    # With three edges, correct the wrench so that grad H is the motion that the conditions alone fix: nearly dependent
    # rows magnify roundoff, so Newton's method stalls short of it. Corrections that are not small are not made.
    hessian, gradient, residual = equations.evaluate(beta)
    step = solve(hessian, combined(row_basis, -residual))
    small = used[2] & (dot(step, step) < 1e-8 * dot(f, f))
    f = f + jnp.where(small[None], step, 0.0)

    weight = products(edge_basis, f)
    weight = weight + products(edge_basis, f - combined(full_edges, weight))
    gradient = problem.surface.gradient(f)
    # the twist nearest to grad H that satisfies the conditions, so that a sticking contact has no slip
    twist = gradient
    for _ in range(2):  # the second pass is for nearly dependent rows
        twist = twist + combined(row_basis, b - products(rows, twist))
    weight = jnp.where(used, weight, 0.0)  # directions orthogonal to the edges get none
    total, left = summed(jnp.abs(weight), 0), f - combined(edges, weight)
    is_wrench = dot(left, left) <= (64 * jnp.finfo(f.dtype).eps * total) ** 2
    is_wrench &= dot(f, f) > (zero_wrench_tolerance(f.dtype) * total) ** 2
    h = dot(f, gradient) / problem.surface.degree
    return Refined(twist, gradient, f, weight, combined(edge_basis, weight), h, is_wrench)


def completed(vectors: Array, used: Bool[Array, "3 *batch"], relative: float) -> tuple[Array, Array]:
    """Three vectors, the unused ones replaced by directions orthogonal to those in use; and the dual basis."""
    # the dual basis is zero where |det| is at most `relative` times the product of the lengths
    zero = jnp.zeros_like(vectors[0, 0])
    v1 = jnp.where(used[:1], vectors[0], jnp.stack([zero + 1, zero, zero]))
    sideways = jnp.stack([-v1[1], v1[0], zero]), jnp.stack([zero, -v1[2], v1[1]])
    v2 = jnp.where(used[1:2], vectors[1], jnp.where((jnp.abs(v1[0]) > jnp.abs(v1[1]))[None], *sideways))
    full = jnp.stack([v1, v2, jnp.where(used[2:], vectors[2], cross(v1, v2))])
    sizes = summed(full * full, 1)
    return full, dual(full, relative * jnp.sqrt(sizes[0] * sizes[1] * sizes[2]))[0]


def _rescaled(equations: Equations, beta: Array) -> Array:
    """Scale beta so that grad H is as long as the conditions require, by least squares."""
    motion = products(equations.rows, equations.evaluate(beta)[1])
    squared = dot(motion, motion)
    factor = jnp.maximum(dot(motion, equations.b) / jnp.where(squared > 0, squared, 1.0), 0)
    return beta * (factor if equations.surface.degree == 2 else jnp.exp(jnp.log(factor) / 3))[None]  # faster than cbrt


def check(
    problem: ScaledProblem, chosen: EdgeSet, moves: Bool[Array, "*batch"], refined: Refined
) -> tuple[Bool[Array, "*batch"], Bool[Array, "edges *batch"], Int[Array, "contacts *batch"]]:
    """Whether every condition holds, whether each cone edge may carry force under the motion, and the modes."""
    # No contact is violated, the forces are inside their cones and on the side of the slip, the twist is along grad H
    # and not too fast. A search has checked these conditions before the refinement, which changes its numbers by
    # roundoff only, so the tolerances are somewhat wider here.
    dtype, twist, weight = refined.twist.dtype, refined.twist, refined.weight
    slip_n, slip_t = problem.slips(twist)
    tolerance = kinematic_tolerance(twist)[None]
    touches = problem.active & (jnp.abs(slip_n) <= tolerance)
    numbers = jnp.arange(2 * problem.count).reshape(1, -1, *(1,) * (twist.ndim - 1))
    in_set = jnp.any(chosen.edges[:, None] == numbers, axis=0).reshape(problem.count, 2, *twist.shape[1:])
    sides = jnp.stack([slip_t, -slip_t], axis=1)  # below zero where the slip fits the edge
    admissible = (touches[:, None] & (sides <= tolerance[:, None])) | in_set

    wide, relative = 1.25 * tolerance, 1.25 * relative_tolerance(dtype)
    passes = jnp.all((slip_n >= -wide) | ~problem.active, axis=0)
    fits = (sides <= wide[:, None]) & (problem.active & (slip_n <= wide))[:, None]
    passes &= jnp.all(fits | ~in_set, axis=(0, 1))
    per_weight = selected(violation_per_weight(problem.friction)[None], chosen.edges >> 1)[0]
    total = summed(jnp.abs(weight), 0)
    passes &= jnp.all((per_weight * weight >= -relative / 2 * total[None]) | (chosen.edges < 0), axis=0)
    # In a wedge the rows are nearly dependent. They then determine grad H only up to this tolerance.
    direction = 1.25 * ill_conditioned_tolerance(dtype)
    difference, squared = twist - refined.gradient, dot(twist, twist)
    passes &= (dot(difference, difference) <= direction**2 * squared) & is_slow(squared, 1.25)
    solved = moves & (refined.h > 0) & refined.is_wrench & passes

    slides = jnp.where(slip_t < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT)
    mode = jnp.where(jnp.abs(slip_t) <= tolerance, ContactMode.STICKING, slides)
    # from the motion alone, because modes must not depend on which of several force distributions is returned
    mode = jnp.where(solved[None] & problem.active & (slip_n <= tolerance), mode, ContactMode.SEPARATED)
    admissible = admissible.reshape(2 * problem.count, *twist.shape[1:])
    return solved, admissible, mode.astype(jnp.int8)


class Solution(NamedTuple):
    """The answer to a contact problem, in physical units."""

    twist: Float[Array, "3 *batch"]  # m, m, rad
    wrench: Float[Array, "3 *batch"]  # normalized, on H = 1
    force: Float[Array, "2 contacts *batch"]  # along (normal, tangent), N


class Answer(NamedTuple):
    """The answer to a contact problem."""

    solution: Solution
    mode: Int[Array, "contacts *batch"]  # `ContactMode`
    status: Int[Array, "*batch"]  # `Status`
    margin: Float[Array, "*batch"]  # minus the hand's squeeze power, m, as in `Motion`
    unique: Bool[Array, "*batch"]  # False where the search found another twist that satisfies every condition
    best: EdgeSet  # the cone edges that carry the force; the guess where there is no motion
    loaded: Bool[Array, "edges *batch"]  # which edges carry force
    indeterminate: Bool[Array, "*batch"]  # whether more edges share the force than the wrench determines
    dual: Float[Array, "3 *batch"]  # y of `force_distribution`, where they do
    squeeze_edges: Int[Array, "4 *batch"]  # edges of the equilibrium of the largest squeeze power


def in_units(
    problem: ScaledProblem, solved: Bool[Array, "*batch"], twist: Array, wrench: Array, weights: Array
) -> Solution:
    """The motion with its forces, given the weights of all edges; zero where not `solved`."""
    h = problem.surface.value(wrench)
    h = jnp.where(solved & (h > 0), h, 1.0)
    scale = 1 / (problem.surface.root(h) * problem.surface.root(problem.surface_scale))  # puts the wrench on H = 1
    left, right = weights[::2], weights[1::2]
    force = jnp.stack([left + right, problem.friction * (left - right)]) * scale[None, None]
    length = jnp.ones_like(problem.length)
    return Solution(
        jnp.where(solved[None], twist * (problem.unit[None] / jnp.stack([length, length, problem.length])), 0.0),
        jnp.where(solved[None], wrench * scale[None], 0.0),
        jnp.where(solved[None, None], force, 0.0),
    )
