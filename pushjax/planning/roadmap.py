"""Transits of a round finger around a polygon, and among obstacles, that touch neither.

A transit is a path of the finger from one push to the next, on which it moves alone.

The shortest transit around polygons at a given distance has straight segments, and arcs around convex corners.
`Roadmap` has a few points just outside of each such arc; the segments between points that see each other are a
visibility graph. Start and goal are joined to it by the segments that keep the distance too.

A finger that has just pushed is nearer than that distance, so it first retreats, straight to where it has the distance.
So does a finger that overlaps the polygon a little, as positions that are measured may, if its center is outside.
The goal of an approach is the start of a push, which may be nearer too. The finger gets there along the direction of
the push, from a point that has the distance: so a push begins with a run-up.

The points and segments around the polygon are fixed in its frame. Where the limits of the workspace cut a point off,
the point is moved to the limit and its segments are checked anew. Obstacles move in this frame, so their points and all
segments among them are found for each pose. Of the segments to the many goals only those are checked that would be the
ends of shortest transits.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import dijkstra

from pushjax._internal.checks import check_positive
from pushjax.geometry.polygon_numpy import exterior_angles, segment_distances, signed_distances
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.planning.obstacles import Obstacles
from pushjax.planning.workspace import Workspace

ARC_STEP = np.pi / 4  # largest angle between neighboring points around a corner
OUTSIDE = 1e-3  # points are outside of the arc by this part of its radius, so that segments along it keep the distance
DISK_POINTS = 16  # around a disk
RETREATS = 24  # directions in which a retreat is tried
UNLIMITED, NO_OBSTACLES = Workspace.unlimited(), Obstacles()


class TransitStatus(IntEnum):
    """Whether there is a transit, or why not."""

    FOUND = 0
    START_IN_SLIDER = 1  # the center of the finger is inside the polygon at the start
    NO_RETREAT = 2  # the finger is too near to the polygon or to an obstacle at the start, and no segment leads out
    GOAL_BLOCKED = 3  # the end, or each run-up to the push, is too near to the polygon or to an obstacle
    NO_TRANSIT = 4  # no path leads from start to end
    START_IN_FIXTURE = 5  # the center of the finger is inside an obstacle at the start


class Transit(NamedTuple):
    """A transit of the finger's center."""

    points: np.ndarray  # (points, 2), its corners, world, m; only the start if there is no transit
    length: float  # m; infinite if there is no transit
    status: TransitStatus  # whether there is a transit, and why not


class ShortestTransits(NamedTuple):
    """Shortest transits from one start to many goals, one of which `Roadmap.transit` traces."""

    lengths: np.ndarray  # (goals,), of the transit to each goal, m, infinite where there is none
    status: TransitStatus  # FOUND, or why no goal can be reached at all
    # (nodes, 2), corners that transits may have, body frame, m. The first one is the start. If the finger must retreat,
    # the first one is where the retreat ends, and the last one is the start.
    points: np.ndarray
    previous: np.ndarray  # (nodes,), index of the point before each on the shortest transit; negative for the start
    last: np.ndarray  # (goals,), index of the last of the points before each goal
    blocked: np.ndarray  # (goals,), whether a goal itself is too near to the polygon or an obstacle


