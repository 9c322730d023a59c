"""One contact alone, as an answer to a problem of several: in rollouts mostly one contact does all the work.

The contact that is pressed most is solved as if there were no other (`single`). The result is a solution of the whole
problem if every other contact separates: the other contacts then bear no force, and no condition requires one.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import decide, tree_where
from pushjax.contact.contact_plane import Contact
from pushjax.contact.single import SingleSolution, solve_single
from pushjax.contact.status import Status
from pushjax.contact.sticking import ScalarRoot
from pushjax.contact.tolerances import relative_tolerance
from pushjax.friction.limit_surface import Form

# How far a contact has to separate to be left out, in units of the distance that passes as touching.
CLEARANCE = 4


def solve_most_pressed(
    form: Form, contacts: tuple[Contact, ...]
) -> tuple[Bool[Array, ""], SingleSolution, tuple[Bool[Array, ""], ...]]:
    """Solve the contact that is pressed most, as if it were alone.

    Returns:
        Whether the motion is an answer: it moves the slider away from all other contacts, or no contact is pressed.
        Then the motion, and for each contact whether it is the one.
    """
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
    suffices = valid & ((all_clear & (one.status == Status.MOVING)) | none_pressed)
    return decide(suffices, contacts[0].gap), one, is_main
