"""Random start positions for experiments."""

import numpy as np


def uniform_in_circle(rng: np.random.Generator, radius: float, n: int) -> np.ndarray:
    """Sample points (n, 2) uniformly in a circle about the origin, m."""
    distance, angle = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=1)
