"""Monte Carlo simulation: many pushes under random friction, for the distribution of the slider's final pose."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Array, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_type, traced
from pushjax._internal.compilation_cache import processor
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax._internal.warn import warn
from pushjax.contact.problem import check_solver
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.table import Table
from pushjax.simulation.arguments import (
    check_start_among_fixtures,
    checked_fixtures,
    checked_rollout_arguments,
    checked_table,
)
from pushjax.simulation.checkpoint import Checkpoint, CheckpointError, digest
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.monte_carlo_result import MonteCarlo
from pushjax.simulation.monte_carlo_tiles import Devices, PushResults, Setup, copy_to_devices, fetch_round, start_round
from pushjax.simulation.slider import Slider

TILE = 2048  # pushes that a CPU computes at once, so that their data stay in the cache
ACCELERATOR_TILE = 1 << 18  # the same for an accelerator, whose kernels take long to start but compute many at once
TILE_MULTIPLE = 64  # a tile for fewer pushes is a multiple of this
# A file of a checkpoint is written after this many pushes, or after this time in s, at the end of the round.
BLOCK_PUSHES, BLOCK_SECONDS = 16 * TILE, 20.0
MANY_REPAIRS = 1 / 3  # share of repaired surfaces from which their distribution is no longer that of the model


def monte_carlo(
    key: "PRNGKeyArray",  # as text, so that help shows this name and not the types behind it
    n: int,
    slider: Slider,
    hand: Hand,
    path: ArrayLike,
    *,
    pose: ArrayLike,
    model: FrictionModel,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
    trajectories: bool = False,
    batch_size: int | None = None,
    devices: Sequence[Any] | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | ProgressCallback = False,
) -> MonteCarlo:
    """Push the slider `n` times along a path, each time under other friction.

    Push i is `random_rollout(fold_in(key, i), ...)`. Its bits depend on key, `batch_size`, `trajectories` and machine,
    and on whether `n` exceeds `batch_size`, but not on the number of devices and processes. Each device compiles its
    own program, once. On a CPU, a run of at most `batch_size` pushes is compiled for a short compile time, a longer one
    for a short run time. Memory does not depend on `n`, except for the results, some 60 bytes a push, and for paths and
    starts of each push.

    This function runs on the host. Under `jit`, `vmap` or `grad`, use `random_rollout`.

    Args:
        key: PRNG key of everything random.
        n: Number of pushes.
        slider: The slider; its surface is the mean of the sampled surfaces.
        hand: The hand.
        path: Configurations of the hand, as in `rollout`: (steps + 1, dof), or (n, steps + 1, dof) for a path of each
            push.
        pose: Pose of the slider at the start, world, m and rad: (3,), or (n, 3) for a start of each push.
        model: Distribution from which friction is sampled around `slider.surface`.
        solver: Solver of contact problems, as in `rollout`.
        table: A table whose friction depends on direction or place, as in `rollout`.
        fixtures: Walls and bodies that the slider may touch, as in `rollout`; their friction is not random.
        trajectories: Whether to keep every pose of every push (12 bytes a step in float32), not only the last.
        batch_size: Number of pushes that a device computes at once, in one compiled program. Default 2048 on a
            CPU and 262 144 on an accelerator, or for fewer pushes the next multiple of 64.
        devices: Devices to use. By default all, including those of other processes (`jax.distributed`), which must then
            all make the same call.
        checkpoint: Folder in which finished pushes are kept; all processes must have access to it. A run that finds its
            beginning there continues from it, and gives the same bits.
        progress: True for a progress bar on the terminal (lines on standard error if there is none), or a function of
            (done, n).

    Returns:
        The pushes, in numpy.

    Raises:
        ValueError: As in `rollout` and `FrictionModel.around`. Also for a key that is not one PRNG key, for `n` or
            `batch_size` below one, and for devices that are neither of this process nor equally many of each process.
        CheckpointError: A ValueError, for a checkpoint that belongs to another run, is damaged, or cannot be written.
            What is in the folder stays there.
        TypeError: Under `jit`, `vmap` or `grad`. Also as in `rollout`, and for a model of another type.

    Reference: Zhou et al. 2017, sections V and VI.
    """
    start_time = time.perf_counter()
    if traced((key, slider, hand, path, pose, model, table, fixtures)):
        raise TypeError(
            "monte_carlo works on the host; under jit, vmap or grad use random_rollout, with vmap over keys"
        )
    check_count("n", n)
    check_count("batch_size", 1 if batch_size is None else batch_size)
    n = int(n)
    check_solver(solver)
    check_type("model", model, FrictionModel)
    with _progress_report(progress, n) as report:
        slider, hand, path_array, start, _ = checked_rollout_arguments(slider, hand, path, pose, 0.0, pushes=n)
        key_data, impl = _key_data(key)
        used = Devices.of(devices)
        default_tile = TILE if used.local[0].platform == "cpu" else ACCELERATOR_TILE
        tile = int(batch_size) if batch_size is not None else min(default_tile, -(-n // TILE_MULTIPLE) * TILE_MULTIPLE)
        if used.multiprocess:
            # connect the processes now: after compiling, one may be later than the 30 s that the others wait
            multihost_utils.sync_global_devices("pushjax monte_carlo")
        surfaces = model.around(slider.surface)
        cast_table, fixed = checked_table(table, start.dtype), checked_fixtures(fixtures, start.dtype)
        check_start_among_fixtures(slider, fixed, start)
        setup = Setup(key_data, surfaces, model, slider.shape, hand, solver, cast_table, fixed)
        run = _Run(n, tile, setup, impl, used, np.asarray(start), np.asarray(path_array), trajectories)
        saved = None if checkpoint is None else _checkpoint(Path(checkpoint), run, setup, slider, path_array, start)
        results = run.compute_all(saved, report)
    _warn_about_repairs(results.shrinkage)
    return MonteCarlo(np.broadcast_to(run.start, (n, 3)), *results, time.perf_counter() - start_time)


def _checkpoint(folder: Path, run: "_Run", setup: Setup, slider: Slider, path: Array, start: Array) -> Checkpoint:
    """Return the checkpoint of a run, which identifies the run by its arguments, versions and platform."""
    hand, model, solver = setup.hand, setup.model, setup.solver
    identity = {"n": run.n, "batch_size": run.tile, "trajectories": run.keep_trajectories}
    identity |= {"key": digest(setup.key, run.impl), "slider": digest(slider)}
    identity |= {"hand": digest(hand, hand.poses(path)), "path": digest(path), "pose": digest(start)}
    identity |= {"model": digest(model), "solver": digest(solver) if solver else "default"}
    identity |= {"table": digest(setup.table) if setup.table else "uniform", "fixtures": digest(setup.fixtures)}
    identity |= {name: version(name) for name in ("pushjax", "jax", "jaxlib")}
    device = run.devices.local[0]
    identity |= {"platform": device.platform, "device": device.device_kind}
    # other instructions or flags of the compiler give other bits; another number of devices does not
    flags = sorted(flag for flag in os.environ.get("XLA_FLAGS", "").split() if "device_count" not in flag)
    identity |= {"processor": processor() if device.platform == "cpu" else "", "xla_flags": flags}
    return run.in_all_processes(lambda: Checkpoint(folder.expanduser(), identity, writes=run.devices.writes))


def _warn_about_repairs(shrinkage: np.ndarray) -> None:
    """Warn if many of the sampled surfaces were not convex and had to be moved toward their mean."""
    share = float(np.mean(shrinkage > 0))
    if share > MANY_REPAIRS:
        warn(
            f"model: {share:.0%} of the sampled limit surfaces were not convex and were moved toward the mean; put the "
            "origin of the body frame at the center of the pressure, give a larger dof, or use "
            'sampler="sum_of_squares"'
        )


@contextmanager
def _progress_report(progress: bool | ProgressCallback, n: int) -> Iterator[ProgressCallback]:
    """Yield the progress callback of `n` pushes."""
    if progress is not True:
        yield progress or no_progress
        return
    # imported here, because nothing but a progress bar needs it
    from pushjax._internal.progress_bar import progress_bar

    with progress_bar() as reporter:
        reporter.say(f"compiling and making {n} pushes")
        yield reporter


def _key_data(key: Any) -> tuple[Any, Any]:
    """Return the raw data of a key, and the name of its PRNG implementation."""
    message = f"key must be one key, of jax.random.key or PRNGKey; got {key!r}"
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise ValueError(message)
    try:
        typed = key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(jnp.asarray(key))
    except (TypeError, ValueError):
        raise ValueError(message) from None
    if typed.shape != ():
        raise ValueError(message)
    return jax.random.key_data(typed), str(jax.random.key_impl(typed))


class _Run:
    """A Monte Carlo run, which computes the pushes in rounds of one tile on each device."""

    def __init__(
        self,
        n: int,
        tile: int,
        setup: Setup,
        impl: Any,
        devices: Devices,
        start: np.ndarray,  # pose of the slider, (3,) or (n, 3), world, m and rad
        path: np.ndarray,  # (steps + 1, dof) or (n, steps + 1, dof)
        keep_trajectories: bool,
    ):
        self.n, self.tile, self.impl, self.devices, self.keep_trajectories = n, tile, impl, devices, keep_trajectories
        self.start, self.path = start, path
        self.setups, self.round = copy_to_devices(setup, devices), tile * devices.count
        # A CPU runs one tile in less time than it takes to compile it. This compares `n` with a tile and not with a
        # round, because the bits must not depend on the number of devices.
        self.quick = n <= tile and devices.local[0].platform == "cpu"

    def in_all_processes(self, action: Callable[[], Any]) -> Any:
        """Return `action()`; if one process raises CheckpointError, all do, so that none waits for another."""
        error, value = None, None
        try:
            value = action()
        except CheckpointError as caught:
            error = caught
        failed = error is not None
        if self.devices.multiprocess:
            failed = bool(np.any(multihost_utils.process_allgather(np.int32(failed))))
        if failed:
            raise error or CheckpointError("checkpoint: another process could not go on; it says why")
        return value

    def _block_is_due(self, pushes: int, seconds: float) -> bool:
        """Return whether to write a block of the checkpoint; all processes get the answer of the first."""
        due = pushes >= BLOCK_PUSHES or seconds >= BLOCK_SECONDS
        return bool(multihost_utils.broadcast_one_to_all(np.int32(due))) if self.devices.multiprocess else due

    def compute_all(self, saved: Checkpoint | None, report: ProgressCallback) -> PushResults:
        """Return all pushes; compute those that are not in `saved`."""
        with ThreadPoolExecutor(len(self.setups)) as pool:
            return self._compute_rounds(saved, report, pool)

    def _compute_rounds(
        self, saved: Checkpoint | None, report: ProgressCallback, pool: ThreadPoolExecutor
    ) -> PushResults:
        """Return all pushes, computed round by round, with one thread of `pool` for each device."""
        parts, done = self._saved_blocks(saved)
        # block: results that are not in the checkpoint yet; block_begin: index of their first push
        block, block_begin, block_time = [], done, time.perf_counter()
        running: tuple[int, int, list[PushResults]] | None = None
        report(done, self.n)
        while done < self.n or running is not None:
            # the devices compute the next round while the host copies this one
            next_round = self._start_round(done, pool) if done < self.n else None
            if running is not None:
                first, last, device_results = running
                results = fetch_round(device_results, self.devices)
                block.append(jax.tree.map(lambda leaf, k=last - first: leaf[:k], results))
                if saved is not None and (
                    last == self.n or self._block_is_due(last - block_begin, time.perf_counter() - block_time)
                ):
                    parts.append(_concatenated(block))
                    self.in_all_processes(partial(saved.write, block_begin, last, _arrays_by_name(parts[-1])))
                    block, block_begin, block_time = [], last, time.perf_counter()
                report(last, self.n)
            running = next_round
            done = done if next_round is None else next_round[1]
        return _concatenated(parts + block)

    def _start_round(self, first: int, pool: ThreadPoolExecutor) -> tuple[int, int, list[PushResults]]:
        """Start the round of push `first`; return that index, the index after its end, and results on each device."""
        last = min(first + self.round, self.n)
        # the last round repeats its last push
        indices = np.minimum(np.arange(first, first + self.round), self.n - 1).astype(np.uint32).reshape(-1, self.tile)
        poses = np.broadcast_to(self.start, (self.n, 3))[indices]
        # a path that all pushes share is sent once
        paths = self.path if self.path.ndim == 2 else self.path[indices]
        device_results = start_round(
            self.setups,
            self.impl,
            self.devices,
            indices,
            poses,
            paths,
            self.keep_trajectories,
            self.quick,
            pool,
        )
        return first, last, device_results

    def _saved_blocks(self, saved: Checkpoint | None) -> tuple[list[PushResults], int]:
        """Return the pushes that are in the checkpoint, in blocks, and their number."""
        if saved is None:
            return [], 0
        blocks = saved.blocks()
        end = blocks[-1][1] if blocks else 0
        names = tuple(name for name in PushResults._fields if self.keep_trajectories or name != "trajectory")

        def read() -> list[PushResults]:
            if self.devices.multiprocess and len(np.unique(multihost_utils.process_allgather(np.int32(end)))) > 1:
                raise CheckpointError(
                    f"checkpoint: not every process sees the same in {saved.folder}; give a shared one"
                )
            return [PushResults(**({"trajectory": None} | saved.read(path, names))) for _, _, path in blocks]

        return self.in_all_processes(read), end


def _concatenated(parts: list[PushResults]) -> PushResults:
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _arrays_by_name(results: PushResults) -> dict[str, np.ndarray]:
    return {name: leaf for name, leaf in results._asdict().items() if leaf is not None}
