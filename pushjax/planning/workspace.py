"""Where a finger and a slider may move: a rectangle for each. Fixtures are not considered here."""

from typing import NamedTuple

import numpy as np

from pushjax._internal.checks import check_finite
from pushjax.geometry.se2_numpy import to_world

ROUNDING = 1e-7  # m, by which a slider at the goal may be out of the workspace


class Workspace(NamedTuple):
    """A rectangle for the center of a finger, and one for the whole slider, both parallel to the world's axes.

    Attributes:
        finger_low: Lowest x and y of the finger's center, (2,), world, m.
        finger_high: Highest x and y of the finger's center, (2,), world, m.
        slider_low: Lowest x and y of any point of the slider, (2,), world, m.
        slider_high: Highest x and y of any point of the slider, (2,), world, m.
    """

    finger_low: np.ndarray
    finger_high: np.ndarray
    slider_low: np.ndarray
    slider_high: np.ndarray

    @staticmethod
    def rectangle(low: tuple[float, float], high: tuple[float, float]) -> "Workspace":
        """Return a workspace with the same limits for finger and slider.

        Args:
            low: Lowest x and y, m.
            high: Highest x and y, m.
        """
        lowest, highest = np.asarray(low, float), np.asarray(high, float)
        return Workspace(lowest, highest, lowest, highest)

    @staticmethod
    def unlimited() -> "Workspace":
        """Return a workspace without limits."""
        return Workspace.rectangle((-np.inf, -np.inf), (np.inf, np.inf))

    def allows_finger(self, points: np.ndarray) -> np.ndarray:
        """Return whether points (..., 2), world, m, are within the finger's limits."""
        return np.all((points >= self.finger_low) & (points <= self.finger_high), axis=-1)

    def check_goal(self, goal: np.ndarray, vertices: np.ndarray) -> None:
        """Raise ValueError unless a slider with these vertices is within its limits at a goal, (3,)."""
        if goal.shape != (3,):
            raise ValueError(f"goal has shape {goal.shape}; expected (3,)")
        check_finite("goal", goal)
        corners = to_world(goal, vertices)
        outside = np.maximum(self.slider_low - corners, corners - self.slider_high).max()
        if outside > ROUNDING:
            raise ValueError(
                f"goal must be a pose at which the slider is within the workspace; got {goal.tolist()}, at which it "
                f"reaches {1e3 * outside:.3g} mm out of it"
            )


class BoundingBoxTable:
    """Table over the angle of how far a slider, (vertices, 2), reaches beyond its origin along the world's axes."""

    def __init__(self, vertices: np.ndarray, angles: int = 720):
        self.angles = angles
        # twice as many directions as cells, so that each cell has its ends and its middle
        theta = np.arange(2 * angles) * np.pi / angles
        c, s = np.cos(theta)[:, None], np.sin(theta)[:, None]
        x, y = c * vertices[:, 0] - s * vertices[:, 1], s * vertices[:, 0] + c * vertices[:, 1]
        reach = np.stack([-x.min(1), -y.min(1), x.max(1), y.max(1)], axis=1)  # toward -x, -y, +x and +y
        # the largest reach between neighboring angles
        around = np.maximum(np.maximum(np.roll(reach, 1, axis=0), reach), np.roll(reach, -1, axis=0))
        self.reach = around[::2].astype(np.float32)

    def outside(self, poses: np.ndarray, workspace: Workspace) -> np.ndarray:
        """Return the largest distance along x or y by which the slider is beyond its limits, zero within, (...,), m."""
        # Poses are (..., 3), world, m and rad.
        cell = np.round(poses[..., 2] * (self.angles / (2 * np.pi))).astype(np.int32) % self.angles
        reach = self.reach[cell]
        (x, y), low, high = (poses[..., 0], poses[..., 1]), workspace.slider_low, workspace.slider_high
        over_x = np.maximum(low[0] - x + reach[..., 0], x + reach[..., 2] - high[0])
        over_y = np.maximum(low[1] - y + reach[..., 1], y + reach[..., 3] - high[1])
        return np.maximum(np.maximum(over_x, over_y), 0)
