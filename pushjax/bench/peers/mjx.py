"""The same pushes by MJX, MuJoCo in JAX: `vmap` over pushes, a loop over steps, one compiled program a batch.

What differs from `mujoco`, because MJX (3.17, its JAX implementation) has neither conveyors nor the integrator
"discrete": the tip slides on a joint of its own and is put back on its path, at its speed, after each step; and the
normal time constant must be two steps, not one. Spheres on a plane and a sphere against a box are exact in MJX.

So a larger step has softer contacts (`softened`), and there are two limits to it: 0.1 mm from the converged answer of
the same contacts, and that answer within 0.2 mm of exact Coulomb friction (`coulomb`). On four supports:

- The tip's sliding has three steps' time, else it creeps unevenly: with two, the least that there is, MJX is 0.20 mm
  off its converged answer at 7 ms steps, with three 0.01 mm.
- An impedance of 0.9 sinks in less than the 0.86 of `Settings`: at 10 ms steps the converged answer is 0.16 mm off the
  exact one, not 0.21. At 0.93 poses begin to scatter, by 0.3 mm at 11 ms; from 0.95 on the slider hops, by millimetres
  and more.
- From 5 to 11 ms the error stays under 0.1 mm (0.06 at 11). It is the exact answer that sets the limit: the converged
  one is 0.07 mm off it at 5 ms, 0.16 at 10, 0.19 at 11, 0.23 at 12. So the steps are 11 ms, which takes half as long as
  5 ms.
- That is so of four supports only: on three the slider hops away by centimetres from 8.5 ms on, and is right at 7.

Time constants are arguments of the program, since it takes 20 s to compile; that costs no time in the run.

In float32 the solver stalls on rounding before it has converged: every step takes all the iterations it may, and final
poses are 2.7 mm off at 5 ms and 0.7 mm at 11. In float64 it is right (6 and 12 µm of creep at 11 ms) and two to three
times as fast, so that is the default. Of its two solvers Newton is the better one; a batch iterates until its slowest
push has converged, hence a low limit: 30 iterations, not 10, change no pose.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pushjax.bench.peers.mujoco import (
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
from pushjax.bench.peers.scene import Scene, Settings, build, engine
from pushjax.bench.tasks import error_mm

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
    """Pushes compiled for any number of steps. compile_seconds: what that took. pushed() runs them.

    starts, ends: (n, 2) m, as of `mujoco.push`. timestep (s): of the longest push at most; shorter ones have as many
    steps, which are shorter. double: in float64, whatever JAX's default is; else in that.

    Raises ValueError for a scene with an outline, a time constant under two steps, or without the package.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        timestep: float,
        starts: np.ndarray,
        ends: np.ndarray,
        double: bool = True,
    ):
        if scene.outline:
            raise ValueError("mjx pushes squares only; the scene has an outline")
        self.scene, self.settings, self.timestep = scene, settings, timestep
        self.starts, self.ends, self.double = np.asarray(starts, float), np.asarray(ends, float), double
        _, arguments = self._at(timestep, settings)
        begin = time.perf_counter()
        with self._numbers():
            rollout = _rollout(build(scene, settings, timestep, conveyor=False), scene.speed)
            self.program = jax.jit(jax.vmap(rollout, in_axes=(0, 0, None, None))).lower(*arguments).compile()
        self.compile_seconds = time.perf_counter() - begin

    def pushed(self, timestep: float | None = None, settings: Settings | None = None) -> Pushed:
        """With what is compiled already also at another timestep, and with other time constants."""
        frames, arguments = self._at(timestep or self.timestep, settings or self.settings)
        begin, busy = time.perf_counter(), time.process_time()
        qpos = np.asarray(jax.block_until_ready(self.program(*arguments)), float)
        seconds, processor = time.perf_counter() - begin, time.process_time() - busy
        pose = np.array([final_pose(*each) for each in zip(frames, qpos, self.starts, strict=True)])
        return Pushed(pose, slip(self.scene, pose, self.starts, self.ends), seconds, processor)

    def _at(self, timestep: float, settings: Settings) -> tuple[list[Frame], tuple]:
        """The pushes, all of as many steps, and the arguments of the program for them."""
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
        double = self.double or jnp.zeros(()).dtype == jnp.float64
        with jax.numpy_rank_promotion("allow"), jax.enable_x64(double):  # MJX promotes
            yield


CONTACTS = ("pair_solref", "pair_solreffriction", "pair_solimp")


def _contacts(model: Any) -> dict[str, np.ndarray]:
    """Time constants and impedances of all contacts: arguments, since MJX takes long to compile."""
    return {name: getattr(model, name).copy() for name in CONTACTS}


def _rollout(model: Any, speed: float):
    """From positions (nq,), the timestep of a push, its number of steps and its contacts to its final positions."""
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
    """`SETTINGS` with time constants as long as this timestep asks for."""
    normal, tip_sliding = max(SETTINGS.normal, 2 * timestep), max(SETTINGS.tip_sliding, 3 * timestep)
    return replace(SETTINGS, normal=normal, tip_sliding=tip_sliding)


def accuracy(batch: Batch) -> list[StepError]:
    """Rows of `mujoco.fan`, as of `mujoco.by_timestep`; but each against its own converged answer, of the same
    `softened` settings. batch: what is timed."""
    few = Batch(batch.scene, SETTINGS, CONVERGED, *fan(batch.scene))

    def at(timestep: float) -> StepError:
        settings = softened(timestep)
        pose, exact = (few.pushed(each, settings).pose for each in (timestep, CONVERGED))
        processor = batch.pushed(timestep, settings).processor / len(batch.starts)
        return StepError(timestep, float(error_mm(pose, exact).max()), 1e6 * processor)

    return refined([at(each) for each in sorted(TIMESTEPS, reverse=True)], at)


def push(scene: Scene, settings: Settings, timestep: float, starts: np.ndarray, ends: np.ndarray) -> Pushed:
    """As `mujoco.push`, compiled and run once; its seconds leave the compilation out. For timings keep a `Batch`."""
    return Batch(scene, settings, timestep, starts, ends).pushed()
