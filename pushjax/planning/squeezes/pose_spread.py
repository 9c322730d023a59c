"""The spread of samples of a pose: their entropy, and the most likely pose.

A slider that looks the same after some turns has equivalent poses, which count as one.

The entropy compares every sample i with every sample j, by a Gaussian kernel of the width h:

    entropy = -mean over i of log(mean over j of exp(-d_ij^2 / (4 h^2))).

Here d_ij^2 is the squared distance of the positions plus the squared difference of the angles times a length.

It is zero if all samples are the same, log k for k poses far apart that are equally likely, and at most the logarithm
of the number of samples. So its exponential is the number of poses that can be told apart.
"""

import numpy as np


def distances(
    poses: np.ndarray,  # (..., samples, 3), m and rad
    turns: np.ndarray,  # (turns,), after which the slider looks the same, rad
    length: float,  # distance that counts as much as an angle of one radian, m
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of positions, and of angles times `length`, between samples, (..., samples, samples), m."""
    difference = poses[..., :, None, :] - poses[..., None, :, :]
    position_distance = np.hypot(difference[..., 0], difference[..., 1])
    angles = difference[..., 2, None] - turns
    angles = np.abs(angles - 2 * np.pi * np.round(angles / (2 * np.pi))).min(axis=-1)
    return position_distance, length * angles


def entropy(
    poses: np.ndarray,
    turns: np.ndarray,
    length: float,
    width: float,  # of the kernel, m: poses that are nearer than about this are the same
) -> np.ndarray:
    """Return the entropy of samples of poses, (...,), in nats, with `poses`, `turns` and `length` as in `distances`."""
    position_distance, angle_distance = distances(poses, turns, length)
    kernel = np.exp(-(position_distance**2 + angle_distance**2) / (4 * width**2))
    return -np.log(kernel.mean(axis=-1)).mean(axis=-1)


def most_likely(poses: np.ndarray, turns: np.ndarray, max_distance: float, max_angle: float) -> tuple[int, np.ndarray]:
    """Return the index of the sample with the most others near it, and whether each is near it, (samples,)."""
    # Near are poses within `max_distance`, m, and `max_angle`, rad.
    position_distance, angle_distance = distances(poses, turns, 1.0)  # with this length the second one is in rad
    near = (position_distance <= max_distance) & (angle_distance <= max_angle)
    best = int(np.argmax(near.sum(axis=1)))
    return best, near[best]
