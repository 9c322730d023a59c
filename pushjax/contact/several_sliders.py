"""The quasi-static motion of several sliders that touch each other, by a sequence of LCPs.

The limit surface of each slider is replaced by a law that is linear. The motion is then that of an LCP, which Lemke's
method solves. A round solves one LCP. There are two kinds of rounds:

- A round of weights has the laws V = s B F, with the ellipsoid B that agrees with the limit surface at the wrench of
  the round before, and a weight s. The LCP always has a solution unless the contacts jam. The weight is then multiplied
  by the gauge of the wrench. These rounds converge from afar, but slowly where a slider hardly moves: its weight goes
  to zero.
- A Newton round has the limit surfaces made linear at that wrench, with the dissipation s >= 0 as an unknown of each
  slider. It finds by itself which sliders rest, and converges quadratically. It may go astray.

Newton rounds follow the first, second, fourth, eighth ... round of weights, as long as each makes the violation of the
true conditions smaller. A small part of the ellipsoid's law, of changes of the wrench, is added to the law of a Newton
round. It vanishes where the rounds converge, and determines the forces between sliders that rest.

If Lemke's method ends on a ray in a round of weights, there are contact forces that balance on every slider and do
positive work on the motion of the pushers: the contacts jam.

Reference: Zhou et al. 2017, section IV.B, solves one LCP in each step; Stewart & Trinkle 1996.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.trailing_batch import tree_where_last
from pushjax.contact.lemke import lemke
from pushjax.contact.linear_patch import LinearPatch
from pushjax.contact.sliders_problem import LinearLaws, SlidersLCP, SlidersProblem
from pushjax.contact.status import ContactMode, Status

MAX_ROUNDS = 100  # most problems take three to six
# Keyed by the bytes of a float: the least weight of a slider, and the part of the ellipsoid's law in a Newton round, in
# units of the largest weight.
LEAST_WEIGHT, PROXIMAL = {4: 1e-3, 8: 1e-4}, {4: 1e-3, 8: 1e-5}
RESTING_GAUGE = 0.9  # of a slider that counts as resting in a round of weights
SAME_COVER, GOLDEN = 6, 0.6180339887  # rounds with the same covering vector, and what scatters it
LEAST_DECREASE = 0.9  # of the violation from a Newton round to the next, for another one to follow
MAX_FACTOR = 10.0  # of a weight, from a round to the next
MAX_REFINEMENTS = 6  # Newton steps after the rounds, with the unknowns that may be positive in the best of them
# Keyed by the bytes of a float: largest violation of a condition of a motion, and where Newton steps end.
TOLERANCE, ROUNDOFF = {4: 1e-4, 8: 1e-9}, {4: 1e-5, 8: 1e-13}
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
    patch: LinearPatch  # the limit surfaces at the wrench


class Start(NamedTuple):
    """Where the search for a motion may start: at that of a similar problem."""

    exists: Bool[Array, "*batch"]
    force: Float[Array, "2 contacts *batch"]
    dissipation: Float[Array, "sliders *batch"]
    basic: Bool[Array, "rows *batch"]
    normal: Float[Array, "3 sliders *batch"]  # of the limit surfaces; zero if not known

    @staticmethod
    def none(contacts: int, dissipation: Float[Array, "sliders *batch"]) -> "Start":
        """Nothing to start from, with the shape and dtype of what is given."""
        zero = jnp.zeros_like(dissipation[0])
        force, basic = (jnp.stack([zero] * rows) for rows in (2 * contacts, 3 * contacts + len(dissipation)))
        force = force.reshape(2, contacts, *zero.shape)
        still = jnp.zeros_like(dissipation)
        return Start(zero > 0, force, still, basic > 0, jnp.stack([still] * 3))


class _Round(NamedTuple):
    """What a round starts from."""

    is_newton: Bool[Array, " batch"]
    weight: Float[Array, "sliders batch"]
    wrench: Float[Array, "3 sliders batch"]
    patch: LinearPatch  # at the wrench
    ellipsoid: Float[Array, "3 3 sliders batch"]  # of a round of weights

    def laws(self, mean: Float[Array, "3 3 sliders batch"]) -> LinearLaws:
        """The laws of the sliders in this round."""
        item, newton, patch = self.weight.dtype.itemsize, self.is_newton[None, None], self.patch
        largest = jnp.max(self.weight, axis=0)[None]
        weight = jnp.maximum(self.weight, LEAST_WEIGHT[item] * largest)[None, None]
        own = weight * patch.curvature + PROXIMAL[item] * largest[None, None] * mean
        law = jnp.where(newton[None], own, weight * self.ellipsoid)
        normal, origin = (jnp.where(newton, x, 0.0) for x in (patch.normal, self.wrench))
        return LinearLaws(law, normal, origin, jnp.sqrt(weight[0, 0]))


class _State(NamedTuple):
    """State between two rounds."""

    next: _Round
    weights: _Round  # the next round of weights
    weighted: Int[Array, " batch"]  # number of rounds of weights
    last_violation: Float[Array, " batch"]  # of the last Newton round, or infinity
    best: SlidersMotion
    ongoing: Bool[Array, " batch"]
    number: Int[Array, ""]


def solve_all(
    problem: SlidersProblem, start: Start, valid: Bool[Array, " batch"], anew: Bool[Array, ""]
) -> SlidersMotion:
    """The motion of several sliders, given a problem of numbers that can be computed with."""
    pushes, active = problem.pushes(), problem.active
    basic = start.basic & jnp.concatenate([active, active, active, jnp.ones_like(start.dissipation, bool)])
    start = start._replace(force=jnp.where(active, start.force, 0.0), basic=basic)
    before = _motion(problem, start.force, start.dissipation, start.basic, 0, near=start.normal)
    tolerance = TOLERANCE[before.force.dtype.itemsize]

    def attempt(state: tuple[SlidersMotion, Array, Array]) -> tuple[SlidersMotion, Array, Array]:
        """Search from the start, then, where that fails, from nothing."""
        found, wanted, number = state
        exists = start.exists & (number == 0)
        new = tree_where_last(anew & wanted, _in_rounds(problem, before, exists & wanted, wanted & anew), before)
        new = _refined(problem, new, wanted & (new.status != Status.JAMMED) & (anew | exists))
        is_better = wanted & ((number == 0) | (new.status == Status.JAMMED) | (new.violation < found.violation))
        found = tree_where_last(is_better, new, found)
        unsolved = (found.status != Status.JAMMED) & (found.violation > tolerance)
        return found, wanted & exists & unsolved & anew, number + 1

    first = before, pushes, jnp.zeros((), jnp.int32)
    found, *_ = jax.lax.while_loop(lambda state: jnp.any(state[1]), attempt, first)
    unsolved = jnp.full_like(found.status, Status.NOT_CONVERGED)
    status = jnp.where(found.violation <= tolerance, Status.MOVING, unsolved)
    status = jnp.where(found.status == Status.JAMMED, Status.JAMMED, status)
    status = jnp.where(valid, jnp.where(pushes, status, Status.FREE), Status.INVALID).astype(jnp.int8)
    still = jax.tree.map(jnp.zeros_like, found)._replace(mode=jnp.full_like(found.mode, ContactMode.SEPARATED))
    found, still = (x._replace(status=status, violation=found.violation, rounds=found.rounds) for x in (found, still))
    return tree_where_last(status == Status.MOVING, found, still)


def _in_rounds(
    problem: SlidersProblem, before: SlidersMotion, exists: Bool[Array, " batch"], wanted: Bool[Array, " batch"]
) -> SlidersMotion:
    """Solve LCPs in rounds, from a motion before where one exists: the best motion of all rounds."""
    mean, infinite = problem.surface.mean_ellipsoid(before.wrench), jnp.full_like(before.violation, jnp.inf)
    guess = _Round(exists, before.dissipation, before.wrench, before.patch, mean)
    first = guess._replace(is_newton=exists & False, weight=jnp.ones_like(before.dissipation))
    best = before._replace(violation=infinite, status=jnp.full_like(before.status, Status.NOT_CONVERGED))
    none = jnp.zeros(exists.shape, jnp.int32)
    start = _State(tree_where_last(exists, guess, first), first, none, infinite, best, wanted, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(
        lambda state: jnp.any(state.ongoing) & (state.number < MAX_ROUNDS),
        lambda state: _next_round(problem, mean, state),
        start,
    ).best


def _next_round(problem: SlidersProblem, mean: Float[Array, "3 3 sliders batch"], state: _State) -> _State:
    """Solve the LCP of a round, and decide what the next one starts from."""
    now = state.next
    laws = now.laws(mean)
    lcp = SlidersLCP.of(problem, laws)
    found, newton = lemke(lcp.matrix, lcp.q, _cover(state.number, lcp.q), state.ongoing), now.is_newton
    force = lcp.force(found.z) * lcp.force_unit[None]
    patch = LinearPatch.at(problem.surface, problem.wrenches(force), now.patch.normal)
    by_gauge = lcp.speed_unit**2 * jnp.clip(patch.gauge, 1 / MAX_FACTOR, MAX_FACTOR)
    weight = jnp.where(newton[None], lcp.dissipation(found.z), by_gauge)
    dissipation = jnp.where(newton[None] | (patch.gauge >= RESTING_GAUGE), weight, 0.0)
    basic = jnp.concatenate([found.basic[: 3 * problem.count], dissipation > 0])
    motion = _motion(problem, force, dissipation, basic, state.number + 1, patch)
    jams = ~newton & _is_certificate(problem, lcp.force(found.ray) * lcp.force_unit[None])
    motion = motion._replace(status=jnp.where(jams, Status.JAMMED, motion.status).astype(jnp.int8))

    goes_on = ~newton | (found.solved & (motion.violation < LEAST_DECREASE * state.last_violation))
    twist = jnp.sum(laws.law * motion.wrench[None], axis=1)  # of a round of weights
    ellipsoid, by_twist = problem.surface.reweighted(twist, patch.ellipsoid(), weight)
    after = _Round(newton, jnp.where(newton[None], weight, by_twist), motion.wrench, patch, ellipsoid)
    weights = tree_where_last(state.ongoing & found.solved & ~newton, after, state.weights)
    number = state.weighted + ~newton
    tries_newton = newton | (number & (number - 1) == 0)
    next_round = tree_where_last(goes_on, after._replace(is_newton=tries_newton), weights)
    violation = jnp.where(newton, motion.violation, jnp.inf)
    is_better = jams | (motion.violation < state.best.violation)
    ends = jams | (motion.violation <= TOLERANCE[force.dtype.itemsize])
    best = tree_where_last(state.ongoing & is_better, motion, state.best)
    return _State(next_round, weights, number, violation, best, state.ongoing & ~ends, state.number + 1)


def _cover(number: Int[Array, ""], q: Float[Array, "rows batch"]) -> Float[Array, "rows"]:
    """The covering vector of a round: ones at first, then scattered numbers, to find another one of several answers."""
    scattered = jnp.modf(jnp.arange(1, len(q) + 1, dtype=q.dtype) * (number.astype(q.dtype) * GOLDEN))[0]
    return jnp.where(number < SAME_COVER, 1.0, 0.2 + scattered)


def _motion(
    problem: SlidersProblem,
    force: Float[Array, "2 contacts batch"],
    dissipation: Float[Array, "sliders batch"],
    basic: Bool[Array, "rows batch"],
    rounds: int | Int[Array, ""],
    patch: LinearPatch | None = None,
    near: Float[Array, "3 sliders batch"] | None = None,
) -> SlidersMotion:
    """The motion under contact forces, given the dissipation of each slider, and how far it violates any condition."""
    wrench = problem.wrenches(force)
    patch = LinearPatch.at(problem.surface, wrench, near) if patch is None else patch
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
    return SlidersMotion(twist, wrench, force, dissipation, mode, status, violation, basic, rounds, patch)


def _is_certificate(problem: SlidersProblem, force: Float[Array, "2 contacts batch"]) -> Bool[Array, " batch"]:
    """Whether contact forces within their cones balance on every slider and do work on the motion of the pushers."""
    least, total = CERTIFICATE[force.dtype.itemsize], jnp.sum(force[0], axis=0)
    force = force / jnp.where(total > 0, total, 1.0)[None, None]
    within = jnp.all((force[0] >= 0) & (jnp.abs(force[1]) <= problem.friction * force[0] + least), axis=0)
    balanced = jnp.max(jnp.abs(problem.wrenches(force)), axis=(0, 1)) <= least
    return (total > 0) & within & balanced & (jnp.sum(force * problem.goal, axis=(0, 1)) > least)


class _Refinement(NamedTuple):
    """State between two Newton steps."""

    last: SlidersMotion
    best: SlidersMotion
    ongoing: Bool[Array, " batch"]
    number: Int[Array, ""]


def _refined(problem: SlidersProblem, motion: SlidersMotion, wanted: Bool[Array, " batch"]) -> SlidersMotion:
    """The best motion of Newton's method, with the same unknowns that may be positive."""
    item = motion.force.dtype.itemsize

    def newton_step(state: _Refinement) -> _Refinement:
        lcp, z = _at(problem, state.last, PROXIMAL[item])
        z = z - lcp.solve_basic(motion.basic, lcp.complements(z, state.last.patch))
        dissipation = jnp.maximum(lcp.dissipation(z), 0.0)
        force, near = lcp.force(z) * lcp.force_unit[None], state.last.patch.normal
        new = _motion(problem, force, dissipation, motion.basic, motion.rounds, near=near)
        is_better = state.ongoing & (new.violation < state.best.violation)
        best = tree_where_last(is_better, new, state.best)
        goes_on = (new.violation < state.last.violation / 2) | (best.violation > TOLERANCE[item])
        ongoing = state.ongoing & goes_on & (new.violation > ROUNDOFF[item])
        return _Refinement(new, best, ongoing, state.number + 1)

    start = _Refinement(motion, motion, wanted & (motion.violation > ROUNDOFF[item]), jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(
        lambda state: jnp.any(state.ongoing) & (state.number < MAX_REFINEMENTS), newton_step, start
    )
    return last.best


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
    twist = dissipation[None] * LinearPatch.at(problem.surface, wrench, motion.patch.normal).normal
    found = motion._replace(twist=twist, wrench=wrench, force=force, dissipation=dissipation)
    return tree_where_last(moves, found, motion)


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

    def complements(problem: SlidersProblem) -> Float[Array, "rows batch"]:
        lcp = _at(problem, motion, 0.0)[0]
        wrench = lcp.problem.wrenches(lcp.force(z))
        return lcp.complements(z, LinearPatch.at(problem.surface, wrench, motion.patch.normal))

    _, change = eqx.filter_jvp(complements, (problem,), (changes,))
    lcp, _ = _at(problem, motion, proximal)
    return _root(problem, motion, z), -lcp.solve_basic(motion.basic, change)


def _at(
    problem: SlidersProblem, motion: SlidersMotion, proximal: float
) -> tuple[SlidersLCP, Float[Array, "rows batch"]]:
    """The LCP of a Newton round at a motion, and its unknowns there."""
    # the small part of the ellipsoid's law is only for sliders that rest
    patch, largest = motion.patch, jnp.max(motion.dissipation, axis=0)[None]
    weight = jnp.where(motion.dissipation > 0, motion.dissipation, jnp.where(largest > 0, largest, 1.0))
    resting = proximal * weight[None, None] * patch.ellipsoid()
    law = jnp.where((motion.dissipation > 0)[None, None], weight[None, None] * patch.curvature, resting)
    laws = LinearLaws(law, patch.normal, motion.wrench, jnp.sqrt(weight))
    lcp = SlidersLCP.of(problem, laws)
    z = lcp.unknowns(motion.force, problem.slips(motion.twist)[1], motion.dissipation)
    return lcp, jnp.where(motion.basic, z, 0.0)
