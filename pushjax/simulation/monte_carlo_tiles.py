"""Rounds of a Monte Carlo run: a tile of pushes on every device.

Each device runs its own program for a whole tile. The program is the same whatever the number of devices and processes,
so the bits do not depend on that number. (XLA optimizes one program that is partitioned over the devices differently
from a program for a single device: of a million draws, some thousands differed by a rounding.) The key of push i is
`fold_in(key, i)`. Sampling is a separate program, so that the samples do not depend on what is computed from them
either.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Array

from pushjax._internal.jit import QUICK_OPTIONS, with_own_floats, without_gc
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.status import ContactMode
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.table import Table
from pushjax.geometry.shape import Shape
from pushjax.simulation.checkpoint import CheckpointError
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand
from pushjax.simulation.random_rollout import Distributions, Draws, draw, rollout_under_draws

Results = dict[str, Any]  # of pushes: the fields of `MonteCarlo` by name, also the arrays in a checkpoint


class Setup(NamedTuple):
    """What all pushes share."""

    key: Array
    distributions: Distributions
    model: FrictionModel
    shape: Shape | tuple[Shape, ...]  # of the slider, or of several
    hand: Hand
    solver: ContactSolver | StickingSolver | None  # None for the default
    table: Table | None  # None for uniform friction
    fixtures: Fixtures


class Devices(NamedTuple):
    """Devices of a run in this process. As many in each of the other processes take part."""

    local: list[Any]
    rank: int  # of this process; the first one, 0, writes files
    processes: int

    @staticmethod
    def of(devices: Sequence[Any] | None) -> "Devices":
        """Return the devices of a run, from JAX devices, or from all devices of all processes for None."""
        used, this_process = list(jax.devices() if devices is None else devices), jax.process_index()
        if not used:
            raise ValueError("devices must not be empty")
        counts = Counter(device.process_index for device in used)
        if len(counts) not in (1, jax.process_count()) or len(set(counts.values())) > 1 or this_process not in counts:
            raise ValueError("devices must all be of this process, or equally many of each process")
        local = [device for device in used if device.process_index == this_process]
        return Devices(local, this_process if len(counts) > 1 else 0, len(counts))

    def gather(self, value: Any) -> np.ndarray:
        """Return the numbers or arrays `value` of all processes, joined along the first axis."""
        value = np.atleast_1d(value)
        return np.asarray(multihost_utils.process_allgather(value, tiled=True)) if self.processes > 1 else value

    def in_all_processes(self, action: Callable[[], Any]) -> Any:
        """Return `action()`; if one process raises CheckpointError, all do, so that none waits for another."""
        value, error = None, None
        try:
            value = action()
        except CheckpointError as caught:
            error = caught
        if self.gather(int(error is not None)).any():
            raise error or CheckpointError("checkpoint: another process could not go on; it says why")
        return value


@dataclass(frozen=True)
class Rounds:
    """A Monte Carlo run, whose pushes are computed in rounds of one tile on each device."""

    n: int
    tile: int
    setup: Setup
    devices: Devices
    start: np.ndarray  # pose of each slider, of all pushes or with an axis for them, world, m and rad
    path: np.ndarray  # (steps + 1, dof) or (n, steps + 1, dof)
    keep_trajectories: bool

    @property
    def starts(self) -> np.ndarray:
        """The start of each push, (n, 3), or (n, sliders, 3) of several sliders."""
        shape = self.setup.shape
        return np.broadcast_to(self.start, (self.n, *((len(shape),) if isinstance(shape, tuple) else ()), 3))

    def compute(self, begin: int) -> Iterator[tuple[int, Results]]:
        """Yield the results of each round from push `begin` on, after the index at which the round ends."""
        setups = [jax.device_put(self.setup, device) for device in self.devices.local]
        size = self.devices.processes * len(setups) * self.tile

        def fetch(*tiles: Array) -> np.ndarray:
            return self.devices.gather(np.concatenate(tiles))[: self.n - first]

        with ThreadPoolExecutor(len(setups)) as pool:
            firsts = range(begin, self.n, size)
            started = (self._start_round(first, setups, pool) for first in firsts)
            # the devices compute the next round while the host copies this one
            for first, (results, _) in zip(firsts, pairwise(chain(started, [[]])), strict=True):
                yield min(first + size, self.n), jax.tree.map(fetch, *results)

    @without_gc
    def _start_round(self, first: int, setups: list[Setup], pool: Executor) -> list[Results]:
        """Start the round of push `first`, and return its results on each device without waiting for them."""
        # A CPU runs one tile in less time than it takes to compile it. This compares `n` with a tile and not with a
        # round, because the bits must not depend on the number of devices.
        draw_tile, push_tile = _PROGRAMS[self.n <= self.tile and self.devices.local[0].platform == "cpu"]
        processes, rank = self.devices.processes, self.devices.rank
        pushes = np.arange(processes * len(setups) * self.tile, dtype=np.uint32).reshape(processes, -1, self.tile)
        index = np.minimum(first + pushes[rank], self.n - 1)  # (devices, tile); the last round repeats its last push
        poses = self.starts[index]
        # a path that all pushes share is sent once to each device
        paths = [self.path] * len(setups) if self.path.ndim == 2 else self.path[index]
        steps = self.path.shape[-2] - 1
        draw_args = [
            (steps, each.key, each.distributions, each.model, i) for each, i in zip(setups, index, strict=True)
        ]
        shapes = draw_tile.eval_shape(*draw_args[0])
        # In parallel, because each device compiles its own programs, once. XLA compiles without Python's lock, and JAX
        # keeps what is traced here for the calls that follow.
        draw_there, push_there = with_own_floats(draw_tile), with_own_floats(push_tile)
        drawn = [pool.submit(draw_there, *args) for args in draw_args]
        push_tile.trace(self.keep_trajectories, setups[0], shapes, paths[0], poses[0])
        draws = [each.result() for each in drawn]
        return list(pool.map(partial(push_there, self.keep_trajectories), setups, draws, paths, poses))


def _draw_tile(steps: int, key: Array, distributions: Distributions, model: FrictionModel, index: Array) -> Draws:
    """Sample the friction of each push of a tile; `index` has the indices of the pushes, (tile,)."""
    return jax.vmap(lambda i: draw(jax.random.fold_in(key, i), distributions, model, steps))(index)


def _push_tile(keep_trajectories: bool, setup: Setup, draws: Draws, paths: Array, poses: Array) -> Results:
    """Make the pushes of a tile; `paths` is (steps + 1, dof) for all of them or (tile, steps + 1, dof)."""
    _, _, model, shape, hand, solver, table, fixtures = setup

    def push_once(draws: Draws, path: Array, pose: Array) -> Results:
        push = rollout_under_draws(draws, shape, hand, path, pose, solver, model.resample_every, table, fixtures)
        in_mode = [jnp.sum(push.mode == mode, axis=0, dtype=jnp.int32) for mode in ContactMode]
        results = {
            "pose": push.pose[-1],
            "status": push.status[-1],
            "mode": push.mode[-1],
            "steps_in_mode": jnp.stack(in_mode, axis=-1),
            "failed": jnp.sum(push.failed, dtype=jnp.int32),
            "first_failure": push.first_failure.astype(jnp.int32),
            "stopped": push.stopped.astype(jnp.int32),
            "friction": draws.friction,
            "shrinkage": draws.shrinkage,
        }
        return results | ({"trajectory": push.pose} if keep_trajectories else {})

    return jax.vmap(push_once, (0, None if paths.ndim == 2 else 0, 0))(draws, paths, poses)


# JAX compiles the two programs of a tile at their first call, for a short run time or for a short compile time.
_PROGRAMS = {
    quick: [jax.jit(tile, static_argnums=0, compiler_options=options) for tile in (_draw_tile, _push_tile)]
    for quick, options in ((False, None), (True, QUICK_OPTIONS))
}
