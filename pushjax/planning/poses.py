"""Operations on many poses in NumPy, for planners that run outside of compiled programs.

They agree with `pushjax.geometry.se2`, but keep the arrays' own dtype and compile nothing for new shapes.
"""

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


def pose_features(poses: np.ndarray, center: np.ndarray, length: float) -> np.ndarray:
    """Return four numbers of each pose whose Euclidean distance is a distance of poses, (..., 4), m.

    They are the position of the center, and `length` times cosine and sine of the angle. So angles that differ by a
    full turn are the same, and for small differences the distance is sqrt(dx^2 + dy^2 + (length dtheta)^2).

    Args:
        poses: Poses, (..., 3), m and rad.
        center: The slider's center, (2,), body frame, m.
        length: What an angle of one radian counts, m.
    """
    theta = poses[..., 2]
    center_position = to_world(poses, np.asarray(center, poses.dtype))
    return np.concatenate(
        [center_position, np.stack([length * np.cos(theta), length * np.sin(theta)], axis=-1).astype(poses.dtype)],
        axis=-1,
    )
