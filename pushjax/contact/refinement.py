"""The last stage of a contact solver: it refines the solution that the search found, and checks it.

The search returns a set of friction-cone edges whose forces make up the wrench F. Once the set is known, F lies in the
space that its edges span: F = Q beta, where Q is an orthonormal basis of that space. The unknown beta solves the square
system R grad H(Q beta) = b. H is the limit surface's function, the rows of R are those of the kinematic conditions, and
b holds the pushers' displacements. The unknowns are not the weights of the edges: where forces nearly cancel, the
weights may be a million times as large as F, and F would lose six digits.

Newton's method refines the wrench that the search found. Derivatives come from the implicit function theorem at the
solution, R hess H Q d(beta) = ..., so nothing of the search is differentiated. The set itself is held fixed, so the
derivatives hold as long as the contact modes stay the same.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.linalg import Basis, complete_basis
from pushjax._math.vec import Scalar, Vec2, Vec3, linear_combination
from pushjax.contact.edge_sets import Incumbent
from pushjax.contact.force_distribution import distribute_force
from pushjax.contact.jam_certificate import squeeze_power
from pushjax.contact.scaled_problem import ScalarSolution, ScaledProblem, dynamic_index
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.tolerances import ill_conditioned_tolerance, kinematic_tolerance, relative_tolerance
from pushjax.friction.limit_surface import Form

Rows = tuple[Vec3, Vec3, Vec3]


class _System(NamedTuple):
    """The square system R grad H(Q beta) = b.

    It has three slots, one for each edge that a set can have. A slot without an edge has zero axis, row and right-hand
    side, and a one on the Jacobian's diagonal.

    Attributes:
        form: H, as a function of the scalar components of the wrench.
        axes: Columns of Q.
        rows: Rows of R.
        b: Right-hand side.
        unused: One for each slot without an edge, else zero; added to the diagonal of the Jacobian.
    """

    form: Form
    axes: Rows
    rows: Rows
    b: Vec3
    unused: Vec3

    def wrench(self, beta: Vec3) -> Vec3:
        """The wrench F = Q beta."""
        return linear_combination(self.axes, beta)

    def components(self, f: Vec3) -> Vec3:
        """Components of a wrench along the axes."""
        return Vec3(*(q.dot(f) for q in self.axes))

    def residual(self, beta: Vec3) -> Vec3:
        """R grad H(Q beta) - b."""
        motion = self.form.gradient(self.wrench(beta))
        return Vec3(*(row.dot(motion) for row in self.rows)) - self.b

    def newton_step(self, beta: Vec3, residual: Vec3) -> Vec3:
        """Newton step -J^-1 residual with J = R hess H Q; zero where J is singular."""
        hessian = compute_once(self.form.hessian(self.wrench(beta)), beta.x)
        columns = [Vec3(*(row.dot(hessian.times(q)) for row in self.rows)) for q in self.axes]
        for k, unused in enumerate(self.unused):
            columns[k] = columns[k]._replace(**{"xyz"[k]: columns[k][k] + unused})
        c1, c2, c3 = compute_once(tuple(columns), beta.x)
        squared_lengths = c1.dot(c1) * c2.dot(c2) * c3.dot(c3)
        basis = Basis.of(c1, c2, c3, jnp.finfo(squared_lengths.dtype).eps * 1e-2 * jnp.sqrt(squared_lengths))
        return basis.weights(residual.scale(-1.0))


@eqx.filter_custom_jvp
def _refined_components(system: _System, beta: Vec3) -> Vec3:
    """Refine beta by two Newton steps, each kept only if it makes the residual smaller."""

    def iterate(_, state):
        beta, residual = state
        candidate = compute_once(beta + system.newton_step(beta, residual), system.b.x)
        new_residual = system.residual(candidate)
        better = decide(new_residual.dot(new_residual) < residual.dot(residual), system.b.x)
        return tree_where(better, candidate, beta), tree_where(better, new_residual, residual)

    return jax.lax.fori_loop(0, 2, iterate, (beta, system.residual(beta)))[0]


@_refined_components.def_jvp
def _refined_components_jvp(primals, tangents):
    system, beta = primals
    d_system, _ = tangents
    beta = _refined_components(system, beta)
    # Equinox gives None as the tangent of what is not perturbed.
    d_system = jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if d is None else d, d_system, system, is_leaf=lambda d: d is None
    )
    _, change = jax.jvp(lambda s: s.residual(beta), (system,), (d_system,))
    return beta, system.newton_step(beta, change)


def refine_and_check(problem: ScaledProblem, chosen: Incumbent, *, proves_jams: bool) -> ScalarSolution:
    """Compute and check the motion under the forces along the chosen cone edges.

    If the search found no set of edges, the motion is zero, and the status says why.

    Args:
        problem: The dimensionless contact problem.
        chosen: The best set of edges that the search found.
        proves_jams: Whether the search tries every set there is, so that finding none means that there is no solution.

    Returns:
        The motion, zero unless the status is MOVING, with the contact forces, modes, status and margin.
    """
    zero = jnp.zeros_like(problem.runtime_scalar)
    moves = decide(chosen.found & problem.pushes, problem.runtime_scalar)
    edges = _edges(problem, chosen, moves)
    system = _system(problem, chosen, moves, edges)
    start = jax.lax.stop_gradient(system.components(edges.total(chosen.weight)))
    beta = _refined_components(system, tree_where(moves, _rescale(system, start), Vec3(zero, zero, zero)))
    wrench = compute_once(_refine_wrench(system, system.wrench(beta)), problem.runtime_scalar)
    chosen_weights = edges.weights(wrench)
    chosen_weights = compute_once(
        chosen_weights + edges.weights(wrench - edges.total(chosen_weights)), problem.runtime_scalar
    )
    h = problem.form.value(wrench)
    solved = moves & (h > 0)
    gradient = compute_once(problem.form.gradient(wrench), problem.runtime_scalar)
    twist = _satisfy_conditions(system, gradient, problem.runtime_scalar)
    slips, tolerance = jax.lax.stop_gradient((problem.slips(twist), kinematic_tolerance(twist)))
    admissible = _admissible_edges(problem, chosen, slips, tolerance)
    weights = compute_once(
        distribute_force(problem.generators, admissible, chosen.edges, chosen_weights, wrench), problem.runtime_scalar
    )
    passes = _passes_final_check(problem, chosen, slips, tolerance, chosen_weights, gradient, twist)
    solved = decide(solved & passes, problem.runtime_scalar)

    unsolved = problem.pushes & ~chosen.found & ~chosen.too_fast
    power, presses = squeeze_power(problem, True if problem.margin else compute_once(unsolved, problem.runtime_scalar))
    # If the search found a set that the final check then rejects, this is no proof of a jam. The same holds if the
    # search found a twist that is too fast to be represented.
    unmoved = jnp.where(proves_jams & presses & unsolved, Status.JAMMED, Status.NOT_CONVERGED)
    status = jnp.where(problem.pushes, jnp.where(solved, Status.MOVING, unmoved), Status.FREE)
    status = jnp.where(problem.valid, status, Status.INVALID).astype(jnp.int8)

    surface_scale = jnp.where(solved, h, 1.0) ** (-1 / problem.form.degree)  # puts the wrench on the scaled H = 1
    force_scale = surface_scale * problem.form_scale ** (-1 / problem.form.degree)

    def where_moving(value):
        return jax.tree.map(lambda entry: jnp.where(solved, entry, 0.0), value)

    force = []
    for i, mu in enumerate(problem.friction):
        left, right = weights[2 * i], weights[2 * i + 1]
        force.append(where_moving(Vec2(left + right, mu * (left - right)).scale(force_scale)))
    displacement = twist.scale(problem.displacement_unit)
    return ScalarSolution(
        where_moving(Vec3(displacement.x, displacement.y, displacement.z / problem.form.length)),
        where_moving(wrench.scale(force_scale)),
        tuple(force),
        tuple(
            jnp.where(solved, mode, ContactMode.SEPARATED).astype(jnp.int8)
            for mode in _modes(problem, slips, tolerance)
        ),
        status,
        -power * problem.displacement_unit,
        # `unique`. If nothing pushes, the answer is that the slider stays. Any set found is then a second solution, in
        # which a pusher drags the slider along.
        ~jnp.where(problem.pushes, chosen.second_found & solved, chosen.found),
    )


def _edges(problem: ScaledProblem, chosen: Incumbent, moves: Bool[Array, ""]) -> Basis:
    """Basis of the chosen edges' wrenches; directions orthogonal to them take the place of unused edges."""
    zero = jnp.zeros_like(problem.runtime_scalar)
    g1, g2, g3 = (dynamic_index(problem.generators, jnp.maximum(edge, 0)) for edge in chosen.edges)
    g1 = tree_where(moves, g1, Vec3(zero + 1, zero, zero))
    used2, used3 = (moves & (edge >= 0) for edge in chosen.edges[1:])
    return complete_basis(g1, g2, g3, used2, used3, 0.01 * float(jnp.finfo(zero.dtype).eps))


