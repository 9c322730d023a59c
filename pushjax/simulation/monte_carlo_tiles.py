"""One round of a Monte Carlo run: a tile of pushes on every device.

Each device runs its own program for a whole tile. The program is the same whatever the number of devices and processes,
so the bits do not depend on that number. (XLA optimizes one program that is partitioned over the devices differently
from a program for a single device: of a million draws, some thousands differed by a rounding.) The key of push i is
`fold_in(key, i)`. Sampling is a separate program, so that the samples do not depend on what is computed from them
either.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Array

from pushjax._internal.jit import without_gc
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.status import ContactMode
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.random import FrictionModel, SurfaceDistribution
from pushjax.friction.table import Table
from pushjax.geometry.shape import Shape
from pushjax.simulation.hand import Hand
from pushjax.simulation.random_rollout import draw, push_under


class Setup(NamedTuple):
    """What all pushes share.

    Attributes:
        key: Raw data of the PRNG key.
        around: Distribution of limit surfaces around their mean.
        model: Distribution of friction.
        shape: Outline of the slider.
        hand: The hand.
        solver: Solver of contact problems; None for the default.
        table: A table whose friction depends on direction or place; None for uniform friction.
    """

    key: Array
    around: SurfaceDistribution
    model: FrictionModel
    shape: Shape
    hand: Hand
    solver: ContactSolver | StickingSolver | None
    table: Table | None


class Outcome(NamedTuple):
    """Results of pushes, fields as in `MonteCarlo`.

    Attributes:
        trajectory: None, unless it is kept.
    """

    pose: Any
    status: Any
    mode: Any
    steps_in_mode: Any
    failed: Any
    first_failure: Any
    stopped: Any
    friction: Any
    shrinkage: Any
    trajectory: Any


class Devices(NamedTuple):
    """Devices of a run, those of the first process first.

    Attributes:
        count: Number of devices of all processes.
        mine: Devices of this process.
        first: Index of the first of this process's devices among all.
        several: Whether other processes take part.
        writes: Whether this process writes files.
    """

    count: int
    mine: tuple[Any, ...]
    first: int
    several: bool
    writes: bool

    @staticmethod
    def of(devices: Sequence[Any] | None) -> "Devices":
        """Devices of a run; None for all devices.

        Raises:
            ValueError: For no devices, or unless they are this process's own or as many of each process.
        """
        every = list(jax.devices() if devices is None else devices)
        if not every:
            raise ValueError("devices must not be empty")
        me = jax.process_index()
        held = [[d for d in every if d.process_index == process] for process in range(jax.process_count())]
        part = [len(devices) for devices in held if devices]
        if len(part) not in (1, jax.process_count()) or len(set(part)) != 1 or not held[me]:
            raise ValueError("devices must be this process's own, or as many of each of all processes")
        several = len(part) > 1
        first = me * part[0] if several else 0
        return Devices(len(every), tuple(held[me]), first, several, me == 0 or not several)


def placed(setup: Setup, devices: Devices) -> list[Setup]:
    """Copy the setup to each device of this process."""
    return [jax.device_put(setup, device) for device in devices.mine]


def submit(
    setups: list[Setup],
    impl: Any,
    devices: Devices,
    indices: np.ndarray,
    poses: np.ndarray,
    paths: np.ndarray,
    keep: bool,
    pool: Executor,
) -> list[Outcome]:
    """Start one round without waiting for it; reading its numbers waits.

    Args:
        setups: The setup on each device of this process.
        impl: Name of the PRNG implementation.
        devices: Devices of the run.
        indices: Indices of the pushes, (devices, tile), for the devices of all processes.
        poses: Poses of the slider at the start, (devices, tile, 3), for the devices of all processes.
        paths: Configurations of the hand, (steps + 1, dof) for all pushes, or (devices, tile, steps + 1, dof).
        keep: Whether to keep trajectories.
        pool: Threads, one for each device of this process.
    """

    def start(k: int) -> Outcome:
        setup, there = setups[k], devices.first + k
        path = paths if paths.ndim == 2 else paths[there]
        index, pose, path = jax.device_put((indices[there], poses[there], path), devices.mine[k])
        draws = _draw(impl, path.shape[-2] - 1, setup.key, setup.around, setup.model, index)
        rest = setup.shape, setup.hand, setup.solver, setup.table
        return _push(setup.model.resample_every, keep, draws, rest, path, pose)

    # in parallel, because each device compiles its own program, once
    return list(pool.map(start, range(len(setups))))


def fetch(outcomes: list[Outcome], devices: Devices) -> Outcome:
    """Copy the results of a round, of all processes, to the host, in order."""
    mine = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *outcomes)
    if not devices.several:
        return mine
    return jax.tree.map(lambda leaf: np.concatenate(list(multihost_utils.process_allgather(leaf))), mine)


@without_gc
@partial(jax.jit, static_argnums=(0, 1))
def _draw(impl: Any, steps: int, key: Array, around: SurfaceDistribution, model: FrictionModel, index: Array):
    root = jax.random.wrap_key_data(key, impl=impl)
    return jax.vmap(lambda i: draw(jax.random.fold_in(root, i), around, model, steps))(index)


@without_gc
@partial(jax.jit, static_argnums=(0, 1))
def _push(every: int | None, keep: bool, draws, rest: tuple, paths: Array, poses: Array) -> Outcome:
    each = (0, None if paths.ndim == 2 else 0, 0)
    return jax.vmap(lambda draws, path, pose: _outcome(draws, rest, path, pose, every, keep), each)(draws, paths, poses)


def _outcome(draws, rest: tuple, path, pose, every, keep) -> Outcome:
    shape, hand, solver, table = rest
    push = push_under(draws, shape, hand, path, pose, solver, every, table)
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
        draws.shrinkage,
        push.pose if keep else None,
    )
