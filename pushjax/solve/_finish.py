"""From the cone edges that make up the wrench to the motion: exact, differentiable, and checked.

With the set of edges known, the wrench F in the space they span solves the square system R grad H(Q beta) = b: R has
the conditions' rows, Q an orthonormal basis of that space, b the pushers' motion. (In the edges' own weights, which may
be a million times F where forces nearly cancel, F would lose as many digits.) Newton's method polishes what the search
found; derivatives come from the implicit function theorem at the solution, R hess H Q d(beta) = ..., so that nothing of
the search is differentiated. The set itself is held fixed: derivatives are those within a sequence of contact modes.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec2, Vec3, select, settle, weighted
from pushjax.limit_surface import Form
from pushjax.solve._basis import Basis, completed
from pushjax.solve._edge_sets import Found
from pushjax.solve._several import Several, SeveralMotion, clean, pick, rough, violation
from pushjax.solve.share import share_force
from pushjax.solve.squeeze import squeeze
from pushjax.status import ContactMode, Status

Rows = tuple[Vec3, Vec3, Vec3]


class _System(NamedTuple):
    """R grad H(Q beta) = b; zeros, and one on the diagonal, for edges that are not used."""

    form: Form
    axes: Rows
    rows: Rows
    b: Vec3
    idle: Vec3

    def wrench(self, beta: Vec3) -> Vec3:
        return weighted(self.axes, beta)

    def within(self, f: Vec3) -> Vec3:
        """Components of a wrench along the axes."""
        return Vec3(*(q.dot(f) for q in self.axes))

    def residual(self, beta: Vec3) -> Vec3:
        motion = self.form.gradient(self.wrench(beta))
        return Vec3(*(row.dot(motion) for row in self.rows)) - self.b

    def newton(self, beta: Vec3, residual: Vec3) -> Vec3:
        """-J^-1 residual, with J = R hess H Q; zero where J is singular."""
        hessian = settle(self.form.hessian(self.wrench(beta)), beta.x)
        columns = [Vec3(*(row.dot(hessian.times(q)) for row in self.rows)) for q in self.axes]
        for k, idle in enumerate(self.idle):
            columns[k] = columns[k]._replace(**{"xyz"[k]: columns[k][k] + idle})
        c1, c2, c3 = settle(tuple(columns), beta.x)
        sizes = c1.dot(c1) * c2.dot(c2) * c3.dot(c3)
        basis = Basis.of(c1, c2, c3, jnp.finfo(sizes.dtype).eps * 1e-2 * jnp.sqrt(sizes))
        return basis.weights(residual.scale(-1.0))


@eqx.filter_custom_jvp
def _polished(system: _System, beta: Vec3) -> Vec3:
    """Two Newton rounds, each kept if it makes the residual smaller."""

    def round_(_, state):
        beta, residual = state
        new = settle(beta + system.newton(beta, residual), system.b.x)
        after = system.residual(new)
        better = settle(after.dot(after) < residual.dot(residual), system.b.x)
        return select(better, new, beta), select(better, after, residual)

    return jax.lax.fori_loop(0, 2, round_, (beta, system.residual(beta)))[0]


@_polished.def_jvp
def _polished_jvp(primals, tangents):
    system, beta = primals
    d_system, _ = tangents
    beta = _polished(system, beta)
    # anything not perturbed comes as None
    d_system = jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if d is None else d, d_system, system, is_leaf=lambda d: d is None
    )
    _, change = jax.jvp(lambda s: s.residual(beta), (system,), (d_system,))
    return beta, system.newton(beta, change)


def finish(problem: Several, chosen: Found, *, proves_jams: bool) -> SeveralMotion:
    """The motion under the chosen edges; without any, what their absence means.

    proves_jams: whether the search tries everything there is, so that finding nothing means there is nothing.
    """
    zero = jnp.zeros_like(problem.speed)
    moves = settle(chosen.found & problem.pushes, problem.speed)
    edges = _edges(problem, chosen, moves)
    system = _system(problem, chosen, moves, edges)
    begin = jax.lax.stop_gradient(system.within(edges.total(chosen.weight)))
    beta = _polished(system, select(moves, _to_scale(system, begin), Vec3(zero, zero, zero)))
    f = settle(_facing(system, system.wrench(beta)), problem.speed)
    alpha = edges.weights(f)
    alpha = settle(alpha + edges.weights(f - edges.total(alpha)), problem.speed)
    h = problem.form.value(f)
    solved = moves & (h > 0)
    # what the conditions fix of the twist is taken from them, not from H: a contact that sticks has no slip
    motion = settle(problem.form.gradient(f), problem.speed)
    twist = motion
    for _ in range(2):  # the second for rows that are nearly dependent
        missing = system.b - Vec3(*(row.dot(twist) for row in system.rows))
        twist = settle(twist + _least(system, missing), problem.speed)

    slips, tolerance = jax.lax.stop_gradient((problem.slips(twist), violation(twist)))
    suitable = _suitable(problem, chosen, slips, tolerance)
    weights = settle(share_force(problem.generators, suitable, chosen.edges, alpha, f), problem.speed)
    passes = _passes(problem, chosen, slips, tolerance, alpha, motion, twist)
    solved = settle(solved & passes, problem.speed)

    unsolved = problem.pushes & ~chosen.found & ~chosen.hasty
    power, presses = squeeze(problem, True if problem.margin else settle(unsolved, problem.speed))
    # what the search found and the last look refused, or it could not write down, proves nothing
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
    return SeveralMotion(
        where_moving(Vec3(moved.x, moved.y, moved.z / problem.form.length)),
        where_moving(f.scale(to_newton)),
        tuple(force),
        tuple(
            jnp.where(solved, mode, ContactMode.SEPARATED).astype(jnp.int8)
            for mode in _modes(problem, slips, tolerance)
        ),
        status,
        -power * problem.speed,
        # where the slider may stay, it does; any set found is then another motion, of a pusher that drags it along
        ~jnp.where(problem.pushes, chosen.several & solved, chosen.found),
    )


def _edges(problem: Several, chosen: Found, moves: Bool[Array, ""]) -> Basis:
    """The chosen edges, and in place of unused ones directions at right angles to them."""
    zero = jnp.zeros_like(problem.speed)
    g1, g2, g3 = (pick(problem.generators, jnp.maximum(edge, 0)) for edge in chosen.edges)
    g1 = select(moves, g1, Vec3(zero + 1, zero, zero))
    used2, used3 = (moves & (edge >= 0) for edge in chosen.edges[1:])
    return completed(g1, g2, g3, used2, used3, 0.01 * float(jnp.finfo(zero.dtype).eps))


def _system(problem: Several, chosen: Found, moves: Bool[Array, ""], edges: Basis) -> _System:
    zero = jnp.zeros_like(problem.speed)
    sticks = (chosen.edges[1] >= 0) & (chosen.edges[0] // 2 == chosen.edges[1] // 2)
    blank = Vec3(zero, zero, zero)
    rows, bs, idle = [], [], []
    for slot, edge in enumerate(chosen.edges):
        used = moves & (edge >= 0)
        contact = jnp.maximum(edge, 0) // 2
        row, push = pick(problem.normal, contact), pick(problem.approach, contact)
        b = push.x
        if slot == 1:
            row = select(sticks, pick(problem.tangent, contact), row)
            b = jnp.where(sticks, push.y, push.x)
        rows.append(select(used, row, blank))
        bs.append(jnp.where(used, b, 0.0))
        idle.append(jnp.where(used, zero, zero + 1))
    # of the first edge, of the plane of the first two, of space
    q1 = edges.vectors[0].unit()
    q3 = edges.vectors[0].cross(edges.vectors[1]).unit()
    axes = tuple(select(none == 0, q, blank) for q, none in zip((q1, q3.cross(q1), q3), idle, strict=True))
    axes, rows, bs = settle((axes, tuple(rows), tuple(bs)), problem.speed)
    return _System(problem.form, axes, rows, Vec3(*bs), Vec3(*idle))


def _to_scale(system: _System, beta: Vec3) -> Vec3:
    """The multiple of beta whose grad H is as long as the conditions ask; a constant."""
    system, beta = jax.lax.stop_gradient((system, beta))
    motion = system.form.gradient(system.wrench(beta))
    u = Vec3(*(row.dot(motion) for row in system.rows))
    squared = u.dot(u)
    k = jnp.maximum(u.dot(system.b) / jnp.where(squared > 0, squared, 1.0), 0)
    return beta.scale(k if system.form.degree == 2 else jnp.exp(jnp.log(k) / 3))  # faster than cbrt


def _least(system: _System, missing: Vec3) -> Vec3:
    """The shortest v with rows . v = missing."""
    zero = jnp.zeros_like(missing.x)
    r1, r2, r3 = system.rows
    r1 = select(system.idle.x == 0, r1, Vec3(zero + 1, zero, zero))
    # what is missing is rounding, which nearly dependent rows would blow up
    relative = float(jnp.finfo(zero.dtype).eps) ** 0.5
    return completed(r1, r2, r3, system.idle.y == 0, system.idle.z == 0, relative).with_products(missing)


def _facing(system: _System, f: Vec3) -> Vec3:
    """Of three edges, the wrench whose grad H is the motion that the conditions alone fix: rows that nearly depend on
    each other leave Newton's method short of that by rounding, which they magnify. A constant to every derivative."""
    fixed, f0 = jax.lax.stop_gradient((system, f))
    motion = fixed.form.gradient(f0)
    missing = fixed.b - Vec3(*(row.dot(motion) for row in fixed.rows))
    step = fixed.form.hessian(f0).solve(_least(fixed, missing))
    small = step.dot(step) < 1e-8 * f0.dot(f0)
    return f + select((fixed.idle.z == 0) & small, step, Vec3(*(0 * x for x in step)))


