"""Values of poses on a grid, and of poses between them by interpolation."""

from typing import NamedTuple

import numpy as np

POSITIONS = 36  # cells along x and y each, of the cost to go


class PoseGrid(NamedTuple):
    """Values of poses on a regular grid, with linear interpolation."""

    # Angles are periodic over a full turn. Positions beyond the border have the value of the nearest one on it.

    origin: np.ndarray  # (2,), position of the first cell, m
    spacing: float  # of neighboring cells, m
    values: np.ndarray  # (positions, positions, angles)

    def nearest(self, poses: np.ndarray) -> np.ndarray:
        """Return the value at the nearest cell of poses (..., 3), (...,)."""
        i, j, k = np.moveaxis(np.rint(self._cells(poses)).astype(np.int32), -1, 0)
        rows, columns, angles = self.values.shape
        return self.values[np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1), k % angles]

    def __call__(self, poses: np.ndarray) -> np.ndarray:
        """Return the value of poses (..., 3) by linear interpolation, (...,)."""
        cells = self._cells(poses)
        rows, columns, angles = self.values.shape
        # a little less than the last cell, so that the next higher one exists
        cells[..., :2] = np.clip(cells[..., :2], 0, np.array([rows - 1.001, columns - 1.001]))
        low = np.floor(cells).astype(np.int32)
        part = cells - low
        total = np.zeros(cells.shape[:-1])
        for corner in np.ndindex(2, 2, 2):
            i, j, k = np.moveaxis(low + np.array(corner), -1, 0)
            weight = np.prod(np.where(corner, part, 1 - part), axis=-1)
            total = total + weight * self.values[i, j, k % angles]
        return total

    def _cells(self, poses: np.ndarray) -> np.ndarray:
        """Return positions in the grid, in units of cells, (..., 3)."""
        angles = self.values.shape[2]
        return np.concatenate(
            [(poses[..., :2] - self.origin) / self.spacing, poses[..., 2:] * (angles / (2 * np.pi))], axis=-1
        )


def grid_spacing(low: np.ndarray, high: np.ndarray) -> float:
    """Return the spacing of POSITIONS positions from the lowest to the highest along the wider axis, m."""
    return float(np.max(high - low)) / (POSITIONS - 1)
