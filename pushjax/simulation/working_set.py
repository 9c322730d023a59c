"""The working set: which of a hand's contacts are solved together.

The cost of a contact problem grows with the cube of its number of contacts. But a motion in the plane loads at most
three contacts, and a proof that there is no motion takes four. So if there are more than `MAX_SOLVED` contacts, only
the likeliest are solved, as in an active-set method, and the others are checked against the solution. A contact that
the solution violates joins the set in place of one without force, and the problem is solved again.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._math.vec import Scalar
from pushjax.contact.contact_plane import Contact
from pushjax.contact.problem import ContactSolution
from pushjax.contact.scaled_problem import NO_EDGE, EdgeSet

MAX_SOLVED = 4  # a jam is proved by up to four cone edges that balance, which may belong to four contacts
LOADED = 1e6  # m, urgency of a contact that carries a force: above that of any other

# Urgency of having each contact in the set, m: by how much a solution without the contact violates it.
Urgency = Float[Array, " contacts"]


def initial_urgency(counts: list[int], like: Scalar) -> Urgency | None:
    """Return the urgency before the first solve: the first contacts of all fingers come first, then the second ones."""
    # Only the order of these numbers has a meaning. The contacts of a finger are sorted, the likeliest first.
    if num_solved_together(counts) == sum(counts):
        return None
    return -LOADED * jnp.concatenate([1 + jnp.arange(count, dtype=like.dtype) for count in counts])


def num_solved_together(counts: list[int]) -> int:
    """Return the number of contacts that are solved together, for fingers with `counts` contacts each."""
    return min(sum(counts), MAX_SOLVED)


class WorkingSet(NamedTuple):
    """The contacts that are solved together."""

    masks: Bool[Array, "solved contacts"] | None  # one row for each contact of the set; None if all are in it

    @staticmethod
    def most_urgent(urgency: Urgency | None, size: int) -> "WorkingSet":
        """Return the `size` most urgent contacts; ties go to the lower index. All of them if `urgency` is None."""
        if urgency is None:
            return WorkingSet(None)
        index = jnp.arange(urgency.size)
        others, own = urgency[None], urgency[:, None]
        more_urgent = (others > own) | ((others == own) & (index[None] < index[:, None]))
        rank = jnp.sum(more_urgent, axis=1)
        return WorkingSet(rank[None] == jnp.arange(size)[:, None])

    def select(self, contacts: Contact, active: Bool[Array, "contacts"]) -> tuple[Contact, Bool[Array, "solved"]]:
        """Select the contacts that are in the set."""
        if self.masks is None:
            return contacts, active
        masks = self.masks
        selected = jax.tree.map(lambda column: jnp.sum(jnp.where(masks, column[None], 0.0), axis=1), contacts)
        return selected, jnp.any(masks & active[None], axis=1)

    def local(self, guess: EdgeSet) -> EdgeSet:
        """Number a set of cone edges by the contacts in this set; return none if one of them is not in it."""
        if self.masks is None:
            return guess
        masks, index = self.masks, jnp.arange(self.masks.shape[1])
        slots = jnp.arange(len(self.masks), dtype=jnp.int32)

        def renumbered(numbers: Int[Array, "3"]) -> Int[Array, "3"]:
            is_slot = jnp.any(((numbers >> 1)[:, None] == index[None])[:, None] & masks[None], axis=2)
            slot = jnp.sum(jnp.where(is_slot, slots[None], 0), axis=1, dtype=jnp.int32)
            return jnp.where(jnp.any(is_slot, axis=1), 2 * slot + (numbers & 1), NO_EDGE)

        edges, conditions = renumbered(guess.edges), renumbered(guess.conditions)
        complete = jnp.all((edges >= 0) | (guess.edges < 0)) & jnp.all((conditions >= 0) | (guess.conditions < 0))
        edges, conditions = (jnp.where(complete, numbers, NO_EDGE) for numbers in (edges, conditions))
        return EdgeSet(edges, conditions, guess.weight)

    def spread_edges(self, best: EdgeSet) -> EdgeSet:
        """Number a set of cone edges by all contacts: the reverse of `local`."""
        if self.masks is None:
            return best
        contacts = jnp.argmax(self.masks, axis=1).astype(jnp.int32)
        slots = jnp.arange(len(self.masks))

        def renumbered(numbers: Int[Array, "3"]) -> Int[Array, "3"]:
            is_slot = (numbers >> 1)[:, None] == slots[None]
            contact = jnp.sum(jnp.where(is_slot, contacts[None], 0), axis=1, dtype=jnp.int32)
            return jnp.where(numbers >= 0, 2 * contact + (numbers & 1), NO_EDGE)

        return EdgeSet(renumbered(best.edges), renumbered(best.conditions), best.weight)

    def spread(self, solution: ContactSolution) -> ContactSolution:
        """Extend the motion to all contacts; force and mode are zero outside the set."""
        if self.masks is None:
            return solution
        masks = self.masks
        force = jax.tree.map(lambda f: jnp.sum(jnp.where(masks, f[:, None], 0.0), axis=0), solution.force)
        mode = jnp.sum(jnp.where(self.masks, solution.mode[:, None], 0), axis=0, dtype=solution.mode.dtype)
        best = None if solution.best is None else self.spread_edges(solution.best)
        return solution._replace(force=force, mode=mode, best=best)


def violations(contacts: Contact, active: Bool[Array, "contacts"], solution: ContactSolution) -> Urgency:
    """Violation of each contact by a motion, m, to first order; `LOADED` for a contact that carries a force."""
    twist = solution.twist
    relative_motion = twist.xy + contacts.point.perp().scale(twist.z) - contacts.displacement
    violation = -(contacts.gap + contacts.normal.dot(relative_motion))
    loaded = jnp.where(solution.force.x > 0, LOADED, jnp.where(active, violation, -LOADED))
    return jax.lax.stop_gradient(loaded)
