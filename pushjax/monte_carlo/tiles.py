"""One round of a Monte Carlo run: a tile of pushes on every device.

A device always runs whole tiles, by a program for the shape of one, whatever the number of devices and processes: so
the bits do not depend on it. Push i's key is `fold_in(key, i)`; what is drawn is a program of its own, so that it does
not depend on what is done with it either.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from pushjax.friction_model import FrictionModel, RandomSurface
from pushjax.hands import Hand
from pushjax.random_rollout import Draws, draw, push_under
from pushjax.shapes import Shape
from pushjax.solve import ContactSolver, StickingSolver
from pushjax.status import ContactMode

AXIS = "devices"


class Setup(NamedTuple):
    """What all pushes share. key: its raw data. path: (steps + 1, dof)."""

    key: Array
    around: RandomSurface
    model: FrictionModel
    shape: Shape
    hand: Hand
    path: Array
    solver: ContactSolver | StickingSolver | None


class Outcome(NamedTuple):
    """Of each push. trajectory: None, unless it is kept."""

    pose: Any
    status: Any
    mode: Any
    steps_in_mode: Any
    failed: Any
    first_failure: Any
    stopped: Any
    friction: Any
    pull: Any
    trajectory: Any


def spread(tree: Any, mesh: Mesh, spec: PartitionSpec) -> Any:
    """Arrays on all devices of all processes; every process gives the same."""

    def placed(leaf: Any) -> Array:
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, NamedSharding(mesh, spec), lambda index: whole[index])

    return jax.tree.map(placed, tree)


def fetch(tree: Any) -> Any:
    """The same on the host, whole in every process, whichever device has what."""

    def whole(leaf: Array) -> np.ndarray:
        # of one process's devices it is whole already, and gathering would mix what each process does for itself
        return np.asarray(leaf if leaf.is_fully_addressable else multihost_utils.process_allgather(leaf, tiled=True))

    return jax.tree.map(whole, tree)


def submit(setup: Setup, impl: Any, mesh: Mesh, indices: np.ndarray, poses: np.ndarray, keep: bool) -> Outcome:
    """Start one round; it is done when its numbers are asked for. indices, poses: (devices * tile, ...)."""
    mine, shared = PartitionSpec(AXIS), PartitionSpec()
    placed = spread((indices, poses), mesh, mine)
    setup = spread(setup, mesh, shared)
    draws = _draw(mesh, impl, len(setup.path) - 1, setup.key, setup.around, setup.model, placed[0])
    rest = setup.shape, setup.hand, setup.path, setup.solver
    return _push(mesh, setup.model.every, keep, draws, rest, placed[1])


@partial(jax.jit, static_argnums=(0, 1, 2))
def _draw(mesh: Mesh, impl: Any, steps: int, key: Array, around: RandomSurface, model: FrictionModel, index: Array):
    def tile(key, around, model, index):
        root = jax.random.wrap_key_data(key, impl=impl)
        return jax.vmap(lambda i: draw(jax.random.fold_in(root, i), around, model, steps))(index)

    mine, shared = PartitionSpec(AXIS), PartitionSpec()
    specs = (shared, shared, shared, mine)
    return jax.shard_map(tile, mesh=mesh, in_specs=specs, out_specs=mine, check_vma=False)(key, around, model, index)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _push(mesh: Mesh, every: int | None, keep: bool, draws: Draws, rest: tuple, poses: Array) -> Outcome:
    def tile(draws, rest, poses):
        shape, hand, path, solver = rest
        return jax.vmap(lambda draws, pose: _outcome(draws, shape, hand, path, pose, solver, every, keep))(draws, poses)

    mine, shared = PartitionSpec(AXIS), PartitionSpec()
    specs = (mine, shared, mine)
    return jax.shard_map(tile, mesh=mesh, in_specs=specs, out_specs=mine, check_vma=False)(draws, rest, poses)


def _outcome(draws, shape, hand, path, pose, solver, every, keep) -> Outcome:
    push = push_under(draws, shape, hand, path, pose, solver, every)
    mode = push.mode
    return Outcome(
        push.pose[-1],
        push.status[-1],
        mode[-1],
        jnp.stack([jnp.sum(mode == kind, axis=0, dtype=jnp.int32) for kind in ContactMode], axis=-1),
        jnp.sum(push.failed, dtype=jnp.int32),
        push.first_failure.astype(jnp.int32),
        push.stopped.astype(jnp.int32),
        draws.friction,
        draws.pull,
        push.pose if keep else None,
    )
