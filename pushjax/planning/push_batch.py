"""Simulation of any number of pushes of any length by one compiled program.

Pushes are simulated in groups of a fixed number, and their paths in legs of a fixed number of steps. So a library of a
hundred thousand outcomes and the few pushes that correct a push while it runs share one program, which is compiled
once.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from pushjax._internal.checks import ArrayLike
from pushjax._internal.jit import quick_jit
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry.shape import Shape
from pushjax.simulation.hand import Hand
from pushjax.simulation.rollout import rollout
from pushjax.simulation.slider import Slider

GROUP = 64  # pushes that are simulated together
LEG = 32  # steps of a leg


def simulate_pushes(
    slider: Slider,
    hand: Hand,
    paths: np.ndarray,  # (pushes, steps + 1, dof), world; steps are not divided, so their size sets the accuracy
    poses: np.ndarray,  # (pushes, 3), of the slider at the start, world, m and rad
    friction: ArrayLike,  # of the contacts, ()
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate pushes of one slider along paths."""
    # Returns poses of the slider along each path, (pushes, steps + 1, 3), world, m and rad, and the number of steps
    # before the first one that failed or stopped, (pushes,).
    count, steps = len(paths), paths.shape[1] - 1
    dtype = np.dtype(jnp.result_type(float))
    columns = np.minimum(np.arange(-(-steps // LEG) * LEG + 1), steps)  # in the last leg the hand may rest at the end
    paths = np.asarray(paths, dtype)[:, columns]
    mu = np.full(GROUP, friction, dtype)
    surfaces = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (GROUP, *leaf.shape)), slider.surface)
    found = np.empty((count, len(columns), 3), dtype)
    found[:, 0] = poses
    valid_steps = np.full(count, steps)
    for begin in range(0, steps, LEG):
        leg = slice(begin, begin + LEG + 1)

        def simulate(rows: np.ndarray, leg: slice = leg) -> tuple[Array, Array]:
            return _simulate_group(slider.shape, hand, surfaces, mu, paths[rows, leg], found[rows, leg.start])

        found[:, leg], valid = in_batches(count, GROUP, simulate)
        valid_steps = np.minimum(valid_steps, np.where(valid < LEG, begin + valid, steps))
    return found[:, : steps + 1], valid_steps


def in_batches(count: int, size: int, program: Callable[[np.ndarray], Any]) -> Any:
    """Call a program with the indices below `count`, `size` at a time, and join the rows of its results, in NumPy."""
    # The last batch is filled up with indices from zero on, so that one compiled program serves any number.
    batches = -(-count // size)
    found = [program(rows) for rows in np.split(np.arange(batches * size) % count, batches)]
    return jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves])[:count], *found)


@quick_jit
def _simulate_group(shape: Shape, hand: Hand, surfaces: LimitSurface, friction, paths, poses):
    """Return the poses (group, leg + 1, 3), and the steps before the first that failed or stopped, (group,)."""

    def simulate(surface, mu, path, pose):
        push = rollout(Slider(shape, surface), hand, path, pose=pose, friction=mu)
        stops = jnp.where(push.stopped >= 0, push.stopped, LEG)
        return push.pose, jnp.where(push.first_failure >= 0, jnp.minimum(push.first_failure, stops), stops)

    return jax.vmap(simulate)(surfaces, friction, paths, poses)
