"""Rotations, cross products, angles and interpolation in NumPy, for the readers of logs."""

import numpy as np

from pushjax.datasets.recordings import Floats


def interpolated(time: Floats, known_time: Floats, known: Floats) -> Floats:
    """Interpolate known values (k, c) linearly at the times (m,); NaN outside the known times (k,)."""
    columns = [np.interp(time, known_time, column, left=np.nan, right=np.nan) for column in known.T]
    return np.stack(columns, axis=1)


def rotation(theta: Floats | float) -> Floats:
    """Return the rotation matrices (..., 2, 2) of angles (...) in rad."""
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)


def in_body(pose: Floats, vectors: Floats) -> Floats:
    """Rotate world vectors (k, 2) into the body frames of k poses (k, 3)."""
    return np.einsum("kji,kj->ki", rotation(pose[:, 2]), vectors)


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products (n,) of vectors (n, 2) in the plane."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def wrap_angle(angle: Floats) -> Floats:
    """Return the same angle in (-pi, pi], in rad."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)
