"""Several contacts of a hand on its way, of which mostly one does all the work.

The contact that is pressed most is answered alone, as if there were no other (`single`). That is a solution of the
whole problem if every other contact comes apart: it bears no force then, and nothing asks for one. Where one does not,
all are solved together (`exhaustive`), for those examples of a batch only.

Where there are several solutions this one is taken before others, also before one of larger power, which
`solve_contacts` would give: a hand that pushes with one finger goes on pushing with it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._autodiff import undifferentiated
from pushjax._internal.compaction import only_where
from pushjax._vec import Vec2, select, settle
from pushjax.limit_surface import Form
from pushjax.solve._contact_plane import Contact
from pushjax.solve._edge_sets import Found, nothing
from pushjax.solve._finish import finish
from pushjax.solve._several import SeveralMotion, assemble, clean
from pushjax.solve.exhaustive import Exhaustive, enumerate_sets
from pushjax.solve.single import solve_single
from pushjax.solve.sticking import ScalarRoot
from pushjax.status import ContactMode, Status

# How far a contact has to come apart to be out of it, in roundings that pass as touching.
CLEAR = 4

Problem = tuple[Form, tuple[Contact, ...], tuple[Bool[Array, ""], ...]]


# `jit`, here and below, saves tracing: a loop traces and batches its body again until it is known what in it is
# batched, and a `jit` in the body remembers what came of it. The compiler inlines it.
@jax.jit
def single_first(form: Form, contacts: tuple[Contact, ...], active: tuple[Bool[Array, ""], ...]) -> SeveralMotion:
    """The motion of a slider under two or more contacts; its derivatives are those of the solution."""
    return _answered((form, contacts, active))


@eqx.filter_custom_jvp
def _answered(problem: Problem) -> SeveralMotion:
    enough, one = _alone(problem)
    return only_where(~enough, _together, one, problem)


@_answered.def_jvp
def _answered_jvp(primals, tangents):
    return eqx.filter_jvp(_differentiable, primals, tangents)


@jax.jit
def _together(problem: Problem) -> SeveralMotion:
    return Exhaustive().solve(assemble(*problem, margin=False))


def _differentiable(problem: Problem) -> SeveralMotion:
    """The same: where all are solved together, only the search is kept from derivatives."""
    enough, one = _alone(problem)
    found = undifferentiated(_search, enough, problem)
    return select(enough, one, finish(assemble(*problem, margin=False), found, proves_jams=True))


def _search(enough: Bool[Array, ""], problem: Problem) -> Found:
    form, *_ = problem
    return only_where(~enough, _enumerated, nothing(form.length), problem)


@jax.jit
def _enumerated(problem: Problem) -> Found:
    return enumerate_sets(assemble(*problem, margin=False))


def _alone(problem: Problem) -> tuple[Bool[Array, ""], SeveralMotion]:
    """The motion under the contact that is pressed most, and whether it is an answer: it moves the slider away from all
    others, or none is pressed."""
    form, contacts, active = problem
    contacts = tuple(contact.where(a) for contact, a in zip(contacts, active, strict=True))
    pressed = tuple(contact.approach().x for contact in contacts)
    main, most = contacts[0], pressed[0]
    mine = (jnp.ones((), bool),)
    for contact, its in zip(contacts[1:], pressed[1:], strict=True):
        more = settle(its > most, form.length)
        main, most = select(more, contact, main), jnp.where(more, its, most)
        mine = (*(own & ~more for own in mine), more)
    one = solve_single(form, main, ScalarRoot())
    twist, length, given = jax.lax.stop_gradient((one.twist, form.length, contacts))
    size = jnp.abs(twist.x) + jnp.abs(twist.y) + length * jnp.abs(twist.z)
    for contact in given:
        goes = jnp.abs(contact.displacement.x) + jnp.abs(contact.displacement.y)
        size = jnp.maximum(size, jnp.maximum(goes, -contact.gap))
    clear, still, known = (jnp.ones((), bool),) * 3
    for contact, its, own in zip(given, pressed, mine, strict=True):
        away = contact.normal.dot(twist.xy + contact.point.perp().scale(twist.z))
        clear &= (away - its > CLEAR * clean(its.dtype) * size) | own
        still &= its <= 0
        known &= contact.friction >= 0
    enough = settle(known & ((clear & (one.status == Status.MOVING)) | still), form.length)
    zero = jnp.zeros_like(most)
    force = tuple(select(own, one.force, Vec2(zero, zero)) for own in mine)
    mode = tuple(jnp.where(own, one.mode, ContactMode.SEPARATED).astype(jnp.int8) for own in mine)
    motion = SeveralMotion(one.twist, one.wrench, force, mode, one.status, jnp.full_like(most, jnp.inf), one.unique)
    return enough, motion
