"""The same pushes by MJX, MuJoCo in JAX: `vmap` over pushes, a loop over steps, one compiled program per batch.

Two things differ from `mujoco`, because MJX (3.17, its JAX implementation) has neither conveyors nor the integrator
"discrete". The tip slides on its own joint, and its position and speed are reset to the path after each step. The
normal time constant must be at least two timesteps instead of one. Spheres on a plane and a sphere against a box are
exact in MJX.

A larger timestep therefore has softer contacts (`softened`). Two conditions limit it: the error against the converged
answer of the same contacts must be at most 0.1 mm, and that converged answer must be within 0.2 mm of exact Coulomb
friction (`coulomb`). On four supports:

- The tip's time constant of sliding is three timesteps, because with fewer the tip creeps unevenly. With two, the least
  possible, MJX differs from its converged answer by 0.20 mm at 7 ms steps; with three, by 0.01 mm.
- An impedance of 0.9 gives less penetration than the 0.86 of `Settings`: at 10 ms steps the converged answer differs
  from the exact one by 0.16 mm instead of 0.21. At 0.93 poses begin to scatter, by 0.3 mm at 11 ms. From 0.95 on the
  slider hops, by millimeters and more.
- From 5 to 11 ms the error stays under 0.1 mm (0.06 at 11). The exact answer sets the limit: the converged one differs
  from it by 0.07 mm at 5 ms, 0.16 at 10, 0.19 at 11, 0.23 at 12. The timestep is therefore 11 ms, which takes half as
  long as 5 ms.
- This holds for four supports only. On three, the slider hops away by centimeters from 8.5 ms on; 7 ms is correct.

Time constants are arguments of the compiled program, because it takes 20 s to compile. This does not slow the run.

In float32 the solver stalls at roundoff before it converges: every step takes the largest number of iterations, and
final poses are off by 2.7 mm at 5 ms and 0.7 mm at 11. In float64 it is correct (6 and 12 µm of creep at 11 ms) and two
to three times as fast, so float64 is the default. Newton is the better one of its two solvers. A batch iterates until
its slowest push has converged, so the limit is low; 30 iterations instead of 10 change no pose.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.mujoco import (
    Frame,
    Pushed,
    StepError,
    fan,
    final_pose,
    frame,
    initial,
    refined,
    settle,
    slip,
)
from benchmarks.peers.scene import Scene, Settings, build, engine
from benchmarks.reference_push import error_mm

SETTINGS = replace(
    Settings(),
    solver="Newton",
    integrator="implicitfast",
    iterations=10,
    line_search=10,
    tolerance=1e-8,
    impedance=(0.9, 0.9),
)
TIMESTEPS = (0.0025, 0.005, 0.006, 0.007, 0.0085, 0.010, 0.011)  # s; the contacts of longer ones are too soft
CONVERGED = 0.00125  # s


class Batch:
    """A batch of pushes of a square, compiled for any number of steps and run by `pushed`."""

    # All pushes have the same number of steps, so shorter pushes have shorter timesteps.

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        timestep: float,  # upper limit of that of the longest push, s
        starts: np.ndarray,  # of the tip's center, (n, 2), m, as for `mujoco.push`
        ends: np.ndarray,  # of the tip's center, (n, 2), m
        double: bool = True,  # whether to compute in float64 whatever JAX's default is
    ):
        self.scene, self.settings, self.timestep = scene, settings, timestep
        self.starts, self.ends, self.double = np.asarray(starts, float), np.asarray(ends, float), double
        _, arguments = self._at(timestep, settings)
        begin = time.perf_counter()
        with self._numbers():
            rollout = _rollout(build(scene, settings, timestep, conveyor=False), scene.speed)
            self.program = jax.jit(jax.vmap(rollout, in_axes=(0, 0, None, None))).lower(*arguments).compile()
        self.compile_seconds = time.perf_counter() - begin  # wall time of building and compiling

    def pushed(self, timestep: float | None = None, settings: Settings | None = None) -> Pushed:
        """Run the compiled program, with another timestep (s), time constants and impedances if given."""
        frames, arguments = self._at(timestep or self.timestep, settings or self.settings)
        busy = time.process_time()
        qpos = np.asarray(jax.block_until_ready(self.program(*arguments)), float)
        processor = time.process_time() - busy
        pose = np.array([final_pose(*each) for each in zip(frames, qpos, self.starts, strict=True)])
        return Pushed(pose, slip(self.scene, pose, self.starts, self.ends), processor)

    def _at(self, timestep: float, settings: Settings) -> tuple[list[Frame], tuple]:
        """Return the frames of the pushes, all with the same number of steps, and the arguments of the program."""
        if settings.normal < 2 * timestep * (1 - 1e-9):
            raise ValueError(f"normal must be at least two timesteps, {2 * timestep:g} s; got {settings.normal:g}")
        model = build(self.scene, settings, timestep, conveyor=False)
        settled = settle(model, settings)
        frames = [frame(self.scene, timestep, *each) for each in zip(self.starts, self.ends, strict=True)]
        steps = max(each.steps for each in frames)
        frames = [each._replace(steps=steps, timestep=each.timestep * each.steps / steps) for each in frames]
        qpos = np.array([initial(model, settled, *each) for each in zip(frames, self.starts, strict=True)])
        timesteps = np.array([each.timestep for each in frames])
        with self._numbers():
            return frames, jax.tree.map(jnp.asarray, (qpos, timesteps, steps, _contacts(model)))

    @contextmanager
    def _numbers(self) -> Iterator[None]:
        """Set the floating type of the batch, and allow rank promotion."""
        double = self.double or jnp.zeros(()).dtype == jnp.float64
        with jax.numpy_rank_promotion("allow"), jax.enable_x64(double):  # MJX promotes ranks
            yield


CONTACTS = ("pair_solref", "pair_solreffriction", "pair_solimp")


def _contacts(model: Any) -> dict[str, np.ndarray]:
    """Return time constants and impedances of all contacts; as arguments they need no new compilation of MJX."""
    return {name: getattr(model, name).copy() for name in CONTACTS}


def _rollout(model: Any, speed: float):
    """Return a function from qpos, (nq,), timestep, number of steps and contacts of a push to its final qpos, (nq,)."""
    engine()
    from mujoco import mjx

    on_device = mjx.put_model(model)
    template = mjx.make_data(model)

    def rollout(qpos, timestep, steps, contacts):
        mine = on_device.replace(opt=on_device.opt.replace(timestep=timestep), **contacts)
        data = template.replace(qpos=qpos, qvel=template.qvel.at[6].set(speed))

        def step(k, data):
            data = mjx.step(mine, data)
            return data.replace(qpos=data.qpos.at[7].set((k + 1) * timestep * speed), qvel=data.qvel.at[6].set(speed))

        return jax.lax.fori_loop(0, steps, step, data).qpos

    return rollout


def softened(timestep: float) -> Settings:
    """Return `SETTINGS` with time constants long enough for this timestep (s)."""
    normal, tip_sliding = max(SETTINGS.normal, 2 * timestep), max(SETTINGS.tip_sliding, 3 * timestep)
    return replace(SETTINGS, normal=normal, tip_sliding=tip_sliding)


def accuracy(batch: Batch) -> list[StepError]:
    """Return error and cost by timestep, as `mujoco.by_timestep` does, for the pushes of `mujoco.fan`."""
    # Each timestep is compared with its own converged answer, computed with the same `softened` settings.
    few = Batch(batch.scene, SETTINGS, CONVERGED, *fan(batch.scene))

    def at(timestep: float) -> StepError:
        settings = softened(timestep)
        pose, exact = (few.pushed(each, settings).pose for each in (timestep, CONVERGED))
        processor = batch.pushed(timestep, settings).processor / len(batch.starts)
        return StepError(timestep, float(error_mm(pose, exact).max()), 1e6 * processor)

    return refined([at(each) for each in sorted(TIMESTEPS, reverse=True)], at)
