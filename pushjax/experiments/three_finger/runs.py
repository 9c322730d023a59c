"""The recorded grasps, simulated again; and the friction that makes them end as they did."""

from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets.pushes import wrap_angle
from pushjax.datasets.three_finger import ThreeFingerLog

CHUNK = 112  # runs in one batch
# The friction: a first grid, then narrower ones about the best, on so many of the runs set aside for it.
GRID, ZOOMS, FIT_RUNS = np.linspace(0.0, 0.6, 13), (0.0125, 0.003), 84
NUDGE = 1e-6  # m, of the start


class Runs(NamedTuple):
    """Simulated again: pose (n, steps + 1, 3), d (n, steps + 1) as reached, and each run's last status (n,)."""

    pose: np.ndarray
    distance: np.ndarray
    status: np.ndarray


def float64() -> AbstractContextManager:
    """float64 within; the process's own setting stays."""
    switch = getattr(jax, "enable_x64", None)
    if switch is None:  # JAX before 0.8
        from jax.experimental import enable_x64 as switch  # pyright: ignore[reportAttributeAccessIssue]
    return switch(True)


def slider_of(log: ThreeFingerLog) -> pj.Slider:
    surface = pj.Ellipsoid if log.degree == 2 else pj.Quartic
    return pj.Slider(pj.Polygon(log.vertices), surface(log.coefficients, log.length))


def last_distance(log: ThreeFingerLog) -> float:
    """m: the d at which a hand that nothing stops comes to rest."""
    unstopped = log.distance[log.stop == len(log.time) - 1, -1]
    return float(np.median(unstopped)) if len(unstopped) else float(log.distance[:, -1].min())


@jax.jit
def _rollouts(slider: pj.Slider, hand: pj.Hand, place, starts, distances, frictions):
    def one(start, distance, friction):
        path = jnp.concatenate([jnp.broadcast_to(place, (len(distance), 3)), distance[:, None]], axis=1)
        run = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return run.pose, run.configuration[:, 3], run.status[-1]

    return jax.vmap(one)(starts, distances, frictions)


def rollouts(log: ThreeFingerLog, starts: np.ndarray, distances: np.ndarray, friction: Any) -> Runs:
    """From starts (n, 3) along distances (n, steps + 1), in batches of one size."""
    slider, hand, place = slider_of(log), pj.Hand.three_fingers(log.radius), jnp.asarray(log.hand)
    mu = np.broadcast_to(np.asarray(friction, np.float64), (len(starts),))
    parts = []
    for begin in range(0, len(starts), CHUNK):
        take = np.minimum(np.arange(begin, begin + CHUNK), len(starts) - 1)
        batch = _rollouts(slider, hand, place, *(jnp.asarray(v[take]) for v in (starts, distances, mu)))
        parts.append([np.asarray(part)[: len(starts) - begin] for part in batch])
    return Runs(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def simulate(log: ThreeFingerLog, which: np.ndarray, friction: float, steps: int) -> Runs:
    """The runs `which` (n,), twice; the second time with most steps around where the first one stopped."""
    starts = log.pose[which, 0]
    even = np.linspace(log.distance[0, 0], last_distance(log), steps + 1)
    first = rollouts(log, starts, np.tile(even, (len(which), 1)), friction)
    most = steps * 45 // 100
    paths = []
    for reached in first.distance[:, -1]:
        at = int(np.argmin(np.abs(even - reached)))
        knots = [even[0], even[max(at - 2, 0)], even[min(at + 2, steps)], even[-1]]
        paths.append(np.interp(np.arange(steps + 1), [0, most, 2 * most, steps], knots) if at < steps else even)
    return rollouts(log, starts, np.array(paths), friction)


def along(distance: np.ndarray, pose: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses (n, …, 3) at d = `at` (n, …) of runs recorded at `distance` (n, T)."""
    rows = [[np.interp(-a, -d, p[:, i]) for i in range(3)] for d, p, a in zip(distance, pose, at, strict=True)]
    return np.moveaxis(np.array(rows), 1, -1)


def fitted_friction(log: ThreeFingerLog, which: np.ndarray, steps: int) -> float:
    """The friction with the least deviation along the runs; the median over runs in which anything moves.

    Not of the final poses alone: those of a run that jams depend on where between two steps it does.
    """
    moved = np.abs(log.pose[which, -1] - log.pose[which, 0]).max(axis=1) > NUDGE
    runs = which[moved][:FIT_RUNS]
    even = np.linspace(log.distance[0, 0], last_distance(log), steps + 1)
    starts, paths = log.pose[runs, 0], np.tile(even, (len(runs), 1))
    going = np.arange(len(log.time)) < log.stop[runs][:, None]

    def losses(frictions: np.ndarray) -> np.ndarray:
        count = len(frictions)
        ours = rollouts(log, np.tile(starts, (count, 1)), np.tile(paths, (count, 1)), np.repeat(frictions, len(runs)))
        poses = ours.pose.reshape(count, len(runs), steps + 1, 3)
        return np.array([loss(each) for each in poses])

    def loss(pose: np.ndarray) -> float:
        error = difference(along(paths, pose, log.distance[runs]), log.pose[runs])
        error = error[..., 0] + 1e3 * log.length * np.radians(error[..., 1])
        return float(np.median(np.sum(error * going, axis=1) / np.maximum(going.sum(axis=1), 1)))

    best = GRID[np.argmin(losses(GRID))]
    for width in ZOOMS:
        grid = np.maximum(best + width * np.arange(-4, 5), 0.0)
        best = grid[np.argmin(losses(grid))]
    return float(best)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 2): of poses (..., 3), in mm and degrees."""
    delta = a - b
    return np.stack([1e3 * np.hypot(delta[..., 0], delta[..., 1]), np.degrees(np.abs(wrap_angle(delta[..., 2])))], -1)


def apart_at_end(log: ThreeFingerLog, which: np.ndarray, ours: Runs) -> np.ndarray:
    """(n, 2): how far the final poses are apart, mm and degrees."""
    return difference(ours.pose[:, -1], log.pose[which, -1])
