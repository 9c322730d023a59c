"""The pushes simulated on a grid of frictions and finger radii, and what random splits choose from it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets.two_finger import TwoFingerLog

MODELS = {"quartic": 4, "ellipsoid": 2}
PAIRS, CELLS = 400, 150
SPLITS, TRAIN_SHARE = 10, 0.4
FRICTIONS = np.linspace(0.0, 0.8, 17)
RADII = (0.0, 0.0005, 0.001, 0.0015)


class Prediction(NamedTuple):
    """Of every push with every radius and friction. final: (radii, frictions, n, 3), world, m and rad. failed, jammed:
    (radii, frictions, n), steps that failed, and whether the hand jammed or grasped on the way."""

    final: np.ndarray
    failed: np.ndarray
    jammed: np.ndarray


class Tested(NamedTuple):
    """What the splits gave. chosen: the (radius, friction) indices of each split. test: which pushes each tested."""

    chosen: list[tuple[int, int]]
    test: list[np.ndarray]


def support(log: TwoFingerLog) -> pj.Support:
    """What carries the object, of unit load."""
    if len(log.support_points) == 0:
        return pj.Support.uniform(pj.Polygon(log.vertices), CELLS)
    return pj.Support.points(log.support_points, log.support_force / np.sum(log.support_force))


def predict(log: TwoFingerLog, model: str, key: jax.Array, steps: int, batch: int | None = None) -> Prediction:
    """Every push, with every radius and friction. batch: pad the pushes to so many, so that logs of different lengths
    share one compiled program."""
    pairs = support(log).wrench_twist_pairs(key, PAIRS)
    slider = pj.Slider(pj.Polygon(log.vertices), pj.fit_limit_surface(*pairs, degree=MODELS[model]))
    rows = np.arange(max(len(log), batch or 0)) % len(log)
    paths, starts = jnp.asarray(log.paths(steps)[rows]), jnp.asarray(log.pose_start[rows])
    results = [_final_poses(slider, jnp.asarray(radius), paths, starts, jnp.asarray(FRICTIONS)) for radius in RADII]
    final, failed, jammed = (np.stack([np.asarray(r[k])[:, : len(log)] for r in results]) for k in range(3))
    return Prediction(final.astype(np.float64), failed, jammed)


@jax.jit
def _final_poses(slider: pj.Slider, radius, paths, starts, frictions):
    hand = pj.Hand.two_fingers(radius)

    def one(path, start, friction):
        push = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return push.pose[-1], jnp.sum(push.failed), push.stopped >= 0

    over_pushes = jax.vmap(one, in_axes=(0, 0, None))
    return jax.vmap(over_pushes, in_axes=(None, None, 0))(paths, starts, frictions)


def deviation_mm(log: TwoFingerLog, final: np.ndarray) -> np.ndarray:
    """(..., n) mm, from predicted final poses (..., n, 3) to the measured ones."""
    return 1e3 * np.asarray(pj.deviation(final, log.pose_end, log.length), np.float64)


def splits(log: TwoFingerLog, errors: np.ndarray, rng: np.random.Generator) -> Tested:
    """Friction and radius chosen on part of the actions, the others held back."""
    actions = np.unique(log.group)
    chosen, test = [], []
    for _ in range(SPLITS):
        training = rng.permutation(actions)[: round(TRAIN_SHARE * len(actions))]
        trains = np.isin(log.group, training)
        scores = errors[..., trains].mean(axis=-1)
        radius, friction = np.unravel_index(int(np.argmin(scores)), scores.shape)
        chosen.append((int(radius), int(friction)))
        test.append(np.flatnonzero(~trains))
    return Tested(chosen, test)


def per_push(values: np.ndarray, tested: Tested) -> np.ndarray:
    """(n,): the mean of values (radii, frictions, n) over the splits that tested a push; NaN where none did."""
    count, total = np.zeros(values.shape[-1]), np.zeros(values.shape[-1])
    for at, pushes in zip(tested.chosen, tested.test, strict=True):
        total[pushes] += values[at][pushes]
        count[pushes] += 1
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
