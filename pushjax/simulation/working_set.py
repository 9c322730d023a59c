"""The working set: which of a hand's contacts are solved together.

The cost of a contact problem grows with the cube of its number of contacts. But a motion in the plane loads at most
three contacts, and a proof that there is no motion takes four. So if there are more than `MAX_SOLVED` contacts, only
the likeliest are solved, as in an active-set method, and the others are checked against the solution. A contact that
the solution violates joins the set in place of one without force, and the problem is solved again.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.scaled_problem import ScalarSolution

MAX_SOLVED = 4  # a jam is proved by up to four cone edges that balance, which may belong to four contacts
LOADED = 1e6  # m, urgency of a contact that carries a force: above that of any other

# Urgency of having each contact in the set, m: by how much a solution without the contact violates it.
Urgency = Float[Array, " contacts"]


def initial_urgency(counts: list[int], like: Scalar) -> Urgency | None:
    """The urgency before anything has been solved; None if all contacts are solved together.

    Only the order of these numbers has a meaning: the first contacts of all fingers come first, then the second ones.

    Args:
        counts: Number of contacts of each finger and fixture. The contacts of a finger are sorted, the likeliest first.
        like: A scalar of the floating dtype to use.
    """
    if num_solved_together(counts) == sum(counts):
        return None
    return -LOADED * jnp.concatenate([1 + jnp.arange(count, dtype=like.dtype) for count in counts])


def num_solved_together(counts: list[int]) -> int:
    """Number of contacts that are solved together, for fingers with `counts` contacts each."""
    return min(sum(counts), MAX_SOLVED)


class WorkingSet(NamedTuple):
    """The contacts that are solved together.

    Attributes:
        masks: For each contact of the set, a mask over all contacts that marks it; None if all are in the set.
    """

    masks: tuple[Bool[Array, " contacts"], ...] | None

    @staticmethod
    def most_urgent(urgency: Urgency | None, size: int) -> "WorkingSet":
        """The `size` most urgent contacts; ties go to the lower index. All of them if `urgency` is None."""
        if urgency is None:
            return WorkingSet(None)
        index = jnp.arange(urgency.size)
        others, own = urgency[None], urgency[:, None]
        more_urgent = (others > own) | ((others == own) & (index[None] < index[:, None]))
        rank = jnp.sum(more_urgent, axis=1)
        return WorkingSet(tuple(rank == k for k in range(size)))

    def select(self, contacts: tuple[Contact, ...]) -> tuple[Contact, ...]:
        """Select the contacts that are in the set."""
        if self.masks is None:
            return contacts
        rows = jax.tree.map(lambda *entries: jnp.stack(entries), *contacts)
        return tuple(
            jax.tree.map(lambda row, mark=mark: jnp.sum(jnp.where(mark, row, 0.0)), rows) for mark in self.masks
        )

    def spread(self, solution: ScalarSolution, contacts: int) -> ScalarSolution:
        """Extend the motion to all `contacts` contacts; force and mode are zero outside the set."""
        if self.masks is None:
            return solution
        force = [Vec2(jnp.zeros_like(solution.twist.x), jnp.zeros_like(solution.twist.x))] * contacts
        mode = [jnp.zeros_like(solution.mode[0])] * contacts
        for mark, contact_force, contact_mode in zip(self.masks, solution.force, solution.mode, strict=True):
            for k in range(contacts):
                force[k] = force[k] + Vec2(
                    jnp.where(mark[k], contact_force.x, 0.0), jnp.where(mark[k], contact_force.y, 0.0)
                )
                mode[k] = jnp.where(mark[k], contact_mode, mode[k])
        return solution._replace(force=tuple(force), mode=tuple(mode))


def violations(contacts: tuple[Contact, ...], twist: Vec3, force: tuple[Vec2, ...]) -> Urgency:
    """Violation of each contact by a twist, m, to first order; `LOADED` for a contact that carries a force.

    Not differentiated.
    """
    urgency = []
    for contact, contact_force in zip(contacts, force, strict=True):
        relative_motion = twist.xy + contact.point.perp().scale(twist.z) - contact.displacement
        urgency.append(jnp.where(contact_force.x > 0, LOADED, -(contact.gap + contact.normal.dot(relative_motion))))
    return jax.lax.stop_gradient(jnp.stack(urgency))
