"""The grasp of `bench.grasps` by MuJoCo (C): the same square, the same two fingers, the same openings.

A finger slides on a joint along y, held by a very stiff spring whose rest moves at constant speed ("intvelocity"); the
integrator "discrete" takes its stiffness implicitly, so it lags behind by a part of a step, and is sent ahead by that.
One call of `mj_step` closes the hand. The table stands still.

What the settings do, found by some 600 random ones, with the time at the largest step within 0.1 mm of the converged
answer as the measure:

- How far a finger sinks in is multiplied here: the square turns by 1 rad for 14 mm of closing when it is nearly
  straight. With the settings of a push (`scene.Settings`: 10 ms, 0.86) the converged answer is 1.1 to 1.5 mm off that
  of rigid contact, with stiffer fingers (7.5 ms, 0.98) 0.2 mm. The supports stay apart from them.
- The corners slide at up to 0.1 m/s, ten times as fast as in a push. On supports as stiff as there the square hops, and
  poses scatter by 0.2 mm at any step; on softer ones (40 ms, 0.5; 0.15 s of sliding) errors fall with the step.
- Twice the speed needs half the step. Slowing down towards the end, in eight pieces, gains nothing.
- "Newton" (tolerance 1e-6) and "CG" (1e-8) do about as well; so do values of impratio from 50 to 170.
"""

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pushjax.bench import grasps
from pushjax.bench.peers.mujoco import AWAY, StepError, by_timestep
from pushjax.bench.peers.scene import Scene, Settings, engine, options, pair, slider_body, supported

SUPPORTED = Settings(
    solver="CG", tolerance=1e-8, impratio=50.0, normal=0.040, sliding=0.150, impedance=(0.5, 0.5)
)  # of the table; the fingers have their own
SETTLE = 10.0  # s, until the square lies still
TIMESTEPS = (0.000625, 0.00125, 0.0025, 0.0035, 0.005, 0.006, 0.007, 0.0085, 0.010, 0.012, 0.014, 0.020)


@dataclass(frozen=True)
class Fingers:
    """normal, sliding, impedance: of a finger's contact, as in `Settings`. mass (kg), stiffness (N/m): of a finger and
    of what moves it. lead: how many steps its spring's rest is ahead. speed: m/s, of each."""

    normal: float = 0.0075
    sliding: float = 0.050
    impedance: tuple[float, float] = (0.98, 0.98)
    mass: float = 1.0
    stiffness: float = 1e8
    lead: float = 0.75
    speed: float = 0.007


class Grasped(NamedTuple):
    """pose: (n, 3) m, rad, final. processor: seconds of all."""

    pose: np.ndarray
    processor: float


def build(scene: Scene, settings: Settings, fingers: Fingers, timestep: float) -> Any:
    """The MjModel. qpos: the slider's free joint (7), and how far each finger has come along its own way; these are
    -`AWAY` to begin with. World as in `bench.grasps`."""
    contact = scene.friction_tip, fingers.normal, fingers.sliding, fingers.impedance
    body, mesh = slider_body(scene)
    ways = {"lower": 1, "upper": -1}
    moving = "".join(
        f'<body name="{name}"><joint name="{name}" type="slide" axis="0 {way} 0"/>'
        f'<inertial mass="{fingers.mass}" pos="0 0 0" diaginertia="1 1 1"/>'
        f'<geom name="{name}" type="sphere" size="{scene.tip_radius}"/></body>'
        for name, way in ways.items()
    )
    motors = "".join(f'<intvelocity joint="{name}" kp="{fingers.stiffness}" actrange="-1 1"/>' for name in ways)
    touching = "".join(pair(name, "slider", *contact) for name in ways)
    return engine().MjModel.from_xml_string(f"""<mujoco>
      {options(settings, timestep)}
      <asset>{mesh}</asset>
      <default><geom contype="0" conaffinity="0" mass="0"/></default>
      <worldbody><geom name="table" type="plane" size="1 1 .1"/>{body}{moving}</worldbody>
      <contact>{supported(scene, settings)}{touching}</contact>
      <actuator>{motors}</actuator>
    </mujoco>""")


def grasp(scene: Scene, settings: Settings, fingers: Fingers, timestep: float, poses: np.ndarray) -> Grasped:
    """From poses (n, 3) of the square, each from the opening at which a finger first touches it.

    timestep (s): at most; a little less, so that a whole number of steps makes each grasp.
    """
    mujoco = engine()
    model = build(scene, settings, fingers, timestep)
    data = mujoco.MjData(model)
    height = _settled(model, data)
    ends = np.asarray(grasps.openings(jnp.asarray(poses), 1), float) / 2
    found, processor = [], 0.0
    for (x, y, theta), (first, last) in zip(poses, ends, strict=True):
        steps = max(1, int(np.ceil((first - last) / (fingers.speed * timestep) - 1e-9)))
        model.opt.timestep = (first - last) / (fingers.speed * steps)
        mujoco.mj_resetData(model, data)
        data.qpos[:] = (x, y, height, np.cos(theta / 2), 0, 0, np.sin(theta / 2), -first, -first)
        data.qvel[6:] = data.ctrl[:] = fingers.speed
        data.act[:] = -first + fingers.lead * fingers.speed * model.opt.timestep
        busy = time.process_time()
        mujoco.mj_step(model, data, nstep=steps)
        processor += time.process_time() - busy
        found.append((*data.qpos[:2], 2 * np.arctan2(data.qpos[6], data.qpos[3])))
    return Grasped(np.array(found), processor)


def _settled(model: Any, data: Any) -> float:
    """At what height the square lies on the table, the fingers away."""
    data.qpos[0] = AWAY
    engine().mj_step(model, data, nstep=round(SETTLE / model.opt.timestep))
    return float(data.qpos[2])


def accuracy(
    scene: Scene, settings: Settings, fingers: Fingers, timesteps: tuple[float, ...] = TIMESTEPS
) -> tuple[list[StepError], np.ndarray]:
    """`mujoco.by_timestep` of the fan of `bench.grasps`."""
    poses = grasps.fan()

    def run(timestep: float) -> tuple[np.ndarray, float]:
        found = grasp(scene, settings, fingers, timestep, poses)
        return found.pose, found.processor

    return by_timestep(run, timesteps)
