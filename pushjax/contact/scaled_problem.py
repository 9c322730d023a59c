"""The dimensionless problem of several contacts, from which every solver of several contacts starts.

With the normalized twist (vx, vy, length omega) and wrench (fx, fy, tau / length), a contact is two rows, a_n and a_t.
The slider's contact point moves by (a_n . V, a_t . V) along normal and tangent, and the force (f_n, f_t) has the wrench
f_n a_n + f_t a_t. The friction cone has two edges. Their wrenches are the generators a_n + mu a_t (the pusher slides
left) and a_n - mu a_t (right).

Displacements are divided by the longest displacement of a pusher, and H by the sum of its values at the three unit
wrenches. So tolerances are relative, and powers of the coefficients of H stay within the range of float32.

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
        form: H, divided by `form_scale`.
        normal: The rows a_n.
        tangent: The rows a_t.
        generators: Wrenches of the friction cones' edges with unit normal force, two for each contact.
        approach: Displacement (n, t) of the slider's contact point that keeps it with its pusher, the gap subtracted.
        friction: Coefficients of friction mu.
        active: Whether the contact takes part: False for padding, and for every contact if the problem is not valid.
        displacement_unit: Unit of displacement, m: the longest displacement of a pusher or the largest penetration
            depth, whichever is larger; one if both are zero.
        form_scale: Number by which H was divided.
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
    displacement_unit: Scalar
    form_scale: Scalar
    pushes: Bool[Array, ""]
    valid: Bool[Array, ""]
    margin: bool

    @property
    def runtime_scalar(self) -> Scalar:
        """A finite scalar that is not a compile-time constant, for `compute_once` and `decide`."""
        return self.displacement_unit

    @property
    def count(self) -> int:
        """Number of contacts."""
        return len(self.friction)

    def violation_per_weight(self, contact: Index) -> Scalar:
        """How far a contact's force is outside its friction cone if one of its edges has weight minus one.

        The checks of an edge's weight multiply it by this number. So they allow the same error of the force, whatever
        the coefficient of friction is.

        Args:
            contact: Number of the contact.

        Returns:
            The distance, in units of the normal force.
        """
        return jnp.maximum(2 * dynamic_index(self.friction, contact), 1)

    def slips(self, twist: Vec3) -> tuple[Vec2, ...]:
        """Motion of each contact point relative to its pusher.

        Args:
            twist: Dimensionless twist.

        Returns:
            For each contact, the motion along the normal, with the gap added, and along the tangent (the slip). A
            negative normal component violates the contact.
        """
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
    sums = (jnp.where(a, sum(jax.tree.leaves(c)), 0.0) for c, a in zip(contacts, active, strict=True))
    valid = jnp.isfinite(sum(sums))
    for contact, is_active in zip(contacts, active, strict=True):
        valid &= (contact.friction >= 0) | ~is_active
    zero, one = jnp.zeros_like(contacts[0].gap), jnp.ones_like(contacts[0].gap)
    zero_vector = Vec2(zero, zero)
    # This is not a compile-time constant if the length, a point or a displacement is an argument of the program.
    runtime_scalar = form.length + sum((contact.point.x + contact.displacement.x for contact in contacts), zero)
    # Without `compute_once`, the sum over all inputs would be recomputed for every row below.
    valid, runtime_scalar = compute_once((valid, runtime_scalar), runtime_scalar)
    takes_part = tuple(decide(valid & is_active, runtime_scalar) for is_active in active)
    contacts = tuple(contact.where(used) for used, contact in zip(takes_part, contacts, strict=True))

    displacements = [tree_where(a, c.displacement, zero_vector) for a, c in zip(takes_part, contacts, strict=True)]
    depths = [jnp.where(a, -c.gap, 0.0) for a, c in zip(takes_part, contacts, strict=True)]
    displacement_unit = _displacement_unit(displacements, depths)
    form_scale = _form_scale(form)
    runtime_scalar = jnp.where(valid, runtime_scalar, 1.0)
    displacement_unit = compute_once(displacement_unit, runtime_scalar)

    normals, tangential_moments, approaches = [], [], []
    for contact in contacts:
        normals.append(contact.wrench(Vec2(one, zero), form.length))
        tangential_moments.append(contact.wrench(Vec2(zero, one), form.length).z)
        approaches.append(contact.approach().scale(1 / displacement_unit))
    normals, tangential_moments, approaches = compute_once(
        (tuple(normals), tuple(tangential_moments), tuple(approaches)), runtime_scalar
    )
    tangents = tuple(Vec3(-n.y, n.x, moment) for n, moment in zip(normals, tangential_moments, strict=True))
    pushes = jnp.zeros((), bool)
    for used, approach in zip(takes_part, approaches, strict=True):
        pushes |= used & (approach.x > 0)
    friction = tuple(contact.friction for contact in contacts)
    generators = []
    for n, t, mu in zip(normals, tangents, friction, strict=True):
        generators += [n + t.scale(mu), n - t.scale(mu)]
    generators, pushes = compute_once((tuple(generators), pushes), runtime_scalar)
    scaled_form = form.scaled(1 / form_scale)
    per_contact = (normals, tangents, generators, approaches, friction, takes_part)
    return ScaledProblem(scaled_form, *per_contact, displacement_unit, form_scale, pushes, valid, margin)


def _displacement_unit(displacements: list[Vec2], depths: list[Scalar]) -> Scalar:
    """The longest of the displacements or the largest of the depths, if that is larger; one where all are zero.

    Units are constants to every derivative, because the answer does not depend on them.
    """
    # Divide by the largest component first, because the square of a small displacement underflows.
    component = _largest([jnp.abs(x) for displacement in displacements for x in displacement])
    component = jnp.where(component > 0, component, 1.0)
    squared = _largest([d.scale(1 / component).dot(d.scale(1 / component)) for d in displacements])
    unit = jnp.maximum(component * jnp.sqrt(squared), _largest(depths))
    return jax.lax.stop_gradient(jnp.where(unit > 0, unit, 1.0))


def _form_scale(form: Form) -> Scalar:
    """The sum of H at the three unit wrenches, a constant to every derivative.

    It depends on the surface alone. So a batch that shares one surface also shares the scaled one, which is not read
    again for each example.
    """
    zero, one = jnp.zeros_like(form.length), jnp.ones_like(form.length)
    axes = (Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one))
    scale = jax.lax.stop_gradient(sum((form.value(axis) for axis in axes), zero))
    return compute_once(jnp.where(scale > 0, scale, 1.0), form.length)


def _largest(values: list[Scalar]) -> Scalar:
    """The largest of some values, as a constant to every derivative."""
    return functools.reduce(jnp.maximum, jax.lax.stop_gradient(values))


def dynamic_index(values: tuple[Any, ...], index: Index) -> Any:
    """Return `values[index]`, also for an index that a loop runs over.

    A traced index selects by `where`, because a gather is slow in a batch.

    Args:
        values: Pytrees of the same structure.
        index: Number of an entry, not negative.

    Returns:
        The entry.
    """
    if isinstance(index, int):
        return values[index]
    chosen = values[0]
    for k, value in enumerate(values[1:], start=1):
        chosen = jax.tree.map(lambda a, b, k=k: jnp.where(index == k, a, b), value, chosen)
    return chosen
