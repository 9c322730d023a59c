"""The contact problem of several sliders, and the LCP that it is while limit surfaces are linear.

At each contact a normal force f_n and a tangential one f_t act on one slider and, in the opposite direction, on the
other slider or on a pusher. With the motion (u_n, u_t) at the contact relative to its goal, and with
f_R = f_t + mu f_n and f_L = mu f_n - f_t, Coulomb's law is

    0 <= f_n _|_ u_n >= 0,   0 <= f_R _|_ u_R >= 0,   0 <= f_L _|_ u_L >= 0,   u_t = u_R - u_L.

The unknowns are f_n, f_R and u_L of each contact, and the dissipation s of each slider; what is complementary to them
is u_n, u_R, f_L, and what is left of the limit surface, 1 - gamma.

Arrays have components first, then sliders, then contacts, and the batch last.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._math.linalg import solve
from pushjax.contact.linear_patch import LinearPatch, Surface


class SlidersProblem(NamedTuple):
    """Contacts of several sliders with each other and with pushers, in dimensionless numbers."""

    surface: Surface  # by the normalized wrench
    # motion (n, t) of the first body of a contact relative to the second, by the normalized twist of each slider
    rows: Float[Array, "2 3 sliders contacts batch"]
    goal: Float[Array, "2 contacts batch"]  # the motion that keeps the bodies in contact, at most of order one
    friction: Float[Array, "contacts batch"]  # coefficient of friction mu
    active: Bool[Array, "contacts batch"]  # False for padding

    @property
    def count(self) -> int:
        """Number of contacts."""
        return self.friction.shape[0]

    def wrenches(self, force: Float[Array, "2 contacts batch"]) -> Float[Array, "3 sliders batch"]:
        """The wrench of contact forces on each slider."""
        return jnp.sum(self.rows * force[:, None, None], axis=(0, 3))

    def slips(self, twist: Float[Array, "3 sliders batch"]) -> Float[Array, "2 contacts batch"]:
        """The motion (n, t) at each contact relative to its goal; a normal motion below zero is a violation."""
        return jnp.sum(self.rows * twist[None, :, :, None], axis=(1, 2)) - self.goal

    def pushes(self) -> Bool[Array, " batch"]:
        """Whether a contact would be violated if nothing moved."""
        return jnp.any(self.active & (self.goal[0] > 0), axis=0)

    def usable(self) -> tuple["SlidersProblem", Bool[Array, " batch"]]:
        """The problem without numbers that cannot be computed with, all of one batch, and whether there were none."""
        size = jnp.broadcast_shapes(*(leaf.shape[-1:] for leaf in jax.tree.leaves(self)))
        self = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], *size)), self)
        surface, finite = self.surface.usable()
        own = jnp.isfinite(jnp.sum(self.rows, axis=(0, 1, 2)) + jnp.sum(self.goal, axis=0) + self.friction)
        valid = finite & jnp.all((own & (self.friction >= 0)) | ~self.active, axis=0)
        return self._replace(surface=surface).of_contacts(self.active & valid[None]), valid

    def of_contacts(self, active: Bool[Array, "contacts batch"]) -> "SlidersProblem":
        """The problem with these contacts alone; the numbers of the others are zero."""
        rows, goal = (jnp.where(jnp.expand_dims(active, tuple(range(x.ndim - 2))), x, 0.0) for x in self[1:3])
        return SlidersProblem(self.surface, rows, goal, jnp.where(active, self.friction, 0.0), active)


class LinearLaws(NamedTuple):
    """The laws V = s n + law (F - origin), 0 <= s _|_ 1 - n . F >= 0, of all sliders."""

    law: Float[Array, "3 3 sliders batch"]
    normal: Float[Array, "3 sliders batch"]
    origin: Float[Array, "3 sliders batch"]
    unit: Float[Array, "sliders batch"]  # s is in units of its square: the row of a slider is scaled like its column


class SlidersLCP(NamedTuple):
    """The LCP of linear laws: w = matrix z + q."""

    matrix: Float[Array, "rows rows batch"]
    q: Float[Array, "rows batch"]
    problem: SlidersProblem  # with forces in units of their own at each contact, which scale the matrix
    force_unit: Float[Array, "contacts batch"]
    speed_unit: Float[Array, "sliders batch"]  # the unit of s, and of what is left of the limit surface

    @staticmethod
    def of(problem: SlidersProblem, laws: LinearLaws) -> "SlidersLCP":
        """Write down the LCP."""
        law, normal, origin, speed_unit = laws
        whole = law + (speed_unit**2)[None, None] * normal[:, None] * normal[None]
        normal_rows = problem.rows[0]
        size = jnp.sum(normal_rows * jnp.sum(whole[:, :, :, None] * normal_rows[None], axis=1), axis=(0, 1))
        usable = problem.active & (size > 0)
        # units are constants to every derivative
        force_unit = jax.lax.stop_gradient(jnp.where(usable, 1 / jnp.sqrt(jnp.where(usable, size, 1.0)), 1.0))
        goal = problem.goal * force_unit[None]
        problem = problem._replace(rows=problem.rows * force_unit[None, None, None], goal=goal)
        count, sliders, batch, dtype = problem.count, len(speed_unit), size.shape[1:], size.dtype

        rows = jnp.moveaxis(problem.rows, 0, 2).reshape(3, sliders, 2 * count, *batch)  # normals, then tangents
        moved = jnp.sum(law[:, :, :, None] * rows[None], axis=1)
        compliance = jnp.sum(rows[:, :, :, None] * moved[:, :, None], axis=(0, 1))
        actives = jnp.concatenate([problem.active, problem.active])
        compliance = jnp.where(
            actives[:, None] & actives[None], compliance, jnp.eye(2 * count, dtype=dtype)[:, :, None]
        )
        along = jnp.sum(rows * normal[:, :, None], axis=0) * speed_unit[:, None]
        shift = problem.slips(jnp.sum(law * origin[None], axis=1)) + goal
        slips = jnp.where(actives, -(goal + shift).reshape(2 * count, *batch), 1.0)
        q = jnp.concatenate([slips, 1 - problem.active.astype(dtype), speed_unit])

        def zeros(*shape: int) -> Array:
            return jnp.zeros((*shape, *batch), dtype)

        # columns of f_n, f_R, u_L and s, where f_t = f_R - mu f_n; rows of u_n and u_R, of f_L, and of the sliders
        mu, eye = (
            problem.friction[None],
            jnp.broadcast_to(jnp.eye(count, dtype=dtype)[:, :, None], (count, count, *batch)),
        )
        by_force = jnp.concatenate([compliance, -along])
        by_force = jnp.concatenate([by_force[:, :count] - by_force[:, count:] * mu, by_force[:, count:]], axis=1)
        by_slip = jnp.concatenate([zeros(count, count), eye, zeros(sliders, count)])
        by_speed = jnp.concatenate([jnp.swapaxes(along, 0, 1), zeros(sliders, sliders)])
        cone = jnp.concatenate([2 * mu * eye, -eye, zeros(count, count), zeros(count, sliders)], axis=1)
        others = jnp.concatenate([by_force, by_slip, by_speed], axis=1)
        matrix = jnp.concatenate([others[: 2 * count], cone, others[2 * count :]])
        return SlidersLCP(matrix, q, problem, force_unit, speed_unit)

    def force(self, z: Float[Array, "rows batch"]) -> Float[Array, "2 contacts batch"]:
        """The forces of unknowns, in units of their own at each contact."""
        normal, right = z[: self.problem.count], z[self.problem.count : 2 * self.problem.count]
        return jnp.stack([normal, right - self.problem.friction * normal])

    def dissipation(self, z: Float[Array, "rows batch"]) -> Float[Array, "sliders batch"]:
        """The dissipation of each slider."""
        return z[3 * self.problem.count :] * self.speed_unit

    def unknowns(
        self, force: Float[Array, "2 contacts batch"], slip: Array, dissipation: Float[Array, "sliders batch"]
    ) -> Float[Array, "rows batch"]:
        """The unknowns of forces, tangential slips and dissipations."""
        normal, tangential = force / self.force_unit[None]
        left = jnp.maximum(-slip * self.force_unit, 0.0)
        right = tangential + self.problem.friction * normal
        return jnp.concatenate([normal, right, left, dissipation / self.speed_unit])

    def complements(self, z: Float[Array, "rows batch"], patch: LinearPatch) -> Float[Array, "rows batch"]:
        """What is complementary to the unknowns by the true limit surfaces at their wrench, where w is by the laws."""
        problem, force = self.problem, self.force(z)
        slip = problem.slips(self.dissipation(z)[None] * patch.normal)
        left = z[2 * problem.count : 3 * problem.count]
        rest = problem.friction * force[0] - force[1]
        return jnp.concatenate([slip[0], slip[1] + left, rest, (1 - patch.gauge) * self.speed_unit])

    def solve_basic(self, basic: Bool[Array, "rows batch"], right: Array) -> Float[Array, "rows batch"]:
        """Solve the rows of the LCP that belong to unknowns that may be positive; zero for the others."""
        count, mu = self.problem.count, self.problem.friction
        right = jnp.where(basic, right, 0.0)
        # Where u_L may be positive, f_R = 2 mu f_n - (right side of the row of f_L). This and u_L are put in by hand.
        left = basic[count : 2 * count] & basic[2 * count : 3 * count]
        rest = jnp.where(left, right[2 * count : 3 * count], 0.0)
        rows = np.r_[: 2 * count, 3 * count : len(basic)]
        wanted = basic[rows].at[count : 2 * count].set(basic[count : 2 * count] & ~left)
        matrix = self.matrix[rows][:, rows]
        by_right = matrix[:, count : 2 * count]
        reduced = matrix.at[:, :count].add(jnp.where(left, 2 * mu, 0.0)[None] * by_right)
        reduced = jnp.where(wanted[:, None] & wanted[None], reduced, jnp.eye(len(rows), dtype=right.dtype)[:, :, None])
        known = jnp.where(wanted, right[rows] + jnp.sum(by_right * rest[None], axis=1), 0.0)
        found = solve(reduced, known)
        force = jnp.where(left, 2 * mu * found[:count] - rest, found[count : 2 * count])
        found = found.at[count : 2 * count].set(force)
        slip = right[count : 2 * count] - jnp.sum(matrix[count : 2 * count] * found[None], axis=1)
        return jnp.concatenate([found[: 2 * count], jnp.where(left, slip, 0.0), found[2 * count :]])