def _suitable(
    problem: Several, chosen: Found, slips: tuple[Vec2, ...], tolerance: Scalar
) -> tuple[Bool[Array, ""], ...]:
    """Which cone edges suit the motion: those of contacts that touch, on the side of their slip; the chosen ones do."""
    edges = []
    for i, (slip, active) in enumerate(zip(slips, problem.active, strict=True)):
        touches = active & (jnp.abs(slip.x) <= tolerance)
        for side, right_way in ((0, slip.y <= tolerance), (1, slip.y >= -tolerance)):
            used = jnp.zeros((), bool)
            for edge in chosen.edges:
                used |= edge == 2 * i + side
            edges.append((touches & right_way) | used)
    return settle(tuple(edges), problem.speed)


def _passes(
    problem: Several, chosen: Found, slips: tuple[Vec2, ...], tolerance: Scalar, alpha: Vec3, motion: Vec3, twist: Vec3
) -> Bool[Array, ""]:
    """A last look at what is returned: no contact violated, forces inside their cones and on the side of the slip, the
    twist along grad H. The tolerance leaves some room to that of the search, whose numbers these are to rounding.
    """
    tolerance, relative = 1.25 * tolerance, 1.25 * clean(problem.speed.dtype)
    along = 1.25 * rough(problem.speed.dtype)  # rows of a wedge, nearly dependent, leave grad H that much freedom
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


def _modes(problem: Several, slips: tuple[Vec2, ...], tolerance: Scalar):
    """From the motion alone, so that it does not depend on which of several equal force distributions is given."""
    for slip, active in zip(slips, problem.active, strict=True):
        sliding = jnp.where(slip.y < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT)
        touching = jnp.where(jnp.abs(slip.y) <= tolerance, ContactMode.STICKING, sliding)
        yield jnp.where(active & (slip.x <= tolerance), touching, ContactMode.SEPARATED)
