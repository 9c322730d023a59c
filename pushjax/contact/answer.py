"""The last stage of a contact solver: it refines the solution that the search found, and checks it.

The search returns a set of friction-cone edges whose forces make up the wrench F. Once the set is known, F lies in the
space that its edges span: F = Q beta, where Q is an orthonormal basis of that space. The unknown beta solves the square
system R grad H(Q beta) = b. H is the limit surface's function, the rows of R are those of the kinematic conditions, and
b holds the pushers' motion. The unknowns are not the weights of the edges: where forces nearly cancel, the weights may
be a million times as large as F, and F would lose as many digits.

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
        idle: One for each slot without an edge, else zero; added to the diagonal of the Jacobian.
    """

    form: Form
    axes: Rows
    rows: Rows
    b: Vec3
    idle: Vec3

    def wrench(self, beta: Vec3) -> Vec3:
        """The wrench F = Q beta."""
        return linear_combination(self.axes, beta)

    def within(self, f: Vec3) -> Vec3:
        """Components of a wrench along the axes."""
        return Vec3(*(q.dot(f) for q in self.axes))

    def residual(self, beta: Vec3) -> Vec3:
        """R grad H(Q beta) - b."""
        motion = self.form.gradient(self.wrench(beta))
        return Vec3(*(row.dot(motion) for row in self.rows)) - self.b

    def newton(self, beta: Vec3, residual: Vec3) -> Vec3:
        """Newton step -J^-1 residual with J = R hess H Q; zero where J is singular."""
        hessian = compute_once(self.form.hessian(self.wrench(beta)), beta.x)
        columns = [Vec3(*(row.dot(hessian.times(q)) for row in self.rows)) for q in self.axes]
        for k, idle in enumerate(self.idle):
            columns[k] = columns[k]._replace(**{"xyz"[k]: columns[k][k] + idle})
        c1, c2, c3 = compute_once(tuple(columns), beta.x)
        sizes = c1.dot(c1) * c2.dot(c2) * c3.dot(c3)
        basis = Basis.of(c1, c2, c3, jnp.finfo(sizes.dtype).eps * 1e-2 * jnp.sqrt(sizes))
        return basis.weights(residual.scale(-1.0))


@eqx.filter_custom_jvp
def _polished(system: _System, beta: Vec3) -> Vec3:
    """Refine beta by two Newton steps, each kept only if it makes the residual smaller."""

    def round_(_, state):
        beta, residual = state
        new = compute_once(beta + system.newton(beta, residual), system.b.x)
        after = system.residual(new)
        better = decide(after.dot(after) < residual.dot(residual), system.b.x)
        return tree_where(better, new, beta), tree_where(better, after, residual)

    return jax.lax.fori_loop(0, 2, round_, (beta, system.residual(beta)))[0]


@_polished.def_jvp
def _polished_jvp(primals, tangents):
    system, beta = primals
    d_system, _ = tangents
    beta = _polished(system, beta)
    # tangents of what is not perturbed are None
    d_system = jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if d is None else d, d_system, system, is_leaf=lambda d: d is None
    )
    _, change = jax.jvp(lambda s: s.residual(beta), (system,), (d_system,))
    return beta, system.newton(beta, change)


