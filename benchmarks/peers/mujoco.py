"""Pushes by MuJoCo (C): final poses, creep of a sticking tip, the timestep that they need, and their computing time.

One call of `mj_step` with the number of steps computes a whole push in C, without Python between the steps.
`mujoco.rollout` does the same work, and also records every state, in the same time.

The slider starts at rest on the table, after it has settled; settling is not timed. The final pose is read when the tip
arrives at its end, before anything coasts.

The largest sufficient timestep is searched on a grid and then by bisection, so that the grid is no disadvantage for
MuJoCo: the search finds 15.4 ms where the grid alone has 14.1 on four supports, and 12.2 where it has 10 on three.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.peers.scene import Scene, Settings, build, engine
from benchmarks.reference_push import error_mm

SETTLE = 400  # time until the slider lies still, in time constants of normal contact
AWAY = 10.0  # m; where the slider settles, out of the tip's reach
# Offset (m) along the side and angle (rad) from its normal. The first four stick on most supports; the others slide.
PUSHES = (
    (0.0, 0.0),
    (0.004, 0.0),
    (0.01, 0.0),
    (0.02, 0.0),
    (0.03, 0.0),
    (-0.015, 0.175),
    (0.02, -0.44),
    (-0.03, 0.61),
)
REFINEMENTS = 3.5  # halvings of the time constant down to the timestep that counts as converged
COARSEST = 8  # largest timestep of the grid, in time constants: contact is certainly lost
BISECTIONS = 4  # between the largest good timestep and the first bad one: a factor of √2 becomes 1.02


class Pushed(NamedTuple):
    """Results of the pushes."""

    pose: np.ndarray  # final poses of the slider, (n, 3), m and rad, in the frame of its start pose
    # Distance that the tip's contact has slid along the slider's side, (n,), m; positive to the left of the inward
    # normal.
    slip: np.ndarray
    processor: float  # CPU time of the pushes, s, without building and settling


class StepError(NamedTuple):
    """Error and cost at one timestep."""

    timestep: float  # s
    error_mm: float  # largest deviation of a final pose from that of the smallest timestep
    us_per_push: float  # CPU time, µs


class Frame(NamedTuple):
    """The world frame in which MuJoCo computes a push, and the timestep."""

    rotation: np.ndarray  # from the slider's start frame to the world frame, (2, 2)
    angle: float  # of the same rotation, rad
    steps: int
    timestep: float  # s


def fan(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the paths of `PUSHES`: on the square's left side, just touching it at the start."""
    # They are start and end positions of the tip's center, both (n, 2), m, in the slider's start frame.
    offset, angle = np.array(PUSHES).T
    starts = np.stack([np.full(len(PUSHES), -scene.side / 2 - scene.tip_radius), offset], axis=1)
    return starts, starts + scene.travel * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def push(scene: Scene, settings: Settings, timestep: float, starts: np.ndarray, ends: np.ndarray) -> Pushed:
    """Push a slider that starts at pose zero, by a tip whose center moves from start to end, both (n, 2), m."""
    starts, ends = np.asarray(starts, float).reshape(-1, 2), np.asarray(ends, float).reshape(-1, 2)
    model = build(scene, settings, timestep)
    settled = settle(model, settings)
    frames = [frame(scene, timestep, *each) for each in zip(starts, ends, strict=True)]
    qpos = np.array([initial(model, settled, *each) for each in zip(frames, starts, strict=True)])
    data, busy = engine().MjData(model), time.process_time()
    for here, row in zip(frames, qpos, strict=True):
        engine().mj_resetData(model, data)
        model.opt.timestep = here.timestep
        data.qpos[:] = row
        data.qvel[0] = -scene.speed  # the slider moves with the conveyor
        engine().mj_step(model, data, nstep=here.steps)
        row[:] = data.qpos
    processor = time.process_time() - busy
    pose = np.array([final_pose(*each) for each in zip(frames, qpos, ends, strict=True)]).reshape(-1, 3)
    return Pushed(pose, slip(scene, pose, starts, ends), processor)


def settle(model: Any, settings: Settings) -> np.ndarray:
    """Return the slider at rest on the table, (7,): position (m) and quaternion of its free joint."""
    mujoco = engine()
    data, moving = mujoco.MjData(model), model.geom_surfacevel.copy()
    data.qpos[0] = AWAY
    model.geom_surfacevel[:] = 0
    mujoco.mj_step(model, data, nstep=round(SETTLE * settings.normal / model.opt.timestep))
    model.geom_surfacevel[:] = moving
    return data.qpos[:7].copy()


