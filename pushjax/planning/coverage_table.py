"""Measures of how well a final pose reaches the goal: the protocol, and the part of the goal that the slider covers."""

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

from pushjax._internal.jit import quick_jit
from pushjax.geometry import se2
from pushjax.geometry.intersection import intersection_area
from pushjax.geometry.se2_numpy import to_world

POSITIONS, ANGLES = 29, 27  # of the table: points along x and along y, and angles
RANGE = 0.26  # half-width of the table, in units of the surface's length along x and y, and in rad


class Measure(Protocol):
    """Score of final poses: how well they reach the goal."""

    @property
    def enough(self) -> float:
        """Score above which a slider is at the goal."""
        ...

    @property
    def reach(self) -> float:
        """Upper bound of the distance from the goal (`PushLibrary.features`) at which the score can be `enough`, m."""
        ...

    def __call__(self, errors: np.ndarray) -> np.ndarray:
        """Return the score of poses relative to the goal, (..., 3), between 0 and 1, (...,)."""
        ...


class CoverageTable:
    """Coverage: area of the intersection of slider and goal, divided by the slider's, by interpolation in a table."""

    def __init__(
        self,
        vertices: np.ndarray,  # (vertices, 2), of the slider, counterclockwise, m
        center: np.ndarray,  # (2,), of the slider, m
        length: float,  # of its limit surface, m
        enough: float,  # coverage from which the slider is at the goal
    ):
        self.center, self.length, self.enough = np.asarray(center, float), length, enough
        # All lengths are in units of `length`. The axes of the table are the displacement of the center and the turn
        # about it, because a turn about another point displaces the center too.
        side, turn = np.linspace(-RANGE, RANGE, POSITIONS), np.linspace(-RANGE, RANGE, ANGLES)
        errors = np.stack(np.meshgrid(side, side, turn, indexing="ij"), axis=-1)
        outline = jnp.asarray((vertices - self.center) / length, jnp.float32)
        self.table = np.asarray(_coverage(outline, jnp.asarray(errors.reshape(-1, 3), jnp.float32)))
        self.table = self.table.reshape(errors.shape[:3])
        distance = np.linalg.norm(errors, axis=-1)[self.table >= enough]
        # between two points of the table the coverage can be enough up to one spacing farther away
        self.reach = length * float(distance.max(initial=0.0) + side[1] - side[0])

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
    overlap = jax.vmap(lambda error: intersection_area(se2.transform(error, vertices), vertices))(errors)
    return overlap / intersection_area(vertices, vertices)
