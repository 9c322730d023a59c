"""Sets of one, two or three cone edges: the motion of each, and whether every condition of the problem holds there.

Whatever a set gives is checked against all of the problem, so a wrong answer cannot pass. What each set's equations are
stands in `exhaustive`, which tries them all; `projected` tries those that its iteration points to.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._vec import Scalar, Vec3, select, settle
from pushjax.limit_surface import Form
from pushjax.limit_surface._aligned import aligned_wrench
from pushjax.solve._basis import Basis
from pushjax.solve._edge_line import Line, pieces, root
from pushjax.solve._several import HASTY, Index, Several, clean, fastest, pick, violation

NONE = -1  # in place of a generator's number


class Found(NamedTuple):
    """The best set so far, and what it gives.

    edges: numbers of its generators, the used ones first. weight: of each in the wrench, up to one common factor.
    twist: dimensionless. key: power on H = 1, what is largest where solutions are several. found: whether there is any.
    several: whether a second twist passed too. hasty: whether one passed that is too fast to be an answer (`fastest`),
    which is no jam either.
    """

    edges: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]
    weight: Vec3
    twist: Vec3
    key: Scalar
    found: Bool[Array, ""]
    several: Bool[Array, ""]
    hasty: Bool[Array, ""]


def nothing(like: Scalar) -> Found:
    """Before any set has been tried."""
    zero = jnp.zeros_like(like)
    none, no = jnp.full(zero.shape, NONE, jnp.int32), jnp.zeros(zero.shape, bool)
    still = Vec3(zero, zero, zero)
    return Found((none, none, none), still, still, zero, no, no, no)


def one_edge(problem: Several, found: Found, e: Index) -> Found:
    contact, side = e // 2, 1 - 2 * (e % 2)
    g = pick(problem.generators, e)
    motion = settle(problem.form.gradient(g), problem.speed)
    row, push = pick(problem.normal, contact), pick(problem.approach, contact).x
    along = row.dot(motion)
    k = push / jnp.where(along != 0, along, 1.0)  # both may be negative: a receding pusher can drag the slider along
    twist = settle(motion.scale(k), push)
    ((touching, slip),), apart = _seen(problem, twist, (contact,))
    tolerance = violation(twist)
    passes = (along != 0) & (k > 0) & touching & apart & (side * slip <= tolerance)
    one = jnp.ones_like(push)
    power = k * motion.dot(g)
    key = _key(problem.form, power, power / (problem.form.degree * jnp.where(k > 0, k, 1.0)))
    return _consider(found, passes, (e, NONE, NONE), Vec3(one, 0 * one, 0 * one), twist, key)


def two_edges(problem: Several, found: Found, e1: Index, e2: Index) -> Found:
    c1, c2 = e1 // 2, e2 // 2
    sticks = c1 == c2
    form, unit = problem.form, problem.speed
    ends = settle((pick(problem.generators, e1), pick(problem.generators, e2)), unit)
    line = settle(Line.between(form, *ends), unit)
    push1, push2 = pick(problem.approach, c1), pick(problem.approach, c2)
    row1 = pick(problem.normal, c1)
    row2 = select(sticks, pick(problem.tangent, c1), pick(problem.normal, c2))
    b1, b2 = push1.x, jnp.where(sticks, push1.y, push2.x)
    across = row1.scale(b2) - row2.scale(b1)
    constant, linear, quadratic, leading = (across.dot(motion) for motion in line.motions)
    cubic = settle((constant, linear, quadratic, leading), unit)
    normal = row1.cross(row2)
    independent = normal.dot(normal) > jnp.finfo(unit.dtype).eps * row1.dot(row1) * row2.dot(row2)
    monotone, todo = zip(*pieces(cubic, -line.nearest, 1 - line.nearest), strict=True)
    todo = settle(tuple(has & independent for has in todo), unit)

    def at_root(state):
        todo, found = state
        first, second, third = todo
        piece = select(first, monotone[0], select(second, monotone[1], monotone[2]))
        todo = first & False, first & second, (first | second) & third
        u = root(cubic, piece)
        motion = line.motion(u)
        u1, u2 = row1.dot(motion), row2.dot(motion)
        squared = u1 * u1 + u2 * u2
        k = (b1 * u1 + b2 * u2) / jnp.where(squared > 0, squared, 1.0)
        twist = settle(motion.scale(k), unit)
        ((touching1, slip1), (touching2, slip2)), apart = _seen(problem, twist, (c1, c2))
        tolerance = violation(twist)
        right_way = ((1 - 2 * (e1 % 2)) * slip1 <= tolerance) & ((1 - 2 * (e2 % 2)) * slip2 <= tolerance)
        stuck = jnp.abs(slip1) <= tolerance
        passes = (k > 0) & touching1 & touching2 & apart & jnp.where(sticks, stuck, right_way)
        f = line.at(u)
        passes &= f.dot(f) > (faint(unit.dtype)) ** 2
        dh = motion.dot(f)
        s = line.nearest + u
        key = _key(form, k * dh, dh / form.degree)
        return todo, _consider(found, passes, (e1, e2, NONE), Vec3(1 - s, s, 0 * s), twist, key)

    # in a batch few have more than one root: all take their next one together
    return jax.lax.while_loop(lambda state: state[0][0] | state[0][1] | state[0][2], at_root, (todo, found))[1]


def three_edges(problem: Several, found: Found, contacts: tuple, sides: Index) -> Found:
    """Edges of three contacts, one each; or, the first two contacts being the same, both of that one, which sticks.

    sides: how many choices of edges to try: 8, or 2 where one sticks.
    """
    c1, c2, c3 = contacts
    sticks = jnp.asarray(c1 == c2)
    push = pick(problem.approach, c1)
    second = jnp.where(sticks, push.y, pick(problem.approach, c2).x)
    rows = (
        pick(problem.normal, c1),
        select(sticks, pick(problem.tangent, c1), pick(problem.normal, c2)),
        pick(problem.normal, c3),
    )
    twist, regular = solve_rows(rows, Vec3(push.x, second, pick(problem.approach, c3).x))
    twist = settle(twist, problem.speed)
    tolerance = violation(twist)
    seen, apart = _seen(problem, twist, contacts)
    feasible, allowed = regular & apart, []
    for touching, slip in seen:
        feasible &= touching
        allowed.append((slip <= tolerance, slip >= -tolerance))  # left edge, right edge; both where it sticks
    feasible = settle(feasible, problem.speed)
    f, aligned = aligned_wrench(problem.form, twist, feasible, clean(problem.speed.dtype))
    h = problem.form.value(f)
    feasible, allowed = settle((feasible & aligned & (h > 0), tuple(allowed)), problem.speed)
    steep = tuple(problem.beyond(c) for c in contacts)
    choices = [(pick(problem.generators, 2 * c), pick(problem.generators, 2 * c + 1)) for c in contacts]

    def try_sides(which, state):
        best, weight, chosen = state
        side = jnp.where(sticks, 0, which // 4), jnp.where(sticks, 1, which // 2 % 2), which % 2
        picked = tuple(select(k == 0, *pair) for pair, k in zip(choices, side, strict=True))
        candidate, inside, least = _between(f, picked, steep)
        for (left, right), k in zip(allowed, side, strict=True):
            inside &= jnp.where(k == 0, left, right)
        better = settle(inside & (least > best), h)  # of several threes, the one farthest inside
        best, weight = jnp.where(better, least, best), select(better, candidate, weight)
        new = tuple(jnp.where(better, 2 * c + k, old) for c, k, old in zip(contacts, side, chosen, strict=True))
        return best, weight, new

    none = tuple(jnp.full(h.shape, NONE, jnp.int32) for _ in contacts)
    begin = (jnp.full_like(h, -1.0), Vec3(h, h, h), none)
    best, weight, chosen = jax.lax.fori_loop(0, sides, try_sides, begin)
    return _consider(found, feasible & (best >= 0), chosen, weight, twist, _key(problem.form, f.dot(twist), h))


def _consider(found: Found, passes, edges: tuple, weight: Vec3, twist: Vec3, key: Scalar) -> Found:
    """Keep the better of two: more power at H = 1, and where that is equal the smaller twist."""
    size, size_before = twist.dot(twist), found.twist.dot(found.twist)
    too_fast, hopeless = (size > (k * fastest(key.dtype)) ** 2 for k in (1, HASTY))
    passes &= key > 0
    passes, hasty = settle((passes & ~too_fast, passes & too_fast & ~hopeless), key)
    apart = twist - found.twist
    several = passes & found.found & (apart.dot(apart) > same_twist(key.dtype) ** 2 * (size + size_before))
    tie = jnp.abs(key - found.key) <= 4 * clean(key.dtype) * found.key
    # what differs by rounding is the same motion: the one of fewer edges, which was found first, is better conditioned
    smaller = size < (1 - 8 * clean(key.dtype)) * size_before
    better = passes & (~found.found | jnp.where(tie, smaller, key > found.key))
    better, several = settle((better, found.several | several), key)
    edges = tuple(
        jnp.where(better, jnp.asarray(new, jnp.int32), old) for new, old in zip(edges, found.edges, strict=True)
    )
    return Found(
        edges,
        select(better, weight, found.weight),
        select(better, twist, found.twist),
        jnp.where(better, key, found.key),
        found.found | passes,
        several,
        found.hasty | hasty,
    )


def _key(form: Form, power: Scalar, h: Scalar) -> Scalar:
    """The power, on H = 1, of a wrench with this power and value of H."""
    root = jnp.sqrt(jnp.where(h > 0, h, 1.0))
    if form.degree == 4:
        root = jnp.sqrt(root)
    return jnp.where(h > 0, power / root, 0.0)


def _seen(problem: Several, twist: Vec3, contacts: tuple[Index, ...]):
    """Of some contacts, whether each counts and just touches, and its slip; and whether no contact is violated."""
    tolerance = violation(twist)
    slips = problem.slips(twist)
    apart = jnp.ones((), bool)
    for slip, active in zip(slips, problem.active, strict=True):
        apart &= (slip.x >= -tolerance) | ~active
    seen = []
    for contact in contacts:
        own, active = pick(tuple(zip(slips, problem.active, strict=True)), contact)
        seen.append((active & (jnp.abs(own.x) <= tolerance), own.y))
    return seen, apart


def solve_rows(rows: tuple[Vec3, Vec3, Vec3], b: Vec3) -> tuple[Vec3, Bool[Array, ""]]:
    """v with rows . v = b, refined twice (in a wedge near its jam rows are nearly dependent, v large); and whether the
    rows are independent."""
    basis = Basis.of(*rows, _least(b.x.dtype))
    v = settle(basis.with_products(b), b.x)
    v = settle(v + basis.with_products(b - basis.products(v)), b.x)
    return v + basis.with_products(b - basis.products(v)), basis.regular


def _between(
    f: Vec3, generators: tuple[Vec3, Vec3, Vec3], steep: tuple[Scalar, ...]
) -> tuple[Vec3, Bool[Array, ""], Scalar]:
    """The weights of f in three generators, whether it lies between them (steep: `Several.beyond` of each, by which
    less may be missing), and the least weight's share of all."""
    basis = Basis.of(*generators, _least(f.x.dtype))
    a = settle(basis.weights(f), basis.det)
    a = settle(a + basis.weights(f - basis.total(a)), basis.det)
    total = jnp.abs(a.x) + jnp.abs(a.y) + jnp.abs(a.z)
    share = jnp.minimum(jnp.minimum(a.x, a.y), a.z) / jnp.where(total > 0, total, 1.0)
    rest = f - basis.total(a)
    fits = rest.dot(rest) <= (64 * jnp.finfo(f.x.dtype).eps * total) ** 2
    inside = basis.regular & fits & (f.dot(f) > (faint(f.x.dtype) * total) ** 2)
    for weight, beyond in zip(a, steep, strict=True):
        inside &= beyond * weight >= -clean(f.x.dtype) / 2 * total
    # a weight below zero stays: to the wrench, in which large forces may cancel, it can be more than rounding
    return a, inside, jnp.maximum(share, 0)


def same_twist(dtype) -> float:
    """Two twists that differ by less, relative, are one solution: rounding through a badly conditioned set."""
    return max(1e-6, 10 * clean(dtype))


def faint(dtype) -> float:
    """A wrench this small, of forces of order one that cancel in it, may be nothing but their rounding."""
    return float(jnp.finfo(dtype).eps) ** 0.8


def _least(dtype) -> float:
    """Of a determinant whose inverse is still a number that products of a few can hold."""
    return float(jnp.finfo(dtype).tiny) ** 0.5
