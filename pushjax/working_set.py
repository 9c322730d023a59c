"""The working set: which of the places that a hand may touch are solved together.

A contact problem costs the cube of its contacts, but a motion in the plane loads three at most, and to prove that
there is none takes four. So of more places than `MOST` the likeliest are solved, as in an active-set method, and the
others are checked against the answer. What it violates joins, in place of what bore nothing, and the problem is solved
again.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._vec import Scalar, Vec2, Vec3
from pushjax.solve import Contact, SeveralMotion

MOST = 4  # edges of friction cones that hold each other in balance, at most; each may be of another contact
LOADED = 1e6  # m, the urgency of a contact that bears a force: above that of any other

# How urgent it is that each contact is in the set, m: by how much an answer without it violates it.
Urgency = Float[Array, " contacts"]


def likeliest(counts: list[int], like: Scalar) -> Urgency | None:
    """The urgency before anything is solved, of fingers with so many places each, the likeliest first; None if all are
    solved together."""
    if together(counts) == sum(counts):
        return None
    return -LOADED * jnp.concatenate([1 + jnp.arange(each, dtype=like.dtype) for each in counts])


def together(counts: list[int]) -> int:
    """How many contacts are solved together."""
    return min(sum(counts), MOST)


class WorkingSet(NamedTuple):
    """member: for each of those that are solved together, which contact it is; None if all are."""

    member: tuple[Bool[Array, " contacts"], ...] | None

    @staticmethod
    def most_urgent(urgency: Urgency | None, size: int) -> "WorkingSet":
        if urgency is None:
            return WorkingSet(None)
        index = jnp.arange(urgency.size)
        row, column = urgency[None], urgency[:, None]
        before = (row > column) | ((row == column) & (index[None] < index[:, None]))
        rank = jnp.sum(before, axis=1)
        return WorkingSet(tuple(rank == k for k in range(size)))

    def of(self, contacts: tuple[Contact, ...]) -> tuple[Contact, ...]:
        """Those that are in it."""
        if self.member is None:
            return contacts
        rows = jax.tree.map(lambda *entries: jnp.stack(entries), *contacts)
        return tuple(
            jax.tree.map(lambda row, mark=mark: jnp.sum(jnp.where(mark, row, 0.0)), rows) for mark in self.member
        )

    def spread(self, motion: SeveralMotion, contacts: int) -> SeveralMotion:
        """The motion with a force and a mode for every contact; nothing acts at those that are not in it."""
        if self.member is None:
            return motion
        force = [Vec2(jnp.zeros_like(motion.twist.x), jnp.zeros_like(motion.twist.x))] * contacts
        mode = [jnp.zeros_like(motion.mode[0])] * contacts
        for mark, f, m in zip(self.member, motion.force, motion.mode, strict=True):
            for k in range(contacts):
                force[k] = force[k] + Vec2(jnp.where(mark[k], f.x, 0.0), jnp.where(mark[k], f.y, 0.0))
                mode[k] = jnp.where(mark[k], m, mode[k])
        return motion._replace(force=tuple(force), mode=tuple(mode))


def violated(contacts: tuple[Contact, ...], twist: Vec3, force: tuple[Vec2, ...]) -> Urgency:
    """By how much each contact is violated by a twist, m, to first order; of one that bears a force `LOADED`."""
    found = []
    for contact, f in zip(contacts, force, strict=True):
        away = twist.xy + contact.point.perp().scale(twist.z) - contact.displacement
        found.append(jnp.where(f.x > 0, LOADED, -(contact.gap + contact.normal.dot(away))))
    return jax.lax.stop_gradient(jnp.stack(found))
