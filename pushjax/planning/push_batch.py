"""Simulation of any number of pushes of any length by one compiled program.

Pushes are simulated in groups of a fixed number, and their paths in legs of a fixed number of steps. So a library of a
hundred thousand outcomes and the few pushes that correct a push while it runs share one program, which is compiled
once.
"""

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._internal.jit import quick_jit
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry.shape import Shape
from pushjax.simulation.hand import Hand
from pushjax.simulation.rollout import rollout
from pushjax.simulation.slider import Slider

GROUP = 64  # pushes that are simulated together
LEG = 32  # steps of a leg


def simulate_pushes(
    slider: Slider,  # leaves of its surface may have a leading axis of pushes
    hand: Hand,
    paths: np.ndarray,  # (pushes, steps + 1, dof), world; steps are not divided, so their size sets the accuracy
    poses: np.ndarray,  # (pushes, 3), of the slider at the start, world, m and rad
    friction: np.ndarray | float,  # of the contacts; one for all pushes or (pushes,)
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate pushes of one slider along paths."""
    # Returns poses of the slider along each path, (pushes, steps + 1, 3), world, m and rad, and the number of steps
    # before the first one that failed or stopped, (pushes,).
    count, steps = len(paths), paths.shape[1] - 1
    dtype = np.dtype(jnp.result_type(float))
    # The last push is repeated to fill its group. To fill the last leg, the hand rests at the end of its path.
    rows = np.minimum(np.arange(-(-count // GROUP) * GROUP), count - 1)
    columns = np.minimum(np.arange(-(-steps // LEG) * LEG + 1), steps)
    paths = np.asarray(paths, dtype)[rows][:, columns]
    mu = np.broadcast_to(np.asarray(friction, dtype), (count,))[rows]
    surfaces = jax.tree.map(lambda leaf: leaf[rows], _one_surface_each(slider.surface, count))
    found = np.empty((len(rows), len(columns), 3), dtype)
    found[:, 0] = np.asarray(poses, dtype)[rows]
    valid_steps = np.full(len(rows), steps)
    for first in range(0, len(rows), GROUP):
        group = slice(first, first + GROUP)
        surface = jax.tree.map(lambda leaf, group=group: leaf[group], surfaces)
        for begin in range(0, steps, LEG):
            leg, start = paths[group, begin : begin + LEG + 1], found[group, begin]
            reached, valid = map(np.asarray, _simulate_group(slider.shape, hand, surface, mu[group], leg, start))
            found[group, begin + 1 : begin + LEG + 1] = reached[:, 1:]
            until = np.where(valid < LEG, begin + valid, steps)
            valid_steps[group] = np.minimum(valid_steps[group], until)
    return found[:count, : steps + 1], valid_steps[:count]


@quick_jit
def _simulate_group(shape: Shape, hand: Hand, surfaces: LimitSurface, friction, paths, poses):
    """Return the poses (group, leg + 1, 3), and the steps before the first that failed or stopped, (group,)."""

    def simulate(surface, mu, path, pose):
        push = rollout(Slider(shape, surface), hand, path, pose=pose, friction=mu)
        stops = jnp.where(push.stopped >= 0, push.stopped, LEG)
        return push.pose, jnp.where(push.first_failure >= 0, jnp.minimum(push.first_failure, stops), stops)

    return jax.vmap(simulate)(surfaces, friction, paths, poses)


def _one_surface_each(surface: LimitSurface, count: int) -> LimitSurface:
    """Return the surface with a leading axis of pushes on each leaf."""
    if surface.length.ndim == 1:
        return jax.tree.map(np.asarray, surface)
    return jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (count, *leaf.shape)), surface)