def _system(problem: ScaledProblem, chosen: Incumbent, moves: Bool[Array, ""], edges: Basis) -> _System:
    """The system of the chosen edges: normal conditions, and the tangential one of a contact that sticks."""
    zero = jnp.zeros_like(problem.runtime_scalar)
    sticks = (chosen.edges[1] >= 0) & (chosen.contacts[0] == chosen.contacts[1])
    zero_vector = Vec3(zero, zero, zero)
    rows, b, unused = [], [], []
    for slot, number in enumerate(chosen.contacts):
        used = moves & (number >= 0)
        contact = jnp.maximum(number, 0)
        row, approach = dynamic_index(problem.normal, contact), dynamic_index(problem.approach, contact)
        condition = approach.x
        if slot == 1:
            row = tree_where(sticks, dynamic_index(problem.tangent, contact), row)
            condition = jnp.where(sticks, approach.y, approach.x)
        rows.append(tree_where(used, row, zero_vector))
        b.append(jnp.where(used, condition, 0.0))
        unused.append(jnp.where(used, zero, zero + 1))
    # orthonormal axes of the first edge, of the plane of the first two, of all of space
    q1 = edges.vectors[0].unit()
    q3 = edges.vectors[0].cross(edges.vectors[1]).unit()
    axes = tuple(
        tree_where(is_unused == 0, q, zero_vector) for q, is_unused in zip((q1, q3.cross(q1), q3), unused, strict=True)
    )
    axes, rows, b = compute_once((axes, tuple(rows), tuple(b)), problem.runtime_scalar)
    return _System(problem.form, axes, rows, Vec3(*b), Vec3(*unused))


