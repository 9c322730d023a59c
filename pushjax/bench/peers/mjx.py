"""The same pushes by MJX, MuJoCo in JAX: `vmap` over pushes, `lax.scan` over steps, one compiled program a batch.

What differs from `mujoco`, because MJX (3.17, its JAX implementation) has neither conveyors nor the integrator
"discrete": the tip slides on a joint of its own and is put back on its path, at its speed, after each step; and the
normal time constant must be two steps, not one. Spheres on a plane and a sphere against a box are exact in MJX.

In float32 the solver stalls on rounding before it has converged: every step takes all the iterations it may, sticking
tips creep by 0.2 mm and final poses are 0.25 mm off. In float64 it is right (0.09 mm at 5 ms, 2 µm of creep) and three
times as fast, so that is the default. Of its two solvers Newton is the better one; a batch iterates until its slowest
push has converged, hence a low limit.
"""

import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pushjax.bench.peers.mujoco import Pushed, final_pose, frame, initial, settle, slip
from pushjax.bench.peers.scene import Scene, Settings, build, engine

SETTINGS = replace(
    Settings(), solver="Newton", integrator="implicitfast", iterations=10, line_search=10, tolerance=1e-8
)
TIMESTEP = SETTINGS.normal / 2


class Batch:
    """Pushes of one number of steps, compiled. compile_seconds: what that took. pushed() runs them.

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
        if settings.normal < 2 * timestep * (1 - 1e-9):
            raise ValueError(f"normal must be at least two timesteps, {2 * timestep:g} s; got {settings.normal:g}")
        self.scene, self.starts, self.ends = scene, np.asarray(starts, float), np.asarray(ends, float)
        model = build(scene, settings, timestep, conveyor=False)
        settled = settle(model, settings)
        frames = [frame(scene, timestep, *each) for each in zip(self.starts, self.ends, strict=True)]
        steps = max(each.steps for each in frames)
        self.frames = [each._replace(steps=steps, timestep=each.timestep * each.steps / steps) for each in frames]
        qpos = np.array([initial(model, settled, *each) for each in zip(frames, self.starts, strict=True)])
        begin = time.perf_counter()
        with (
            jax.numpy_rank_promotion("allow"),
            jax.enable_x64(double or jnp.zeros(()).dtype == jnp.float64),
        ):  # MJX promotes
            self.arguments = (jnp.asarray(qpos), jnp.asarray([each.timestep for each in self.frames]))
            program = jax.jit(jax.vmap(_rollout(model, scene.speed, steps)))
            self.program = program.lower(*self.arguments).compile()
        self.compile_seconds = time.perf_counter() - begin

    def pushed(self) -> Pushed:
        begin, busy = time.perf_counter(), time.process_time()
        qpos = np.asarray(jax.block_until_ready(self.program(*self.arguments)), float)
        seconds, processor = time.perf_counter() - begin, time.process_time() - busy
        pose = np.array([final_pose(*each) for each in zip(self.frames, qpos, self.starts, strict=True)])
        return Pushed(pose, slip(self.scene, pose, self.starts, self.ends), seconds, processor)


def _rollout(model: Any, speed: float, steps: int):
    """From positions (nq,) and the timestep of a push to its final positions."""
    engine()
    from mujoco import mjx

    on_device = mjx.put_model(model)
    template = mjx.make_data(model)

    def rollout(qpos, timestep):
        mine = on_device.replace(opt=on_device.opt.replace(timestep=timestep))
        data = template.replace(qpos=qpos, qvel=template.qvel.at[6].set(speed))

        def step(data, k):
            data = mjx.step(mine, data)
            on_path = data.replace(
                qpos=data.qpos.at[7].set((k + 1) * timestep * speed), qvel=data.qvel.at[6].set(speed)
            )
            return on_path, None

        return jax.lax.scan(step, data, jnp.arange(steps))[0].qpos

    return rollout


def push(scene: Scene, settings: Settings, timestep: float, starts: np.ndarray, ends: np.ndarray) -> Pushed:
    """As `mujoco.push`, compiled and run once; its seconds leave the compilation out. For timings keep a `Batch`."""
    return Batch(scene, settings, timestep, starts, ends).pushed()
