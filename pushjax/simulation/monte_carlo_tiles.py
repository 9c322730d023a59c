"""One round of a Monte Carlo run: a tile of pushes on every device.

Each device runs its own program for a whole tile. The program is the same whatever the number of devices and processes,
so the bits do not depend on that number. (XLA optimizes one program that is partitioned over the devices differently
from a program for a single device: of a million draws, some thousands differed by a rounding.) The key of push i is
`fold_in(key, i)`. Sampling is a separate program, so that the samples do not depend on what is computed from them
either.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Array

from pushjax._internal.jit import QUICK_OPTIONS, without_gc
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.status import ContactMode
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.surface_distributions import SurfaceDistribution
from pushjax.friction.table import Table
from pushjax.geometry.shape import Shape
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand
from pushjax.simulation.random_rollout import draw, rollout_under_draws


class Setup(NamedTuple):
    """What all pushes share."""

    key: Array  # raw data of the PRNG key
    surfaces: SurfaceDistribution
    model: FrictionModel
    shape: Shape  # of the slider
    hand: Hand
    solver: ContactSolver | StickingSolver | None  # None for the default
    table: Table | None  # None for uniform friction
    fixtures: Fixtures


class PushResults(NamedTuple):
    """Results of pushes, as the fields of `MonteCarlo` of the same names; also the names of arrays in a checkpoint."""

    pose: Any
    status: Any
    mode: Any
    steps_in_mode: Any
    failed: Any
    first_failure: Any
    stopped: Any
    friction: Any
    shrinkage: Any
    trajectory: Any  # None, unless it is kept


class Devices(NamedTuple):
    """Devices of a run; the devices of the first process come first."""

    count: int  # of all processes
    local: tuple[Any, ...]  # of this process
    first: int  # index of the first of `local` among all
    multiprocess: bool  # whether other processes take part
    writes: bool  # whether this process writes files

    @staticmethod
    def of(devices: Sequence[Any] | None) -> "Devices":
        """Return the devices of a run, from JAX devices, or from all devices of all processes for None."""
        all_devices = list(jax.devices() if devices is None else devices)
        if not all_devices:
            raise ValueError("devices must not be empty")
        this_process = jax.process_index()
        by_process = [[d for d in all_devices if d.process_index == process] for process in range(jax.process_count())]
        counts = [len(devices) for devices in by_process if devices]
        if len(counts) not in (1, jax.process_count()) or len(set(counts)) != 1 or not by_process[this_process]:
            raise ValueError("devices must all be of this process, or equally many of each process")
        multiprocess = len(counts) > 1
        first = this_process * counts[0] if multiprocess else 0
        writes = this_process == 0 or not multiprocess
        return Devices(len(all_devices), tuple(by_process[this_process]), first, multiprocess, writes)


def copy_to_devices(setup: Setup, devices: Devices) -> list[Setup]:
    """Copy the setup to each device of this process."""
    return [jax.device_put(setup, device) for device in devices.local]


def start_round(
    setups: list[Setup],
    impl: Any,
    devices: Devices,
    indices: np.ndarray,  # of the pushes, (devices, tile), for the devices of all processes; so are poses and paths
    poses: np.ndarray,  # (devices, tile, 3)
    paths: np.ndarray,  # (devices, tile, steps + 1, dof), or (steps + 1, dof) for all pushes
    keep_trajectories: bool,
    quick: bool,  # whether to compile for a short compile time
    pool: Executor,  # one thread for each device of this process
) -> list[PushResults]:
    """Start one round, and return its results on each device of this process without waiting for them."""
    programs = _PROGRAMS[quick]

    def start_on(k: int) -> PushResults:
        setup, device_index = setups[k], devices.first + k
        path = paths if paths.ndim == 2 else paths[device_index]
        index, pose, path = jax.device_put((indices[device_index], poses[device_index], path), devices.local[k])
        shared = setup.shape, setup.hand, setup.solver, setup.table, setup.fixtures
        draw_args = impl, path.shape[-2] - 1, setup.key, setup.surfaces, setup.model, index

        def push_args(draws) -> tuple:
            return setup.model.resample_every, keep_trajectories, draws, shared, path, pose

        return programs.push(*push_args(_draw_while_tracing(programs, draw_args, push_args)))

    # in parallel, because each device compiles its own program, once
    return list(pool.map(start_on, range(len(setups))))


def fetch_round(results: list[PushResults], devices: Devices) -> PushResults:
    """Return the results of a round on the host, from all processes, in the order of the pushes."""
    local = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *results)
    if not devices.multiprocess:
        return local
    return jax.tree.map(lambda leaf: np.concatenate(list(multihost_utils.process_allgather(leaf))), local)


def _draw_tile(impl: Any, steps: int, key: Array, surfaces: SurfaceDistribution, model: FrictionModel, index: Array):
    """Sample the friction of each push of a tile; `index` has the indices of the pushes, (tile,)."""
    root = jax.random.wrap_key_data(key, impl=impl)
    return jax.vmap(lambda i: draw(jax.random.fold_in(root, i), surfaces, model, steps))(index)


def _push_tile(
    resample_every: int | None, keep_trajectories: bool, draws, shared: tuple, paths: Array, poses: Array
) -> PushResults:
    """Make the pushes of a tile; `paths` is (steps + 1, dof) for all of them or (tile, steps + 1, dof)."""
    axes = (0, None if paths.ndim == 2 else 0, 0)

    def push_once(draws, path, pose) -> PushResults:
        return _push_results(draws, shared, path, pose, resample_every, keep_trajectories)

    return jax.vmap(push_once, axes)(draws, paths, poses)


def _push_results(draws, shared: tuple, path, pose, resample_every, keep_trajectories) -> PushResults:
    """Make one push, and return its results."""
    shape, hand, solver, table, fixtures = shared
    push = rollout_under_draws(draws, shape, hand, path, pose, solver, resample_every, table, fixtures)
    mode = push.mode
    return PushResults(
        push.pose[-1],
        push.status[-1],
        mode[-1],
        jnp.stack([jnp.sum(mode == kind, axis=0, dtype=jnp.int32) for kind in ContactMode], axis=-1),
        jnp.sum(push.failed, dtype=jnp.int32),
        push.first_failure.astype(jnp.int32),
        push.stopped.astype(jnp.int32),
        draws.friction,
        draws.shrinkage,
        push.pose if keep_trajectories else None,
    )


class _Programs(NamedTuple):
    """The two programs of a tile, which JAX compiles at their first call."""

    draw: Any  # of `_draw_tile`
    push: Any  # of `_push_tile`

    @staticmethod
    def of(options: dict[str, str | bool | int] | None) -> "_Programs":
        """Return the programs for options of the compiler."""
        return _Programs(
            *(jax.jit(tile, static_argnums=(0, 1), compiler_options=options) for tile in (_draw_tile, _push_tile))
        )


@without_gc
def _draw_while_tracing(programs: _Programs, draw_args: tuple, push_args: Callable[[Any], tuple]) -> Any:
    """Return the draws of a tile, and trace the program of the pushes while XLA compiles the other program."""
    (device,) = draw_args[-1].devices()
    sharding = jax.sharding.SingleDeviceSharding(device)
    draws = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
        programs.draw.eval_shape(*draw_args),
    )
    # XLA compiles without Python's lock, and JAX keeps what is traced for the call that follows
    with ThreadPoolExecutor(1) as thread:
        drawn = thread.submit(programs.draw, *draw_args)
        programs.push.lower(*push_args(draws))
        return drawn.result()


_PROGRAMS = {False: _Programs.of(None), True: _Programs.of(QUICK_OPTIONS)}