def frame(scene: Scene, timestep: float, start: np.ndarray, end: np.ndarray) -> Frame:
    """Return the world frame in which a push from `start` to `end`, (2,), m, is along x, with its number of steps."""
    along = end - start
    distance = np.hypot(*along)
    steps = max(1, int(np.ceil(distance / (scene.speed * timestep) - 1e-9)))
    cos, sin = along / distance
    return Frame(np.array([[cos, sin], [-sin, cos]]), -np.arctan2(sin, cos), steps, distance / (scene.speed * steps))


def initial(model: Any, settled: np.ndarray, frame: Frame, start: np.ndarray) -> np.ndarray:
    """Return the initial qpos, (nq,), with the tip at the world's origin and at `start` in the slider's frame."""
    qpos = np.zeros(model.nq)
    qpos[:2] = -frame.rotation @ start
    qpos[2] = settled[2]
    turn = np.array([np.cos(frame.angle / 2), 0.0, 0.0, np.sin(frame.angle / 2)])
    engine().mju_mulQuat(qpos[3:7], turn, settled[3:7])
    return qpos


def final_pose(frame: Frame, qpos: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the slider's final pose, (3,), m and rad, in the frame of its start pose."""
    # origin: final position of the world's origin in that frame, (2,), m; with a conveyor, the world moves with the tip
    w, x, y, z = qpos[3:7]
    theta = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - frame.angle
    return np.append(frame.rotation.T @ qpos[:2] + origin, (theta + np.pi) % (2 * np.pi) - np.pi)


def slip(scene: Scene, pose: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return how far the tips slip, (n,), m, along the edge that faces their start, for final poses (n, 3)."""
    # A tip that sticks rolls on the edge: its center moves by the radius times the angle. That is not counted as slip.
    corner = scene.vertices
    edge = np.roll(corner, -1, axis=0) - corner
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
    outside = np.sum(inward[None] * (corner[None] - starts[:, None]), axis=-1)
    normal = inward[np.argmax(outside, axis=1)]
    left = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    away = ends - pose[:, :2]
    seen = np.stack([cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]], axis=1)
    return np.sum((seen - starts) * left, axis=1) - scene.tip_radius * pose[:, 2]


def accuracy(scene: Scene, settings: Settings, timesteps: Sequence[float] = ()) -> list[StepError]:
    """Return `by_timestep` for the pushes of `fan`, from the largest timestep to the smallest."""
    # down by factors of √2 from `COARSEST` to 2^-`REFINEMENTS` time constants of normal contact
    exponents = np.arange(np.log2(COARSEST), -REFINEMENTS - 0.5, -0.5)
    chosen = [float(each) for each in (timesteps or settings.normal * 2.0**exponents)]
    starts, ends = fan(scene)

    def run(timestep: float) -> tuple[np.ndarray, float]:
        found = push(scene, settings, timestep, starts, ends)
        return found.pose, found.processor

    return by_timestep(run, chosen)[0]


def by_timestep(
    run: Callable[[float], tuple[np.ndarray, float]], timesteps: Sequence[float], allowed: float = 1e-4
) -> tuple[list[StepError], np.ndarray]:
    """Compare final poses with those at the smallest timestep, refine the rows by `refined`, and return both."""
    *coarse, finest = sorted(timesteps, reverse=True)  # `run` returns final poses, (n, 3), and the CPU time of all, s
    exact, _ = run(finest)

    def at(timestep: float) -> StepError:
        pose, processor = run(timestep)
        return StepError(timestep, float(error_mm(pose, exact).max()), 1e6 * processor / len(pose))

    return refined([at(each) for each in coarse], at, allowed), exact


def refined(rows: Sequence[StepError], at: Callable[[float], StepError], allowed: float = 1e-4) -> list[StepError]:
    """Insert rows by bisection, so that the result of `largest` does not depend on the grid."""
    # The timesteps (s) of the rows fall. `at` computes the row of a timestep. `allowed` is the allowed error, m.
    found = list(rows)
    for _ in range(BISECTIONS):
        good = found.index(largest(found, allowed))
        if good == 0:
            break
        found.insert(good, at(float(np.sqrt(found[good - 1].timestep * found[good].timestep))))
    return found


def largest(rows: Sequence[StepError], allowed: float = 1e-4) -> StepError:
    """Return the row of the largest timestep up to which all errors are at most `allowed` (m), or raise ValueError."""
    good = None
    for row in reversed(rows):
        if not row.error_mm <= 1e3 * allowed:
            break
        good = row
    if good is None:
        raise ValueError(f"MuJoCo comes within {1e3 * allowed:g} mm at no timestep")
    return good


def timed(scene: Scene, settings: Settings, timestep: float, n: int = 40) -> Pushed:
    """Compute `n` pushes, the pushes of `fan` repeated, to time them."""
    starts, ends = (np.resize(each, (n, 2)) for each in fan(scene))
    return push(scene, settings, timestep, starts, ends)
