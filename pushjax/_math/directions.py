"""Evenly distributed directions on a half sphere."""

import numpy as np


def fibonacci_hemisphere(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors on a half sphere, spaced by the golden angle."""
    # Half a sphere is enough for a form of even degree, which has the same value at v and -v.
    k = np.arange(count) + 0.5
    height, angle = 1 - k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
