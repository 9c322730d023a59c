"""The dimensionless problem of several contacts, from which every solver of several contacts starts.

With the normalized twist (vx, vy, length omega) and wrench (fx, fy, tau / length), a contact is two rows, a_n and a_t.
The slider's contact point moves by (a_n . V, a_t . V) along normal and tangent, and the force (f_n, f_t) has the wrench
f_n a_n + f_t a_t. The friction cone has two edges. Their wrenches are a_n + mu a_t (the pusher slides left) and
a_n - mu a_t (right). Edges are numbered 2 i for the left and 2 i + 1 for the right edge of contact i, and rows 2 i for
a_n and 2 i + 1 for a_t.

Displacements are divided by the longest displacement of a pusher, or the deepest overlap if that is larger, and H by
the sum of its values at the three unit wrenches. So tolerances are relative, and powers of the coefficients of H stay
within the range of float32.

Arrays have vectors along the first axis, then contacts, then the batch, if there is one.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._math.sums import repeated, summed
from pushjax.friction.polynomial import Polynomial

NO_EDGE = -1  # the number of an edge or a contact that is not there


class ContactArrays(NamedTuple):
    """Contacts of a slider, in its body frame."""

    surface: Polynomial
    length: Float[Array, "*batch"]  # characteristic length of the surface, m
    point: Float[Array, "2 contacts *batch"]  # m
    normal: Float[Array, "2 contacts *batch"]  # of unit length, into the slider
    displacement: Float[Array, "2 contacts *batch"]  # of the pusher's material point over the step, m
    gap: Float[Array, "contacts *batch"]  # distance still to close along the normal, m
    friction: Float[Array, "contacts *batch"]  # coefficient of friction mu
    active: Bool[Array, "contacts *batch"]  # False for padding


class ScaledProblem(NamedTuple):
    """A contact problem in dimensionless numbers."""

    surface: Polynomial  # H, divided by `surface_scale`
    length: Float[Array, "*batch"]  # m
    normal: Float[Array, "3 contacts *batch"]  # the rows a_n
    tangent: Float[Array, "3 contacts *batch"]  # the rows a_t
    edges: Float[Array, "3 edges *batch"]  # wrenches of the cone edges with unit normal force
    goal: Float[Array, "2 contacts *batch"]  # motion (n, t) of the contact point that keeps it with its pusher
    friction: Float[Array, "contacts *batch"]
    active: Bool[Array, "contacts *batch"]  # False for padding, and for every contact if the problem is not valid
    unit: Float[Array, "*batch"]  # of displacement, m
    surface_scale: Float[Array, "*batch"]
    pushes: Bool[Array, "*batch"]  # whether any contact would be violated if the slider stayed
    valid: Bool[Array, "*batch"]  # whether every number is finite and no friction negative; if not, nothing pushes

    @property
    def count(self) -> int:
        """Number of contacts."""
        return self.friction.shape[0]

    def numbered_rows(self) -> tuple[Float[Array, "3 rows *batch"], Float[Array, "rows *batch"]]:
        """All rows, a_n and a_t of each contact in turn, and their goals."""
        rows = jnp.stack([self.normal, self.tangent], axis=2)
        return rows.reshape(3, -1, *rows.shape[3:]), jnp.stack([*self.goal], axis=1).reshape(-1, *rows.shape[3:])

    def slips(self, twist: Float[Array, "3 *batch"]) -> Float[Array, "2 contacts *batch"]:
        """Motion (n, t) of each contact point relative to its pusher; a normal motion below zero is a violation."""
        rows = jnp.stack([self.normal, self.tangent], axis=1)
        return summed(rows * twist[:, None, None], 0) - self.goal


class EdgeSet(NamedTuple):
    """The cone edges that carry the force of a solution."""

    edges: Int[Array, "3 *batch"]  # numbers of the edges, the used ones first, then `NO_EDGE`
    # Numbers of the rows whose conditions a . V = goal fix the twist, then `NO_EDGE`. They are those of the edges'
    # contacts (of one that sticks, both rows), except at the ends of segments of solutions (`exhaustive`).
    conditions: Int[Array, "3 *batch"]
    weight: Float[Array, "3 *batch"]  # of each edge in the wrench, up to one common factor

    @staticmethod
    def none(like: Float[Array, "*batch"]) -> "EdgeSet":
        """No set."""
        numbers = jnp.full((3, *like.shape), NO_EDGE, jnp.int32)
        return EdgeSet(numbers, numbers, jnp.zeros((3, *like.shape), like.dtype))

    def exists(self) -> Bool[Array, "*batch"]:
        """Whether there is a set."""
        return self.edges[0] >= 0


class Found(NamedTuple):
    """The best set of cone edges that a search found."""

    best: EdgeSet
    second_found: Bool[Array, "*batch"]  # whether a set with a different twist passed too
    # Whether a set passed whose twist exceeds `max_twist_ratio` by a factor of at most `TOO_FAST`. Such a twist is not
    # accepted as an answer. But it shows that the problem is not a jam.
    too_fast: Bool[Array, "*batch"]

    @staticmethod
    def guessed(best: EdgeSet) -> "Found":
        """A set whose solution is not known yet."""
        no = jnp.zeros(best.weight.shape[1:], bool)
        return Found(best, no, no)


class ContactSolver(eqx.Module):
    """Finds the motion of a slider under several contacts. It has settings only, no state.

    Attributes:
        proves_jams: Whether finding no solution proves that there is none.
    """

    proves_jams: eqx.AbstractClassVar[bool]

    @abstractmethod
    def search(self, problem: ScaledProblem) -> Found:
        """Find the cone edges that carry the force.

        Args:
            problem: Dimensionless contact problems, with an axis for the batch.

        Returns:
            The best set of cone edges of each problem.
        """


def nondimensionalize(given: ContactArrays) -> ScaledProblem:
    """Make a problem of several contacts dimensionless."""
    given = _broadcast(given)
    vectors = jnp.concatenate([given.point, given.normal, given.displacement, given.gap[None], given.friction[None]])
    usable = jnp.isfinite(jnp.sum(vectors, axis=0)) & (given.friction >= 0)
    valid = jnp.all(usable | ~given.active, axis=0) & jnp.isfinite(given.length)
    active = given.active & valid[None]
    # Contacts that take no part are out of reach. They are replaced before anything is computed from their numbers: a
    # NaN that is only masked afterwards comes back in the gradient.
    neutral = jnp.asarray([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], vectors.dtype)
    vectors = jnp.where(active[None], vectors, neutral.reshape(8, *(1,) * active.ndim))
    # a split, because reverse mode would add up arrays that are zero but for one slice
    point, normal, displacement, (gap, friction) = jax.lax.split(vectors, (2, 2, 2, 2))
    unit = _displacement_unit(displacement, jnp.where(active, -gap, 0.0))
    scale = jax.lax.stop_gradient(given.surface.scale())

    length = jnp.where(valid, given.length, 1.0)
    moment_n = (point[0] * normal[1] - point[1] * normal[0]) / length[None]
    moment_t = (point[0] * normal[0] + point[1] * normal[1]) / length[None]
    a_n = jnp.stack([normal[0], normal[1], moment_n])
    a_t = jnp.stack([-normal[1], normal[0], moment_t])
    # a sum over an axis, because XLA would compute other sums again wherever an edge is used
    along = jnp.stack([jnp.ones_like(friction), friction])[:, :, None]  # (n, t), contact, side
    sides = jnp.asarray([[1.0, 1.0], [1.0, -1.0]], gap.dtype).reshape(2, 1, 2, *(1,) * (gap.ndim - 1))
    rows = repeated(jnp.stack([a_n, a_t], axis=1), 3, 2)
    edges = summed(rows * repeated(along * sides, 0, 3), 1).reshape(3, 2 * len(gap), *gap.shape[1:])
    along_normal = summed(displacement * normal, 0) - gap
    goal = jnp.stack([along_normal, displacement[1] * normal[0] - displacement[0] * normal[1]]) / unit[None, None]
    pushes = jnp.any(active & (goal[0] > 0), axis=0)
    surface = Polynomial(given.surface.table / scale[None, None, None])
    return ScaledProblem(surface, length, a_n, a_t, edges, goal, friction, active, unit, scale, pushes, valid)


def _broadcast(given: ContactArrays) -> ContactArrays:
    """The contacts with all arrays of one batch; the surface may be shared."""
    axes = 0, 2, 2, 2, 1, 1, 1  # of one example
    shapes = (array.shape[n:] for array, n in zip(given[1:], axes, strict=True))
    batch = jnp.broadcast_shapes(given.surface.table.shape[3:], *shapes)
    arrays = (jnp.broadcast_to(array, (*array.shape[:n], *batch)) for array, n in zip(given[1:], axes, strict=True))
    return ContactArrays(given.surface, *arrays)


def _displacement_unit(displacement: Array, depth: Array) -> Array:
    """The longest of the displacements or the largest of the depths, if that is larger; one where all are zero."""
    # units are constants to every derivative, because the answer does not depend on them
    displacement, depth = jax.lax.stop_gradient((displacement, depth))
    # Divide by the largest component first, because the square of a small displacement underflows.
    component = jnp.max(jnp.abs(displacement), axis=(0, 1))
    component = jnp.where(component > 0, component, 1.0)
    squared = jnp.max(summed((displacement / component[None, None]) ** 2, 0), axis=0)
    unit = jnp.maximum(component * jnp.sqrt(squared), jnp.max(depth, axis=0))
    return jnp.where(unit > 0, unit, 1.0)


def selected(values: Array, index: Int[Array, "picks *batch"]) -> Array:
    """The entries with these numbers along the second axis, (k, n, ...) to (k, picks, ...); zero for `NO_EDGE`."""
    # a masked sum, because a gather is slow in a batch and its derivative is a scatter
    numbers = jnp.arange(values.shape[1]).reshape(1, -1, *(1,) * (index.ndim - 1))
    return summed(jnp.where((index[:, None] == numbers)[None], repeated(values, 1, len(index)), 0), 2)


def violation_per_weight(friction: Array) -> Array:
    """How far a contact's force is outside its friction cone if one of its edges has weight minus one."""
    # The checks of an edge's weight multiply it by this number, to allow the same error of the force at every
    # coefficient of friction.
    return jnp.maximum(2 * friction, 1)
