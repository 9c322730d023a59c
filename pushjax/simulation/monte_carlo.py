"""Monte Carlo simulation: many pushes under random friction, for the distribution of the slider's final pose."""

import os
import time
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_type, traced, warn
from pushjax._internal.compilation_cache import processor
from pushjax._internal.progress import ProgressCallback, no_progress, progress_bar
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.table import Table
from pushjax.simulation.checkpoint import Checkpoint, CheckpointError, digest
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.monte_carlo_result import MonteCarlo
from pushjax.simulation.monte_carlo_tiles import Devices, Results, Rounds, Setup
from pushjax.simulation.random_rollout import Distributions, checked_random_scene, shape_and_surface
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
    slider: Slider | Sequence[Slider],
    hand: Hand,
    path: ArrayLike,
    *,
    pose: ArrayLike,
    model: FrictionModel,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
    between: ArrayLike | None = None,
    trajectories: bool = False,
    batch_size: int | None = None,
    devices: Sequence[Any] | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | ProgressCallback = False,
) -> MonteCarlo:
    """Push the slider, or several, `n` times along a path, each time under other friction.

    Push i is `random_rollout(fold_in(key, i), ...)`. Its bits depend on key, `batch_size`, `trajectories` and machine,
    and on whether `n` exceeds `batch_size`, but not on the number of devices and processes. Each device compiles its
    own program, once. On a CPU, a run of at most `batch_size` pushes is compiled for a short compile time, a longer one
    for a short run time. Memory does not depend on `n`, except for the results, some 60 bytes a push, and for paths and
    starts of each push.

    This function runs on the host. Under `jit`, `vmap` or `grad`, use `random_rollout`.

    Args:
        key: PRNG key of everything random.
        n: Number of pushes.
        slider: The slider, or a tuple of several; its surface is the mean of the sampled surfaces.
        hand: The hand.
        path: Configurations of the hand, as in `rollout`: (steps + 1, dof), or (n, steps + 1, dof) for a path of each
            push.
        pose: Pose of the slider at the start, world, m and rad: (3,), or (n, 3) for a start of each push. Of several
            sliders, (sliders, 3) or (n, sliders, 3).
        model: Distribution from which friction is sampled around `slider.surface`.
        solver: Solver of contact problems, as in `rollout`.
        table: A table whose friction depends on direction or place, as in `rollout`.
        fixtures: Walls and bodies that the slider may touch, as in `rollout`; their friction is not random.
        between: Friction of several sliders with each other, or its range, as in `random_rollout`.
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
    if traced((key, slider, hand, path, pose, model, table, fixtures, between)):
        raise TypeError(
            "monte_carlo works on the host; under jit, vmap or grad use random_rollout, with vmap over keys"
        )
    check_count("n", n)
    check_count("batch_size", 1 if batch_size is None else batch_size)
    check_type("model", model, FrictionModel)
    words = f"compiling and making {n} pushes"
    with progress_bar(words) if progress is True else nullcontext(progress or no_progress) as report:
        scene, limits = checked_random_scene(slider, hand, path, pose, between, solver, table, fixtures, int(n))
        typed_key, used = _typed_key(key), Devices.of(devices)
        default_tile = TILE if used.local[0].platform == "cpu" else ACCELERATOR_TILE
        tile = batch_size or min(default_tile, -(-n // TILE_MULTIPLE) * TILE_MULTIPLE)
        # connect the processes now: after compiling, one may be later than the 30 s that the others wait
        used.gather(0)
        shape, surface = shape_and_surface(scene.slider)
        distributions = Distributions.of(surface, model, limits)
        setup = Setup(typed_key, distributions, model, shape, scene.hand, solver, scene.table, scene.fixtures)
        rounds = Rounds(int(n), int(tile), setup, used, np.asarray(scene.start), np.asarray(scene.path), trajectories)
        results = _compute(rounds, scene.slider, checkpoint, report)
    share = float(np.mean(results["shrinkage"] > 0))
    if share > MANY_REPAIRS:
        warn(
            f"model: {share:.0%} of the sampled limit surfaces were not convex and were moved toward the mean; put the "
            "origin of the body frame at the center of the pressure, give a larger dof, or use "
            'sampler="sum_of_squares"'
        )
    results.setdefault("trajectory", None)
    return MonteCarlo(start=rounds.starts, **results, seconds=time.perf_counter() - start_time)


def _typed_key(key: Any) -> PRNGKeyArray:
    """Return one key, of either style, as a typed key."""
    try:
        typed = key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(jnp.asarray(key))
    except (AttributeError, TypeError, ValueError):
        typed = None
    if typed is None or typed.shape != ():
        raise ValueError(f"key must be one key, of jax.random.key or PRNGKey; got {key!r}")
    return typed


def _identity(rounds: Rounds, slider: Slider | tuple[Slider, ...]) -> dict[str, Any]:
    """Return what the bits of a run depend on: its arguments, versions and platform."""
    setup, device = rounds.setup, rounds.devices.local[0]
    key = jax.random.key_data(setup.key), str(jax.random.key_impl(setup.key))
    hand = setup.hand, setup.hand.poses(jnp.asarray(rounds.path))
    arguments = {"key": key, "slider": slider, "hand": hand, "path": rounds.path, "pose": rounds.start}
    arguments |= {name: getattr(setup, name) for name in ("model", "solver", "table", "fixtures")}
    arguments |= {"between": setup.distributions.between}
    # other instructions or flags of the compiler give other bits; another number of devices does not
    flags = sorted(flag for flag in os.environ.get("XLA_FLAGS", "").split() if "device_count" not in flag)
    return (
        {"n": rounds.n, "batch_size": rounds.tile, "trajectories": rounds.keep_trajectories}
        | {name: digest(value) for name, value in arguments.items()}
        | {name: version(name) for name in ("pushjax", "jax", "jaxlib")}
        | {"platform": device.platform, "device": device.device_kind, "xla_flags": flags}
        | {"processor": processor() if device.platform == "cpu" else ""}
    )


def _compute(
    rounds: Rounds, slider: Slider | tuple[Slider, ...], folder: str | Path | None, report: ProgressCallback
) -> Results:
    """Return the results of all pushes; compute those that are not in the checkpoint in `folder`."""
    devices, saved = rounds.devices, None
    parts, done = [], 0
    if folder is not None:
        folder, identity = Path(folder).expanduser(), _identity(rounds, slider)
        saved = devices.in_all_processes(lambda: Checkpoint(folder, identity, writes=devices.rank == 0))
        parts, done = devices.in_all_processes(saved.read)
        if len(np.unique(devices.gather(done))) > 1:
            raise CheckpointError(f"checkpoint: not every process sees the same in {folder}; give a shared one")
    # block: results that are not in the checkpoint yet; block_begin: index of their first push
    block, block_begin, block_time = [], done, time.perf_counter()
    report(done, rounds.n)
    for end, results in rounds.compute(done):
        block.append(results)
        is_due = end - block_begin >= BLOCK_PUSHES or time.perf_counter() - block_time >= BLOCK_SECONDS
        # all processes do what the first one says
        if saved is not None and (end == rounds.n or devices.gather(int(is_due))[0]):
            parts.append(_concatenated(block))
            devices.in_all_processes(partial(saved.write, block_begin, end, parts[-1]))
            block, block_begin, block_time = [], end, time.perf_counter()
        report(end, rounds.n)
    return _concatenated(parts + block)


def _concatenated(parts: list[Results]) -> Results:
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
