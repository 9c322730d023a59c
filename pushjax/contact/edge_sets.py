"""Solves sets of one, two or three cone edges, and checks each solution against every condition of the problem.

Each solution is checked against the whole problem, so a wrong answer cannot pass. The equations of each set are in the
header of `exhaustive`, which tries all sets. `projected` tries those that its iteration points to.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.linalg import Basis
from pushjax._math.vec import Scalar, Vec3
from pushjax.contact.edge_segment import WrenchSegment, cubic_root, monotone_intervals
from pushjax.contact.scaled_problem import Index, ScaledProblem, dynamic_index
from pushjax.contact.tolerances import (
    TOO_FAST,
    kinematic_tolerance,
    max_twist_ratio,
    min_determinant,
    relative_tolerance,
    same_solution_tolerance,
    zero_wrench_tolerance,
)
from pushjax.friction.inverse_map import aligned_wrench
from pushjax.friction.limit_surface import Form

NONE = -1  # the number of an unused generator


class Incumbent(NamedTuple):
    """The best set so far, and its solution.

    Attributes:
        edges: Numbers of the set's generators, the used ones first, then NONE.
        weight: Weight of each generator in the wrench, up to one common factor.
        twist: Dimensionless twist.
        key: Power on H = 1. Of several solutions, the one with the largest is kept.
        found: Whether any set passed.
        several: Whether a second twist passed too.
        hasty: Whether a twist passed that is too fast to be an answer (`max_twist_ratio`), by a factor of at most
            `TOO_FAST`. Then the problem is no jam either.
    """

    edges: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]
    weight: Vec3
    twist: Vec3
    key: Scalar
    found: Bool[Array, ""]
    several: Bool[Array, ""]
    hasty: Bool[Array, ""]


def no_incumbent(like: Scalar) -> Incumbent:
    """The state before any set has been tried."""
    zero = jnp.zeros_like(like)
    none, no = jnp.full(zero.shape, NONE, jnp.int32), jnp.zeros(zero.shape, bool)
    still = Vec3(zero, zero, zero)
    return Incumbent((none, none, none), still, still, zero, no, no, no)


def solve_one_edge(problem: ScaledProblem, found: Incumbent, e: Index) -> Incumbent:
    """Solve and check the set of one edge.

    Args:
        problem: The dimensionless contact problem.
        found: The best set so far.
        e: Number of the generator.

    Returns:
        The best set so far, this one included.
    """
    contact, side = e // 2, 1 - 2 * (e % 2)
    g = dynamic_index(problem.generators, e)
    motion = compute_once(problem.form.gradient(g), problem.speed)
    row, push = dynamic_index(problem.normal, contact), dynamic_index(problem.approach, contact).x
    along = row.dot(motion)
    k = push / jnp.where(along != 0, along, 1.0)  # both may be negative: a receding pusher can drag the slider along
    twist = compute_once(motion.scale(k), push)
    ((touching, slip),), apart = _relative_motion(problem, twist, (contact,))
    tolerance = kinematic_tolerance(twist)
    passes = (along != 0) & (k > 0) & touching & apart & (side * slip <= tolerance)
    one = jnp.ones_like(push)
    power = k * motion.dot(g)
    key = _key(problem.form, power, power / (problem.form.degree * jnp.where(k > 0, k, 1.0)))
    return _update_incumbent(found, passes, (e, NONE, NONE), Vec3(one, 0 * one, 0 * one), twist, key)


def solve_two_edges(problem: ScaledProblem, found: Incumbent, e1: Index, e2: Index) -> Incumbent:
    """Solve and check a set of two edges: of two contacts, which slide, or both of one contact, which sticks.

    Every root of the set's cubic equation is tried.

    Args:
        problem: The dimensionless contact problem.
        found: The best set so far.
        e1: Number of the first generator.
        e2: Number of the second generator.

    Returns:
        The best set so far, this one included.
    """
    c1, c2 = e1 // 2, e2 // 2
    sticks = c1 == c2
    form, unit = problem.form, problem.speed
    ends = compute_once((dynamic_index(problem.generators, e1), dynamic_index(problem.generators, e2)), unit)
    line = compute_once(WrenchSegment.between(form, *ends), unit)
    push1, push2 = dynamic_index(problem.approach, c1), dynamic_index(problem.approach, c2)
    row1 = dynamic_index(problem.normal, c1)
    row2 = tree_where(sticks, dynamic_index(problem.tangent, c1), dynamic_index(problem.normal, c2))
    b1, b2 = push1.x, jnp.where(sticks, push1.y, push2.x)
    across = row1.scale(b2) - row2.scale(b1)
    constant, linear, quadratic, leading = (across.dot(motion) for motion in line.motions)
    cubic = compute_once((constant, linear, quadratic, leading), unit)
    normal = row1.cross(row2)
    independent = normal.dot(normal) > jnp.finfo(unit.dtype).eps * row1.dot(row1) * row2.dot(row2)
    monotone, todo = zip(*monotone_intervals(cubic, -line.nearest, 1 - line.nearest), strict=True)
    todo = compute_once(tuple(has & independent for has in todo), unit)

    def at_root(state):
        todo, found = state
        first, second, third = todo
        piece = tree_where(first, monotone[0], tree_where(second, monotone[1], monotone[2]))
        todo = first & False, first & second, (first | second) & third
        u = cubic_root(cubic, piece)
        motion = line.motion(u)
        u1, u2 = row1.dot(motion), row2.dot(motion)
        squared = u1 * u1 + u2 * u2
        k = (b1 * u1 + b2 * u2) / jnp.where(squared > 0, squared, 1.0)
        twist = compute_once(motion.scale(k), unit)
        ((touching1, slip1), (touching2, slip2)), apart = _relative_motion(problem, twist, (c1, c2))
        tolerance = kinematic_tolerance(twist)
        right_way = ((1 - 2 * (e1 % 2)) * slip1 <= tolerance) & ((1 - 2 * (e2 % 2)) * slip2 <= tolerance)
        stuck = jnp.abs(slip1) <= tolerance
        passes = (k > 0) & touching1 & touching2 & apart & jnp.where(sticks, stuck, right_way)
        f = line.at(u)
        passes &= f.dot(f) > (zero_wrench_tolerance(unit.dtype)) ** 2
        dh = motion.dot(f)
        s = line.nearest + u
        key = _key(form, k * dh, dh / form.degree)
        return todo, _update_incumbent(found, passes, (e1, e2, NONE), Vec3(1 - s, s, 0 * s), twist, key)

    # few examples of a batch have more than one root: all take their next root in the same iteration
    return jax.lax.while_loop(lambda state: state[0][0] | state[0][1] | state[0][2], at_root, (todo, found))[1]


def solve_three_edges(problem: ScaledProblem, found: Incumbent, contacts: tuple, sides: Index) -> Incumbent:
    """Solve and check sets of three edges: one of each of three contacts, or both of one contact and one of another.

    Args:
        problem: The dimensionless contact problem.
        found: The best set so far.
        contacts: Numbers of the three contacts. If the first two are the same, both edges of that one are in the set
            and it sticks.
        sides: How many choices of edges to try: 8, or 2 where one contact sticks.

    Returns:
        The best set so far, these included.
    """
    c1, c2, c3 = contacts
    sticks = jnp.asarray(c1 == c2)
    push = dynamic_index(problem.approach, c1)
    second = jnp.where(sticks, push.y, dynamic_index(problem.approach, c2).x)
    rows = (
        dynamic_index(problem.normal, c1),
        tree_where(sticks, dynamic_index(problem.tangent, c1), dynamic_index(problem.normal, c2)),
        dynamic_index(problem.normal, c3),
    )
    twist, regular = solve_rows(rows, Vec3(push.x, second, dynamic_index(problem.approach, c3).x))
    twist = compute_once(twist, problem.speed)
    tolerance = kinematic_tolerance(twist)
    seen, apart = _relative_motion(problem, twist, contacts)
    feasible, allowed = regular & apart, []
    for touching, slip in seen:
        feasible &= touching
        allowed.append((slip <= tolerance, slip >= -tolerance))  # left edge, right edge; both where the contact sticks
    feasible = compute_once(feasible, problem.speed)
    f, aligned = aligned_wrench(problem.form, twist, feasible, relative_tolerance(problem.speed.dtype))
    h = problem.form.value(f)
    feasible, allowed = compute_once((feasible & aligned & (h > 0), tuple(allowed)), problem.speed)
    steep = tuple(problem.beyond(c) for c in contacts)
    choices = [
        (dynamic_index(problem.generators, 2 * c), dynamic_index(problem.generators, 2 * c + 1)) for c in contacts
    ]

    def try_sides(which, state):
        best, weight, chosen = state
        side = jnp.where(sticks, 0, which // 4), jnp.where(sticks, 1, which // 2 % 2), which % 2
        picked = tuple(tree_where(k == 0, *pair) for pair, k in zip(choices, side, strict=True))
        candidate, inside, least = _cone_coordinates(f, picked, steep)
        for (left, right), k in zip(allowed, side, strict=True):
            inside &= jnp.where(k == 0, left, right)
        better = decide(inside & (least > best), h)  # of several sets, the one with f farthest inside
        best, weight = jnp.where(better, least, best), tree_where(better, candidate, weight)
        new = tuple(jnp.where(better, 2 * c + k, old) for c, k, old in zip(contacts, side, chosen, strict=True))
        return best, weight, new

    none = tuple(jnp.full(h.shape, NONE, jnp.int32) for _ in contacts)
    begin = (jnp.full_like(h, -1.0), Vec3(h, h, h), none)
    best, weight, chosen = jax.lax.fori_loop(0, sides, try_sides, begin)
    return _update_incumbent(found, feasible & (best >= 0), chosen, weight, twist, _key(problem.form, f.dot(twist), h))


def _update_incumbent(found: Incumbent, passes, edges: tuple, weight: Vec3, twist: Vec3, key: Scalar) -> Incumbent:
    """Keep the better of two sets: more power on H = 1, or, where that is equal, the smaller twist."""
    size, size_before = twist.dot(twist), found.twist.dot(found.twist)
    too_fast, hopeless = (size > (k * max_twist_ratio(key.dtype)) ** 2 for k in (1, TOO_FAST))
    passes &= key > 0
    passes, hasty = decide((passes & ~too_fast, passes & too_fast & ~hopeless), key)
    apart = twist - found.twist
    several = passes & found.found & (apart.dot(apart) > same_solution_tolerance(key.dtype) ** 2 * (size + size_before))
    tie = jnp.abs(key - found.key) <= 4 * relative_tolerance(key.dtype) * found.key
    # Twists that differ by roundoff are the same motion. The set with fewer edges, which was found first, is better
    # conditioned.
    smaller = size < (1 - 8 * relative_tolerance(key.dtype)) * size_before
    better = passes & (~found.found | jnp.where(tie, smaller, key > found.key))
    better, several = compute_once((better, found.several | several), key)
    edges = tuple(
        jnp.where(better, jnp.asarray(new, jnp.int32), old) for new, old in zip(edges, found.edges, strict=True)
    )
    return Incumbent(
        edges,
        tree_where(better, weight, found.weight),
        tree_where(better, twist, found.twist),
        jnp.where(better, key, found.key),
        found.found | passes,
        several,
        found.hasty | hasty,
    )


def _key(form: Form, power: Scalar, h: Scalar) -> Scalar:
    """The power on H = 1 of a wrench with this power and this value of H."""
    root = jnp.sqrt(jnp.where(h > 0, h, 1.0))
    if form.degree == 4:
        root = jnp.sqrt(root)
    return jnp.where(h > 0, power / root, 0.0)


def _relative_motion(problem: ScaledProblem, twist: Vec3, contacts: tuple[Index, ...]):
    """The kinematic state of contacts under a twist.

    Returns:
        For each of `contacts`, whether it is active and just touches, and its tangential slip. And whether no contact
        of the problem is violated.
    """
    tolerance = kinematic_tolerance(twist)
    slips = problem.slips(twist)
    apart = jnp.ones((), bool)
    for slip, active in zip(slips, problem.active, strict=True):
        apart &= (slip.x >= -tolerance) | ~active
    seen = []
    for contact in contacts:
        own, active = dynamic_index(tuple(zip(slips, problem.active, strict=True)), contact)
        seen.append((active & (jnp.abs(own.x) <= tolerance), own.y))
    return seen, apart


def solve_rows(rows: tuple[Vec3, Vec3, Vec3], b: Vec3) -> tuple[Vec3, Bool[Array, ""]]:
    """Solve rows . v = b, with two steps of refinement.

    In a wedge near its jam the rows are nearly dependent and v is large, so v is refined.

    Args:
        rows: The three rows.
        b: Right-hand side.

    Returns:
        v, and whether the rows are independent.
    """
    basis = Basis.of(*rows, min_determinant(b.x.dtype))
    v = compute_once(basis.with_products(b), b.x)
    v = compute_once(v + basis.with_products(b - basis.products(v)), b.x)
    return v + basis.with_products(b - basis.products(v)), basis.regular


def _cone_coordinates(
    f: Vec3, generators: tuple[Vec3, Vec3, Vec3], steep: tuple[Scalar, ...]
) -> tuple[Vec3, Bool[Array, ""], Scalar]:
    """Weights of the wrench f in three generators, and whether f lies between them.

    Args:
        f: The wrench.
        generators: The three generators.
        steep: `ScaledProblem.beyond` of each generator's contact; the larger it is, the less may a weight be below
            zero.

    Returns:
        The weights, whether f lies between the generators, and the least weight as a fraction of their sum.
    """
    basis = Basis.of(*generators, min_determinant(f.x.dtype))
    a = compute_once(basis.weights(f), basis.det)
    a = compute_once(a + basis.weights(f - basis.total(a)), basis.det)
    total = jnp.abs(a.x) + jnp.abs(a.y) + jnp.abs(a.z)
    share = jnp.minimum(jnp.minimum(a.x, a.y), a.z) / jnp.where(total > 0, total, 1.0)
    rest = f - basis.total(a)
    fits = rest.dot(rest) <= (64 * jnp.finfo(f.x.dtype).eps * total) ** 2
    inside = basis.regular & fits & (f.dot(f) > (zero_wrench_tolerance(f.x.dtype) * total) ** 2)
    for weight, beyond in zip(a, steep, strict=True):
        inside &= beyond * weight >= -relative_tolerance(f.x.dtype) / 2 * total
    # A weight below zero is kept. Large forces may cancel in the wrench, and relative to the wrench such a weight can
    # be more than roundoff.
    return a, inside, jnp.maximum(share, 0)
