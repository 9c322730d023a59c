"""Solver of several contacts for rollouts, in which mostly one contact does all the work.

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
from pushjax._internal.compaction import where_needed_without_derivatives
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
CLEARANCE = 4

# H of the limit surface, the contacts, and for each contact whether it is active.
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
    return _solve_one_first((form, contacts, active))


@eqx.filter_custom_jvp
def _solve_one_first(problem: Problem) -> ScalarSolution:
    """Solve one contact alone, and all contacts together only where one is not enough."""
    one_suffices, one = _solve_most_pressed(problem)
    return where_needed_without_derivatives(~one_suffices, _together, one, problem)


@_solve_one_first.def_jvp
def _solve_one_first_jvp(primals, tangents):
    return eqx.filter_jvp(_solve_differentiably, primals, tangents)


@jax.jit
def _together(problem: Problem) -> ScalarSolution:
    """The motion under all contacts."""
    return Exhaustive().solve(nondimensionalize(*problem, margin=False))


def _solve_differentiably(problem: Problem) -> ScalarSolution:
    """`_solve_one_first` in a form that JAX can differentiate.

    Where all contacts are solved together, only the search is kept from differentiation.
    """
    one_suffices, one = _solve_most_pressed(problem)
    found = without_derivatives(_search, one_suffices, problem)
    return tree_where(
        one_suffices, one, refine_and_check(nondimensionalize(*problem, margin=False), found, proves_jams=True)
    )


def _search(one_suffices: Bool[Array, ""], problem: Problem) -> Incumbent:
    """The best set of cone edges, where one contact alone is not enough."""
    form, *_ = problem
    return where_needed_without_derivatives(~one_suffices, _enumerated, no_incumbent(form.length), problem)


@jax.jit
def _enumerated(problem: Problem) -> Incumbent:
    """The best set of cone edges."""
    return enumerate_sets(nondimensionalize(*problem, margin=False))


def _solve_most_pressed(problem: Problem) -> tuple[Bool[Array, ""], ScalarSolution]:
    """Solve the contact that is pressed most, as if it were alone.

    Returns:
        Whether the motion is an answer: it moves the slider away from all other contacts, or no contact is pressed. And
        the motion.
    """
    form, contacts, active = problem
    contacts = tuple(contact.where(a) for contact, a in zip(contacts, active, strict=True))
    approaches = tuple(contact.approach().x for contact in contacts)
    main, deepest = contacts[0], approaches[0]
    is_main = (jnp.ones((), bool),)
    for contact, approach in zip(contacts[1:], approaches[1:], strict=True):
        deeper = decide(approach > deepest, form.length)
        main, deepest = tree_where(deeper, contact, main), jnp.where(deeper, approach, deepest)
        is_main = (*(is_own & ~deeper for is_own in is_main), deeper)
    one = solve_single(form, main, ScalarRoot())
    twist, length, constant_contacts = jax.lax.stop_gradient((one.twist, form.length, contacts))
    size = jnp.abs(twist.x) + jnp.abs(twist.y) + length * jnp.abs(twist.z)
    for contact in constant_contacts:
        displacement = jnp.abs(contact.displacement.x) + jnp.abs(contact.displacement.y)
        size = jnp.maximum(size, jnp.maximum(displacement, -contact.gap))
    all_clear, none_pressed, valid = (jnp.ones((), bool),) * 3
    for contact, approach, is_own in zip(constant_contacts, approaches, is_main, strict=True):
        normal_motion = contact.normal.dot(twist.xy + contact.point.perp().scale(twist.z))
        all_clear &= (normal_motion - approach > CLEARANCE * relative_tolerance(approach.dtype) * size) | is_own
        none_pressed &= approach <= 0
        valid &= contact.friction >= 0
    one_suffices = decide(valid & ((all_clear & (one.status == Status.MOVING)) | none_pressed), form.length)
    zero = jnp.zeros_like(deepest)
    force = tuple(tree_where(is_own, one.force, Vec2(zero, zero)) for is_own in is_main)
    mode = tuple(jnp.where(is_own, one.mode, ContactMode.SEPARATED).astype(jnp.int8) for is_own in is_main)
    motion = ScalarSolution(one.twist, one.wrench, force, mode, one.status, jnp.full_like(deepest, jnp.inf), one.unique)
    return one_suffices, motion
