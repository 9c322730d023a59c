"""Several contacts, made dimensionless: what every solver of them starts from.

In the normalised twist (vx, vy, length omega) and wrench (fx, fy, tau / length) a contact is two rows, a_n and a_t: the
slider's contact point moves by (a_n . V, a_t . V) along normal and tangent, and the force (f_n, f_t) is the wrench
f_n a_n + f_t a_t. Its friction cone has two edges, the generators a_n + mu a_t (the pusher slides left) and
a_n - mu a_t (right). Displacements are divided by the fastest pusher's, and H by its size: so tolerances are relative,
and powers of a stiff surface's coefficients stay inside float32.

Generators are numbered 2 i for the left and 2 i + 1 for the right edge of contact i.
"""

import functools
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._vec import Scalar, Vec2, Vec3, select, settle
from pushjax.limit_surface import Form
from pushjax.solve._contact_plane import Contact

Index = int | Int[Array, ""]  # of a contact or generator: known, or a loop's


class SeveralMotion(NamedTuple):
    """The answer, in scalars. twist: (m, m, rad); wrench: normalised, on H = 1; per contact force (n, t) in N, mode."""

    twist: Vec3
    wrench: Vec3
    force: tuple[Vec2, ...]
    mode: tuple[Int[Array, ""], ...]
    status: Int[Array, ""]
    margin: Scalar
    unique: Bool[Array, ""]


class Several(NamedTuple):
    """A contact problem in dimensionless numbers, a tuple entry for each contact.

    normal, tangent: the rows. generators: wrenches of the cones' edges, with unit normal force. approach: what (n,
    t) the contact point must do to stay with its pusher, the gap taken off. speed: the unit of displacement, m.
    size: what H was divided by. pushes: whether any contact would be violated if the slider stayed. valid: whether
    every number was usable; if not, nothing pushes. margin: whether that is asked for, also where there is a motion.
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
        return len(self.friction)

    def beyond(self, contact: Index) -> Scalar:
        """How far a contact's force is beyond its cone, if the weight of one of its edges is minus one."""
        return jnp.maximum(2 * pick(self.friction, contact), 1)

    def slips(self, twist: Vec3) -> tuple[Vec2, ...]:
        """Motion of each contact point relative to its pusher, along normal (the gap added) and tangent."""
        rows = zip(self.normal, self.tangent, self.approach, strict=True)
        return tuple(Vec2(n.dot(twist), t.dot(twist)) - b for n, t, b in rows)


class ContactSolver(eqx.Module):
    """Finds the motion of a slider under several contacts. Settings only; it has no state."""

    @abstractmethod
    def solve(self, problem: Several) -> SeveralMotion:
        """The motion; its derivatives are those of the solution."""


