"""Which pushes of a library keep slider and finger out of walls and fixed bodies.

As long as nothing else touches the slider, a push has the outcome that the library has. So a push is free if slider and
finger keep a distance from all obstacles at every pose on the way. Other pushes are not considered at all.

The many pushes from one pose are first checked by a grid of the slider's distance from obstacles. The best few of them
are then checked exactly.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from pushjax.geometry.se2_numpy import compose, to_world
from pushjax.planning.obstacles import OVERLAP_TOLERANCE
from pushjax.planning.push_library import PushLibrary
from pushjax.planning.roadmap import Roadmap
from pushjax.planning.workspace import Workspace

POSITIONS = 36  # cells along x and y each, of the cost to go
# By how much a push must increase the slider's distance from an obstacle that is too near, in units of the surface's
# length.
MIN_RETREAT = 0.02
# Of the lengths of a push, every so many is checked: by the grid, and exactly.
GRID_STRIDE, EXACT_STRIDE = 4, 2
ANGLES = 72  # number of angles of the grid
SUBDIVISIONS = 4  # spacings of the grid in one spacing of that of the cost to go
MAX_VERTICES = 24  # number of vertices of the slider for the grid


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
        i, j, k = np.moveaxis(self._cells(poses), -1, 0)
        # the first angle comes again after the last one, so that every angle lies between two
        values = np.pad(self.values, ((0, 0), (0, 0), (0, 1)), "wrap")
        cells = np.stack([i, j, k % self.values.shape[2]])
        found = map_coordinates(values, cells.reshape(3, -1), np.float64, order=1, mode="nearest")
        return found.reshape(poses.shape[:-1])

    def _cells(self, poses: np.ndarray) -> np.ndarray:
        """Return positions in the grid, in units of cells, (..., 3)."""
        angles = self.values.shape[2]
        return np.concatenate(
            [(poses[..., :2] - self.origin) / self.spacing, poses[..., 2:] * (angles / (2 * np.pi))], axis=-1
        )


def grid_spacing(low: np.ndarray, high: np.ndarray) -> float:
    """Return the spacing of POSITIONS positions from the lowest to the highest along the wider axis, m."""
    return float(np.max(high - low)) / (POSITIONS - 1)


class FreeSpace:
    """Collision checks of one slider and one finger among obstacles, and of the pushes of a library."""

    def __init__(
        self,
        workspace: Workspace,  # limits of the finger
        roadmap: Roadmap,  # its goals are the points where the library's pushes begin with run-ups
        library: PushLibrary,  # the methods take other outcomes too, of the same starts, directions and lengths
        clearance: float,  # that slider and finger keep from obstacles, m
        goal: np.ndarray,  # (3,), world; if it is nearer to an obstacle, the slider keeps only its distance there
        low: np.ndarray,  # (2,), lowest position of the slider on the grids here and of the cost to go, world, m
        high: np.ndarray,  # (2,), highest
    ):
        self.workspace, self.roadmap, self.length = workspace, roadmap, library.length
        self.obstacles, self.vertices, self.radius = roadmap.obstacles, roadmap.vertices, roadmap.radius
        self.low, self.spacing = low, grid_spacing(low, high) / SUBDIVISIONS
        self.positions = SUBDIVISIONS * (POSITIONS - 1) + 1
        reach = np.linalg.norm(library.starts, axis=1).max() + library.travel[-1]
        self.padding = int(np.ceil(reach / self.spacing)) + 1  # cells beyond the grid that a push may lead to
        self.clearance = clearance  # of the finger, m
        at_goal = float(self.slider_distance(goal))
        if at_goal < -OVERLAP_TOLERANCE * self.length:
            raise ValueError(
                f"goal must be a pose at which the slider overlaps no fixture; got {np.asarray(goal).tolist()}, where "
                "it does"
            )
        self.slider_clearance = min(clearance, max(at_goal, 0.0))  # of the slider, m

    def slider_distance(self, poses: np.ndarray, stride: int = 1) -> np.ndarray:
        """Return the distance of the slider from obstacles at poses (..., 3), as `Obstacles.slider_clearance` does."""
        # with the outline of every so many of the vertices
        tolerance = OVERLAP_TOLERANCE * self.length
        return self.obstacles.slider_clearance(self.vertices[::stride], poses, 2 * self.clearance, tolerance)

    @cached_property
    def distances(self) -> PoseGrid:
        """`slider_distance` on a grid of poses, for an outline of at most `MAX_VERTICES` vertices."""
        axes = [low + self.spacing * np.arange(self.positions) for low in self.low]
        theta = np.arange(ANGLES) * (2 * np.pi / ANGLES)
        stride = -(-len(self.vertices) // MAX_VERTICES)
        cells = (np.stack(np.meshgrid(*axes, [each], indexing="ij"), axis=-1) for each in theta)
        values = [self.slider_distance(each, stride) for each in cells]
        return PoseGrid(self.low, self.spacing, np.concatenate(values, axis=-1).astype(np.float32))

    @cached_property
    def _free_cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Free cells of slider and finger on the grid of `distances` with `padding` more cells on each side."""
        # Of the slider, (angles, cells, cells); of the finger during a push, and at the start of a run-up, (cells,
        # cells).
        side = (self.padding, self.padding)
        slider = np.pad(
            np.moveaxis(self.distances.values, 2, 0) >= self.slider_clearance,
            ((0, 0), side, side),
            constant_values=True,
        )
        axes = [low + self.spacing * np.arange(-self.padding, self.positions + self.padding) for low in self.low]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        finger = self.obstacles.point_clearance(points) >= self.radius + self.clearance
        return np.ascontiguousarray(slider), finger, self._run_up_may_start(points)

    def _run_up_may_start(self, points: np.ndarray) -> np.ndarray:
        """Return whether the finger may start a run-up at points (..., 2), world, m."""
        distance = self.obstacles.point_clearance(points)
        return self.workspace.allows_finger(points) & (distance >= self.roadmap.min_obstacle_distance)

    def probably_free(self, library: PushLibrary, pose: np.ndarray, pushes: np.ndarray) -> np.ndarray:
        """Return which pushes from one pose, (3,), are free by the grid, (pushes, checked lengths)."""
        # Only the pushes with the indices `pushes` are checked, each up to every `GRID_STRIDE`-th length; the others
        # are not free.
        found = np.zeros((len(library.starts), len(range(0, len(library.travel), GRID_STRIDE))), bool)
        poses = compose(pose, library.outcomes[0][pushes, ::GRID_STRIDE])
        distance = self.distances(poses)
        # poses outside of the grid count as free of obstacles for the slider
        last = self.low + self.spacing * (self.positions - 1)
        in_grid = np.all((poses[..., :2] >= self.low) & (poses[..., :2] <= last), axis=-1)
        ends = library.starts[pushes, None] + library.travel[::GRID_STRIDE, None] * library.directions[pushes, None]
        finger = self.obstacles.point_clearance(to_world(pose, ends)) >= self.radius + self.clearance
        # A slider that is nearer already may stay so. Its distance on the grid can be off by about the spacing.
        required = min(self.slider_clearance, float(self.slider_distance(pose)) - self.spacing)
        found[pushes] = np.logical_and.accumulate((~in_grid | (distance >= required)) & finger, axis=1)
        return found

    def free(self, library: PushLibrary, poses: np.ndarray, entries: np.ndarray) -> np.ndarray:
        """Return whether pushes `entries` from poses (entries, 3), world, are free by exact distances, (entries,)."""
        push, index = library.entries[entries].T
        steps = np.minimum(np.arange(0, index.max(initial=0) + EXACT_STRIDE, EXACT_STRIDE), index[:, None])
        ends = library.starts[push] + library.travel[index, None] * library.directions[push]
        starts = to_world(poses, self.roadmap.goals[push])
        kept = self._run_up_may_start(starts) & self.finger_free(starts, to_world(poses, ends), self.clearance)
        # A slider that is too near to an obstacle at first must come no nearer, and must be farther away at the end.
        distance = self.slider_distance(compose(poses[:, None], library.outcomes[0][push[:, None], steps]))
        before, required = distance[:, 0], self.slider_clearance
        kept &= distance.min(1) >= np.minimum(required, before - OVERLAP_TOLERANCE * self.length)
        return kept & (distance[:, -1] >= np.minimum(required, before + MIN_RETREAT * self.length))

    def finger_free(self, start: np.ndarray, end: np.ndarray, clearance: float = 0.0) -> np.ndarray:
        """Return whether the finger keeps a clearance from obstacles along segments (..., 2), world, m."""
        enough = self.radius + clearance
        return self.obstacles.segment_clearance(start, end, enough) >= enough

    def free_from_grid(self, library: PushLibrary, angle: float, entries: np.ndarray) -> np.ndarray:
        """Return whether pushes from an angle, rad, are free by the grid, (entries, rows, columns)."""
        # From every position on the grid of the cost to go. Poses on the way and positions of the finger are rounded to
        # the nearest cell.
        slider, finger, run_up = self._free_cells
        push, index = library.entries[entries].T
        steps = np.minimum(np.arange(0, len(library.travel) + GRID_STRIDE, GRID_STRIDE), index[:, None])
        here = np.array([0.0, 0.0, angle])
        poses = compose(here, library.outcomes[0][push[:, None], steps].astype(float))
        ends = library.starts[push, None] + library.travel[steps, None] * library.directions[push, None]
        turns = np.rint(poses[..., 2] * (ANGLES / (2 * np.pi))).astype(int) % ANGLES
        slider_cells, finger_cells, run_up_cells = (
            np.rint(each / self.spacing).astype(int) + self.padding
            for each in (poses[..., :2], to_world(here, ends), to_world(here, self.roadmap.goals[push]))
        )
        free = np.ones((len(entries), POSITIONS, POSITIONS), bool)
        for k, free_from in enumerate(free):
            free_from &= self._shifted(run_up, run_up_cells[k])
            for step in range(-(-index[k] // GRID_STRIDE) + 1):
                free_from &= self._shifted(slider[turns[k, step]], slider_cells[k, step])
                free_from &= self._shifted(finger, finger_cells[k, step])
        return free

    def _shifted(self, cells: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the values of cells at each position of the cost to go plus a shift, in cells from the first one."""
        i, j = shift
        return cells[i : i + self.positions : SUBDIVISIONS, j : j + self.positions : SUBDIVISIONS]
