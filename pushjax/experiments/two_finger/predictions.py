"""The two-finger pushes, simulated on a grid of frictions and finger radii, and what random splits choose from it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets.two_finger import TwoFingerLog

MODELS = {"quartic": 4, "ellipsoid": 2}
PAIRS, SUPPORT_POINTS = 400, 150
SPLITS, TRAIN_SHARE = 10, 0.4
FRICTIONS = np.linspace(0.0, 0.8, 17)
RADII = (0.0, 0.0005, 0.001, 0.0015)


class Prediction(NamedTuple):
    """Predictions of every push with every radius and friction."""

    final: np.ndarray  # (radii, frictions, n, 3), final poses, world, m and rad
    failed: np.ndarray  # (radii, frictions, n), number of failed steps
    jammed: np.ndarray  # (radii, frictions, n), whether the hand jammed or grasped on the way


class Tested(NamedTuple):
    """The radius and friction that each split chose, and the pushes that it tested."""

    chosen: list[tuple[int, int]]  # (radius, friction) indices, one for each split
    test: list[np.ndarray]  # indices of the test pushes of each split


def support(log: TwoFingerLog) -> pj.Support:
    """Return the support of the object, with unit load: its points, or uniform pressure if it has none."""
    if len(log.support_points) == 0:
        return pj.Support.uniform(pj.Polygon(log.vertices), SUPPORT_POINTS)
    return pj.Support.points(log.support_points, log.support_force / np.sum(log.support_force))


def predict(log: TwoFingerLog, model: str, key: jax.Array, steps: int, batch: int | None = None) -> Prediction:
    """Simulate every push with every radius and friction, with pushes padded to the number `batch`."""
    pairs = support(log).wrench_twist_pairs(key, PAIRS)
    slider = pj.Slider(pj.Polygon(log.vertices), pj.fit_limit_surface(*pairs, degree=MODELS[model]))
    # logs that are padded to the same number share one compiled program
    rows = np.arange(max(len(log), batch or 0)) % len(log)
    paths, starts = jnp.asarray(log.paths(steps)[rows]), jnp.asarray(log.pose_start[rows])
    results = [_final_poses(slider, jnp.asarray(radius), paths, starts, jnp.asarray(FRICTIONS)) for radius in RADII]
    final, failed, jammed = (np.stack([np.asarray(r[k])[:, : len(log)] for r in results]) for k in range(3))
    return Prediction(final.astype(np.float64), failed, jammed)


@jax.jit
def _final_poses(slider: pj.Slider, radius, paths, starts, frictions):
    """Return the final poses, the number of failed steps, and whether the hand stopped, by friction and push."""
    hand = pj.Hand.two_fingers(radius)

    def final_pose(path, start, friction):
        push = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return push.pose[-1], jnp.sum(push.failed), push.stopped >= 0

    over_pushes = jax.vmap(final_pose, in_axes=(0, 0, None))
    return jax.vmap(over_pushes, in_axes=(None, None, 0))(paths, starts, frictions)


def deviation_mm(log: TwoFingerLog, final: np.ndarray) -> np.ndarray:
    """Return the deviations (..., n), mm, of predicted final poses (..., n, 3) from the measured ones."""
    return 1e3 * np.asarray(pj.deviation(final, log.pose_end, log.length), np.float64)


def splits(log: TwoFingerLog, errors: np.ndarray, rng: np.random.Generator) -> Tested:
    """Choose friction and radius on random training actions, by their deviations (radii, frictions, n)."""
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
    """Average values (radii, frictions, n) over the splits that tested each push; NaN if none did."""
    count, total = np.zeros(values.shape[-1]), np.zeros(values.shape[-1])
    for at, pushes in zip(tested.chosen, tested.test, strict=True):
        total[pushes] += values[at][pushes]
        count[pushes] += 1
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
