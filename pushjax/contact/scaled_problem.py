"""The dimensionless problem of several contacts, from which every solver of several contacts starts.

With the normalized twist (vx, vy, length omega) and wrench (fx, fy, tau / length), a contact is two rows, a_n and a_t.
The slider's contact point moves by (a_n . V, a_t . V) along normal and tangent, and the force (f_n, f_t) has the wrench
f_n a_n + f_t a_t. The friction cone has two edges. Their wrenches are the generators a_n + mu a_t (the pusher slides
left) and a_n - mu a_t (right).

Displacements are divided by that of the fastest pusher, and H by its size. So tolerances are relative, and powers of a
stiff surface's coefficients stay within the range of float32.

Generators are numbered 2 i for the left and 2 i + 1 for the right edge of contact i.
"""

import functools
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.friction.limit_surface import Form

Index = int | Int[Array, ""]  # of a contact or generator: a Python integer, or traced in a loop


class ScalarSolution(NamedTuple):
    """The answer to a contact problem, in scalars.

    Attributes:
        twist: Twist of the slider over the step (m, m, rad).
        wrench: Normalized wrench on H = 1.
        force: For each contact, the force along (normal, tangent), N.
        mode: For each contact, its `ContactMode`.
        status: `Status`.
        margin: Minus the hand's squeeze power, m, as in `Motion`.
        unique: False where the solver found another twist that satisfies every condition.
    """

    twist: Vec3
    wrench: Vec3
    force: tuple[Vec2, ...]
    mode: tuple[Int[Array, ""], ...]
    status: Int[Array, ""]
    margin: Scalar
    unique: Bool[Array, ""]


class ScaledProblem(NamedTuple):
    """A contact problem in dimensionless numbers, with one tuple entry for each contact.

    Attributes:
        form: H, divided by `size`.
        normal: The rows a_n.
        tangent: The rows a_t.
        generators: Wrenches of the friction cones' edges with unit normal force, two for each contact.
        approach: Displacement (n, t) of the slider's contact point that keeps it with its pusher, the gap subtracted.
        friction: Coefficients of friction mu.
        active: Whether the contact takes part: False for padding, and for every contact if the problem is not valid.
        speed: Unit of displacement, m: that of the fastest pusher or the largest penetration depth, if that is larger.
        size: Number by which H was divided.
        pushes: Whether any contact would be violated if the slider stayed.
        valid: Whether every number is finite and no friction negative. If not, nothing pushes.
        margin: Whether the margin is wanted also where there is a motion.
    """

    form: Form
    normal: tuple[Vec3, ...]
    tangent: tuple[Vec3, ...]
    generators: tuple[Vec3, ...]
    approach: tuple[Vec2, ...]
    friction: tuple[Scalar, ...]
    active: tuple[Bool[Array, ""], ...]
    speed: Scalar
    size: Scalar
    pushes: Bool[Array, ""]
    valid: Bool[Array, ""]
    margin: bool

    @property
    def count(self) -> int:
        """Number of contacts."""
        return len(self.friction)

    def beyond(self, contact: Index) -> Scalar:
        """How far a contact's force is outside its cone if one of its edges has weight minus one."""
        return jnp.maximum(2 * dynamic_index(self.friction, contact), 1)

    def slips(self, twist: Vec3) -> tuple[Vec2, ...]:
        """Motion of each contact point relative to its pusher, along normal (the gap added) and tangent."""
        rows = zip(self.normal, self.tangent, self.approach, strict=True)
        return tuple(Vec2(n.dot(twist), t.dot(twist)) - b for n, t, b in rows)


class ContactSolver(eqx.Module):
    """Finds the motion of a slider under several contacts. It has settings only, no state."""

    @abstractmethod
    def solve(self, problem: ScaledProblem) -> ScalarSolution:
        """Solve a dimensionless contact problem.

        Args:
            problem: The contact problem.

        Returns:
            The motion. Its derivatives are those of the solution, not of the search.
        """


