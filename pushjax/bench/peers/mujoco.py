"""Pushes by MuJoCo (C): how they end, how far a tip that sticks creeps, what timestep they need, how long they take.

One call of `mj_step` with its number of steps makes a whole push in C, without Python between the steps. A thread has
its own copy of the model and takes its share of the pushes; `mujoco.rollout` does the same work, and writes down every
state, in the same time.

The slider starts at rest on the table as it has settled, which is not timed; the pose is read when the tip has come to
its end, before anything coasts.

What timestep they need is sought on a grid and then by bisection, so that the grid costs MuJoCo nothing: it takes 15.4
ms where the grid alone has 14.1 on four supports, 12.2 where it has 10 on three.
"""

import copy
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from pushjax.bench.peers.scene import Scene, Settings, build, engine
from pushjax.bench.tasks import error_mm

SETTLE = 400  # time constants of normal contact, until the slider lies still
AWAY = 10.0  # m: where it settles, out of the tip's reach
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
REFINEMENTS = 3.5  # halvings below the time constant until a step counts as converged
COARSEST = 8  # times the time constant: contact is certainly lost
BISECTIONS = 4  # between the largest good timestep and the first bad one: a factor of √2 becomes 1.02


class Pushed(NamedTuple):
    """pose: (n, 3) m, rad: the slider's final pose in the frame of its start pose. slip: (n,) m, how far the tip's
    contact has slid along the slider's side, to its left of the inward normal. seconds: of the pushes alone, without
    building and settling; processor: of all threads."""

    pose: np.ndarray
    slip: np.ndarray
    seconds: float
    processor: float


class StepError(NamedTuple):
    """timestep, s; error_mm: worst final pose against the smallest timestep's; us_per_push: of a processor."""

    timestep: float
    error_mm: float
    us_per_push: float


class Frame(NamedTuple):
    """A push in MuJoCo's world: rotation (2, 2) and angle from the slider's start frame; its steps, each (s)."""

    rotation: np.ndarray
    angle: float
    steps: int
    timestep: float


