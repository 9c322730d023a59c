"""Which pushes of a library keep slider and finger out of walls and fixed bodies.

As long as nothing else touches the slider, a push has the outcome that the library has. So a push is free if slider and
finger keep a distance from all obstacles at every pose on the way; others are not considered at all.

Many pushes from one pose are judged by a table of the slider's distance from obstacles, the few best of them exactly.
"""

from functools import cached_property

import numpy as np

from pushjax.planning.approach import Roadmap
from pushjax.planning.pose_table import POSITIONS, PoseTable, grid_spacing
from pushjax.planning.poses import compose, to_world
from pushjax.planning.push_library import PushLibrary
from pushjax.planning.workspace import Workspace

TOLERANCE = 0.005  # overlap that counts as touching, in units of the surface's length
PROGRESS = 0.02  # by which a slider that is too near must get away, in units of the length
ANGLES = 72  # of the table
REFINED = 4  # cells of the table in one of the cost to go, along x and y each
SPARSE, DENSE = 4, 2  # of the lengths of a push, one in so many is looked at: by the table, and exactly
OUTLINE = 24  # vertices of the slider for the table, at most


class FreeSpace:
    """Where one slider and one finger may be among obstacles, and which pushes of a library keep them there.

    Args:
        workspace: The obstacles, and limits of the finger.
        roadmap: Vertices of the slider, radius of the finger, and as goals the points where each push of the library
            begins with its run-up.
        library: Pushes of the slider. Others may have other outcomes, but the same starts, directions and lengths.
        clearance: Distance that slider and finger keep from obstacles, m.
        goal: The goal, (3,), world. If it is nearer to an obstacle, the slider keeps only the distance it has there.
        low: Lowest position of the slider in the table of the cost to go, (2,), m.
        high: Highest position, (2,), m.

    Raises:
        ValueError: For a goal at which the slider overlaps an obstacle.
    """

    def __init__(
        self,
        workspace: Workspace,
        roadmap: Roadmap,
        library: PushLibrary,
        clearance: float,
        goal: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
    ):
        self.workspace, self.roadmap, self.length = workspace, roadmap, library.length
        self.obstacles, self.vertices, self.radius = workspace.obstacles, roadmap.vertices, roadmap.radius
        self.low, self.spacing = low, grid_spacing(low, high) / REFINED
        self.positions = REFINED * (POSITIONS - 1) + 1
        far = np.linalg.norm(library.starts[:, :2], axis=1).max() + library.travel[-1]
        self.beyond = int(np.ceil(far / self.spacing)) + 1  # cells that a push may lead to, beyond the table
        self.clearance = self.least = clearance
        at_goal = float(self.slider(goal))
        if at_goal < -TOLERANCE * self.length:
            raise ValueError(
                f"goal must be a pose at which the slider overlaps no fixture; got {np.asarray(goal).tolist()}, where "
                "it does"
            )
        self.least = min(clearance, max(at_goal, 0.0))

    def slider(self, poses: np.ndarray) -> np.ndarray:
        """Return the distance of the slider from obstacles at poses (..., 3), as `Obstacles.slider_clearance` does."""
        return self.obstacles.slider_clearance(self.vertices, poses, 2 * self.clearance, TOLERANCE * self.length)

    @cached_property
    def table(self) -> PoseTable:
        """The same distance on a grid of poses."""
        axes = [low + self.spacing * np.arange(self.positions) for low in self.low]
        theta = np.arange(ANGLES) * (2 * np.pi / ANGLES)
        outline = self.vertices[:: -(-len(self.vertices) // OUTLINE)]
        values = [
            self.obstacles.slider_clearance(
                outline,
                np.stack(np.meshgrid(*axes, [each], indexing="ij"), axis=-1),
                2 * self.clearance,
                TOLERANCE * self.length,
            )
            for each in theta
        ]
        return PoseTable(self.low, self.spacing, np.concatenate(values, axis=-1).astype(np.float32))

    @cached_property
    def _grids(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the slider (angles, cells, cells) and the finger in a push (cells, cells) are free, and it before one.

        They have some cells beyond the table.
        """
        side = (self.beyond, self.beyond)
        slider = np.pad(np.moveaxis(self.table.values, 2, 0) >= self.least, ((0, 0), side, side), constant_values=True)
        axes = [low + self.spacing * np.arange(-self.beyond, self.positions + self.beyond) for low in self.low]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        finger = self.obstacles.point_clearance(points) >= self.radius + self.clearance
        return np.ascontiguousarray(slider), finger, self._may_begin(points)

    def _may_begin(self, points: np.ndarray) -> np.ndarray:
        """Return whether a push may begin with the finger at points (..., 2), as far as limits and obstacles go."""
        apart = self.obstacles.point_clearance(points)
        return self.workspace.allows_finger(points) & (apart >= self.roadmap.from_obstacles)

    def likely(self, library: PushLibrary, pose: np.ndarray, pushes: np.ndarray) -> np.ndarray:
        """Return which pushes from one pose seem to be free, (pushes, lengths), each up to every SPARSE-th length.

        Args:
            library: The pushes.
            pose: Pose of the slider, (3,), world.
            pushes: Indices of the pushes that are looked at; the others are not free.
        """
        found = np.zeros((len(library.starts), len(range(0, len(library.travel), SPARSE))), bool)
        poses = compose(pose, library.outcomes[0][pushes, ::SPARSE])
        apart = self.table(poses)
        last = self.low + self.spacing * (self.positions - 1)
        apart = np.where(np.all((poses[..., :2] >= self.low) & (poses[..., :2] <= last), axis=-1), apart, np.inf)
        ends = library.starts[pushes, None, :2] + library.travel[::SPARSE, None] * library.directions[pushes, None]
        finger = self.obstacles.point_clearance(to_world(pose, ends)) >= self.radius + self.clearance
        # a slider that is nearer already, by a table that is not exact
        least = min(self.least, float(self.slider(pose)) - self.spacing)
        found[pushes] = np.logical_and.accumulate((apart >= least) & finger, axis=1)
        return found

    def free(self, library: PushLibrary, poses: np.ndarray, entries: np.ndarray) -> np.ndarray:
        """Return whether pushes are free, (entries,).

        Args:
            library: The pushes.
            poses: Pose of the slider before each, (entries, 3), world.
            entries: Entries of the library, (entries,).
        """
        push, index = library.entries[entries].T
        steps = np.minimum(np.arange(0, index.max(initial=0) + DENSE, DENSE), index[:, None])
        ends = library.starts[push, :2] + library.travel[index, None] * library.directions[push]
        reached = compose(poses[:, None], library.outcomes[0][push[:, None], steps])
        begins = to_world(poses, self.roadmap.goals[push])
        return self._may_begin(begins) & self.keeps_out(reached, begins, to_world(poses, ends))

    def keeps_out(self, poses: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return whether slider and finger keep their distance from obstacles in pushes, (pushes,).

        A slider that is too near to an obstacle at first must come no nearer, and get away.

        Args:
            poses: Poses of the slider along each push, (pushes, poses, 3), world.
            start: Where the finger starts, (pushes, 2), world.
            end: Where it ends, (pushes, 2), world.
        """
        apart = self.slider(poses)
        good = apart.min(1) >= np.minimum(self.least, apart[:, 0] - TOLERANCE * self.length)
        good &= apart[:, -1] >= np.minimum(self.least, apart[:, 0] + PROGRESS * self.length)
        return good & self.finger_free(start, end, self.clearance)

    def finger_free(self, start: np.ndarray, end: np.ndarray, clearance: float = 0.0) -> np.ndarray:
        """Return whether a finger keeps a clearance from obstacles along segments (..., 2), world."""
        enough = self.radius + clearance
        return self.obstacles.segment_clearance(start, end, enough) >= enough

    def moves(self, library: PushLibrary, angle: float, entries: np.ndarray) -> np.ndarray:
        """Return whether pushes run into no obstacle, from all positions of the cost to go, (entries, rows, columns).

        Poses on the way are rounded to the table, and the finger's positions to its spacing.

        Args:
            library: The pushes.
            angle: Angle of the slider before each push, rad.
            entries: Entries of the library, (entries,).
        """
        slider, finger, before = self._grids
        push, index = library.entries[entries].T
        steps = np.minimum(np.arange(0, len(library.travel) + SPARSE, SPARSE), index[:, None])
        here = np.array([0.0, 0.0, angle])
        poses = compose(here, library.outcomes[0][push[:, None], steps].astype(float))
        ends = library.starts[push, None, :2] + library.travel[steps, None] * library.directions[push, None]
        turns = np.rint(poses[..., 2] * (ANGLES / (2 * np.pi))).astype(int) % ANGLES
        places, fingers = (
            np.rint(each / self.spacing).astype(int) + self.beyond for each in (poses[..., :2], to_world(here, ends))
        )
        begins = np.rint(to_world(here, self.roadmap.goals[push]) / self.spacing).astype(int) + self.beyond
        size = self.positions
        allowed = np.ones((len(entries), POSITIONS, POSITIONS), bool)
        for k, may in enumerate(allowed):
            i, j = begins[k]
            may &= before[i : i + size : REFINED, j : j + size : REFINED]
            for step in range(-(-index[k] // SPARSE) + 1):
                for grid, (i, j) in ((slider[turns[k, step]], places[k, step]), (finger, fingers[k, step])):
                    may &= grid[i : i + size : REFINED, j : j + size : REFINED]
        return allowed