def assemble(
    form: Form, contacts: tuple[Contact, ...], active: tuple[Bool[Array, ""], ...], *, margin: bool
) -> Several:
    """The problem of several contacts; where not all of its numbers are usable, one in which nothing pushes."""
    known = jnp.isfinite(sum(jnp.where(a, sum(jax.tree.leaves(c)), 0.0) for c, a in zip(contacts, active, strict=True)))
    for contact, counts in zip(contacts, active, strict=True):
        known &= (contact.friction >= 0) | ~counts
    zero, one = jnp.zeros_like(contacts[0].gap), jnp.ones_like(contacts[0].gap)
    still = Vec2(zero, zero)
    witness = form.length + sum((c.point.x + c.displacement.x for c in contacts), zero)  # variable, if anything is
    # once, or the sum of everything would be part of every row below
    known, witness = settle((known, witness), witness)
    counts = tuple(settle(known & a, witness) for a in active)
    contacts = tuple(contact.where(a) for a, contact in zip(counts, contacts, strict=True))

    # units, no variables: the answer does not depend on them
    pushers = [select(a, c.displacement, still) for a, c in zip(counts, contacts, strict=True)]
    deepest = [jnp.where(a, -c.gap, 0.0) for a, c in zip(counts, contacts, strict=True)]
    # components first: the square of a small displacement underflows
    component = _largest([jnp.abs(x) for push in pushers for x in push])
    component = jnp.where(component > 0, component, 1.0)
    relative = _largest([push.scale(1 / component).dot(push.scale(1 / component)) for push in pushers])
    speed = jnp.maximum(component * jnp.sqrt(relative), _largest(deepest))
    speed = jax.lax.stop_gradient(jnp.where(speed > 0, speed, 1.0))
    nothing, unit = jnp.zeros_like(form.length), jnp.ones_like(form.length)
    axes = (Vec3(unit, nothing, nothing), Vec3(nothing, unit, nothing), Vec3(nothing, nothing, unit))
    size = jax.lax.stop_gradient(sum((form.value(axis) for axis in axes), nothing))
    # the surface's alone: where a batch shares one, the scaled one stays one too, and is not read for each of it
    size = settle(jnp.where(size > 0, size, 1.0), form.length)
    witness = jnp.where(known, witness, 1.0)
    speed = settle(speed, witness)

    normals, moments, approaches = [], [], []
    for contact in contacts:
        normals.append(contact.wrench(Vec2(one, zero), form.length))
        moments.append(contact.wrench(Vec2(zero, one), form.length).z)
        approaches.append(contact.approach().scale(1 / speed))
    normals, moments, approaches = settle((tuple(normals), tuple(moments), tuple(approaches)), witness)
    tangents = tuple(Vec3(-n.y, n.x, moment) for n, moment in zip(normals, moments, strict=True))
    pushes = jnp.zeros((), bool)
    for a, approach in zip(counts, approaches, strict=True):
        pushes |= a & (approach.x > 0)
    friction = tuple(contact.friction for contact in contacts)
    generators = []
    for n, t, mu in zip(normals, tangents, friction, strict=True):
        generators += [n + t.scale(mu), n - t.scale(mu)]
    generators, pushes = settle((tuple(generators), pushes), witness)
    scaled = form.scaled(1 / size)
    each = (normals, tangents, generators, approaches, friction, counts)
    return Several(scaled, *each, speed, size, pushes, known, margin)


def _largest(values: list[Scalar]) -> Scalar:
    """A constant to every derivative: for units."""
    return functools.reduce(jnp.maximum, jax.lax.stop_gradient(values))


def pick(values: tuple[Any, ...], index: Index) -> Any:
    """values[index], also for an index that a loop runs over: selections, which a batch does in its stride."""
    if isinstance(index, int):
        return values[index]
    chosen = values[0]
    for k, value in enumerate(values[1:], start=1):
        chosen = jax.tree.map(lambda a, b, k=k: jnp.where(index == k, a, b), value, chosen)
    return chosen


def violation(twist: Vec3) -> Scalar:
    """Violation of a kinematic condition, in units of the fastest pusher, that passes: `clean`, and what rounding makes
    of a twist that is much faster than the pushers, as of one squirting out of a wedge: up to 6e-9 in float64. Of one
    too fast to be an answer, what rounding leaves at least."""
    dtype = twist.x.dtype
    eps = float(jnp.finfo(dtype).eps)
    size = jnp.abs(twist.x) + jnp.abs(twist.y) + jnp.abs(twist.z)
    slow = twist.dot(twist) <= fastest(dtype) ** 2
    return jnp.where(slow, jnp.minimum(clean(dtype) + 64 * eps * size, rough(dtype)), 8 * eps * size)


def rough(dtype) -> float:
    """What passes where rounding is magnified, of a slider much faster than its pushers: 6e-9 in float64; in float32
    there are no digits to spare."""
    return clean(dtype) * (15 if jnp.finfo(dtype).bits > 32 else 1)


def fastest(dtype) -> float:
    """Twist, in units of the fastest pusher, of which rounding alone violates a condition by all that is allowed
    (1e-8, in float32 1e-4): no answer. 840 in float32."""
    return (1e-8 if jnp.finfo(dtype).bits > 32 else 1e-4) / float(jnp.finfo(dtype).eps)


HASTY = 8  # times that, a twist is still known to be a motion; beyond, rows that depend by rounding give anything


def clean(dtype) -> float:
    """Violation of a condition, relative to the fastest pusher or the whole force, that passes: 4e-10, or 7e-5 in
    float32."""
    return float(jnp.finfo(dtype).eps) ** 0.6