def _rescale(system: _System, beta: Vec3) -> Vec3:
    """Scale beta so that grad H is as long as the conditions require (a least-squares fit).

    The result is a constant to every derivative.
    """
    system, beta = jax.lax.stop_gradient((system, beta))
    motion = system.form.gradient(system.wrench(beta))
    conditions = Vec3(*(row.dot(motion) for row in system.rows))
    squared = conditions.dot(conditions)
    factor = jnp.maximum(conditions.dot(system.b) / jnp.where(squared > 0, squared, 1.0), 0)
    return beta.scale(factor if system.form.degree == 2 else jnp.exp(jnp.log(factor) / 3))  # faster than cbrt


def _least_norm_correction(system: _System, residual: Vec3) -> Vec3:
    """The shortest v with rows . v = residual; zero where the rows are nearly dependent."""
    zero = jnp.zeros_like(residual.x)
    r1, r2, r3 = system.rows
    r1 = tree_where(system.unused.x == 0, r1, Vec3(zero + 1, zero, zero))
    # `residual` is roundoff, which nearly dependent rows would magnify; below this determinant the result is zero
    relative = float(jnp.finfo(zero.dtype).eps) ** 0.5
    return complete_basis(r1, r2, r3, system.unused.y == 0, system.unused.z == 0, relative).with_products(residual)


def _satisfy_conditions(system: _System, gradient: Vec3, runtime_scalar: Scalar) -> Vec3:
    """The twist nearest to grad H that satisfies the kinematic conditions, so that a sticking contact has no slip."""
    twist = gradient
    for _ in range(2):  # the second pass is for nearly dependent rows
        residual = system.b - Vec3(*(row.dot(twist) for row in system.rows))
        twist = compute_once(twist + _least_norm_correction(system, residual), runtime_scalar)
    return twist


