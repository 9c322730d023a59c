"""Sets of one, two or three cone edges of a batch of problems: their equations, solved for many sets at once.

A wrench of each of S sets is (3, S, batch). The equations of each kind of set are in the header of `exhaustive`. The
checks do not depend on how a set was found or solved, so a wrong answer cannot pass.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._math.arrays import combined, cross, dot, dual, products, times
from pushjax._math.sums import summed
from pushjax.contact.cubic import Roots
from pushjax.contact.scaled_problem import NO_EDGE, EdgeSet, ScaledProblem, violation_per_weight
from pushjax.contact.tolerances import (
    kinematic_tolerance,
    min_determinant,
    relative_tolerance,
    zero_wrench_tolerance,
)
from pushjax.friction.inverse_map import aligned_wrenches

Numbers = np.ndarray | Array  # of edges or contacts: a static table (sets,), or numbers that differ, (sets, batch)


class Sets(NamedTuple):
    """Sets of edges; a static table (3, sets), or numbers that differ between problems, (3, sets, batch)."""

    edges: Numbers  # numbers of the edges, then `NO_EDGE`
    conditions: Numbers  # numbers of the rows whose conditions fix the twist, then `NO_EDGE`

    @staticmethod
    def of(edges: Numbers) -> "Sets":
        """Sets of one edge or of two, (1 or 2, sets) or (1 or 2, sets, batch), under their contacts' conditions."""
        xp = np if isinstance(edges, np.ndarray) else jnp
        conditions = edges >> 1 << 1
        if len(edges) == 2:  # of one contact that sticks, both conditions
            conditions = xp.stack([conditions[0], conditions[1] + (conditions[0] == conditions[1])])
        unused = xp.full((3 - len(edges), *edges.shape[1:]), NO_EDGE, np.int32)
        return Sets(xp.concatenate([edges, unused]), xp.concatenate([conditions, unused]))


class Solutions(NamedTuple):
    """A solution of each of S sets."""

    chosen: EdgeSet  # with an axis for the sets, before the batch
    twist: Float[Array, "3 sets batch"]  # dimensionless
    power: Float[Array, "sets batch"]  # with the wrench on H = 1
    passes: Bool[Array, "sets batch"]  # whether it satisfies every condition

    @staticmethod
    def of(sets: Sets, weight: Array, twist: Array, power: Array, passes: Array) -> "Solutions":
        """The solutions of sets."""
        edges, conditions = (jnp.broadcast_to(with_batch(x), weight.shape) for x in sets)
        return Solutions(EdgeSet(edges, conditions, weight), twist, power, passes)


def along(x: Array, index: Array, axis: int) -> Array:
    """The entries of an array at indices along one axis; other axes broadcast."""
    return jnp.take_along_axis(x, index, axis=axis, mode="promise_in_bounds")


def at(x: Array, index: Numbers) -> Array:
    """The entries (..., sets, batch) of a contact or edge of each set, from (..., contacts or edges, batch)."""
    if isinstance(index, np.ndarray):
        return jnp.concatenate([x[..., k : k + 1, :] for k in index], axis=-2)  # a gather takes ten times as long
    if index.ndim == 1:
        return jnp.take(x, index, axis=-2, mode="clip")
    return along(x, index.reshape((1,) * (x.ndim - 2) + index.shape), -2)


def flag_at(x: Array, index: Numbers) -> Array:
    """The entries (sets, batch) of one edge of each set, from those of every edge, (edges, sets, batch)."""
    numbers = jnp.arange(len(x)).reshape(-1, 1, 1)
    return jnp.any(x & (numbers == with_batch(index[None])), axis=0)


def with_batch(numbers: Numbers) -> Array:
    """Numbers of sets with an axis for the batch, which has length one if they are static."""
    return jnp.asarray(numbers).reshape(*numbers.shape, 1) if numbers.ndim == 2 else jnp.asarray(numbers)


