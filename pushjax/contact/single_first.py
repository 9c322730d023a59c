"""Solver of several contacts for a hand on its way, where mostly one contact does all the work.

The contact that is pressed most is solved alone, as if there were no other (`single`). The result is a solution of the
whole problem if every other contact separates: the other contacts then bear no force, and no condition requires one. If
another contact does not separate, all are solved together (`exhaustive`). In a batch, only the examples that need it
are.

Where there are several solutions, this one is taken first, even if another has larger power, which `solve_contacts`
would give. So a hand that pushes with one finger goes on pushing with it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.compaction import only_where
from pushjax._internal.xla import decide, tree_where
from pushjax._math.vec import Vec2
from pushjax.contact.contact_plane import Contact
from pushjax.contact.edge_sets import Incumbent, no_incumbent
from pushjax.contact.exhaustive import Exhaustive, enumerate_sets
from pushjax.contact.refinement import refine_and_check
from pushjax.contact.scaled_problem import ScalarSolution, nondimensionalize
from pushjax.contact.single import solve_single
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import ScalarRoot
from pushjax.contact.tolerances import relative_tolerance
from pushjax.friction.limit_surface import Form

# How far a contact has to separate to be left out, in units of the distance that passes as touching.
CLEAR = 4

Problem = tuple[Form, tuple[Contact, ...], tuple[Bool[Array, ""], ...]]


# `jit`, here and below, saves tracing time. A loop traces and batches its body again until it is known which of its
# values are batched, and a `jit` in the body caches the result. The compiler inlines it.
@jax.jit
def single_first(form: Form, contacts: tuple[Contact, ...], active: tuple[Bool[Array, ""], ...]) -> ScalarSolution:
    """Compute the motion of a slider under two or more contacts.

    Args:
        form: H of the limit surface, in scalars.
        contacts: The contacts, in the body frame.
        active: For each contact, False if it is only padding.

    Returns:
        The motion. Its derivatives are those of the solution, not of the search. The margin is infinite where there is
        a motion.
    """
    return _answered((form, contacts, active))


@eqx.filter_custom_jvp
def _answered(problem: Problem) -> ScalarSolution:
    """The motion; all contacts are solved together only where one alone is not enough."""
    enough, one = _alone(problem)
    return only_where(~enough, _together, one, problem)


@_answered.def_jvp
def _answered_jvp(primals, tangents):
    return eqx.filter_jvp(_differentiable, primals, tangents)


@jax.jit
def _together(problem: Problem) -> ScalarSolution:
    """The motion under all contacts."""
    return Exhaustive().solve(nondimensionalize(*problem, margin=False))


def _differentiable(problem: Problem) -> ScalarSolution:
    """`_answered` in a form that is differentiated.

    Where all contacts are solved together, only the search is kept from differentiation.
    """
    enough, one = _alone(problem)
    found = without_derivatives(_search, enough, problem)
    return tree_where(enough, one, refine_and_check(nondimensionalize(*problem, margin=False), found, proves_jams=True))


def _search(enough: Bool[Array, ""], problem: Problem) -> Incumbent:
    """The best set of cone edges, where one contact alone is not enough."""
    form, *_ = problem
    return only_where(~enough, _enumerated, no_incumbent(form.length), problem)


@jax.jit
def _enumerated(problem: Problem) -> Incumbent:
    """The best set of cone edges."""
    return enumerate_sets(nondimensionalize(*problem, margin=False))


def _alone(problem: Problem) -> tuple[Bool[Array, ""], ScalarSolution]:
    """Solve the contact that is pressed most, as if it were alone.

    Returns:
        Whether the motion is an answer: it moves the slider away from all other contacts, or no contact is pressed. And
        the motion.
    """
    form, contacts, active = problem
    contacts = tuple(contact.where(a) for contact, a in zip(contacts, active, strict=True))
    pressed = tuple(contact.approach().x for contact in contacts)
    main, most = contacts[0], pressed[0]
    mine = (jnp.ones((), bool),)
    for contact, its in zip(contacts[1:], pressed[1:], strict=True):
        more = decide(its > most, form.length)
        main, most = tree_where(more, contact, main), jnp.where(more, its, most)
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
        clear &= (away - its > CLEAR * relative_tolerance(its.dtype) * size) | own
        still &= its <= 0
        known &= contact.friction >= 0
    enough = decide(known & ((clear & (one.status == Status.MOVING)) | still), form.length)
    zero = jnp.zeros_like(most)
    force = tuple(tree_where(own, one.force, Vec2(zero, zero)) for own in mine)
    mode = tuple(jnp.where(own, one.mode, ContactMode.SEPARATED).astype(jnp.int8) for own in mine)
    motion = ScalarSolution(one.twist, one.wrench, force, mode, one.status, jnp.full_like(most, jnp.inf), one.unique)
    return enough, motion
