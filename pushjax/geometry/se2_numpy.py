"""Operations of `pushjax.geometry.se2` in NumPy, in the dtype of the arrays and without compilation for new shapes."""

import numpy as np


def compose(pose: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Return the world pose of a frame whose pose in the frame `pose` is `relative`, both (..., 3)."""
    x, y, theta = np.moveaxis(pose, -1, 0)
    dx, dy, dtheta = np.moveaxis(relative, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([x + c * dx - s * dy, y + s * dx + c * dy, theta + dtheta], axis=-1)


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the pose of the world in the body frame, (..., 3)."""
    x, y, theta = np.moveaxis(pose, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([-c * x - s * y, s * x - c * y, -theta], axis=-1)


def to_world(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return body points (..., 2) in the world, for poses (..., 3)."""
    x, y, theta = np.moveaxis(pose, -1, 0)
    px, py = np.moveaxis(points, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([x + c * px - s * py, y + s * px + c * py], axis=-1)


def to_body(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return world points (..., 2) in the body frame, for poses (..., 3)."""
    x, y, theta = np.moveaxis(pose, -1, 0)
    dx, dy = points[..., 0] - x, points[..., 1] - y
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * dx + s * dy, -s * dx + c * dy], axis=-1)