def _motions(problem: ScaledProblem, twist: Float[Array, "3 sets batch"]) -> tuple[Array, Array]:
    """Motion of each contact point relative to its pusher, (n, gap added) and t, each (m, sets, batch)."""
    normal = summed(problem.normal[:, :, None] * twist[:, None], 0) - problem.goal[0][:, None]
    return normal, summed(problem.tangent[:, :, None] * twist[:, None], 0) - problem.goal[1][:, None]


def is_kinematic(problem: ScaledProblem, twist: Float[Array, "3 sets batch"], sets: Sets) -> Bool[Array, "sets batch"]:
    """Whether no contact is violated, and those of the set touch and slip to the side of their edge, or not at all."""
    edges, conditions = (with_batch(x)[:, None] for x in sets)
    contacts = jnp.arange(problem.count)[None, :, None, None]
    left, right = (jnp.any(edges == 2 * contacts + side, axis=0) for side in (0, 1))  # (contacts, sets, batch)
    touches = left | right | jnp.any(conditions >> 1 == contacts, axis=0)
    normal, slip = _motions(problem, twist)
    violation = jnp.maximum(-normal, jnp.where(touches, jnp.abs(normal), 0.0))
    violation = jnp.maximum(violation, jnp.maximum(jnp.where(left, slip, 0.0), jnp.where(right, -slip, 0.0)))
    violation = jnp.where(problem.active[:, None], violation, jnp.where(touches, jnp.inf, 0.0))
    return jnp.max(violation, axis=0) <= kinematic_tolerance(twist)


def solve_one(problem: ScaledProblem, sets: Sets) -> Solutions:
    """Solve sets of one edge."""
    owner, wrench = sets.edges[0] >> 1, at(problem.edges, sets.edges[0])
    motion = problem.surface.gradient(wrench)
    normal_motion = dot(at(problem.normal, owner), motion)
    # both may be negative: a receding pusher can drag the slider along
    scale = at(problem.goal[0], owner) / jnp.where(normal_motion != 0, normal_motion, 1.0)
    degree_times_h = dot(motion, wrench)  # Euler's identity
    power = _power(problem, scale * degree_times_h, degree_times_h / problem.surface.degree)
    weight = jnp.stack([jnp.ones_like(scale), *(jnp.zeros_like(scale),) * 2])
    twist = motion * scale[None]
    passes = (normal_motion != 0) & (scale > 0) & is_kinematic(problem, twist, sets)
    return Solutions.of(sets, weight, twist, power, passes)


def _power(problem: ScaledProblem, power: Array, h: Array) -> Array:
    """The power on H = 1 of a wrench with this power and this value of H."""
    return jnp.where(h > 0, power / problem.surface.root(jnp.where(h > 0, h, 1.0)), 0.0)


class Segment(NamedTuple):
    """The wrenches between the two edges of each set, and the motions there that fit both conditions but for a factor.

    The wrenches (1 - s) g1 + s g2 are written as center + u along, with u = s - nearest, about the point nearest to
    zero: two fingers that press against each other leave a small wrench, and powers of g1 and g2 themselves would
    cancel.
    """

    center: Float[Array, "3 sets batch"]  # the wrench nearest to zero
    along: Float[Array, "3 sets batch"]  # g2 - g1
    nearest: Float[Array, "sets batch"]  # s at the center
    motion: Float[Array, "terms 3 sets batch"]  # coefficients of grad H as a polynomial in u, the constant first
    rows: Float[Array, "2 3 sets batch"]  # of the two conditions
    goal: Float[Array, "2 sets batch"]  # their right-hand sides

    @staticmethod
    def of(problem: ScaledProblem, sets: Sets) -> "Segment":
        """The segments of sets of two edges."""
        first, second, _ = sets.edges
        surface = problem.surface
        g1 = at(problem.edges, first)
        along = at(problem.edges, second) - g1
        squared = dot(along, along)
        nearest = jnp.clip(-dot(g1, along) / jnp.where(squared > 0, squared, 1.0), 0, 1)
        center = g1 + nearest[None] * along
        at_center, at_along = surface.hessian(center), surface.hessian(along)
        ends = times(at_center, center) / (surface.degree - 1), times(at_along, along) / (surface.degree - 1)
        middle = (times(at_center, along), times(at_along, center)) if surface.degree == 4 else ()
        rows, goal = rows_of(problem, sets.conditions[:2])
        return Segment(center, along, nearest, jnp.stack([ends[0], *middle, ends[1]]), rows, goal)

    def roots(self) -> Roots:
        """The values of u where both conditions can hold, and the intervals in which they are."""
        # orthogonal to the twists that satisfy both conditions up to a common factor
        across = self.rows[0] * self.goal[1][None] - self.rows[1] * self.goal[0][None]
        return Roots.of(summed(self.motion * across[None], 1), -self.nearest, 1 - self.nearest)

    def are_independent(self) -> Bool[Array, "sets batch"]:
        """Whether the two conditions do not depend on each other."""
        orthogonal, (row1, row2) = cross(*self.rows), self.rows
        return dot(orthogonal, orthogonal) > float(jnp.finfo(row1.dtype).eps) * dot(row1, row1) * dot(row2, row2)

    def motion_at(self, u: Float[Array, "sets batch"]) -> Float[Array, "3 sets batch"]:
        """grad H at u."""
        motion = self.motion[-1]
        for term in reversed(self.motion[:-1]):
            motion = motion * u[None] + term
        return motion


