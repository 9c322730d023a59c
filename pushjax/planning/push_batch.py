"""Batches of pushes by one compiled program, whatever their number and length.

A push along a path is simulated in legs of a fixed number of steps, and the pushes in groups of a fixed number. So a
library of a hundred thousand outcomes and the few pushes that correct a push while it runs share one program, which is
compiled once.
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
    mu = np.broadcast_to(np.asarray(friction, dtype), (count,))
    surfaces = _one_surface_each(slider.surface, count)
    found = np.empty((count, steps + 1, 3), dtype)
    valid = np.full(count, steps)
    for first in range(0, count, GROUP):
        group = slice(first, min(first + GROUP, count))
        size = group.stop - first
        padded = np.minimum(np.arange(GROUP), size - 1) + first  # the last push is repeated to fill the group
        surface = jax.tree.map(lambda leaf, rows=padded: leaf[rows], surfaces)
        pose = np.asarray(poses, dtype)[padded]
        found[group, 0] = pose[:size]
        for begin in range(0, steps, LEG):
            index = np.minimum(np.arange(begin, begin + LEG + 1), steps)  # beyond its end the hand rests
            leg = np.asarray(paths[padded][:, index], dtype)
            reached, until = _simulate_group(slider.shape, hand, surface, mu[padded], leg, pose)
            reached, until = np.array(reached), np.asarray(until)
            done = min(LEG, steps - begin)
            found[group, begin + 1 : begin + done + 1] = reached[:size, 1 : done + 1]
            stopped = until[:size] < done
            valid[group] = np.where(stopped, np.minimum(valid[group], begin + until[:size]), valid[group])
            pose = reached[:, -1]
    return found, valid


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