def polish_and_check(problem: ScaledProblem, chosen: Incumbent, *, proves_jams: bool) -> ScalarSolution:
    """Compute and check the motion under the chosen edges.

    If the search found no set of edges, the motion is zero, and the status says why.

    Args:
        problem: The dimensionless contact problem.
        chosen: The best set of edges that the search found.
        proves_jams: Whether the search tries every set there is, so that finding none means that there is no solution.

    Returns:
        The motion, zero unless the status is MOVING, with the contact forces, modes, status and margin.
    """
    zero = jnp.zeros_like(problem.speed)
    moves = decide(chosen.found & problem.pushes, problem.speed)
    edges = _edges(problem, chosen, moves)
    system = _system(problem, chosen, moves, edges)
    begin = jax.lax.stop_gradient(system.within(edges.total(chosen.weight)))
    beta = _polished(system, tree_where(moves, _rescale(system, begin), Vec3(zero, zero, zero)))
    f = compute_once(_refine_wrench(system, system.wrench(beta)), problem.speed)
    alpha = edges.weights(f)
    alpha = compute_once(alpha + edges.weights(f - edges.total(alpha)), problem.speed)
    h = problem.form.value(f)
    solved = moves & (h > 0)
    # The components of the twist that the conditions fix are taken from the conditions, not from H. So a sticking
    # contact has no slip.
    motion = compute_once(problem.form.gradient(f), problem.speed)
    twist = motion
    for _ in range(2):  # the second pass is for nearly dependent rows
        missing = system.b - Vec3(*(row.dot(twist) for row in system.rows))
        twist = compute_once(twist + _least_norm_correction(system, missing), problem.speed)

    slips, tolerance = jax.lax.stop_gradient((problem.slips(twist), kinematic_tolerance(twist)))
    suitable = _admissible_edges(problem, chosen, slips, tolerance)
    weights = compute_once(distribute_force(problem.generators, suitable, chosen.edges, alpha, f), problem.speed)
    passes = _passes_final_check(problem, chosen, slips, tolerance, alpha, motion, twist)
    solved = decide(solved & passes, problem.speed)

    unsolved = problem.pushes & ~chosen.found & ~chosen.hasty
    power, presses = squeeze_power(problem, True if problem.margin else compute_once(unsolved, problem.speed))
    # If the search found a set that the final check then rejects, this is no proof of a jam. The same holds if the
    # search found a twist that is too fast to be represented (`hasty`).
    stuck = jnp.where(proves_jams & presses & unsolved, Status.JAMMED, Status.NOT_CONVERGED)
    status = jnp.where(problem.pushes, jnp.where(solved, Status.MOVING, stuck), Status.FREE)
    status = jnp.where(problem.valid, status, Status.INVALID).astype(jnp.int8)

    level = jnp.where(solved, h, 1.0) ** (-1 / problem.form.degree)
    to_newton = level * problem.size ** (-1 / problem.form.degree)

    def where_moving(value):
        return jax.tree.map(lambda entry: jnp.where(solved, entry, 0.0), value)

    force = []
    for i, mu in enumerate(problem.friction):
        left, right = weights[2 * i], weights[2 * i + 1]
        force.append(where_moving(Vec2(left + right, mu * (left - right)).scale(to_newton)))
    moved = twist.scale(problem.speed)
    return ScalarSolution(
        where_moving(Vec3(moved.x, moved.y, moved.z / problem.form.length)),
        where_moving(f.scale(to_newton)),
        tuple(force),
        tuple(
            jnp.where(solved, mode, ContactMode.SEPARATED).astype(jnp.int8)
            for mode in _modes(problem, slips, tolerance)
        ),
        status,
        -power * problem.speed,
        # `unique`. If nothing pushes, the answer is that the slider stays. Any set found is then a second solution, in
        # which a pusher drags the slider along.
        ~jnp.where(problem.pushes, chosen.several & solved, chosen.found),
    )


def _edges(problem: ScaledProblem, chosen: Incumbent, moves: Bool[Array, ""]) -> Basis:
    """Basis of the chosen edges; directions orthogonal to them take the place of unused edges."""
    zero = jnp.zeros_like(problem.speed)
    g1, g2, g3 = (dynamic_index(problem.generators, jnp.maximum(edge, 0)) for edge in chosen.edges)
    g1 = tree_where(moves, g1, Vec3(zero + 1, zero, zero))
    used2, used3 = (moves & (edge >= 0) for edge in chosen.edges[1:])
    return complete_basis(g1, g2, g3, used2, used3, 0.01 * float(jnp.finfo(zero.dtype).eps))