def _refine_wrench(system: _System, f: Vec3) -> Vec3:
    """With three edges, correct the wrench so that grad H is the motion that the conditions alone fix.

    Nearly dependent rows magnify roundoff, so Newton's method stalls short of that motion. A correction that is not
    small is not made. The correction is a constant to every derivative.
    """
    fixed, f0 = jax.lax.stop_gradient((system, f))
    gradient = fixed.form.gradient(f0)
    residual = fixed.b - Vec3(*(row.dot(gradient) for row in fixed.rows))
    step = fixed.form.hessian(f0).solve(_least_norm_correction(fixed, residual))
    small = step.dot(step) < 1e-8 * f0.dot(f0)
    return f + tree_where((fixed.unused.z == 0) & small, step, Vec3(*(0 * x for x in step)))


def _admissible_edges(
    problem: ScaledProblem, chosen: Incumbent, slips: tuple[Vec2, ...], tolerance: Scalar
) -> tuple[Bool[Array, ""], ...]:
    """Whether each cone edge may carry force under the motion, in the order of the generators.

    An edge may if its contact touches and the edge is on the side of the contact's slip. The chosen edges always may.
    """
    edges = []
    for i, (slip, active) in enumerate(zip(slips, problem.active, strict=True)):
        touches = active & (jnp.abs(slip.x) <= tolerance)
        for side, fits_slip in ((0, slip.y <= tolerance), (1, slip.y >= -tolerance)):
            used = jnp.zeros((), bool)
            for edge in chosen.edges:
                used |= edge == 2 * i + side
            edges.append((touches & fits_slip) | used)
    return compute_once(tuple(edges), problem.runtime_scalar)


def _passes_final_check(
    problem: ScaledProblem,
    chosen: Incumbent,
    slips: tuple[Vec2, ...],
    tolerance: Scalar,
    chosen_weights: Vec3,
    gradient: Vec3,
    twist: Vec3,
) -> Bool[Array, ""]:
    """Whether the refined solution satisfies every condition.

    No contact is violated, the forces are inside their cones and on the side of the slip, and the twist is along
    grad H. The search has checked the same conditions before the refinement, which changes its numbers by roundoff
    only. So the tolerances here are somewhat wider than those of the search.
    """
    tolerance, relative = 1.25 * tolerance, 1.25 * relative_tolerance(problem.runtime_scalar.dtype)
    # In a wedge the rows are nearly dependent. They then determine grad H only up to this tolerance.
    direction_tolerance = 1.25 * ill_conditioned_tolerance(problem.runtime_scalar.dtype)
    passes = jnp.ones((), bool)
    for i, (slip, active) in enumerate(zip(slips, problem.active, strict=True)):
        passes &= (slip.x >= -tolerance) | ~active
        for side, wrong_slip in ((0, slip.y), (1, -slip.y)):
            for edge in chosen.edges:
                passes &= (edge != 2 * i + side) | ((wrong_slip <= tolerance) & (slip.x <= tolerance) & active)
    total = jnp.abs(chosen_weights.x) + jnp.abs(chosen_weights.y) + jnp.abs(chosen_weights.z)
    for weight, edge in zip(chosen_weights, chosen.edges, strict=True):
        violation = problem.violation_per_weight(jnp.maximum(edge, 0) // 2) * weight
        passes &= (violation >= -relative / 2 * total) | (edge < 0)
    difference = twist - gradient
    return passes & (difference.dot(difference) <= direction_tolerance**2 * twist.dot(twist))


def _modes(problem: ScaledProblem, slips: tuple[Vec2, ...], tolerance: Scalar):
    """Yield the mode of each contact, from the motion alone.

    The modes must not depend on which of several possible force distributions is returned.
    """
    for slip, active in zip(slips, problem.active, strict=True):
        sliding = jnp.where(slip.y < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT)
        touching = jnp.where(jnp.abs(slip.y) <= tolerance, ContactMode.STICKING, sliding)
        yield jnp.where(active & (slip.x <= tolerance), touching, ContactMode.SEPARATED)