class Roadmap:
    """Visibility graph of the center of a round finger around a polygon."""

    def __init__(
        self,
        vertices: np.ndarray,  # (vertices, 2), of the polygon, counterclockwise, body frame, m
        radius: float,  # of the finger, m
        clearance: float,  # that the finger keeps from the polygon on its way, m
        goals: np.ndarray,  # (goals, 2), ends of the transits, body frame, m; not reached if nearer than the clearance
        obstacles: Obstacles = NO_OBSTACLES,  # walls and fixed bodies, world frame
        obstacle_clearance: float | None = None,  # that the finger keeps from obstacles, m; None: as from the polygon
    ):
        check_positive("clearance", clearance)
        # distances of the finger's center from obstacles and from the polygon that a transit keeps, m
        self.min_obstacle_distance = radius + (clearance if obstacle_clearance is None else obstacle_clearance)
        self.vertices, self.radius, self.min_distance = vertices, radius, radius + clearance
        self.clearance, self.goals, self.obstacles = clearance, np.asarray(goals, float), obstacles
        points = _corner_points(vertices, self.min_distance * (1 + OUTSIDE))
        self.nodes = points[signed_distances(vertices, points) >= self.min_distance]
        self.goal_clearance = signed_distances(vertices, self.goals)
        # (nodes, goals), m, infinite where segments come too near
        self.links = self._lengths(self.nodes[:, None], self.goals, end_distance=self.goal_clearance)

    def transits(self, start: np.ndarray, pose: np.ndarray, workspace: Workspace = UNLIMITED) -> ShortestTransits:
        """Find the shortest transits from one point, (2,), world, m, to all goals, for a pose of the polygon, (3,)."""
        body_start, obstacles = to_body(pose, np.asarray(start, float)), self.obstacles.in_frame(pose)
        begin, status = self._retreat(body_start, pose, workspace, obstacles)
        if status != TransitStatus.FOUND:
            none, blocked = np.full(len(self.goals), np.inf), self.goal_clearance < self.min_distance
            return ShortestTransits(none, status, body_start[None], np.array([-1]), np.zeros(len(none), int), blocked)
        nodes, links = self._within(pose, workspace)
        if obstacles.any:
            nodes, links = self._among(nodes, links, pose, workspace, obstacles)
        corners = np.concatenate([begin[-1:], nodes])
        graph = self._lengths(corners[:, None], corners)
        graph[np.isinf(graph) | ~self._clear(obstacles, corners[:, None], corners)] = 0  # no edge
        distance, previous = dijkstra(graph, indices=0, return_predecessors=True)
        direct = self._lengths(begin[-1], self.goals, end_distance=self.goal_clearance)
        total = distance[:, None] + np.concatenate([direct[None], links])
        total[:, ~workspace.allows_finger(to_world(pose, self.goals))] = np.inf
        blocked = self.goal_clearance < self.min_distance
        if obstacles.any:
            blocked |= obstacles.point_clearance(self.goals) < self.min_obstacle_distance
            total[:, blocked] = np.inf
        last = self._last(total, corners, obstacles)
        lengths = total[last, np.arange(len(self.goals))]
        if len(begin) > 1:  # the retreat comes first
            corners = np.concatenate([corners, begin[:1]])
            previous = np.append(previous, -1)
            previous[0] = len(corners) - 1
            lengths = lengths + np.linalg.norm(begin[1] - begin[0])
        status = TransitStatus.FOUND if np.isfinite(lengths).any() else TransitStatus.NO_TRANSIT
        return ShortestTransits(lengths, status, corners, previous, last, blocked)

    def transit(self, transits: ShortestTransits, goal: int, pose: np.ndarray) -> Transit:
        """Return the shortest transit to one goal, by its index, for the pose that `transits` was given."""
        if not np.isfinite(transits.lengths[goal]):
            status = transits.status if transits.status != TransitStatus.FOUND else TransitStatus.NO_TRANSIT
            is_blocked = status == TransitStatus.NO_TRANSIT and transits.blocked[goal]
            start = transits.points[:1] if transits.previous[0] < 0 else transits.points[-1:]
            return Transit(to_world(pose, start), np.inf, TransitStatus.GOAL_BLOCKED if is_blocked else status)
        corner, points = int(transits.last[goal]), [self.goals[goal]]
        while corner >= 0:
            points.append(transits.points[corner])
            corner = int(transits.previous[corner])
        return Transit(to_world(pose, np.array(points[::-1])), float(transits.lengths[goal]), TransitStatus.FOUND)

    def retreat(
        self,
        start: np.ndarray,  # (2,), center of the finger, world, m
        pose: np.ndarray,  # (3,), of the polygon, world, m and rad
        workspace: Workspace = UNLIMITED,
    ) -> Transit:
        """Return the shortest straight transit to where the finger has its clearance, only the start if it has it."""
        obstacles = self.obstacles.in_frame(pose)
        points, status = self._retreat(to_body(pose, np.asarray(start, float)), pose, workspace, obstacles)
        length = float(np.linalg.norm(points[-1] - points[0])) if status == TransitStatus.FOUND else np.inf
        return Transit(to_world(pose, points), length, status)

    def between(self, starts: np.ndarray) -> np.ndarray:
        """Return the lengths of the shortest transits from points to all goals, (points, goals), m, inf for none."""
        # `starts` are points with the clearance, (points, 2), body frame, m. Workspace and obstacles are ignored.
        start_distance = signed_distances(self.vertices, starts)
        direct = self._lengths(starts[:, None], self.goals, start_distance[:, None], self.goal_clearance)
        graph = self._lengths(self.nodes[:, None], self.nodes)
        graph[np.isinf(graph)] = 0
        from_nodes = np.min(dijkstra(graph)[..., None] + self.links, axis=1)  # (nodes, goals)
        to_nodes = self._lengths(starts[:, None], self.nodes, start_distance[:, None])
        through = np.stack([np.min(row[:, None] + from_nodes, axis=0) for row in to_nodes])
        return np.minimum(direct, through)

    def _lengths(self, start, end, start_distance=None, end_distance=None) -> np.ndarray:
        """Return the lengths of segments, infinite where they do not keep the distance."""
        distance = segment_distances(self.vertices, start, end, start_distance, end_distance)
        return np.where(distance >= self.min_distance * (1 - 1e-9), np.linalg.norm(end - start, axis=-1), np.inf)

    def _within(self, pose: np.ndarray, workspace: Workspace) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes, moved to the limits of the workspace where they are outside, and their links to goals."""
        world = to_world(pose, self.nodes)
        allowed = workspace.allows_finger(world)
        if allowed.all():
            return self.nodes, self.links
        clipped = np.clip(world, workspace.finger_low, workspace.finger_high)
        nodes = np.where(allowed[:, None], self.nodes, to_body(pose, clipped))
        links = self.links.copy()
        links[~allowed] = self._lengths(nodes[~allowed][:, None], self.goals, end_distance=self.goal_clearance)
        return nodes, links

    def _clear(self, obstacles: Obstacles, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return whether segments keep the distance from obstacles."""
        enough = self.min_obstacle_distance
        return obstacles.segment_clearance(start, end, enough) >= enough * (1 - 1e-9)

    def _among(self, nodes: np.ndarray, links: np.ndarray, pose, workspace: Workspace, obstacles: Obstacles):
        """Return nodes and links with those around obstacles."""
        # All links may run through an obstacle, and those of the new nodes also through the polygon. `_last` excludes
        # them.
        around = [_corner_points(body, self.min_obstacle_distance * (1 + OUTSIDE)) for body in obstacles.bodies]
        angle, half = np.arange(DISK_POINTS) * (2 * np.pi / DISK_POINTS), np.pi / DISK_POINTS
        circle = (1 + OUTSIDE) / np.cos(half) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        around += [
            center + (radius + self.min_obstacle_distance) * circle
            for center, radius in zip(obstacles.centers, obstacles.radii, strict=True)
        ]
        world = to_world(pose, np.concatenate([np.zeros((0, 2)), *around]))
        more = to_body(pose, np.clip(world, workspace.finger_low, workspace.finger_high))
        more = more[signed_distances(self.vertices, more) >= self.min_distance]
        nodes = np.concatenate([nodes, more])
        links = np.concatenate([links, np.linalg.norm(self.goals - more[:, None], axis=-1)])
        is_free = obstacles.point_clearance(nodes) >= self.min_obstacle_distance
        return nodes[is_free], links[is_free]

    def _last(self, total: np.ndarray, corners: np.ndarray, obstacles: Obstacles) -> np.ndarray:
        """Return the last corner before each goal on the shortest transit."""
        # `total` is the length of the transit to each goal by each corner, (corners, goals). It becomes infinite where
        # the last segment of a shortest transit does not keep the distances.
        if not obstacles.any:
            return np.argmin(total, axis=0)
        open_goals = np.flatnonzero(np.isfinite(total).any(0))
        while len(open_goals):
            last = np.argmin(total[:, open_goals], axis=0)
            ends = self.goals[open_goals]
            is_free = self._clear(obstacles, corners[last], ends)
            is_free &= np.isfinite(self._lengths(corners[last], ends, end_distance=self.goal_clearance[open_goals]))
            total[last[~is_free], open_goals[~is_free]] = np.inf
            open_goals = open_goals[~is_free]
            open_goals = open_goals[np.isfinite(total[:, open_goals]).any(0)]
        return np.argmin(total, axis=0)

    def _retreat(self, start: np.ndarray, pose, workspace: Workspace, obstacles: Obstacles):
        """Return the start, and where the finger has retreated to if it is too near, (1 or 2, 2), and the status."""
        solids = (Obstacles((self.vertices,)), self.min_distance), (obstacles, self.min_obstacle_distance)
        distances = [float(solid.point_clearance(start)) for solid, _ in solids]
        missing = max(required - distance for distance, (_, required) in zip(distances, solids, strict=True))
        if missing <= 0:
            return start[None], TransitStatus.FOUND
        if min(distances) <= 0:
            return start[None], TransitStatus.START_IN_SLIDER if distances[0] <= 0 else TransitStatus.START_IN_FIXTURE
        angle = np.arange(RETREATS) * (2 * np.pi / RETREATS)
        # out of a wedge between polygon and obstacle it is farther
        reach = missing * np.array([1.0, 1.5, 2.0, 3.0, 5.0, 8.0][: 6 if obstacles.any else 4]) + 1e-3 * self.clearance
        ends = start + (reach[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
        good = workspace.allows_finger(to_world(pose, ends))
        for (solid, required), distance in zip(solids, distances, strict=True):
            good &= _recedes(solid, distance, required, start, ends)
        if not good.any():
            return start[None], TransitStatus.NO_RETREAT
        best = np.argmin(np.where(good, np.linalg.norm(ends - start, axis=1), np.inf))
        return np.stack([start, ends[best]]), TransitStatus.FOUND


def _recedes(solid: Obstacles, distance: float, required: float, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return whether segments from a start at a distance end at the required one or more, and are nowhere nearer."""
    # A little after the start the distance must have grown, to exclude segments that slide along an edge.
    early = solid.point_clearance(start + 0.2 * (ends - start))
    grows = distance >= required or early > distance + 0.02 * (required - distance)
    least = solid.segment_clearance(start, ends)
    return grows & (least >= min(distance, required) * (1 - 1e-9)) & (solid.point_clearance(ends) >= required)


def run_ups(
    vertices: np.ndarray,  # (vertices, 2), of the polygon, counterclockwise, m
    radius: float,  # of the finger, m
    clearance: float,  # of the finger from the polygon at the beginning, m
    starts: np.ndarray,  # (pushes, 2), m
    directions: np.ndarray,  # (pushes, 2), unit vectors
    longest: float,  # m
) -> np.ndarray:
    """Return how far before its start each push can begin, (pushes,), m, NaN where no run-up is free."""
    # The longest of nine lengths from `longest` to zero with which the finger does not touch the polygon, and has the
    # clearance where it begins.
    start_distance = signed_distances(vertices, starts)
    found = np.full(len(starts), np.nan)
    for length in np.linspace(longest, 0.0, 9):
        begin = starts - length * directions
        apart = signed_distances(vertices, begin)
        least = segment_distances(vertices, begin, starts, apart, start_distance)
        recedes = least >= np.minimum(start_distance, radius + clearance) * 0.999
        found = np.where(np.isnan(found) & recedes & (apart >= radius + clearance), length, found)
    return found


def _corner_points(vertices: np.ndarray, distance: float) -> np.ndarray:
    """Return points around the convex corners, such that the segments between neighbors keep the distance."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    heading = np.arctan2(edge[:, 1], edge[:, 0])
    points = []
    for vertex, turn, leaving in zip(vertices, exterior_angles(vertices), heading, strict=True):
        if turn <= 0:
            continue
        count = max(1, int(np.ceil(turn / ARC_STEP)))
        half = turn / count / 2
        normal = leaving - turn - np.pi / 2 + half + 2 * half * np.arange(count)
        points.append(vertex + distance / np.cos(half) * np.stack([np.cos(normal), np.sin(normal)], axis=1))
    return np.concatenate(points)
