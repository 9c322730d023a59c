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
    """Predictions of every push with every radius and friction.

    Attributes:
        final: (radii, frictions, n, 3), final poses, world, m and rad.
        failed: (radii, frictions, n), number of failed steps.
        jammed: (radii, frictions, n), whether the hand jammed or grasped on the way.
    """

    final: np.ndarray
    failed: np.ndarray
    jammed: np.ndarray


class Tested(NamedTuple):
    """The radius and friction that each split chose, and the pushes that it tested.

    Attributes:
        chosen: Indices (radius, friction) that each split chose.
        test: Indices of the pushes that each split tested.
    """

    chosen: list[tuple[int, int]]
    test: list[np.ndarray]


def support(log: TwoFingerLog) -> pj.Support:
    """Return the support of the object, with unit load: its points, or uniform pressure if it has none."""
    if len(log.support_points) == 0:
        return pj.Support.uniform(pj.Polygon(log.vertices), SUPPORT_POINTS)
    return pj.Support.points(log.support_points, log.support_force / np.sum(log.support_force))


def predict(log: TwoFingerLog, model: str, key: jax.Array, steps: int, batch: int | None = None) -> Prediction:
    """Simulate every push with every radius and friction.

    Args:
        log: The pushes of one object.
        model: "quartic" or "ellipsoid".
        key: PRNG key of the wrench-twist pairs.
        steps: Steps of each push.
        batch: Number to which the pushes are padded, so that logs of different lengths share one compiled program.
            None: no padding.
    """
    pairs = support(log).wrench_twist_pairs(key, PAIRS)
    slider = pj.Slider(pj.Polygon(log.vertices), pj.fit_limit_surface(*pairs, degree=MODELS[model]))
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
    """Return the deviation of predicted from measured final poses, (..., n), mm.

    Args:
        log: The n pushes.
        final: (..., n, 3), predicted final poses, world, m and rad.
    """
    return 1e3 * np.asarray(pj.deviation(final, log.pose_end, log.length), np.float64)


def splits(log: TwoFingerLog, errors: np.ndarray, rng: np.random.Generator) -> Tested:
    """Choose friction and radius on part of the actions, for each of `SPLITS` random splits.

    Args:
        log: The n pushes.
        errors: (radii, frictions, n), deviations.
        rng: Random generator of the splits.

    Returns:
        The choice of each split, and the pushes of the actions that it did not use.
    """
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
    """Average the values of each push over the splits that tested it.

    Args:
        values: (radii, frictions, n).
        tested: The choices and the test pushes of the splits.

    Returns:
        (n,), NaN where no split tested the push.
    """
    count, total = np.zeros(values.shape[-1]), np.zeros(values.shape[-1])
    for at, pushes in zip(tested.chosen, tested.test, strict=True):
        total[pushes] += values[at][pushes]
        count[pushes] += 1
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
