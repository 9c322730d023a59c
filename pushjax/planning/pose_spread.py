"""The spread of samples of a pose: their entropy, and the most likely pose.

A slider that looks the same after some turns has equivalent poses, which count as one.

The entropy is that of the samples blurred by a Gaussian kernel of a width h: with distances d of poses,

    entropy = -mean over i of log(mean over j of exp(-d_ij^2 / (4 h^2))).

It is zero if all samples are the same, log k for k poses far apart that are equally likely, and at most the logarithm
of the number of samples. So its exponential is the number of poses that can be told apart.
"""

import numpy as np


def distances(poses: np.ndarray, turns: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances between samples, of their positions and of their angles.

    Args:
        poses: Samples of poses, (..., samples, 3), m and rad.
        turns: Turns after which the slider looks the same, (turns,), rad.
        length: Distance that counts as much as an angle of one radian, m.

    Returns:
        The distances of the positions, and of the angles times `length`, both (..., samples, samples), m.
    """
    difference = poses[..., :, None, :] - poses[..., None, :, :]
    apart = np.hypot(difference[..., 0], difference[..., 1])
    angles = difference[..., 2, None] - turns
    angles = np.abs(angles - 2 * np.pi * np.round(angles / (2 * np.pi))).min(axis=-1)
    return apart, length * angles


def entropy(poses: np.ndarray, turns: np.ndarray, length: float, width: float) -> np.ndarray:
    """Return the entropy of samples of poses, (...,), in nats.

    Args:
        poses: Samples of poses, (..., samples, 3), m and rad.
        turns: Turns after which the slider looks the same, (turns,), rad.
        length: Distance that counts as much as an angle of one radian, m.
        width: Width of the kernel, m: poses that are nearer than about this are the same.
    """
    apart, turned = distances(poses, turns, length)
    kernel = np.exp(-(apart**2 + turned**2) / (4 * width**2))
    return -np.log(kernel.mean(axis=-1)).mean(axis=-1)


def most_likely(poses: np.ndarray, turns: np.ndarray, position: float, angle: float) -> tuple[int, np.ndarray]:
    """Return the sample that most others are near to, and which are.

    Args:
        poses: Samples of poses, (samples, 3), m and rad.
        turns: Turns after which the slider looks the same, (turns,), rad.
        position: Largest distance that counts as near, m.
        angle: Largest angle that counts as near, rad.

    Returns:
        Index of the sample, and whether each sample is near to it, (samples,).
    """
    apart, turned = distances(poses, turns, 1.0)
    near = (apart <= position) & (turned <= angle)
    best = int(np.argmax(near.sum(axis=1)))
    return best, near[best]
