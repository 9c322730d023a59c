"""The quasi-static motion of several sliders that touch each other, by a sequence of LCPs.

The limit surface of each slider is replaced by a law that is linear. The motion is then that of an LCP, which Lemke's
method solves. A round solves one LCP. There are two kinds of rounds:

- A round of weights has the laws V = s B F, with the ellipsoid B that agrees with the limit surface at the wrench of
  the round before, and a weight s. The LCP always has a solution unless the contacts jam. The weight is then multiplied
  by the gauge of the wrench. These rounds converge from afar, but slowly where a slider hardly moves: its weight goes
  to zero.
- A Newton round has the limit surfaces made linear at that wrench, with the dissipation s >= 0 as an unknown of each
  slider. It finds by itself which sliders rest, and converges quadratically. It may go astray.

Newton rounds follow a round of weights as long as each halves the violation of the true conditions. A small part of
the ellipsoid's law, of changes of the wrench, is added to the law of a Newton round. It vanishes where the rounds
converge, and determines the forces between sliders that rest.

If Lemke's method ends on a ray in a round of weights, there are contact forces that balance on every slider and do
positive work on the motion of the pushers: the contacts jam.

Reference: Zhou et al. 2017, section IV.B, solves one LCP in each step; Stewart & Trinkle 1996.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax.contact.lemke import lemke
from pushjax.contact.linear_patch import LinearPatch, mean_ellipsoid
from pushjax.contact.sliders_problem import LinearLaws, SlidersLCP, SlidersProblem
from pushjax.contact.status import ContactMode, Status

# Most problems take three to six rounds, and one or two from the motion of a similar problem.
MAX_ROUNDS, MAX_ROUNDS_FROM_START = 40, 5
# Keyed by the bytes of a float: the least weight of a slider, and the part of the ellipsoid's law in a Newton round, in
# units of the largest weight.
LEAST_WEIGHT, PROXIMAL = {4: 1e-3, 8: 1e-4}, {4: 1e-3, 8: 1e-5}
RESTING_GAUGE = 0.9  # of a slider that counts as resting in a round of weights
SAME_COVER, GOLDEN = 6, 0.6180339887  # rounds with the same covering vector, and what scatters it
MAX_FACTOR = 10.0  # of a weight, from a round to the next
REFINEMENTS = 6  # Newton steps after the rounds, with the unknowns that may be positive in the best of them
# Keyed by the bytes of a float: largest violation of a condition of a motion, and where the rounds end.
TOLERANCE, NEARLY = {4: 1e-4, 8: 1e-9}, {4: 5e-4, 8: 1e-9}
CERTIFICATE = {4: 1e-3, 8: 1e-6}  # largest wrench that is zero, and least power that is not, of forces of sum one


class SlidersMotion(NamedTuple):
    """The motion of several sliders, in dimensionless numbers."""

    twist: Float[Array, "3 sliders batch"]  # normalized
    wrench: Float[Array, "3 sliders batch"]  # normalized
    force: Float[Array, "2 contacts batch"]  # along normal and tangent
    dissipation: Float[Array, "sliders batch"]  # zero of a slider that rests
    mode: Int[Array, "contacts batch"]  # `ContactMode`
    status: Int[Array, " batch"]  # `Status`: MOVING, FREE, JAMMED, NOT_CONVERGED or INVALID
    violation: Float[Array, " batch"]  # the largest of any condition, relative to the fastest motion and the forces
    basic: Bool[Array, "rows batch"]  # which unknowns of the LCP may be positive
    rounds: Int[Array, " batch"]


class Start(NamedTuple):
    """Where the search for a motion may start: at that of a similar problem."""

    exists: Bool[Array, "*batch"]
    dissipation: Float[Array, "sliders *batch"]
    wrench: Float[Array, "3 sliders *batch"]

    @staticmethod
    def none(problem: SlidersProblem) -> "Start":
        """Nothing to start from."""
        zero = jnp.zeros_like(problem.rows[0, :, :, 0])
        return Start(jnp.zeros(zero.shape[2:], bool), zero[0], zero)


class _Round(NamedTuple):
    """What a round starts from."""

    is_newton: Bool[Array, " batch"]
    is_first: Bool[Array, " batch"]  # whether no wrench is known yet
    weight: Float[Array, "sliders batch"]
    wrench: Float[Array, "3 sliders batch"]

    def laws(self, surface: Any, mean: Float[Array, "3 3 sliders batch"]) -> LinearLaws:
        """The laws of the sliders in this round."""
        item, newton = self.weight.dtype.itemsize, self.is_newton[None, None]
        patch = LinearPatch.at(surface, self.wrench)
        largest = jnp.max(self.weight, axis=0)[None]
        weight = jnp.maximum(self.weight, LEAST_WEIGHT[item] * largest)[None, None]
        ellipsoid = jnp.where(self.is_first[None, None, None], mean, patch.ellipsoid())
        own = weight * patch.curvature + PROXIMAL[item] * largest[None, None] * ellipsoid
        law = jnp.where(newton[None], own, weight * ellipsoid)
        normal, origin = (jnp.where(newton, x, 0.0) for x in (patch.normal, self.wrench))
        return LinearLaws(law, normal, origin, jnp.sqrt(weight[0, 0]))


class _State(NamedTuple):
    """State between two rounds."""

    next: _Round
    weights: _Round  # the next round of weights
    last_violation: Float[Array, " batch"]  # of the last Newton round, or infinity
    best: SlidersMotion
    ongoing: Bool[Array, " batch"]
    number: Int[Array, ""]


def solve_sliders(
    problem: SlidersProblem, start: Start | None = None, anew: Bool[Array, ""] | bool = True
) -> SlidersMotion:
    """Find the motion of several sliders; it is not differentiated. All numbers are zero where they do not move.

    If not `anew`, few rounds are tried, the first of them from `start`.
    """
    problem, valid = problem.usable()
    start = Start.none(problem) if start is None else start
    pushes = jnp.any(problem.active & (problem.goal[0] > 0), axis=0)
    force, none = jnp.zeros_like(problem.goal), jnp.zeros_like(pushes)
    zero = problem.wrenches(force)
    still = _motion(problem, force, zero[0], jnp.zeros((3 * problem.count + len(zero[0]), none.size), bool), 0)
    unsolved = jnp.full_like(still.status, Status.NOT_CONVERGED)
    first = _Round(none, ~none, jnp.ones_like(zero[0]), jnp.ones_like(zero))
    guess = _Round(~none, none, start.dissipation + zero[0], start.wrench + zero)
    guess = _where(start.exists & ~jnp.asarray(anew) & ~none, guess, first)
    infinite = jnp.full_like(still.violation, jnp.inf)
    best, mean = still._replace(violation=infinite, status=unsolved), mean_ellipsoid(problem.surface, zero)
    most = jnp.where(anew, MAX_ROUNDS, MAX_ROUNDS_FROM_START)
    last = jax.lax.while_loop(
        lambda state: jnp.any(state.ongoing) & (state.number < most),
        lambda state: _next_round(problem, mean, state),
        _State(guess, first, infinite, best, pushes, jnp.zeros((), jnp.int32)),
    ).best
    refined = jax.lax.fori_loop(0, REFINEMENTS, lambda _, motion: _refined(problem, motion), last)
    found = _where(refined.violation < last.violation, refined, last)
    status = jnp.where(found.violation <= TOLERANCE[zero.dtype.itemsize], Status.MOVING, unsolved)
    status = jnp.where(last.status == Status.JAMMED, Status.JAMMED, status)
    status = jnp.where(valid, jnp.where(pushes, status, Status.FREE), Status.INVALID).astype(jnp.int8)
    found, still = (x._replace(status=status, violation=found.violation, rounds=last.rounds) for x in (found, still))
    return _where(status == Status.MOVING, found, still)


def _next_round(problem: SlidersProblem, mean: Float[Array, "3 3 sliders batch"], state: _State) -> _State:
    """Solve the LCP of a round, and decide what the next one starts from."""
    now = state.next
    lcp = SlidersLCP.of(problem, now.laws(problem.surface, mean))
    found, newton = lemke(lcp.matrix, lcp.q, _cover(state.number, lcp.q), state.ongoing), now.is_newton
    force = lcp.force(found.z) * lcp.force_unit[None]
    wrench = problem.wrenches(force)
    gauge = LinearPatch.at(problem.surface, wrench).gauge
    by_gauge = lcp.speed_unit**2 * jnp.clip(gauge, 1 / MAX_FACTOR, MAX_FACTOR)
    weight = jnp.where(newton[None], lcp.dissipation(found.z), by_gauge)
    dissipation = jnp.where(newton[None] | (gauge >= RESTING_GAUGE), weight, 0.0)
    basic = jnp.concatenate([found.basic[: 3 * problem.count], dissipation > 0])
    motion = _motion(problem, force, dissipation, basic, state.number + 1)
    jams = ~newton & _is_certificate(problem, lcp.force(found.ray) * lcp.force_unit[None])
    motion = motion._replace(status=jnp.where(jams, Status.JAMMED, motion.status).astype(jnp.int8))

    goes_on = ~newton | (found.solved & (motion.violation < state.last_violation / 2))
    after = _Round(newton, now.is_first & ~found.solved, weight, wrench)
    weights = _where(state.ongoing & found.solved & ~newton, after, state.weights)
    next_round = _where(goes_on, after._replace(is_newton=jnp.ones_like(newton)), weights)
    violation = jnp.where(newton, motion.violation, jnp.inf)
    is_better = jams | (motion.violation < state.best.violation)
    ends = jams | (motion.violation <= NEARLY[force.dtype.itemsize])
    best = _where(state.ongoing & is_better, motion, state.best)
    return _State(next_round, weights, violation, best, state.ongoing & ~ends, state.number + 1)


def _cover(number: Int[Array, ""], q: Float[Array, "rows batch"]) -> Float[Array, "rows"]:
    """The covering vector of a round: ones at first, then scattered numbers, to find another one of several answers."""
    scattered = jnp.modf(jnp.arange(1, len(q) + 1, dtype=q.dtype) * (number.astype(q.dtype) * GOLDEN))[0]
    return jnp.where(number < SAME_COVER, 1.0, 0.2 + scattered)


def _where(condition: Bool[Array, " batch"], a: Any, b: Any) -> Any:
    """`a` where the condition holds, else `b`, for pytrees of arrays with the batch last."""
    return jax.tree.map(lambda x, y: jnp.where(condition.reshape(*(1,) * (x.ndim - 1), -1), x, y), a, b)


def _motion(
    problem: SlidersProblem,
    force: Float[Array, "2 contacts batch"],
    dissipation: Float[Array, "sliders batch"],
    basic: Bool[Array, "rows batch"],
    rounds: int | Int[Array, ""],
) -> SlidersMotion:
    """The motion under contact forces, given the dissipation of each slider, and how far it violates any condition."""
    wrench = problem.wrenches(force)
    patch = LinearPatch.at(problem.surface, wrench)
    twist = dissipation[None] * patch.normal
    speed, total = jnp.max(jnp.abs(twist), axis=(0, 1)), jnp.max(jnp.abs(force[0]), axis=0)
    normal, tangential = force / jnp.where(total > 0, total, 1.0)[None, None]
    apart, along = problem.slips(twist) / jnp.maximum(1.0, speed)[None, None]
    left, right = problem.friction * normal - tangential, problem.friction * normal + tangential
    # a contact that separates has no force, and one that slips has all of its friction
    conditions = [-apart, -normal, jnp.minimum(normal, jnp.abs(apart)), -left, -right]
    conditions += [jnp.minimum(right, along), jnp.minimum(left, -along)]
    of_contacts = jnp.max(jnp.where(problem.active, jnp.stack(conditions), 0.0), axis=(0, 1))
    of_sliders = jnp.max(jnp.where(dissipation > 0, jnp.abs(patch.gauge - 1), patch.gauge - 1), axis=0)
    violation = jnp.maximum(of_contacts, of_sliders)
    violation = jnp.where(jnp.isfinite(violation), violation, jnp.inf)
    tolerance = TOLERANCE[force.dtype.itemsize]
    slides = jnp.where(along < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT)
    mode = jnp.where(jnp.abs(along) <= tolerance, ContactMode.STICKING, slides)
    mode = jnp.where(problem.active & (apart <= tolerance), mode, ContactMode.SEPARATED).astype(jnp.int8)
    status = jnp.full(violation.shape, Status.NOT_CONVERGED, jnp.int8)
    rounds = jnp.broadcast_to(jnp.asarray(rounds, jnp.int32), violation.shape)
    return SlidersMotion(twist, wrench, force, dissipation, mode, status, violation, basic, rounds)


def _is_certificate(problem: SlidersProblem, force: Float[Array, "2 contacts batch"]) -> Bool[Array, " batch"]:
    """Whether contact forces within their cones balance on every slider and do work on the motion of the pushers."""
    least, total = CERTIFICATE[force.dtype.itemsize], jnp.sum(force[0], axis=0)
    force = force / jnp.where(total > 0, total, 1.0)[None, None]
    within = jnp.all((force[0] >= 0) & (jnp.abs(force[1]) <= problem.friction * force[0] + least), axis=0)
    balanced = jnp.max(jnp.abs(problem.wrenches(force)), axis=(0, 1)) <= least
    return (total > 0) & within & balanced & (jnp.sum(force * problem.goal, axis=(0, 1)) > least)


def _refined(problem: SlidersProblem, motion: SlidersMotion) -> SlidersMotion:
    """The motion after one more Newton step, with the same unknowns that may be positive."""
    lcp, z = _at(problem, motion, PROXIMAL[problem.goal.dtype.itemsize])
    z = z - _solve_basic(lcp, motion.basic, lcp.complements(z))
    dissipation = jnp.maximum(lcp.dissipation(z), 0.0)
    return _motion(problem, lcp.force(z) * lcp.force_unit[None], dissipation, motion.basic, 0)


def differentiable_motion(problem: SlidersProblem, motion: SlidersMotion) -> SlidersMotion:
    """The motion as a function of the problem that JAX can differentiate, within its contact modes.

    Its values are right to roundoff. Forces between sliders that rest are indeterminate; their derivatives are those
    of the smallest change.
    """
    moves = motion.status == Status.MOVING
    problem, motion = problem.usable()[0], jax.lax.stop_gradient(motion)
    lcp, z = _at(problem, motion, 0.0)
    z = _root(problem, motion, jax.lax.stop_gradient(z))
    force, dissipation = lcp.force(z) * lcp.force_unit[None], lcp.dissipation(z)
    wrench = problem.wrenches(force)
    twist = dissipation[None] * LinearPatch.at(problem.surface, wrench).normal
    found = motion._replace(twist=twist, wrench=wrench, force=force, dissipation=dissipation)
    return _where(moves, found, motion)


@eqx.filter_custom_jvp
def _root(problem: SlidersProblem, motion: SlidersMotion, z: Float[Array, "rows batch"]) -> Float[Array, "rows batch"]:
    """The unknowns of the LCP at a motion, with their derivatives by the implicit function theorem."""
    return z


@_root.def_jvp
def _root_jvp(primals, tangents):
    problem, motion, z = primals
    changes = jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if d is None and eqx.is_inexact_array(x) else d,
        tangents[0],
        problem,
        is_leaf=lambda d: d is None,
    )
    # with as little of the ellipsoid's law for sliders that rest as roundoff allows
    proximal = float(jnp.finfo(z.dtype).eps) ** 0.5
    _, change = eqx.filter_jvp(lambda problem: _at(problem, motion, 0.0)[0].complements(z), (problem,), (changes,))
    lcp, _ = _at(problem, motion, proximal)
    return _root(problem, motion, z), -_solve_basic(lcp, motion.basic, change)


def _at(
    problem: SlidersProblem, motion: SlidersMotion, proximal: float
) -> tuple[SlidersLCP, Float[Array, "rows batch"]]:
    """The LCP of a Newton round at a motion, and its unknowns there."""
    # the small part of the ellipsoid's law is only for sliders that rest
    patch, largest = LinearPatch.at(problem.surface, motion.wrench), jnp.max(motion.dissipation, axis=0)[None]
    weight = jnp.where(motion.dissipation > 0, motion.dissipation, jnp.where(largest > 0, largest, 1.0))
    resting = proximal * weight[None, None] * patch.ellipsoid()
    law = jnp.where((motion.dissipation > 0)[None, None], weight[None, None] * patch.curvature, resting)
    laws = LinearLaws(law, patch.normal, motion.wrench, jnp.sqrt(weight))
    lcp = SlidersLCP.of(problem, laws)
    z = lcp.unknowns(motion.force, problem.slips(motion.twist)[1], motion.dissipation)
    return lcp, jnp.where(motion.basic, z, 0.0)


def _solve_basic(lcp: SlidersLCP, basic: Bool[Array, "rows batch"], right: Array) -> Float[Array, "rows batch"]:
    """Solve the rows of the LCP that belong to unknowns that may be positive; zero for the others."""
    right = jnp.where(basic, right, 0.0)
    matrix = jnp.where(basic[:, None] & basic[None], lcp.matrix, jnp.eye(len(basic), dtype=right.dtype)[:, :, None])
    return jnp.linalg.solve(jnp.moveaxis(matrix, -1, 0), right.T[:, :, None])[:, :, 0].T
