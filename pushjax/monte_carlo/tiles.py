"""One round of a Monte Carlo run: a tile of pushes on every device.

Each device runs a program of its own for a whole tile, the same whatever the number of devices and processes, so the
bits do not depend on it. (One program partitioned over the devices is optimised differently from one for a single
device: of a million draws, some thousands came out a rounding apart.) Push i's key is `fold_in(key, i)`; what is drawn
is a program apart, so that it does not depend on what is done with it either.
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

from pushjax._programs import uncollected
from pushjax.friction_model import FrictionModel, RandomSurface
from pushjax.hands import Hand
from pushjax.random_rollout import draw, push_under
from pushjax.shapes import Shape
from pushjax.solve import ContactSolver, StickingSolver
from pushjax.status import ContactMode


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


class Devices(NamedTuple):
    """Those of a run, first those of the first process. mine: this process's own. first: the place among all of the
    first of mine. several: whether other processes have a part."""

    count: int
    mine: tuple[Any, ...]
    first: int
    several: bool
    writes: bool

    @staticmethod
    def of(devices: Sequence[Any] | None) -> "Devices":
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
    """The setup on each device."""
    return [jax.device_put(setup, device) for device in devices.mine]


def submit(
    setups: list[Setup], impl: Any, devices: Devices, indices: np.ndarray, poses: np.ndarray, keep: bool, pool: Executor
) -> list[Outcome]:
    """Start one round; it is done when its numbers are asked for. indices, poses: (devices, tile, ...), of all."""

    def start(k: int) -> Outcome:
        setup, there = setups[k], devices.first + k
        index, pose = jax.device_put((indices[there], poses[there]), devices.mine[k])
        steps = len(setup.path) - 1
        draws = _draw(impl, steps, setup.key, setup.around, setup.model, index)
        rest = setup.shape, setup.hand, setup.path, setup.solver
        return _push(setup.model.every, keep, draws, rest, pose)

    return list(pool.map(start, range(len(setups))))  # side by side: each compiles its own, once


def fetch(outcomes: list[Outcome], devices: Devices) -> Outcome:
    """All that a round gave, of all processes, on the host, in order."""
    mine = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *outcomes)
    if not devices.several:
        return mine
    return jax.tree.map(lambda leaf: np.concatenate(list(multihost_utils.process_allgather(leaf))), mine)


@uncollected
@partial(jax.jit, static_argnums=(0, 1))
def _draw(impl: Any, steps: int, key: Array, around: RandomSurface, model: FrictionModel, index: Array):
    root = jax.random.wrap_key_data(key, impl=impl)
    return jax.vmap(lambda i: draw(jax.random.fold_in(root, i), around, model, steps))(index)


@uncollected
@partial(jax.jit, static_argnums=(0, 1))
def _push(every: int | None, keep: bool, draws, rest: tuple, poses: Array) -> Outcome:
    shape, hand, path, solver = rest
    return jax.vmap(lambda draws, pose: _outcome(draws, shape, hand, path, pose, solver, every, keep))(draws, poses)


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
