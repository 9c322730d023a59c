"""Outcome of each grasp.

Every slider whose hand stopped is held between both pads. Unlike `MonteCarlo.outcomes`, this module counts a grasp as
grasped if it is stable: the jaw would have to be wider if the slider turned a little either way. It counts a grasp as
jammed if friction alone keeps it: a turn would let the jaw close.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.experiments._starts import in_circle

TURN = np.radians(1.0)
POINTS = 500
SPIKE = np.radians(1.0)  # width of a bin of angles in which spikes are looked for
FEWEST = 0.02  # smallest share of all angles that makes a spike


def openings(shape: pj.Shape, poses: np.ndarray, pad: float) -> np.ndarray:
    """Compute the least distance between the pads that leaves room for the slider at each pose.

    Args:
        shape: Outline of the slider.
        poses: (n, 3), m and rad, in the frame of the jaw.
        pad: Width of the pads, which are centered at the origin, m.

    Returns:
        (n,), m; zero where the slider is not between the pads.
    """
    outline = np.asarray(shape.boundary(POINTS), np.float64)
    if isinstance(shape, pj.Polygon):
        corners = np.asarray(shape.vertices, np.float64)
        share = np.arange(POINTS)[:, None, None] / POINTS
        outline = (corners + share * (np.roll(corners, -1, axis=0) - corners)).swapaxes(0, 1).reshape(-1, 2)
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = poses[:, :1] + c * outline[:, 0] - s * outline[:, 1]
    y = poses[:, 1:2] + s * outline[:, 0] + c * outline[:, 1]
    top, bottom = np.full(len(poses), -np.inf), np.full(len(poses), np.inf)
    after_x, after_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    for side in (-pad / 2, pad / 2):  # where the outline crosses the lines through the pads' corners
        across = (x - side) * (after_x - side) < 0
        share = np.where(across, (side - x) / np.where(across, after_x - x, 1.0), 0.0)
        height = y + share * (after_y - y)
        top = np.maximum(top, np.where(across, height, -np.inf).max(axis=1))
        bottom = np.minimum(bottom, np.where(across, height, np.inf).min(axis=1))
    between = np.abs(x) <= pad / 2
    top = np.maximum(top, np.where(between, y, -np.inf).max(axis=1))
    bottom = np.minimum(bottom, np.where(between, y, np.inf).min(axis=1))
    return np.where(top >= bottom, top - bottom, 0.0)


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
    here = openings(shape, pose, pad)
    turned = [openings(shape, pose + np.array([0, 0, sign * TURN]), pad) for sign in (1, -1)]
    stable = (here > 0) & (turned[0] >= here) & (turned[1] >= here)
    return np.select([failed, held & stable, held], ["failed", "grasped", "jammed"], "free")


def start_poses(
    slider: pj.Slider, hand: pj.Hand, configuration: Any, circle: float, n: int, seed: int
) -> tuple[np.ndarray, int]:
    """Sample start poses that do not overlap the open jaw.

    Centers are uniform in a circle, and angles are uniform within 90 degrees of zero. Poses that overlap the jaw are
    sampled again.

    Args:
        slider: The slider.
        hand: The jaw.
        configuration: Configuration of the open jaw.
        circle: Radius of the circle, m.
        n: Number of poses.
        seed: Seed of the poses.

    Returns:
        The poses (n, 3), and how many were sampled again.
    """
    from pushjax.simulation.slider import overlaps

    rng = np.random.default_rng(seed)
    kept, again = np.zeros((0, 3)), 0
    dtype = jnp.result_type(float)
    while len(kept) < n:
        centers = in_circle(rng, circle, n)
        poses = np.column_stack([centers, rng.uniform(-np.pi / 2, np.pi / 2, n)]).astype(dtype)
        apart = np.asarray(overlaps(slider, hand, jnp.asarray(poses), jnp.asarray(configuration))) <= 0
        wanted = n - len(kept)
        last = np.flatnonzero(apart)[:wanted]
        again += int(np.sum(~apart[: last[-1] + 1])) if len(last) == wanted else int(np.sum(~apart))
        kept = np.concatenate([kept, poses[last]])
    return kept.astype(dtype), again


def spikes(angles: np.ndarray, symmetry: float) -> list[dict[str, float]]:
    """Find spikes in a distribution of angles: bins that hold at least the share `FEWEST` of all angles.

    Args:
        angles: Angles, rad.
        symmetry: Angle after which the outline is the same, rad. The angles are taken modulo it.

    Returns:
        The angle (degrees) and the share of each spike, largest share first.
    """
    wrapped = np.mod(np.asarray(angles, np.float64) + symmetry / 2, symmetry) - symmetry / 2
    bins = round(symmetry / SPIKE)
    # bins are centered at multiples of a degree, so that a spike at a right angle is in one bin
    number = np.mod(np.round(wrapped / SPIKE).astype(int), bins)
    counts = np.bincount(number, minlength=bins)
    found = np.flatnonzero(counts >= FEWEST * len(angles))
    signed = np.where(found > bins / 2, found - bins, found)
    order = np.argsort(-counts[found])
    return [{"degrees": float(signed[k]), "share": float(counts[found[k]] / len(angles))} for k in order]
