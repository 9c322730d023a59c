"""`monte_carlo`: from a key and a number to the distribution of where a slider ends up."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import PRNGKeyArray

from pushjax._checks import Numeric, traced
from pushjax.friction_model import FrictionModel
from pushjax.hands import Hand
from pushjax.monte_carlo.checkpoint import Checkpoint, CheckpointError, digest
from pushjax.monte_carlo.result import MonteCarlo
from pushjax.monte_carlo.tiles import Devices, Outcome, Setup, fetch, placed, submit
from pushjax.rollout import Slider, prepared
from pushjax.solve import ContactSolver, StickingSolver

TILE = 2048
Report = Callable[[int, int], None]
GRAIN = 64  # of tiles for fewer pushes
# Between two files of a checkpoint, at most: pushes (and the rest of a round), s (likewise)
BLOCK, PATIENCE = 16 * TILE, 20.0


def monte_carlo(
    key: PRNGKeyArray,
    n: int,
    slider: Slider,
    hand: Hand,
    path: Numeric,
    *,
    pose: Numeric,
    model: FrictionModel,
    solver: ContactSolver | StickingSolver | None = None,
    trajectories: bool = False,
    tile: int | None = None,
    devices: Sequence[Any] | None = None,
    checkpoint: str | Path | None = None,
    progress: bool | Report = False,
) -> MonteCarlo:
    """Push the slider `n` times along one path, each time under other friction.

    pose: (3,), or (n, 3), a start for each push, world. model: of which friction is drawn around `slider.surface`; push
    i is `random_rollout(fold_in(key, i), ...)`. path, solver: as in `rollout`. trajectories: keep every pose of
    every push (12 bytes a step in float32), not only the last.

    tile: how many pushes a device makes at once, in one compiled program; default 2048, or the next multiple of 64 for
    fewer. The memory it takes does not depend on n but for the results, some 60 bytes a push. devices: default all,
    also those of other processes (`jax.distributed`), which then all make the same call. The bits of push i depend on
    key, tile, `trajectories` and machine, not on how many devices and processes there are. Each device compiles its
    own program, once.

    checkpoint: a folder, seen by all processes, where what is done is kept; a run that finds its beginning there goes
    on from it to the same bits. progress: True for a bar on the terminal; or a function of (done, n).

    Raises ValueError as `rollout` and `FrictionModel.around` do, for n, tile below one, and CheckpointError (a
    ValueError) for a checkpoint of another run, a damaged one or one that cannot be written; what is there is kept.
    TypeError under `jit`, `vmap` or `grad`, which `random_rollout` is for.

    Source: Zhou et al. 2017, sections V and VI.
    """
    begun = time.perf_counter()
    if traced((key, slider, hand, path, pose, model)):
        raise TypeError(
            "monte_carlo works on the host; under jit, vmap or grad use random_rollout, with vmap over keys"
        )
    for name, value in (("n", n), ("tile", TILE if tile is None else tile)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{name} must be a whole number, at least 1; got {value!r}")
    n = int(n)
    slider, hand, p, start, _ = prepared(slider, hand, path, pose, 0.0, pushes=n)
    width = int(tile) if tile is not None else min(TILE, -(-n // GRAIN) * GRAIN)
    raw, impl = _raw(key)
    on = Devices.of(devices)
    if on.several:
        # they connect now, together: after compiling, one may be later than the others wait (30 s)
        multihost_utils.sync_global_devices("pushjax monte_carlo")
    shared = raw, model.around(slider.surface), model, slider.shape, hand, p, solver
    run = _Run(n, width, Setup(*shared), impl, on, np.asarray(start), trajectories)
    kept: Checkpoint | None = None
    if checkpoint is not None:
        parts = {"n": n, "tile": width, "trajectories": trajectories, "key": digest(raw, impl)}
        parts |= {"slider": digest(slider), "hand": digest(hand, hand.poses(p)), "path": digest(p)}
        parts |= {"pose": digest(start), "model": digest(model), "solver": digest(solver) if solver else "default"}
        versions = {name: version(name) for name in ("pushjax", "jax", "jaxlib")}
        parts |= versions | {"platform": on.mine[0].platform}
        folder = Path(checkpoint)
        kept = run.together(lambda: Checkpoint(folder, parts, writes=on.writes))
    with _shown(progress) as report:
        found = run.all(kept, report)
    starts = np.broadcast_to(run.start, (n, 3))
    return MonteCarlo(starts, *found, time.perf_counter() - begun)


def _shown(progress: bool | Report) -> Any:
    if progress is True:
        from pushjax._progress import progress_bar  # draws on terminals: not for who only imports this

        return progress_bar()
    return nullcontext(progress or (lambda done, total: None))


def _raw(key: Any) -> tuple[Any, Any]:
    """A key's data, and of which kind it is."""
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
    """A run, and how far it is."""

    def __init__(self, n: int, tile: int, setup: Setup, impl: Any, devices: Devices, start: np.ndarray, keep: bool):
        self.n, self.tile, self.impl, self.devices, self.start, self.keep = n, tile, impl, devices, start, keep
        self.setups, self.round = placed(setup, devices), tile * devices.count

    def together(self, action: Callable[[], Any]) -> Any:
        """What `action` gives; where it fails in one process it fails in all, so that none waits for another."""
        error, value = None, None
        try:
            value = action()
        except CheckpointError as caught:
            error = caught
        failed = error is not None
        if self.devices.several:
            failed = bool(np.any(multihost_utils.process_allgather(np.int32(failed))))
        if failed:
            raise error or CheckpointError("checkpoint: another process could not go on; it says why")
        return value

    def _due(self, pushes: int, seconds: float) -> bool:
        due = pushes >= BLOCK or seconds >= PATIENCE
        return bool(multihost_utils.broadcast_one_to_all(np.int32(due))) if self.devices.several else due

    def all(self, kept: Checkpoint | None, report: Report) -> Outcome:
        with ThreadPoolExecutor(len(self.setups)) as pool:
            return self._all(kept, report, pool)

    def _all(self, kept: Checkpoint | None, report: Report, pool: ThreadPoolExecutor) -> Outcome:
        parts, done = self._resumed(kept)
        block, begun, since = [], done, time.perf_counter()  # what is not in the checkpoint yet, and from where
        waiting: tuple[int, int, list[Outcome]] | None = None
        report(done, self.n)
        while done < self.n or waiting is not None:
            ahead = self._submit(done, pool) if done < self.n else None  # the devices go on while the host copies
            if waiting is not None:
                first, last, outcome = waiting
                host = fetch(outcome, self.devices)
                block.append(jax.tree.map(lambda leaf, k=last - first: leaf[:k], host))
                if kept is not None and (last == self.n or self._due(last - begun, time.perf_counter() - since)):
                    parts.append(_joined(block))
                    self.together(partial(kept.write, begun, last, _named(parts[-1])))
                    block, begun, since = [], last, time.perf_counter()
                report(last, self.n)
            waiting = ahead
            done = done if ahead is None else ahead[1]
        return _joined(parts + block)

    def _submit(self, first: int, pool: ThreadPoolExecutor) -> tuple[int, int, list[Outcome]]:
        last = min(first + self.round, self.n)
        indices = np.minimum(np.arange(first, first + self.round), self.n - 1).astype(np.uint32).reshape(-1, self.tile)
        poses = np.broadcast_to(self.start, (self.n, 3))[indices]
        return first, last, submit(self.setups, self.impl, self.devices, indices, poses, self.keep, pool)

    def _resumed(self, kept: Checkpoint | None) -> tuple[list[Outcome], int]:
        if kept is None:
            return [], 0
        blocks = kept.blocks()
        reached = blocks[-1][1] if blocks else 0
        names = tuple(name for name in Outcome._fields if self.keep or name != "trajectory")

        def read() -> list[Outcome]:
            if self.devices.several and len(np.unique(multihost_utils.process_allgather(np.int32(reached)))) > 1:
                raise CheckpointError(
                    f"checkpoint: not every process sees the same in {kept.folder}; give a shared one"
                )
            return [Outcome(**({"trajectory": None} | kept.read(path, names))) for _, _, path in blocks]

        return self.together(read), reached


def _joined(parts: list[Outcome]) -> Outcome:
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _named(outcome: Outcome) -> dict[str, np.ndarray]:
    return {name: leaf for name, leaf in outcome._asdict().items() if leaf is not None}