def solve_two(problem: ScaledProblem, sets: Sets) -> Solutions:
    """Solve sets of two edges, with a solution for each root that the cubic of a set may have."""
    segment = Segment.of(problem, sets)
    roots, independent = segment.roots(), segment.are_independent()
    intervals = len(roots.ends) - 1

    def per_interval(x: Array) -> Array:
        return jnp.concatenate([x] * intervals, axis=-2)

    exists = (roots.exist() & independent[None]).reshape(-1, independent.shape[1])
    u = roots.find().reshape(exists.shape)
    segment, all_sets = (
        jax.tree.map(per_interval, segment),
        Sets(*(per_interval(with_batch(x)) for x in sets)),
    )
    motion = segment.motion_at(u)
    along_rows = products(segment.rows, motion)
    size = summed(along_rows * along_rows, 0)
    scale = summed(segment.goal * along_rows, 0) / jnp.where(size > 0, size, 1.0)
    wrench = segment.center + u[None] * segment.along
    degree_times_h = dot(motion, wrench)
    power = _power(problem, scale * degree_times_h, degree_times_h / problem.surface.degree)
    is_wrench = dot(wrench, wrench) > zero_wrench_tolerance(u.dtype) ** 2
    s, twist = segment.nearest + u, motion * scale[None]
    passes = exists & (scale > 0) & is_wrench & is_kinematic(problem, twist, all_sets)
    return Solutions.of(all_sets, jnp.stack([1 - s, s, jnp.zeros_like(s)]), twist, power, passes)


def rows_of(problem: ScaledProblem, conditions: Numbers) -> tuple[Array, Array]:
    """Rows (n, 3, sets, batch) and right-hand sides (n, sets, batch) of n conditions of each set."""
    rows, goal = problem.numbered_rows()
    return jnp.stack([at(rows, k) for k in conditions]), jnp.stack([at(goal, k) for k in conditions])


