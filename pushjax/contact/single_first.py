"""One contact alone, as an answer to a problem of several: in rollouts mostly one contact does all the work.

The contact that is pressed most is solved as if there were no other (`single`). The result is a solution of the whole
problem if every other contact separates: the other contacts then bear no force, and no condition requires one.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once
from pushjax.contact.contact_plane import Contact
from pushjax.contact.single import SingleSolution, solve_single
from pushjax.contact.status import Status
from pushjax.contact.sticking import ScalarRoot
from pushjax.contact.tolerances import relative_tolerance
from pushjax.friction.limit_surface import Form

# How far a contact has to separate to be left out, in units of the distance that passes as touching.
CLEARANCE = 4


def solve_most_pressed(
    form: Form, contacts: Contact
) -> tuple[Bool[Array, ""], SingleSolution, Bool[Array, "contacts"]]:
    """Return whether the most pressed contact alone gives an answer, its motion, and which contact it is."""
    approach = contacts.approach().x
    is_main = jnp.arange(approach.size) == jnp.argmax(approach)
    one = solve_single(
        form, jax.tree.map(lambda column: jnp.sum(jnp.where(is_main, column, 0.0)), contacts), ScalarRoot()
    )
    twist, length, contacts, approach = jax.lax.stop_gradient((one.twist, form.length, contacts, approach))
    displacement = jnp.abs(contacts.displacement.x) + jnp.abs(contacts.displacement.y)
    size = jnp.abs(twist.x) + jnp.abs(twist.y) + length * jnp.abs(twist.z)
    size = jnp.maximum(size, jnp.max(jnp.maximum(displacement, -contacts.gap)))
    normal_motion = contacts.normal.dot(twist.xy + contacts.point.perp().scale(twist.z))
    # an answer if it moves the slider away from all other contacts, or if no contact is pressed
    clear = normal_motion - approach > CLEARANCE * relative_tolerance(approach.dtype) * size
    answers = jnp.all(clear | is_main) & (one.status == Status.MOVING)
    suffices = jnp.all(contacts.friction >= 0) & (answers | jnp.all(approach <= 0))
    return compute_once(suffices, contacts.gap[0]), one, is_main
