"""How much of the goal a slider covers, from a table of poses near the goal."""

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

from pushjax._internal.jit import quick_jit
from pushjax.geometry import se2
from pushjax.geometry.intersection import intersection_area
from pushjax.geometry.se2_numpy import to_world

POSITIONS, ANGLES = 29, 27  # points of the table along x and y each, and around
RANGE = 0.26  # of the table to each side: in units of the slider's length, and rad


class Measure(Protocol):
    """How good a final pose is."""

    @property
    def enough(self) -> float:
        """Score from which a pose counts as the goal."""
        ...

    @property
    def reach(self) -> float:
        """Largest distance of a pose that counts as the goal, m, in the sense of `pose_features`."""
        ...

    def __call__(self, errors: np.ndarray) -> np.ndarray:
        """Return the score of poses relative to the goal, (..., 3), between 0 and 1, (...,)."""
        ...


class CoverageTable:
    """Area of the intersection of slider and goal, divided by the area of the slider, by linear interpolation."""

    def __init__(
        self,
        vertices: np.ndarray,  # (vertices, 2), of the slider, counterclockwise, m
        center: np.ndarray,  # (2,), of the slider, m
        length: float,  # of its limit surface, m
        enough: float,  # coverage from which the slider is at the goal
    ):
        self.center, self.length, self.enough = np.asarray(center, float), length, enough
        side, turn = np.linspace(-RANGE, RANGE, POSITIONS) * length, np.linspace(-RANGE, RANGE, ANGLES)
        errors = np.stack(np.meshgrid(side, side, turn, indexing="ij"), axis=-1)
        # the table has the displacement of the center, so the slider turns about its center
        around = jnp.asarray((vertices - self.center) / length, jnp.float32)
        scaled = errors / np.array([length, length, 1.0])
        self.table = np.asarray(_coverage(around, jnp.asarray(scaled.reshape(-1, 3), jnp.float32)))
        self.table = self.table.reshape(errors.shape[:3])
        near = self.table >= enough
        distance = np.sqrt((errors**2 * np.array([1, 1, length**2])).sum(-1))
        self.reach = float(distance[near].max(initial=0.0)) + length * 2 * RANGE / (POSITIONS - 1)

    def __call__(self, errors: np.ndarray) -> np.ndarray:
        """Return the coverage at poses relative to the goal, (..., 3); zero outside of the table."""
        shift = to_world(errors, self.center.astype(errors.dtype)) - self.center
        turn = (errors[..., 2] + np.pi) % (2 * np.pi) - np.pi
        x, y = np.moveaxis(shift, -1, 0) / self.length
        sizes = (POSITIONS, POSITIONS, ANGLES)
        cells = np.stack([(each + RANGE) / (2 * RANGE) * (n - 1) for each, n in zip((x, y, turn), sizes, strict=True)])
        found = map_coordinates(self.table, cells.reshape(3, -1), order=1, mode="constant", cval=0.0)
        return found.reshape(cells.shape[1:])


@quick_jit
def _coverage(vertices, errors):
    """Return the coverage of a polygon by itself, moved by each of the poses (poses, 3)."""
    area = intersection_area(vertices, vertices)
    moved = jax.vmap(lambda error: intersection_area(se2.transform(error, vertices), vertices))(errors)
    return moved / area
