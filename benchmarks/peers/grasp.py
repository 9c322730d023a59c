"""The grasp of `benchmarks.grasps` by MuJoCo (C): the same square, the same two fingers, the same openings.

Each finger slides on a joint along y. A very stiff spring holds it, whose rest position moves at constant speed
("intvelocity"). The integrator "discrete" treats the stiffness implicitly, so the finger lags by a fraction of a step.
The rest position is moved ahead by the same amount (`Fingers.lead`). One call of `mj_step` closes the hand. The table
stands still.

The settings were found by trying about 600 random ones. The measure was the time at the largest timestep that stays
within 0.1 mm of the converged answer.

- A grasp amplifies the penetration depth of a finger: the square turns by 1 rad for 14 mm of closing when it is nearly
  straight. With the settings of a push (`scene.Settings`: 10 ms, 0.86) the converged answer differs from that of rigid
  contact by 1.1 to 1.5 mm. With stiffer fingers (7.5 ms, 0.98) it differs by 0.2 mm. The supports have settings of
  their own.
- The corners slide at up to 0.1 m/s, ten times as fast as in a push. On supports as stiff as in a push, the square hops
  and poses scatter by 0.2 mm at any timestep. On softer ones (40 ms, 0.5; 0.15 s of sliding) errors fall with the
  timestep.
- Twice the speed needs half the timestep. Slowing down toward the end, in eight pieces, gains nothing.
- "Newton" (tolerance 1e-6) and "CG" (1e-8) do about equally well; so do values of impratio from 50 to 170.
"""

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import grasps
from benchmarks.peers.mujoco import AWAY, StepError, by_timestep
from benchmarks.peers.scene import Scene, Settings, engine, options, pair, slider_body, supported

SUPPORTED = Settings(
    solver="CG", tolerance=1e-8, impratio=50.0, normal=0.040, sliding=0.150, impedance=(0.5, 0.5)
)  # for the supports on the table; the fingers have their own
SETTLE = 10.0  # s; simulated time until the square lies still
TIMESTEPS = (0.000625, 0.00125, 0.0025, 0.0035, 0.005, 0.006, 0.007, 0.0085, 0.010, 0.012, 0.014, 0.020)


@dataclass(frozen=True)
class Fingers:
    """Parameters of the two fingers."""

    normal: float = 0.0075  # time constant of a finger's normal contact, s, as in `Settings`
    sliding: float = 0.050  # time constant of a finger's friction, s, as in `Settings`
    impedance: tuple[float, float] = (0.98, 0.98)  # least and greatest, of a finger's contact, as in `Settings`
    mass: float = 1.0  # of a finger, kg
    stiffness: float = 1e8  # of the spring that moves a finger, N/m
    lead: float = 0.75  # number of timesteps by which the spring's rest position is ahead
    speed: float = 0.007  # of each finger, m/s


class Grasped(NamedTuple):
    """Results of the grasps."""

    pose: np.ndarray  # final poses of the square, (n, 3), m and rad
    processor: float  # CPU time of all grasps together, s


def build(scene: Scene, settings: Settings, fingers: Fingers, timestep: float) -> Any:
    """Build the MjModel of a grasp, in the world frame of `benchmarks.grasps`."""
    # Its qpos holds the slider's free joint (7 numbers), then the position of each finger along its direction of
    # closing.
    contact = scene.friction_tip, fingers.normal, fingers.sliding, fingers.impedance
    body = slider_body(scene)
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
      <default><geom contype="0" conaffinity="0" mass="0"/></default>
      <worldbody><geom name="table" type="plane" size="1 1 .1"/>{body}{moving}</worldbody>
      <contact>{supported(scene, settings)}{touching}</contact>
      <actuator>{motors}</actuator>
    </mujoco>""")


def grasp(scene: Scene, settings: Settings, fingers: Fingers, timestep: float, poses: np.ndarray) -> Grasped:
    """Simulate grasps of the square from poses (n, 3), m and rad, each from the first touch of a finger."""
    mujoco = engine()
    model = build(scene, settings, fingers, timestep)
    data = mujoco.MjData(model)
    height = _settled(model, data)
    ends = np.asarray(grasps.openings(jnp.asarray(poses), 1), float) / 2
    found, processor = [], 0.0
    for (x, y, theta), (first, last) in zip(poses, ends, strict=True):
        steps = max(1, int(np.ceil((first - last) / (fingers.speed * timestep) - 1e-9)))
        model.opt.timestep = (first - last) / (fingers.speed * steps)  # at most `timestep`, for whole steps
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
    """Return the height at which the square rests on the table, out of the fingers' reach."""
    data.qpos[0] = AWAY
    engine().mj_step(model, data, nstep=round(SETTLE / model.opt.timestep))
    return float(data.qpos[2])


def accuracy(
    scene: Scene, settings: Settings, fingers: Fingers, timesteps: tuple[float, ...] = TIMESTEPS
) -> tuple[list[StepError], np.ndarray]:
    """Return `mujoco.by_timestep` for the fan of grasps of `benchmarks.grasps`."""
    poses = grasps.fan()

    def run(timestep: float) -> tuple[np.ndarray, float]:
        found = grasp(scene, settings, fingers, timestep, poses)
        return found.pose, found.processor

    return by_timestep(run, timesteps)