def nondimensionalize(
    form: Form, contacts: tuple[Contact, ...], active: tuple[Bool[Array, ""], ...], *, margin: bool
) -> ScaledProblem:
    """Make a problem of several contacts dimensionless.

    Args:
        form: H of the limit surface, in scalars.
        contacts: The contacts, in the body frame.
        active: For each contact, False if it is only padding.
        margin: Whether the margin is wanted also where there is a motion.

    Returns:
        The dimensionless problem. If a number of an active contact is not finite, or its friction is negative, `valid`
        is False and nothing pushes.
    """
    known = jnp.isfinite(sum(jnp.where(a, sum(jax.tree.leaves(c)), 0.0) for c, a in zip(contacts, active, strict=True)))
    for contact, counts in zip(contacts, active, strict=True):
        known &= (contact.friction >= 0) | ~counts
    zero, one = jnp.zeros_like(contacts[0].gap), jnp.ones_like(contacts[0].gap)
    still = Vec2(zero, zero)
    like = form.length + sum((c.point.x + c.displacement.x for c in contacts), zero)  # traced, if any input is
    # computed once, or the sum over all inputs would be recomputed for every row below
    known, like = compute_once((known, like), like)
    counts = tuple(decide(known & a, like) for a in active)
    contacts = tuple(contact.where(a) for a, contact in zip(counts, contacts, strict=True))

    # units are constants to every derivative: the answer does not depend on them
    pushers = [tree_where(a, c.displacement, still) for a, c in zip(counts, contacts, strict=True)]
    deepest = [jnp.where(a, -c.gap, 0.0) for a, c in zip(counts, contacts, strict=True)]
    # divide by the largest component first: the square of a small displacement underflows
    component = _largest([jnp.abs(x) for push in pushers for x in push])
    component = jnp.where(component > 0, component, 1.0)
    relative = _largest([push.scale(1 / component).dot(push.scale(1 / component)) for push in pushers])
    speed = jnp.maximum(component * jnp.sqrt(relative), _largest(deepest))
    speed = jax.lax.stop_gradient(jnp.where(speed > 0, speed, 1.0))
    nothing, unit = jnp.zeros_like(form.length), jnp.ones_like(form.length)
    axes = (Vec3(unit, nothing, nothing), Vec3(nothing, unit, nothing), Vec3(nothing, nothing, unit))
    size = jax.lax.stop_gradient(sum((form.value(axis) for axis in axes), nothing))
    # This depends on the surface alone. So a batch that shares one surface also shares the scaled one, which is not
    # read again for each example.
    size = compute_once(jnp.where(size > 0, size, 1.0), form.length)
    like = jnp.where(known, like, 1.0)
    speed = compute_once(speed, like)

    normals, moments, approaches = [], [], []
    for contact in contacts:
        normals.append(contact.wrench(Vec2(one, zero), form.length))
        moments.append(contact.wrench(Vec2(zero, one), form.length).z)
        approaches.append(contact.approach().scale(1 / speed))
    normals, moments, approaches = compute_once((tuple(normals), tuple(moments), tuple(approaches)), like)
    tangents = tuple(Vec3(-n.y, n.x, moment) for n, moment in zip(normals, moments, strict=True))
    pushes = jnp.zeros((), bool)
    for a, approach in zip(counts, approaches, strict=True):
        pushes |= a & (approach.x > 0)
    friction = tuple(contact.friction for contact in contacts)
    generators = []
    for n, t, mu in zip(normals, tangents, friction, strict=True):
        generators += [n + t.scale(mu), n - t.scale(mu)]
    generators, pushes = compute_once((tuple(generators), pushes), like)
    scaled = form.scaled(1 / size)
    each = (normals, tangents, generators, approaches, friction, counts)
    return ScaledProblem(scaled, *each, speed, size, pushes, known, margin)


def _largest(values: list[Scalar]) -> Scalar:
    """The largest of some values, a constant to every derivative; for units."""
    return functools.reduce(jnp.maximum, jax.lax.stop_gradient(values))


def dynamic_index(values: tuple[Any, ...], index: Index) -> Any:
    """`values[index]`, also for an index that a loop runs over: by selections, which cost a batch little."""
    if isinstance(index, int):
        return values[index]
    chosen = values[0]
    for k, value in enumerate(values[1:], start=1):
        chosen = jax.tree.map(lambda a, b, k=k: jnp.where(index == k, a, b), value, chosen)
    return chosen
