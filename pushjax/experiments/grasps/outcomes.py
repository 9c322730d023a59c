"""Outcome of each grasp.

Every slider whose hand stopped is held between both pads. Unlike `MonteCarlo.outcomes`, this module counts a grasp as
grasped if it is stable: to turn the slider a little, either way, the jaw would have to open. It counts a grasp as
jammed if friction alone keeps it: a turn would let the jaw close.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.experiments._starts import uniform_in_circle

PERTURBATION = np.radians(1.0)  # turn either way by which a grasp is tested for stability
OUTLINE_POINTS = 500  # on a curve, and on each edge of a polygon
BIN_WIDTH = np.radians(1.0)  # width of a bin of angles in which spikes are looked for
MIN_SPIKE_SHARE = 0.02  # smallest share of all angles that makes a spike


def openings(shape: pj.Shape, poses: np.ndarray, pad: float) -> np.ndarray:
    """Return the least pad distances (n,), m, with room for the slider at poses (n, 3) in the jaw's frame."""
    outline = np.asarray(shape.boundary(OUTLINE_POINTS), np.float64)
    if isinstance(shape, pj.Polygon):
        corners = np.asarray(shape.vertices, np.float64)
        fraction = np.arange(OUTLINE_POINTS)[:, None, None] / OUTLINE_POINTS  # of each edge
        outline = (corners + fraction * (np.roll(corners, -1, axis=0) - corners)).swapaxes(0, 1).reshape(-1, 2)
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = poses[:, :1] + c * outline[:, 0] - s * outline[:, 1]
    y = poses[:, 1:2] + s * outline[:, 0] + c * outline[:, 1]
    top, bottom = np.full(len(poses), -np.inf), np.full(len(poses), np.inf)
    next_x, next_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    # the pads are centered at the origin
    for side in (-pad / 2, pad / 2):  # where the outline crosses the lines through the pads' corners
        crosses = (x - side) * (next_x - side) < 0
        fraction = np.where(crosses, (side - x) / np.where(crosses, next_x - x, 1.0), 0.0)
        height = y + fraction * (next_y - y)
        top = np.maximum(top, np.where(crosses, height, -np.inf).max(axis=1))
        bottom = np.minimum(bottom, np.where(crosses, height, np.inf).min(axis=1))
    between_pads = np.abs(x) <= pad / 2
    top = np.maximum(top, np.where(between_pads, y, -np.inf).max(axis=1))
    bottom = np.minimum(bottom, np.where(between_pads, y, np.inf).min(axis=1))
    return np.where(top >= bottom, top - bottom, 0.0)  # zero if the slider is not between the pads


def classify(grasps: pj.MonteCarlo, shape: pj.Shape, pad: float) -> np.ndarray:
    """Classify every grasp.

    Args:
        grasps: The n grasps.
        shape: Outline of the slider.
        pad: Width of the pads, m.

    Returns:
        (n,), each "grasped", "jammed", "free" or "failed".
    """
    pose = np.asarray(grasps.pose, np.float64)
    held, failed = grasps.stopped >= 0, grasps.failed > 0
    opening = openings(shape, pose, pad)
    turned_openings = [openings(shape, pose + np.array([0, 0, sign * PERTURBATION]), pad) for sign in (1, -1)]
    stable = (opening > 0) & (turned_openings[0] >= opening) & (turned_openings[1] >= opening)
    return np.select([failed, held & stable, held], ["failed", "grasped", "jammed"], "free")


def start_poses(
    slider: pj.Slider, hand: pj.Hand, configuration: Any, circle: float, n: int, seed: int
) -> tuple[np.ndarray, int]:
    """Sample poses (n, 3), m and rad, clear of the open jaw, and count those that had to be sampled again."""
    from pushjax.simulation.slider import overlaps

    rng = np.random.default_rng(seed)
    kept, resampled = np.zeros((0, 3)), 0
    dtype = jnp.result_type(float)
    while len(kept) < n:
        centers = uniform_in_circle(rng, circle, n)
        poses = np.column_stack([centers, rng.uniform(-np.pi / 2, np.pi / 2, n)]).astype(dtype)
        is_free = np.asarray(overlaps(slider, hand, jnp.asarray(poses), jnp.asarray(configuration))) <= 0
        wanted = n - len(kept)
        chosen = np.flatnonzero(is_free)[:wanted]
        resampled += int(np.sum(~is_free[: chosen[-1] + 1])) if len(chosen) == wanted else int(np.sum(~is_free))
        kept = np.concatenate([kept, poses[chosen]])
    return kept.astype(dtype), resampled


def spikes(angles: np.ndarray, symmetry: float) -> list[dict[str, float]]:
    """Find spikes in a distribution of angles, rad, modulo the outline's symmetry, largest share first."""
    wrapped = np.mod(np.asarray(angles, np.float64) + symmetry / 2, symmetry) - symmetry / 2
    bins = round(symmetry / BIN_WIDTH)
    # bins are centered at multiples of a degree, so that a spike at a right angle is in one bin
    bin_index = np.mod(np.round(wrapped / BIN_WIDTH).astype(int), bins)
    counts = np.bincount(bin_index, minlength=bins)
    spike_bins = np.flatnonzero(counts >= MIN_SPIKE_SHARE * len(angles))
    signed_degrees = np.where(spike_bins > bins / 2, spike_bins - bins, spike_bins)
    order = np.argsort(-counts[spike_bins])
    return [{"degrees": float(signed_degrees[k]), "share": float(counts[spike_bins[k]] / len(angles))} for k in order]
