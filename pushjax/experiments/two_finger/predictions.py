"""The two-finger pushes, simulated on a grid of frictions and finger radii, and what random splits choose from it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import Recordings
from pushjax.datasets.recordings import Floats, interpolated
from pushjax.experiments._tables import MODELS, final_poses, polygon, support

PAIRS = 400
SPLITS, TRAIN_SHARE = 10, 0.4
FRICTIONS = np.linspace(0.0, 0.8, 17)
RADII = (0.0, 0.0005, 0.001, 0.0015)


class OnGrid(NamedTuple):
    """Predictions of every push with every radius and friction."""

    final: np.ndarray  # (radii, frictions, n, 3), final poses, world, m and rad
    failed: np.ndarray  # (radii, frictions, n), number of failed steps
    jammed: np.ndarray  # (radii, frictions, n), whether the hand jammed or grasped on the way


class Tested(NamedTuple):
    """The radius and friction that each split chose, and the pushes that it tested."""

    chosen: list[tuple[int, int]]  # (radius, friction) indices, one for each split
    test: list[np.ndarray]  # indices of the test pushes of each split


def hand_paths(log: Recordings, steps: int) -> Floats:
    """Return the commanded configurations of the hand in equal steps, (n, steps + 1, 4), world, m and rad."""
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")
    paths = []
    for push in log.pushes:
        rows = np.arange(len(push.hand), dtype=float)
        paths.append(interpolated(np.linspace(0, rows[-1], steps + 1), rows, push.hand))
    return np.array(paths)


def predict(log: Recordings, model: str, key: jax.Array, steps: int, batch: int | None = None) -> OnGrid:
    """Simulate every push with every radius and friction, with pushes padded to the number `batch`."""
    pairs = support(log).wrench_twist_pairs(key, PAIRS)
    slider = pj.Slider(polygon(log), pj.fit_limit_surface(*pairs, degree=MODELS[model]))
    # logs that are padded to the same number share one compiled program
    rows = np.arange(max(len(log), batch or 0)) % len(log)
    pushes = pj.Pushes(log.start[rows], hand_paths(log, steps)[rows], log.end[rows])
    hands = [pj.Hand.two_fingers(jnp.asarray(radius)) for radius in RADII]
    results = [final_poses(slider, hand, pushes, jnp.asarray(FRICTIONS)) for hand in hands]
    final, failed, jammed = (np.stack([np.asarray(r[k])[:, : len(log)] for r in results]) for k in range(3))
    return OnGrid(final.astype(np.float64), failed, jammed)


def splits(log: Recordings, errors: np.ndarray, rng: np.random.Generator) -> Tested:
    """Choose friction and radius on random training actions, by their deviations (radii, frictions, n)."""
    action = log.about("action")
    actions = np.unique(action)
    chosen, test = [], []
    for _ in range(SPLITS):
        training = rng.permutation(actions)[: round(TRAIN_SHARE * len(actions))]
        trains = np.isin(action, training)
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
