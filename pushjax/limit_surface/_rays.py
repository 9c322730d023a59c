"""Directions, evenly spread."""

import numpy as np


def half_sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors on half a sphere, by the golden angle: a form of even degree needs no more."""
    k = np.arange(count) + 0.5
    height, angle = 1 - k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
