"""Solver of contacts without friction under an ellipsoidal limit surface.

Under an ellipsoid the twist is V = A sum_i f_i n_i, where A is the Hessian of H, n_i the normal rows of the contacts
(`scaled_problem`) and f_i >= 0 their forces. The conditions 0 <= f_i  _|_  n_i . V - b_i >= 0 are those of a convex
program: minimize V' A^-1 V subject to n_i . V >= b_i. Its solution is unique, and loads at most three contacts. So
every set of one, two or three contacts is tried, each in closed form, and the one whose motion violates the conditions
least is the solution. If that motion violates one of them clearly, no motion satisfies all: a jam.

Two contacts whose normals are opposite up to 3e-3 rad (float32) or 3e-6 rad (float64) count as exactly opposite. They
jam the slider, although it might escape from so narrow a wedge, hundreds of times as fast as the pushers.
"""

from itertools import combinations
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._math.arrays import combined, dual, times
from pushjax._math.sums import summed
from pushjax.contact.edge_sets import along
from pushjax.contact.scaled_problem import NO_EDGE, ContactSolver, EdgeSet, Found, ScaledProblem

# Largest violation of a condition that passes, and largest motion that can be an answer. Both are dimensionless, in
# units of `ScaledProblem.unit`. The other solvers are much stricter (`tolerances`).
TOLERANCE, MAX_MOTION = 1e-3, 1e3
# Keyed by the bytes of a float: determinants smaller than this, relative to the product of the diagonal, count as zero.
SINGULAR = {4: 1e-5, 8: 1e-11}


class Frictionless(ContactSolver):
    """Solver for contacts without friction, whose coefficients of friction are ignored, under an ellipsoid."""

    proves_jams: ClassVar[bool] = True

    def search(self, problem: ScaledProblem) -> Found:
        return Found.guessed(least_violation(problem)[0])


def least_violation(problem: ScaledProblem) -> tuple[EdgeSet, Float[Array, "3 batch"], Bool[Array, " batch"]]:
    """The set of up to three contacts whose motion violates the conditions least, the twist, and whether it passes."""
    if problem.surface.degree != 2:
        raise ValueError(f"solver: Frictionless needs an ellipsoid; the surface has degree {problem.surface.degree}")
    m = problem.count
    sets = [chosen for size in range(1, min(m, 3) + 1) for chosen in combinations(range(m), size)]
    contacts = np.array([(*chosen, *(NO_EDGE,) * (3 - len(chosen))) for chosen in sets], np.int32).T  # (3, sets)
    used, number = (contacts >= 0)[..., None], np.maximum(contacts, 0)
    motions = times(problem.surface.hessian(problem.normal), problem.normal)  # by a unit force at each contact
    # the Delassus matrix of the normals, which is symmetric; of each set, completed by the identity
    gram = summed(problem.normal[:, :, None] * motions[:, None], 0)
    pairs = m * number[:, None] + number[None]
    matrix = jnp.take(gram.reshape(m * m, -1), pairs.reshape(-1), axis=0).reshape(*pairs.shape, -1)
    identity = jnp.eye(3, dtype=gram.dtype)[..., None, None]
    matrix = jnp.where(used[:, None] & used[None], matrix, identity)
    goal = jnp.where(used, jnp.take(problem.goal[0], number, axis=0), 0.0)
    diagonal = jnp.stack([matrix[k, k] for k in range(3)])
    basis, regular = dual(matrix, SINGULAR[gram.dtype.itemsize] * diagonal[0] * diagonal[1] * diagonal[2])
    force = combined(basis, goal)
    twist = summed(jnp.where(used, jnp.take(motions, number, axis=1) * force[None], 0.0), 1)
    # a force of the wrong sign is a violation, too: by the motion that it alone would cause
    violation = jnp.max(jnp.where(used, -force * diagonal, 0.0), axis=0)
    open_by = problem.goal[0][:, None] - summed(problem.normal[:, :, None] * twist[:, None], 0)
    violation = jnp.maximum(violation, jnp.max(jnp.where(problem.active[:, None], open_by, 0.0), axis=0))
    usable = regular & (summed(jnp.abs(twist), 0) < MAX_MOTION)
    usable &= jnp.all(jnp.take(problem.active, number, axis=0) | ~used, axis=0)
    violation = jnp.where(usable, violation, jnp.inf)
    index = jnp.argmin(violation, axis=0)[None]
    chosen = jnp.asarray(contacts)[:, index[0]]
    force, twist = (along(x, index[None], 1)[:, 0] for x in (force, twist))
    edges = jnp.where(chosen >= 0, 2 * chosen, NO_EDGE)
    solved = problem.pushes & (jnp.min(violation, axis=0) < TOLERANCE)
    return EdgeSet(edges, edges, jnp.where(chosen >= 0, jnp.maximum(force, 0), 0.0)), twist, solved
