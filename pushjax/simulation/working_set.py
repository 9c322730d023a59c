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

from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.problem import ScalarSolution
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

    masks: tuple[Bool[Array, " contacts"], ...] | None  # one for each contact of the set; None if all are in it

    @staticmethod
    def most_urgent(urgency: Urgency | None, size: int) -> "WorkingSet":
        """Return the `size` most urgent contacts; ties go to the lower index. All of them if `urgency` is None."""
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

    def local(self, guess: EdgeSet) -> EdgeSet:
        """Number a set of cone edges by the contacts in this set; return none if one of them is not in it."""
        if self.masks is None:
            return guess
        masks, index = jnp.stack(self.masks), jnp.arange(self.masks[0].size)
        slots = jnp.arange(len(self.masks), dtype=jnp.int32)

        def slot_of(contact: Int[Array, "3"]) -> Int[Array, "3"]:
            is_slot = jnp.any((contact[:, None] == index[None])[:, None] & masks[None], axis=2)
            number = jnp.sum(jnp.where(is_slot, slots[None], 0), axis=1, dtype=jnp.int32)
            return jnp.where(jnp.any(is_slot, axis=1), number, NO_EDGE)

        owner, contact = slot_of(guess.edges // 2), slot_of(guess.contacts)
        complete = jnp.all((owner >= 0) | (guess.edges < 0)) & jnp.all((contact >= 0) | (guess.contacts < 0))
        edges = jnp.where(complete & (owner >= 0), 2 * owner + guess.edges % 2, NO_EDGE)
        return EdgeSet(edges, jnp.where(complete, contact, NO_EDGE), guess.weight)

    def spread_edges(self, best: EdgeSet) -> EdgeSet:
        """Number a set of cone edges by all contacts: the reverse of `local`."""
        if self.masks is None:
            return best
        numbers = jnp.stack([jnp.argmax(mask).astype(jnp.int32) for mask in self.masks])
        slots = jnp.arange(len(self.masks))

        def number_of(slot: Int[Array, "3"]) -> Int[Array, "3"]:
            number = jnp.sum(jnp.where(slot[:, None] == slots[None], numbers[None], 0), axis=1, dtype=jnp.int32)
            return jnp.where(slot >= 0, number, NO_EDGE)

        owner = number_of(best.edges // 2)
        edges = jnp.where(owner >= 0, 2 * owner + best.edges % 2, NO_EDGE)
        return EdgeSet(edges, number_of(best.contacts), best.weight)

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
        best = None if solution.best is None else self.spread_edges(solution.best)
        return solution._replace(force=tuple(force), mode=tuple(mode), best=best)


def violations(contacts: tuple[Contact, ...], twist: Vec3, force: tuple[Vec2, ...]) -> Urgency:
    """Violation of each contact by a twist, m, to first order; `LOADED` for a contact that carries a force."""
    urgency = []
    for contact, contact_force in zip(contacts, force, strict=True):
        relative_motion = twist.xy + contact.point.perp().scale(twist.z) - contact.displacement
        urgency.append(jnp.where(contact_force.x > 0, LOADED, -(contact.gap + contact.normal.dot(relative_motion))))
    return jax.lax.stop_gradient(jnp.stack(urgency))
