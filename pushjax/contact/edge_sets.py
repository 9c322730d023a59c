"""Solve sets of one, two or three cone edges, and check each solution against every condition of the problem.

The checks do not depend on how a set was found or solved, so a wrong answer cannot pass. The equations of each set
are in the header of `exhaustive`, which tries all sets. `projected` tries those that its iteration points to.
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

NO_EDGE = -1  # the number of an unused generator


class Incumbent(NamedTuple):
    """The best set so far, and its solution.

    Attributes:
        edges: Numbers of the set's generators (see `scaled_problem`), the used ones first, then `NO_EDGE`.
        contacts: Numbers of the contacts whose conditions fix the twist, then `NO_EDGE`. If the first two are the
            same, the second condition is that this contact sticks. They are the contacts of the edges. An exception
            is the third one in the case that `solve_three_edges` describes.
        weight: Weight of each generator in the wrench, up to one common factor.
        twist: Dimensionless twist.
        power: Power F . V with the wrench F scaled to H = 1. Of several solutions, the one with the largest is kept.
        found: Whether any set passed every check.
        second_found: Whether a set with a different twist passed too.
        too_fast: Whether a set passed whose twist exceeds `max_twist_ratio` by a factor of at most `TOO_FAST`. Such a
            twist is not accepted as an answer. But it shows that the problem is not a jam.
    """

    edges: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]
    contacts: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]
    weight: Vec3
    twist: Vec3
    power: Scalar
    found: Bool[Array, ""]
    second_found: Bool[Array, ""]
    too_fast: Bool[Array, ""]


def no_incumbent(runtime_scalar: Scalar) -> Incumbent:
    """The state before any set has been tried."""
    zero = jnp.zeros_like(runtime_scalar)
    none, no = jnp.full(zero.shape, NO_EDGE, jnp.int32), jnp.zeros(zero.shape, bool)
    zero_vector = Vec3(zero, zero, zero)
    return Incumbent((none, none, none), (none, none, none), zero_vector, zero_vector, zero, no, no, no)


def solve_one_edge(problem: ScaledProblem, incumbent: Incumbent, edge: Index) -> Incumbent:
    """Solve and check the set of one edge.

    Args:
        problem: The dimensionless contact problem.
        incumbent: The best set so far.
        edge: Number of the generator.

    Returns:
        The best set so far, this one included.
    """
    contact, side = edge // 2, 1 - 2 * (edge % 2)
    generator = dynamic_index(problem.generators, edge)
    motion = compute_once(problem.form.gradient(generator), problem.runtime_scalar)
    row, approach = dynamic_index(problem.normal, contact), dynamic_index(problem.approach, contact).x
    normal_motion = row.dot(motion)
    # Both may be negative: a receding pusher can drag the slider along.
    scale = approach / jnp.where(normal_motion != 0, normal_motion, 1.0)
    twist = compute_once(motion.scale(scale), approach)
    ((touching, slip),), none_violated = _contact_states(problem, twist, (contact,))
    tolerance = kinematic_tolerance(twist)
    passes = (normal_motion != 0) & (scale > 0) & touching & none_violated & (side * slip <= tolerance)
    one = jnp.ones_like(approach)
    # By Euler's identity, H is the power of the unscaled motion divided by the degree.
    raw_power = scale * motion.dot(generator)
    power = _power_on_limit_surface(
        problem.form, raw_power, raw_power / (problem.form.degree * jnp.where(scale > 0, scale, 1.0))
    )
    edges, contacts = (edge, NO_EDGE, NO_EDGE), (contact, NO_EDGE, NO_EDGE)
    return _update_incumbent(incumbent, passes, edges, contacts, Vec3(one, 0 * one, 0 * one), twist, power)


def solve_two_edges(problem: ScaledProblem, incumbent: Incumbent, edge1: Index, edge2: Index) -> Incumbent:
    """Solve and check a set of two edges: of two contacts, which slide, or both of one contact, which sticks.

    Every root of the set's cubic equation is tried.

    Args:
        problem: The dimensionless contact problem.
        incumbent: The best set so far.
        edge1: Number of the first generator.
        edge2: Number of the second generator.

    Returns:
        The best set so far, this one included.
    """
    c1, c2 = edge1 // 2, edge2 // 2
    sticks = c1 == c2
    form, runtime_scalar = problem.form, problem.runtime_scalar
    ends = compute_once(
        (dynamic_index(problem.generators, edge1), dynamic_index(problem.generators, edge2)), runtime_scalar
    )
    segment = compute_once(WrenchSegment.between(form, *ends), runtime_scalar)
    approach1, approach2 = dynamic_index(problem.approach, c1), dynamic_index(problem.approach, c2)
    row1 = dynamic_index(problem.normal, c1)
    row2 = tree_where(sticks, dynamic_index(problem.tangent, c1), dynamic_index(problem.normal, c2))
    b1, b2 = approach1.x, jnp.where(sticks, approach1.y, approach2.x)
    # Orthogonal to the twists that satisfy both conditions up to a common factor.
    across = row1.scale(b2) - row2.scale(b1)
    constant, linear, quadratic, leading = (across.dot(motion) for motion in segment.motions)
    cubic = compute_once((constant, linear, quadratic, leading), runtime_scalar)
    orthogonal = row1.cross(row2)
    independent = orthogonal.dot(orthogonal) > jnp.finfo(runtime_scalar.dtype).eps * row1.dot(row1) * row2.dot(row2)
    intervals, pending = zip(*monotone_intervals(cubic, -segment.nearest, 1 - segment.nearest), strict=True)
    pending = compute_once(tuple(has & independent for has in pending), runtime_scalar)

    def try_next_root(state):
        pending, incumbent = state
        first, second, third = pending
        interval = tree_where(first, intervals[0], tree_where(second, intervals[1], intervals[2]))
        # Drop the first one that is pending.
        pending = first & False, first & second, (first | second) & third
        u = cubic_root(cubic, interval)
        motion = segment.motion(u)
        u1, u2 = row1.dot(motion), row2.dot(motion)
        squared = u1 * u1 + u2 * u2
        scale = (b1 * u1 + b2 * u2) / jnp.where(squared > 0, squared, 1.0)
        twist = compute_once(motion.scale(scale), runtime_scalar)
        ((touching1, slip1), (touching2, slip2)), none_violated = _contact_states(problem, twist, (c1, c2))
        tolerance = kinematic_tolerance(twist)
        fits_slip = ((1 - 2 * (edge1 % 2)) * slip1 <= tolerance) & ((1 - 2 * (edge2 % 2)) * slip2 <= tolerance)
        no_slip = jnp.abs(slip1) <= tolerance
        passes = (scale > 0) & touching1 & touching2 & none_violated & jnp.where(sticks, no_slip, fits_slip)
        f = segment.at(u)
        passes &= f.dot(f) > (zero_wrench_tolerance(runtime_scalar.dtype)) ** 2
        degree_times_h = motion.dot(f)  # Euler's identity
        s = segment.nearest + u
        power = _power_on_limit_surface(form, scale * degree_times_h, degree_times_h / form.degree)
        edges, contacts = (edge1, edge2, NO_EDGE), (c1, c2, NO_EDGE)
        return pending, _update_incumbent(incumbent, passes, edges, contacts, Vec3(1 - s, s, 0 * s), twist, power)

    # Few examples of a batch have more than one root, so all take their next root in the same iteration.
    return jax.lax.while_loop(
        lambda state: state[0][0] | state[0][1] | state[0][2], try_next_root, (pending, incumbent)
    )[1]


def solve_three_edges(problem: ScaledProblem, incumbent: Incumbent, contacts: tuple, num_choices: Index) -> Incumbent:
    """Solve and check sets of three edges: one of each of three contacts, or both of one contact and one of another.

    The conditions of these contacts fix the twist. Where one of them sticks, the third edge may also belong to another
    contact that happens to touch under this twist. This occurs where two fingers are exactly opposite each other and
    move together, so that their normal conditions are the same, and a third contact limits how far the slider turns,
    at a force of zero.

    Args:
        problem: The dimensionless contact problem.
        incumbent: The best set so far.
        contacts: Numbers of the three contacts. If the first two are the same, both edges of that one are in the set
            and it sticks.
        num_choices: How many choices of edges to try: 8, or 2 where one contact sticks. In the latter case, if a
            further contact touches, both edges of every contact but the first are tried instead.

    Returns:
        The best set so far, these included.
    """
    c1, c2, c3 = contacts
    sticks = jnp.asarray(c1 == c2)
    twist, regular = solve_rows(*_conditions_of_three(problem, contacts, sticks))
    twist = compute_once(twist, problem.runtime_scalar)
    tolerance = kinematic_tolerance(twist)
    m = problem.count
    states, none_violated = _contact_states(problem, twist, tuple(range(m)))
    feasible = regular & none_violated
    # Whether the left edge and the right edge may carry force; both may where the contact sticks.
    may_carry = tuple((touching & (slip <= tolerance), touching & (slip >= -tolerance)) for touching, slip in states)
    touches = tuple(left | right for left, right in may_carry)
    for contact in contacts:
        feasible &= dynamic_index(touches, contact)
    if m > 2:  # the third edge of a set with a contact that sticks may be that of any other contact
        others = sum((touching & (c1 != k) & (c3 != k)).astype(jnp.int32) for k, touching in enumerate(touches))
        num_choices = jnp.where(sticks & feasible & (others > 0), 2 * (m - 1), num_choices)
    feasible = compute_once(feasible, problem.runtime_scalar)
    f, aligned = aligned_wrench(problem.form, twist, feasible, relative_tolerance(problem.runtime_scalar.dtype))
    h = problem.form.value(f)
    feasible, may_carry = compute_once((feasible & aligned & (h > 0), may_carry), problem.runtime_scalar)
    pairs = tuple(zip(problem.generators[::2], problem.generators[1::2], strict=True))
    per_weight = tuple(problem.violation_per_weight(k) for k in range(m))
    of_contact = tuple(zip(pairs, may_carry, per_weight, strict=True))

    def try_choice(choice, state):
        best_share, weight, best_edges = state
        side = jnp.where(sticks, 0, choice // 4), jnp.where(sticks, 1, choice // 2 % 2), choice % 2
        last = c3
        if m > 2:  # after c3 the other contacts in a circle, without c1
            last = jnp.where(sticks, (c1 + 1 + ((c3 - c1 - 1) % m + choice // 2) % (m - 1)) % m, c3)
        owners = (c1, c2, last)
        chosen = tuple(dynamic_index(of_contact, c) for c in owners)
        generators = tuple(tree_where(k == 0, *pair) for (pair, *_), k in zip(chosen, side, strict=True))
        candidate, inside, least_share = _cone_coordinates(f, generators, tuple(entry[2] for entry in chosen))
        for (_, (left, right), _), k in zip(chosen, side, strict=True):
            inside &= jnp.where(k == 0, left, right)
        better = decide(inside & (least_share > best_share), h)  # of several sets, the one with f farthest inside
        best_share, weight = jnp.where(better, least_share, best_share), tree_where(better, candidate, weight)
        edges = tuple(jnp.where(better, 2 * c + k, old) for c, k, old in zip(owners, side, best_edges, strict=True))
        return best_share, weight, edges

    no_edges = tuple(jnp.full(h.shape, NO_EDGE, jnp.int32) for _ in contacts)
    start = (jnp.full_like(h, -1.0), Vec3(h, h, h), no_edges)  # the weights are placeholders
    best_share, weight, best_edges = jax.lax.fori_loop(0, num_choices, try_choice, start)
    return _update_incumbent(
        incumbent,
        feasible & (best_share >= 0),
        best_edges,
        contacts,
        weight,
        twist,
        _power_on_limit_surface(problem.form, f.dot(twist), h),
    )


def _conditions_of_three(
    problem: ScaledProblem, contacts: tuple, sticks: Bool[Array, ""]
) -> tuple[tuple[Vec3, Vec3, Vec3], Vec3]:
    """The rows and right-hand sides of the three conditions that fix the twist.

    Args:
        problem: The dimensionless contact problem.
        contacts: Numbers of the three contacts.
        sticks: Whether the first two are the same, so that the second condition is the tangential one.
    """
    c1, c2, c3 = contacts
    approach = dynamic_index(problem.approach, c1)
    second = jnp.where(sticks, approach.y, dynamic_index(problem.approach, c2).x)
    rows = (
        dynamic_index(problem.normal, c1),
        tree_where(sticks, dynamic_index(problem.tangent, c1), dynamic_index(problem.normal, c2)),
        dynamic_index(problem.normal, c3),
    )
    return rows, Vec3(approach.x, second, dynamic_index(problem.approach, c3).x)


def _update_incumbent(
    incumbent: Incumbent, passes, edges: tuple, contacts: tuple, weight: Vec3, twist: Vec3, power: Scalar
) -> Incumbent:
    """Keep the better of two sets: more power on H = 1, or, where that is equal, the smaller twist."""
    squared, squared_before = twist.dot(twist), incumbent.twist.dot(incumbent.twist)
    above_limit, far_above_limit = (squared > (factor * max_twist_ratio(power.dtype)) ** 2 for factor in (1, TOO_FAST))
    passes &= power > 0
    passes, too_fast = decide((passes & ~above_limit, passes & above_limit & ~far_above_limit), power)
    difference = twist - incumbent.twist
    second_found = (
        passes
        & incumbent.found
        & (difference.dot(difference) > same_solution_tolerance(power.dtype) ** 2 * (squared + squared_before))
    )
    tie = jnp.abs(power - incumbent.power) <= 4 * relative_tolerance(power.dtype) * incumbent.power
    # Twists that differ by roundoff are the same motion. The set with fewer edges, which was found first, is better
    # conditioned.
    smaller = squared < (1 - 8 * relative_tolerance(power.dtype)) * squared_before
    better = passes & (~incumbent.found | jnp.where(tie, smaller, power > incumbent.power))
    better, second_found = compute_once((better, incumbent.second_found | second_found), power)
    edges, contacts = (
        tuple(jnp.where(better, jnp.asarray(new, jnp.int32), old) for new, old in zip(numbers, before, strict=True))
        for numbers, before in ((edges, incumbent.edges), (contacts, incumbent.contacts))
    )
    return Incumbent(
        edges,
        contacts,
        tree_where(better, weight, incumbent.weight),
        tree_where(better, twist, incumbent.twist),
        jnp.where(better, power, incumbent.power),
        incumbent.found | passes,
        second_found,
        incumbent.too_fast | too_fast,
    )


def _power_on_limit_surface(form: Form, power: Scalar, h: Scalar) -> Scalar:
    """The power on H = 1 of a wrench with this power and this value of H."""
    root = jnp.sqrt(jnp.where(h > 0, h, 1.0))
    if form.degree == 4:
        root = jnp.sqrt(root)
    return jnp.where(h > 0, power / root, 0.0)


def _contact_states(
    problem: ScaledProblem, twist: Vec3, contacts: tuple[Index, ...]
) -> tuple[list[tuple[Bool[Array, ""], Scalar]], Bool[Array, ""]]:
    """The kinematic state of contacts under a twist.

    Args:
        problem: The dimensionless contact problem.
        twist: Dimensionless twist.
        contacts: Numbers of the contacts whose state is wanted.

    Returns:
        For each of `contacts`, whether it is active and just touches, and its tangential slip. And whether no contact
        of the whole problem is violated.
    """
    tolerance = kinematic_tolerance(twist)
    slips = problem.slips(twist)
    none_violated = jnp.ones((), bool)
    for slip, active in zip(slips, problem.active, strict=True):
        none_violated &= (slip.x >= -tolerance) | ~active
    states = []
    for contact in contacts:
        slip, active = dynamic_index(tuple(zip(slips, problem.active, strict=True)), contact)
        states.append((active & (jnp.abs(slip.x) <= tolerance), slip.y))
    return states, none_violated


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
    f: Vec3, generators: tuple[Vec3, Vec3, Vec3], violation_per_weight: tuple[Scalar, ...]
) -> tuple[Vec3, Bool[Array, ""], Scalar]:
    """Weights of the wrench f in three generators, and whether f lies between them.

    Args:
        f: The wrench.
        generators: The three generators.
        violation_per_weight: `ScaledProblem.violation_per_weight` of each generator's contact. A weight may be below
            zero by an amount that is inversely proportional to it.

    Returns:
        The weights, whether f lies between the generators, and the least weight as a fraction of their sum.
    """
    basis = Basis.of(*generators, min_determinant(f.x.dtype))
    weights = compute_once(basis.weights(f), basis.det)
    weights = compute_once(weights + basis.weights(f - basis.total(weights)), basis.det)
    total = jnp.abs(weights.x) + jnp.abs(weights.y) + jnp.abs(weights.z)
    least_share = jnp.minimum(jnp.minimum(weights.x, weights.y), weights.z) / jnp.where(total > 0, total, 1.0)
    residual = f - basis.total(weights)
    reproduces = residual.dot(residual) <= (64 * jnp.finfo(f.x.dtype).eps * total) ** 2
    inside = basis.regular & reproduces & (f.dot(f) > (zero_wrench_tolerance(f.x.dtype) * total) ** 2)
    for weight, violation in zip(weights, violation_per_weight, strict=True):
        inside &= violation * weight >= -relative_tolerance(f.x.dtype) / 2 * total
    # A weight below zero is kept. Large forces may cancel in the wrench, and relative to the wrench such a weight can
    # be more than roundoff.
    return weights, inside, jnp.maximum(least_share, 0)
