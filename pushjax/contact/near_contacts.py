"""The motion of several sliders by the contacts that are near enough to matter.

Among many sliders, most contacts are far from closing in a step. They are left out at first. If the motion that is
found would close one of them, the problem is solved again with all contacts.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.trailing_batch import tree_where_last
from pushjax.contact.several_sliders import SlidersMotion, Start, solve_all
from pushjax.contact.sliders_problem import SlidersProblem
from pushjax.contact.status import Status

# Of this many contacts and more, those farther than a multiple of the largest displacement are left out at first.
MANY_CONTACTS, FAR = 8, 3.0


def solve_sliders(
    problem: SlidersProblem, start: Start | None = None, anew: Bool[Array, ""] | bool = True
) -> SlidersMotion:
    """Find the motion of several sliders; it is not differentiated. All numbers are zero where they do not move.

    If not `anew`, only Newton steps are made, with the unknowns that may be positive at `start`.
    """
    problem, valid = problem.usable()
    if start is None:
        start = Start.none(problem.count, jnp.zeros_like(problem.rows[0, 0, :, 0]))
    start = Start(*(jnp.broadcast_to(x, (*x.shape[:-1], *valid.shape)) for x in start))
    given = start, valid, jnp.asarray(anew)
    if problem.count < MANY_CONTACTS:
        return solve_all(problem, *given)
    # of many contacts, most are too far to matter; whether they are is checked
    few, near = -(-problem.count // 2), problem.active & (problem.goal[0] > -FAR)

    def attempt(state: tuple[SlidersMotion, Array, Array]) -> tuple[SlidersMotion, Array, Array]:
        found, wanted, takes_all = state
        part = problem.of_contacts((near | takes_all) & wanted[None] & problem.active)
        are_few = jnp.all(jnp.sum(part.active, axis=0) <= few)
        new = jax.lax.cond(are_few, partial(_solve_few, few), solve_all, part, *given)
        closes = problem.active & ~near & (problem.slips(new.twist)[0] < 0)
        misses = wanted & (new.status == Status.MOVING) & jnp.any(closes, axis=0)
        return tree_where_last(wanted, new, found), misses & ~takes_all, takes_all | True

    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(solve_all, problem, *given))
    first = blank, valid | True, jnp.zeros((), bool)
    return jax.lax.while_loop(lambda state: jnp.any(state[1]), attempt, first)[0]


def _solve_few(
    few: int, problem: SlidersProblem, start: Start, valid: Bool[Array, " batch"], anew: Bool[Array, ""]
) -> SlidersMotion:
    """The motion by the `few` first of the active contacts alone, given that there are no others."""
    index = jnp.argsort(~problem.active, axis=0, stable=True)[:few]

    def own(x: Array) -> Array:
        return jnp.take_along_axis(x, index.reshape(*(1,) * (x.ndim - 2), *index.shape), axis=-2)

    def spread(x: Array, full: Array) -> Array:
        places = jnp.broadcast_to(index.reshape(*(1,) * (x.ndim - 2), *index.shape), x.shape)
        return jnp.put_along_axis(jnp.zeros_like(full), places, x, axis=-2, inplace=False)

    def of_contacts(basic: Array, count: int) -> Array:
        return basic[: 3 * count].reshape(3, count, -1)

    own_basic = own(of_contacts(start.basic, problem.count)).reshape(3 * few, -1)
    basic = jnp.concatenate([own_basic, start.basic[3 * problem.count :]])
    part = problem._replace(
        rows=own(problem.rows), goal=own(problem.goal), friction=own(problem.friction), active=own(problem.active)
    )
    found = solve_all(part, start._replace(force=own(start.force), basic=basic), valid, anew)
    all_basic = spread(of_contacts(found.basic, few), of_contacts(start.basic, problem.count))
    return found._replace(
        force=spread(found.force, problem.goal),
        mode=spread(found.mode, problem.active.astype(found.mode.dtype)),  # 0 is SEPARATED
        basic=jnp.concatenate([all_basic.reshape(3 * problem.count, -1), found.basic[3 * few :]]),
    )