def solve_three(problem: ScaledProblem, conditions: Numbers, choices: Numbers) -> Solutions:
    """Solve sets of three conditions, (3, sets), which fix the twist.

    Several choices of three edges, (choices, 3, sets), are tried for the wrench of each, in turn.
    """
    twist, regular = _solve_rows(*rows_of(problem, conditions))
    normal, slip = _motions(problem, twist)
    active, tolerance = problem.active[:, None], kinematic_tolerance(twist)[None]
    touches = active & (jnp.abs(normal) <= tolerance)
    feasible = regular & jnp.all(~active | (normal >= -tolerance), axis=0)
    for numbers in conditions:
        feasible &= flag_at(touches, numbers >> 1)
    # whether an edge may carry force: both edges may where the contact sticks
    may_carry = jnp.stack([touches & (slip <= tolerance), touches & (slip >= -tolerance)], axis=1)
    may_carry = may_carry.reshape(2 * problem.count, *feasible.shape)
    f, aligned = aligned_wrenches(problem.surface, twist, feasible, relative_tolerance(twist.dtype))
    per_weight = jnp.repeat(violation_per_weight(problem.friction), 2, axis=0)

    def try_choice(best: tuple[Array, Array, Array], numbers: Array):
        edges = jnp.stack([at(problem.edges, k) for k in numbers])
        weight, inside, share = _cone_coordinates(f, edges, jnp.stack([at(per_weight, k) for k in numbers]))
        for k in numbers:
            inside &= flag_at(may_carry, k)
        better = inside & (share > best[0])  # of several sets, the one with f farthest inside
        numbers = with_batch(numbers)
        return (
            jnp.where(better, share, best[0]),
            jnp.where(better[None], weight, best[1]),
            jnp.where(better[None], numbers, best[2]),
        ), None

    none = jnp.full(twist.shape, NO_EDGE, jnp.int32)
    start = jnp.full_like(f[0], -1.0), 0 * f, none
    share, weight, edges = jax.lax.scan(try_choice, start, jnp.asarray(choices, jnp.int32))[0]
    h = problem.surface.value(f)
    passes = feasible & aligned & (h > 0) & (share >= 0)
    return Solutions.of(Sets(edges, conditions), weight, twist, _power(problem, dot(f, twist), h), passes)


def triples(contacts: Numbers, m: int) -> tuple[Numbers, Numbers]:
    """Conditions and choices of edges of three contacts each, (3, sets); the first two are the same if it sticks.

    Where one sticks, the third edge may also belong to another contact that happens to touch under this twist
    (`exhaustive`): a third one may then limit how far the slider turns, at a force of zero.
    """
    xp = np if isinstance(contacts, np.ndarray) else jnp
    c1, c2, c3 = contacts
    sticks, choices = c1 == c2, []
    for k in range(2 if m == 2 else max(8, 2 * (m - 1))):
        # after c3 the other contacts in a circle, without c1
        last = xp.where(sticks, (c1 + 1 + ((c3 - c1 - 1) % m + k // 2) % max(m - 1, 1)) % m, c3)
        first, second = xp.where(sticks, 0, k // 4 % 2), xp.where(sticks, 1, k // 2 % 2)
        choices.append(xp.stack([2 * c1 + first, 2 * c2 + second, 2 * last + k % 2]))
    return xp.stack([2 * c1, 2 * c2 + sticks, 2 * c3]), xp.stack(choices)


def _solve_rows(rows: Float[Array, "3 3 sets batch"], b: Float[Array, "3 sets batch"]) -> tuple[Array, Array]:
    """Solve rows . v = b, with two steps of refinement; and whether the rows are independent.

    In a wedge near its jam the rows are nearly dependent and v is large, so v is refined.
    """
    basis, regular = dual(rows, min_determinant(b.dtype))
    v = combined(basis, b)
    for _ in range(2):
        v = v + combined(basis, b - products(rows, v))
    return v, regular


def _cone_coordinates(f: Array, edges: Array, per_weight: Array) -> tuple[Array, Array, Array]:
    """Weights of wrenches f, (3, sets, batch), in three edges each, (3, 3, sets, batch).

    Returns:
        The weights, whether f lies between the edges, and the least weight as a share of the sum. A weight below zero
        is kept. Large forces may cancel in the wrench, and relative to the wrench such a weight can be more than
        roundoff.
    """
    eps, tolerance = float(jnp.finfo(f.dtype).eps), relative_tolerance(f.dtype)
    basis, regular = dual(edges, min_determinant(f.dtype))
    weight = products(basis, f)
    weight = weight + products(basis, f - combined(edges, weight))
    total = summed(jnp.abs(weight), 0)
    share = jnp.min(weight, axis=0) / jnp.where(total > 0, total, 1.0)
    left = f - combined(edges, weight)
    inside = regular & (dot(left, left) <= (64 * eps * total) ** 2)
    inside &= dot(f, f) > (zero_wrench_tolerance(f.dtype) * total) ** 2
    inside &= jnp.all(per_weight * weight >= -tolerance / 2 * total[None], axis=0)
    return weight, inside, jnp.maximum(share, 0)