def _system(problem: ScaledProblem, chosen: Incumbent, moves: Bool[Array, ""], edges: Basis) -> _System:
    """The system of the chosen edges: normal conditions, and the tangential one of a contact with both edges."""
    zero = jnp.zeros_like(problem.speed)
    sticks = (chosen.edges[1] >= 0) & (chosen.edges[0] // 2 == chosen.edges[1] // 2)
    blank = Vec3(zero, zero, zero)
    rows, bs, idle = [], [], []
    for slot, edge in enumerate(chosen.edges):
        used = moves & (edge >= 0)
        contact = jnp.maximum(edge, 0) // 2
        row, push = dynamic_index(problem.normal, contact), dynamic_index(problem.approach, contact)
        b = push.x
        if slot == 1:
            row = tree_where(sticks, dynamic_index(problem.tangent, contact), row)
            b = jnp.where(sticks, push.y, push.x)
        rows.append(tree_where(used, row, blank))
        bs.append(jnp.where(used, b, 0.0))
        idle.append(jnp.where(used, zero, zero + 1))
    # orthonormal axes of the first edge, of the plane of the first two, of all of space
    q1 = edges.vectors[0].unit()
    q3 = edges.vectors[0].cross(edges.vectors[1]).unit()
    axes = tuple(tree_where(none == 0, q, blank) for q, none in zip((q1, q3.cross(q1), q3), idle, strict=True))
    axes, rows, bs = compute_once((axes, tuple(rows), tuple(bs)), problem.speed)
    return _System(problem.form, axes, rows, Vec3(*bs), Vec3(*idle))


def _rescale(system: _System, beta: Vec3) -> Vec3:
    """Scale beta so that grad H is as long as the conditions require (a least-squares fit).

    The result is a constant to every derivative.
    """
    system, beta = jax.lax.stop_gradient((system, beta))
    motion = system.form.gradient(system.wrench(beta))
    u = Vec3(*(row.dot(motion) for row in system.rows))
    squared = u.dot(u)
    k = jnp.maximum(u.dot(system.b) / jnp.where(squared > 0, squared, 1.0), 0)
    return beta.scale(k if system.form.degree == 2 else jnp.exp(jnp.log(k) / 3))  # faster than cbrt


def _least_norm_correction(system: _System, missing: Vec3) -> Vec3:
    """The shortest v with rows . v = missing; zero where the rows are nearly dependent."""
    zero = jnp.zeros_like(missing.x)
    r1, r2, r3 = system.rows
    r1 = tree_where(system.idle.x == 0, r1, Vec3(zero + 1, zero, zero))
    # `missing` is roundoff, which nearly dependent rows would magnify; below this determinant the result is zero
    relative = float(jnp.finfo(zero.dtype).eps) ** 0.5
    return complete_basis(r1, r2, r3, system.idle.y == 0, system.idle.z == 0, relative).with_products(missing)


def _refine_wrench(system: _System, f: Vec3) -> Vec3:
    """With three edges, correct the wrench so that grad H is the motion that the conditions alone fix.

    Nearly dependent rows magnify roundoff, so Newton's method stalls short of that motion. A correction that is not
    small is not made. The correction is a constant to every derivative.
    """
    fixed, f0 = jax.lax.stop_gradient((system, f))
    motion = fixed.form.gradient(f0)
    missing = fixed.b - Vec3(*(row.dot(motion) for row in fixed.rows))
    step = fixed.form.hessian(f0).solve(_least_norm_correction(fixed, missing))
    small = step.dot(step) < 1e-8 * f0.dot(f0)
    return f + tree_where((fixed.idle.z == 0) & small, step, Vec3(*(0 * x for x in step)))


def _admissible_edges(
    problem: ScaledProblem, chosen: Incumbent, slips: tuple[Vec2, ...], tolerance: Scalar
) -> tuple[Bool[Array, ""], ...]:
    """Whether each cone edge may carry force under the motion, in the order of the generators.

    An edge may if its contact touches and the edge is on the side of the contact's slip. The chosen edges always may.
    """
    edges = []
    for i, (slip, active) in enumerate(zip(slips, problem.active, strict=True)):
        touches = active & (jnp.abs(slip.x) <= tolerance)
        for side, right_way in ((0, slip.y <= tolerance), (1, slip.y >= -tolerance)):
            used = jnp.zeros((), bool)
            for edge in chosen.edges:
                used |= edge == 2 * i + side
            edges.append((touches & right_way) | used)
    return compute_once(tuple(edges), problem.speed)


def _passes_final_check(
    problem: ScaledProblem,
    chosen: Incumbent,
    slips: tuple[Vec2, ...],
    tolerance: Scalar,
    alpha: Vec3,
    motion: Vec3,
    twist: Vec3,
) -> Bool[Array, ""]:
    """Whether the refined solution satisfies every condition.

    No contact is violated, the forces are inside their cones and on the side of the slip, and the twist is along
    grad H. The search has checked the same conditions before the refinement, which changes its numbers by roundoff
    only. So the tolerances here are somewhat wider than those of the search.
    """
    tolerance, relative = 1.25 * tolerance, 1.25 * relative_tolerance(problem.speed.dtype)
    # In a wedge the rows are nearly dependent. They then determine grad H only up to this tolerance.
    along = 1.25 * ill_conditioned_tolerance(problem.speed.dtype)
    passes = jnp.ones((), bool)
    for i, (slip, active) in enumerate(zip(slips, problem.active, strict=True)):
        passes &= (slip.x >= -tolerance) | ~active
        for side, wrong in ((0, slip.y), (1, -slip.y)):
            for edge in chosen.edges:
                passes &= (edge != 2 * i + side) | ((wrong <= tolerance) & (slip.x <= tolerance) & active)
    total = jnp.abs(alpha.x) + jnp.abs(alpha.y) + jnp.abs(alpha.z)
    for weight, edge in zip(alpha, chosen.edges, strict=True):
        passes &= (problem.beyond(jnp.maximum(edge, 0) // 2) * weight >= -relative / 2 * total) | (edge < 0)
    off = twist - motion
    return passes & (off.dot(off) <= along**2 * twist.dot(twist))


def _modes(problem: ScaledProblem, slips: tuple[Vec2, ...], tolerance: Scalar):
    """The mode of each contact, from the motion alone.

    So the modes do not depend on which of several possible force distributions is returned.
    """
    for slip, active in zip(slips, problem.active, strict=True):
        sliding = jnp.where(slip.y < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT)
        touching = jnp.where(jnp.abs(slip.y) <= tolerance, ContactMode.STICKING, sliding)
        yield jnp.where(active & (slip.x <= tolerance), touching, ContactMode.SEPARATED)
