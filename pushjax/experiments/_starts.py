"""Where random experiments begin."""

import numpy as np


def in_circle(rng: np.random.Generator, radius: float, n: int) -> np.ndarray:
    """(n, 2), uniform in a circle of `radius` m about the origin."""
    away, angle = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)
