"""Several contacts, iteratively: a sequence of projected problems, then an exact finish.

Each round linearises grad H at the last wrench F_t, constant term kept (Josephy and Newton's method; dropping the
constant and damping, as the paper does, converges linearly), and sweeps over the contacts: projected Gauss-Seidel on
normal and tangential force in turn. What the sweeps leave only has to show which cone edges carry the force: the
systems of the heaviest ones are then solved exactly, as in `exhaustive`, and checked against every condition.

It does less work than trying all sets when there are many contacts, but finding nothing proves nothing: where it has no
answer the status is NOT_CONVERGED, also in a jam.

Source: Zhou et al. 2017, section IV.B, algorithm 1; deviations: the constant term, the solver of the linear problems,
the finish.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from pushjax._autodiff import undifferentiated
from pushjax._vec import Scalar, Vec2, Vec3, select, settle, weighted
from pushjax.solve._edge_sets import Found, nothing, one_edge, three_edges, two_edges
from pushjax.solve._finish import finish
from pushjax.solve._several import ContactSolver, Several, SeveralMotion


class Projected(ContactSolver):
    """Projected Gauss-Seidel on successive linearisations. rounds: of linearising; sweeps: over contacts in each."""

    rounds: int = eqx.field(static=True, default=8)
    sweeps: int = eqx.field(static=True, default=20)

    def solve(self, problem: Several) -> SeveralMotion:
        return finish(problem, undifferentiated(self._search, problem), proves_jams=False)

    def _search(self, problem: Several) -> Found:
        return _finished(problem, _forces(problem, self.rounds, self.sweeps))


class _Linear(NamedTuple):
    """grad H(F) = A F + c near the last wrench: A times each row, the rows' own stiffness, and c."""

    along_n: tuple[Vec3, ...]
    along_t: tuple[Vec3, ...]
    stiff_n: tuple[Scalar, ...]
    stiff_t: tuple[Scalar, ...]
    constant: Vec3


def _forces(problem: Several, rounds: int, sweeps: int) -> tuple[Vec2, ...]:
    """Contact forces (n, t) with V = grad H(F), after all rounds."""
    zero = jnp.zeros_like(problem.speed)
    start = tuple(
        Vec2(jnp.where(active & (push.x > 0), jnp.maximum(push.x, 0), 0.0), zero)
        for active, push in zip(problem.active, problem.approach, strict=True)
    )

    def round_(_, forces):
        wrench = _wrench(problem, forces)
        some = settle(wrench.dot(wrench) > 0, problem.speed)
        wrench = select(some, wrench, Vec3(zero + 1, zero, zero))
        linear = settle(_linearised(problem, wrench), problem.speed)
        return jax.lax.fori_loop(0, sweeps, lambda _, f: _sweep(problem, linear, f), forces)

    return jax.lax.fori_loop(0, rounds, round_, start)


def _wrench(problem: Several, forces: tuple[Vec2, ...]) -> Vec3:
    rows = [row for rows in zip(problem.normal, problem.tangent, strict=True) for row in rows]
    return weighted(rows, [component for force in forces for component in force])


def _linearised(problem: Several, wrench: Vec3) -> _Linear:
    hessian = problem.form.hessian(wrench)
    along_n = tuple(hessian.times(n) for n in problem.normal)
    along_t = tuple(hessian.times(t) for t in problem.tangent)
    stiff_n = tuple(n.dot(a) for n, a in zip(problem.normal, along_n, strict=True))
    stiff_t = tuple(t.dot(a) for t, a in zip(problem.tangent, along_t, strict=True))
    # hess H F = (d - 1) grad H
    constant = problem.form.gradient(wrench).scale(float(2 - problem.form.degree))
    return _Linear(along_n, along_t, stiff_n, stiff_t, constant)


def _sweep(problem: Several, linear: _Linear, forces: tuple[Vec2, ...]) -> tuple[Vec2, ...]:
    twist = linear.constant
    for an, at, f in zip(linear.along_n, linear.along_t, forces, strict=True):
        twist = twist + an.scale(f.x) + at.scale(f.y)
    new = []
    for i, f in enumerate(forces):
        push, mu = problem.approach[i], problem.friction[i]
        rate = problem.normal[i].dot(twist) - push.x
        fn = jnp.maximum(f.x - rate / jnp.where(linear.stiff_n[i] > 0, linear.stiff_n[i], 1.0), 0)
        fn = settle(jnp.where(problem.active[i], fn, 0.0), problem.speed)
        twist = twist + linear.along_n[i].scale(fn - f.x)
        rate = problem.tangent[i].dot(twist) - push.y
        ft = f.y - rate / jnp.where(linear.stiff_t[i] > 0, linear.stiff_t[i], 1.0)
        ft = settle(jnp.clip(ft, -mu * fn, mu * fn), problem.speed)
        twist = settle(twist + linear.along_t[i].scale(ft - f.y), problem.speed)
        new.append(Vec2(fn, ft))
    return tuple(new)


def _finished(problem: Several, forces: tuple[Vec2, ...]) -> Found:
    """The exact solutions on the edges that carry the most force; the best that passes."""
    weights = []
    for force, mu in zip(forces, problem.friction, strict=True):
        side = jnp.where(mu > 0, force.y / jnp.where(mu > 0, mu, 1.0), force.x)
        weights += [jnp.maximum((force.x + side) / 2, 0), jnp.maximum((force.x - side) / 2, 0)]
    first = _heaviest(weights, ())
    second = _heaviest(weights, (first,))
    found = one_edge(problem, nothing(problem.speed), first)
    found = two_edges(problem, found, jnp.minimum(first, second), jnp.maximum(first, second))
    if problem.count == 1:
        return found
    least = [jnp.minimum(weights[2 * i], weights[2 * i + 1]) for i in range(problem.count)]
    whole = [weights[2 * i] + weights[2 * i + 1] for i in range(problem.count)]
    stuck = _heaviest(least, ())
    found = two_edges(problem, found, 2 * stuck, 2 * stuck + 1)
    found = three_edges(problem, found, (stuck, stuck, _heaviest(whole, (stuck,))), 2)
    if problem.count == 2:
        return found
    one = _heaviest(whole, ())
    two = _heaviest(whole, (one,))
    return three_edges(problem, found, (one, two, _heaviest(whole, (one, two))), 8)


def _heaviest(weights: list[Scalar], others: tuple) -> jax.Array:
    """Index of the largest weight, apart from `others`."""
    best, top = jnp.zeros(weights[0].shape, jnp.int32), jnp.full_like(weights[0], -1.0)
    for k, weight in enumerate(weights):
        free = jnp.ones((), bool)
        for other in others:
            free &= other != k
        larger = settle(free & (weight > top), weight)
        best, top = jnp.where(larger, k, best), jnp.where(larger, weight, top)
    return best
