"""Solver of contacts without friction under an ellipsoidal limit surface.

Under an ellipsoid the twist is V = A sum_i f_i n_i, where A is the Hessian of H, n_i the normal rows of the contacts
(`scaled_problem`) and f_i >= 0 their forces. The conditions 0 <= f_i  _|_  n_i . V - b_i >= 0 are those of a convex
program: minimize V' A^-1 V subject to n_i . V >= b_i. Its solution is unique, and loads at most three contacts. So
every set of one, two or three contacts is tried, each in closed form, and the one whose motion violates the conditions
least is the solution. If that motion violates one of them clearly, no motion satisfies all: a jam.
"""

from itertools import combinations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.scaled_problem import ContactSolver, ScalarSolution, ScaledProblem
from pushjax.contact.status import ContactMode, Status

# Largest violation of a condition that passes, and largest motion that can be an answer. Both are dimensionless, in
# units of `ScaledProblem.displacement_unit`. The other solvers are much stricter (`tolerances`).
TOLERANCE, MAX_MOTION = 1e-3, 1e3
# Keyed by the bytes of a float: determinants smaller than this, relative to the product of the diagonal, count as zero.
SINGULAR = {4: 1e-5, 8: 1e-11}


class Frictionless(ContactSolver):
    """Solver for contacts without friction, whose coefficients of friction are ignored, under an ellipsoid.

    Two contacts whose normals are opposite up to 3e-3 rad (float32) or 3e-6 rad (float64) count as exactly opposite.
    They jam the slider, although it might escape from so narrow a wedge, hundreds of times as fast as the pushers.
    """

    def solve(self, problem: ScaledProblem) -> ScalarSolution:
        """Solve a dimensionless contact problem.

        Args:
            problem: The contact problem; its form must be that of an ellipsoid.

        Returns:
            The motion, which can be differentiated. Its margin is always infinite. A contact that touches without
            force has the mode SEPARATED.
        """
        if problem.form.degree != 2:
            raise ValueError(f"solver: Frictionless needs an ellipsoid; the surface has degree {problem.form.degree}")
        count, scalar = problem.count, problem.runtime_scalar
        zero = jnp.zeros_like(scalar)
        motions = tuple(problem.form.gradient(n) for n in problem.normal)  # by a unit force at each contact
        # the Delassus matrix of the normals, which is symmetric
        gram = compute_once(tuple(tuple(n.dot(motion) for motion in motions) for n in problem.normal), scalar)
        goal = tuple(b.x for b in problem.approach)
        best_twist, best_force = Vec3(zero, zero, zero), (zero,) * count
        best = jnp.full_like(zero, jnp.inf)
        for size in range(1, min(count, 3) + 1):
            for chosen in combinations(range(count), size):
                forces, singular = _solve([[gram[i][j] for j in chosen] for i in chosen], [goal[i] for i in chosen])
                twist = Vec3(zero, zero, zero)
                for i, force in zip(chosen, forces, strict=True):
                    twist = twist + motions[i].scale(force)
                # a force of the wrong sign is a violation, too: by the motion that it alone would cause
                violation = zero
                for i, force in zip(chosen, forces, strict=True):
                    violation = jnp.maximum(violation, -force * gram[i][i])
                for n, b, active in zip(problem.normal, goal, problem.active, strict=True):
                    violation = jnp.maximum(violation, jnp.where(active, b - n.dot(twist), 0.0))
                twist_size = jnp.abs(twist.x) + jnp.abs(twist.y) + jnp.abs(twist.z)
                usable = ~singular & (twist_size < MAX_MOTION)
                for i in chosen:
                    usable &= problem.active[i]
                violation = compute_once(jnp.where(usable, violation, jnp.inf), scalar)
                better = violation < best
                best = jnp.where(better, violation, best)
                best_twist = tree_where(better, twist, best_twist)
                force_of = dict(zip(chosen, forces, strict=True))
                best_force = tuple(jnp.where(better, force_of.get(i, zero), old) for i, old in enumerate(best_force))
        status = jnp.where(best < TOLERANCE, Status.MOVING, Status.JAMMED)
        status = jnp.where(problem.pushes, status, Status.FREE)
        status = jnp.where(problem.valid, status, Status.INVALID).astype(jnp.int8)
        return _answer(problem, best_twist, best_force, status)


def _solve(gram: list[list[Scalar]], goal: list[Scalar]) -> tuple[list[Scalar], Bool[Array, ""]]:
    """Solve a symmetric system of up to three equations by Cramer's rule; also return whether it is singular."""
    size = len(goal)

    def determinant(rows: list[list[Scalar]]) -> Scalar:
        if len(rows) == 1:
            return rows[0][0]
        if len(rows) == 2:
            return rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
        minors = (determinant([[row[j] for j in range(3) if j != k] for row in rows[1:]]) for k in range(3))
        first, second, third = (entry * minor for entry, minor in zip(rows[0], minors, strict=True))
        return first - second + third

    diagonal = gram[0][0]
    for k in range(1, size):
        diagonal = diagonal * gram[k][k]
    whole = determinant(gram)
    singular = ~(whole > SINGULAR[whole.dtype.itemsize] * diagonal)
    scale = 1 / jnp.where(singular, 1.0, whole)
    columns = (
        [[goal[i] if j == k else row[j] for j in range(size)] for i, row in enumerate(gram)] for k in range(size)
    )
    return [scale * determinant(rows) for rows in columns], singular


def _answer(problem: ScaledProblem, twist: Vec3, forces: tuple[Scalar, ...], status) -> ScalarSolution:
    """Return the solution with its units."""
    moves, zero = status == Status.MOVING, jnp.zeros_like(twist.x)
    unit, length = problem.displacement_unit, problem.form.length
    twist = tree_where(moves, Vec3(unit * twist.x, unit * twist.y, unit * twist.z / length), Vec3(zero, zero, zero))
    forces = tuple(jnp.where(moves, jnp.maximum(force, 0), 0.0) for force in forces)
    wrench = Vec3(zero, zero, zero)
    for n, force in zip(problem.normal, forces, strict=True):
        wrench = wrench + n.scale(force)
    h = problem.form.value(wrench) * problem.form_scale
    scale = jnp.where(h > 0, jax.lax.rsqrt(jnp.where(h > 0, h, 1.0)), 0.0)
    slips = problem.slips(Vec3(twist.x / unit, twist.y / unit, twist.z * length / unit))
    mode = tuple(
        jnp.where(
            force > 0, jnp.where(slip.y < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT), ContactMode.SEPARATED
        ).astype(jnp.int8)
        for force, slip in zip(forces, slips, strict=True)
    )
    force = tuple(Vec2(scale * force, zero) for force in forces)
    true, infinite = jnp.ones((), bool), jnp.full_like(zero, jnp.inf)
    return ScalarSolution(twist, wrench.scale(scale), force, mode, status, infinite, true)