def fan(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends (n, 2) m of the tip's centre: `PUSHES`, on the square's left side, just touching it."""
    offset, angle = np.array(PUSHES).T
    starts = np.stack([np.full(len(PUSHES), -scene.side / 2 - scene.tip_radius), offset], axis=1)
    return starts, starts + scene.travel * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def push(
    scene: Scene, settings: Settings, timestep: float, starts: np.ndarray, ends: np.ndarray, threads: int = 1
) -> Pushed:
    """The slider starts at pose zero; the tip's centre goes straight from starts (n, 2) to ends (n, 2), m.

    timestep (s): at most; a little less, so that a whole number of steps makes each push.
    """
    starts, ends = np.asarray(starts, float).reshape(-1, 2), np.asarray(ends, float).reshape(-1, 2)
    model = build(scene, settings, timestep)
    settled = settle(model, settings)
    frames = [frame(scene, timestep, *each) for each in zip(starts, ends, strict=True)]
    qpos = np.array([initial(model, settled, *each) for each in zip(frames, starts, strict=True)])
    shares = [range(k, len(starts), threads) for k in range(threads)]
    workers = [(copy.copy(model), engine().MjData(model)) for _ in shares]
    begin, busy = time.perf_counter(), time.process_time()
    if threads == 1:
        _run(*workers[0], scene, frames, qpos, shares[0])
    else:
        with ThreadPoolExecutor(threads) as pool:
            tasks = [
                pool.submit(_run, *mine, scene, frames, qpos, share)
                for mine, share in zip(workers, shares, strict=True)
            ]
            for task in tasks:
                task.result()
    seconds, processor = time.perf_counter() - begin, time.process_time() - busy
    pose = np.array([final_pose(*each) for each in zip(frames, qpos, ends, strict=True)]).reshape(-1, 3)
    return Pushed(pose, slip(scene, pose, starts, ends), seconds, processor)


def settle(model: Any, settings: Settings) -> np.ndarray:
    """(7,) position and orientation of the slider's joint when it has come to rest on the table."""
    mujoco = engine()
    data, moving = mujoco.MjData(model), model.geom_surfacevel.copy()
    data.qpos[0] = AWAY
    model.geom_surfacevel[:] = 0
    mujoco.mj_step(model, data, nstep=round(SETTLE * settings.normal / model.opt.timestep))
    model.geom_surfacevel[:] = moving
    return data.qpos[:7].copy()


def frame(scene: Scene, timestep: float, start: np.ndarray, end: np.ndarray) -> Frame:
    """The world in which the push goes along x."""
    along = end - start
    distance = np.hypot(*along)
    steps = max(1, int(np.ceil(distance / (scene.speed * timestep) - 1e-9)))
    cos, sin = along / distance
    return Frame(np.array([[cos, sin], [-sin, cos]]), -np.arctan2(sin, cos), steps, distance / (scene.speed * steps))


def initial(model: Any, settled: np.ndarray, frame: Frame, start: np.ndarray) -> np.ndarray:
    """(nq,) positions with the tip's centre at the origin, and the slider where that is `start` in its frame."""
    qpos = np.zeros(model.nq)
    qpos[:2] = -frame.rotation @ start
    qpos[2] = settled[2]
    turn = np.array([np.cos(frame.angle / 2), 0.0, 0.0, np.sin(frame.angle / 2)])
    engine().mju_mulQuat(qpos[3:7], turn, settled[3:7])
    return qpos


def _run(model, data, scene: Scene, frames: list[Frame], qpos: np.ndarray, share: range) -> None:
    """Overwrites the rows of `share` in `qpos` with the final positions."""
    mujoco = engine()
    for k in share:
        mujoco.mj_resetData(model, data)
        model.opt.timestep = frames[k].timestep
        data.qpos[:] = qpos[k]
        data.qvel[0] = -scene.speed  # it goes along with the conveyor
        mujoco.mj_step(model, data, nstep=frames[k].steps)
        qpos[k] = data.qpos


def final_pose(frame: Frame, qpos: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(3,) in the frame of the start pose, from positions in MuJoCo's world. origin: (2,) what its origin is there now:
    a conveyor's world goes along with the tip."""
    w, x, y, z = qpos[3:7]
    theta = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - frame.angle
    return np.append(frame.rotation.T @ qpos[:2] + origin, (theta + np.pi) % (2 * np.pi) - np.pi)


def slip(scene: Scene, pose: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(n,) m, along the edge that faces the start. A tip that sticks rolls: its centre goes radius times angle."""
    corner = scene.vertices
    edge = np.roll(corner, -1, axis=0) - corner
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
    if np.sum(inward * (corner.mean(axis=0) - corner)) < 0:  # the outline runs clockwise
        inward = -inward
    outside = np.sum(inward[None] * (corner[None] - starts[:, None]), axis=-1)
    normal = inward[np.argmax(outside, axis=1)]
    left = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    away = ends - pose[:, :2]
    seen = np.stack([cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]], axis=1)
    return np.sum((seen - starts) * left, axis=1) - scene.tip_radius * pose[:, 2]


def accuracy(scene: Scene, settings: Settings, timesteps: Sequence[float] = ()) -> list[StepError]:
    """`by_timestep` of `fan`.

    By default from `COARSEST` to 2^-`REFINEMENTS` time constants of normal contact, by factors of √2."""
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
    """Rows from the largest timestep to the smallest, against which the errors are and which is left out, `refined`;
    and the poses of that. run: from a timestep to final poses (n, 3) and the processor seconds of all."""
    *coarse, finest = sorted(timesteps, reverse=True)
    exact, _ = run(finest)

    def at(timestep: float) -> StepError:
        pose, processor = run(timestep)
        return StepError(timestep, float(error_mm(pose, exact).max()), 1e6 * processor / len(pose))

    return refined([at(each) for each in coarse], at, allowed), exact


def refined(rows: Sequence[StepError], at: Callable[[float], StepError], allowed: float = 1e-4) -> list[StepError]:
    """With rows in between, so that `largest` does not depend on the grid. at: makes the row of a timestep.

    Raises ValueError as `largest` does."""
    found = list(rows)
    for _ in range(BISECTIONS):
        good = found.index(largest(found, allowed))
        if good == 0:
            break
        found.insert(good, at(float(np.sqrt(found[good - 1].timestep * found[good].timestep))))
    return found


def largest(rows: Sequence[StepError], allowed: float = 1e-4) -> StepError:
    """Of the largest timestep up to which the final poses stay within `allowed` (m) of the converged ones; from rows
    with falling timesteps. Raises ValueError where not even the smallest does."""
    good = None
    for row in reversed(rows):
        if not row.error_mm <= 1e3 * allowed:
            break
        good = row
    if good is None:
        raise ValueError(f"MuJoCo comes within {1e3 * allowed:g} mm at no timestep")
    return good


def timed(scene: Scene, settings: Settings, timestep: float, n: int = 40) -> Pushed:
    """n pushes, `fan` again and again."""
    starts, ends = (np.resize(each, (n, 2)) for each in fan(scene))
    return push(scene, settings, timestep, starts, ends)
