"""Distances of fingers and sliders from walls and fixed bodies, in NumPy, for planners.

Fixed bodies are disks and convex polygons; another polygon is divided into triangles.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pushjax.geometry.disk import Disk
from pushjax.geometry.polygon_numpy import segment_distances, signed_distances, triangles
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.simulation.arguments import checked_fixtures
from pushjax.simulation.fixtures import Fixture, Wall

OVERLAP_TOLERANCE = 0.005  # overlap that counts as touching, in units of the surface's length
POSES_AT_A_TIME = 4000  # poses whose distances are computed together, so that their data stay in the cache


class Obstacles(NamedTuple):
    """Walls, convex polygons and disks that neither a finger nor the slider may run into."""

    bodies: tuple[np.ndarray, ...] = ()  # vertices of convex polygons, counterclockwise, each (vertices, 2), m
    points: np.ndarray = np.zeros((0, 2))  # (walls, 2), a point on each wall, m
    normals: np.ndarray = np.zeros((0, 2))  # (walls, 2), unit vectors from the walls into the free space
    centers: np.ndarray = np.zeros((0, 2))  # (disks, 2), m
    radii: np.ndarray = np.zeros(0)  # (disks,), m

    @staticmethod
    def of(fixtures: Sequence[Wall | Fixture]) -> "Obstacles":
        """Return walls and fixed bodies as obstacles, in the world frame."""
        fixed = checked_fixtures(fixtures, jnp.result_type(float))
        walls = [(each.point, each.normal) for each in fixed if isinstance(each, Wall)]
        points, normals = np.moveaxis(np.array(walls, float).reshape(-1, 2, 2), 1, 0)
        bodies, disks = [], []
        for each in [fixture for fixture in fixed if isinstance(fixture, Fixture)]:
            if isinstance(each.shape, Disk):
                disks.append((each.center.x, each.center.y, each.shape.radius))
            else:
                placed = to_world(np.asarray(each.pose, float), np.asarray(each.shape.vertices, float))
                bodies += [placed] if each.shape.convex else triangles(placed)
        centers, radii = np.split(np.array(disks, float).reshape(-1, 3), [2], axis=1)
        return Obstacles(tuple(bodies), points, normals, centers, radii[:, 0])

    @property
    def any(self) -> bool:
        """Whether there is an obstacle at all."""
        return bool(self.bodies) or len(self.points) + len(self.radii) > 0

    def in_frame(self, pose: np.ndarray) -> "Obstacles":
        """Return the same obstacles in the frame of a body at a pose, (3,), m and rad."""
        bodies = tuple(to_body(pose, body) for body in self.bodies)
        turned = to_body(np.array([0.0, 0.0, pose[2]]), self.normals)
        return Obstacles(bodies, to_body(pose, self.points), turned, to_body(pose, self.centers), self.radii)

    def point_clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of points (..., 2) from the nearest obstacle, negative inside, (...,)."""
        found = self._wall_clearance(points)
        for center, radius in zip(self.centers, self.radii, strict=True):
            found = np.minimum(found, np.hypot(*np.moveaxis(points - center, -1, 0)) - radius)
        for body in self.bodies:
            found = np.minimum(found, signed_distances(body, points))
        return found

    def segment_clearance(self, start: np.ndarray, end: np.ndarray, enough: float = np.inf) -> np.ndarray:
        """Return the distance of segments from the nearest obstacle, not positive where they touch it, (...,)."""
        # The ends have shape (..., 2), m. Distances larger than `enough`, m, may be too small in the result, but not
        # smaller than it.
        found = np.minimum(self._wall_clearance(start), self._wall_clearance(end))
        for center, radius in zip(self.centers, self.radii, strict=True):
            found = np.minimum(found, _distance_from_point(center, start, end) - radius)
        for body in self.bodies:
            middle = body.mean(0)
            size = np.linalg.norm(body - middle, axis=1).max()
            apart = np.array(_distance_from_point(middle, start, end) - size)
            near = apart < enough
            some = (np.broadcast_to(each, (*apart.shape, 2))[near] for each in (start, end))
            apart[near] = segment_distances(body, *some)
            found = np.minimum(found, apart)
        return found

    def slider_clearance(
        self,
        vertices: np.ndarray,  # (vertices, 2), of the slider, counterclockwise, body frame, m
        poses: np.ndarray,  # (..., 3), world, m and rad
        enough: float,  # larger distances, m, may be too small in the result, but not smaller than this
        tolerance: float,  # overlap that counts as touching, m
    ) -> np.ndarray:
        """Return the distance of a slider from the nearest obstacle at poses (..., 3), (...,), m."""
        # Where they overlap by more than `tolerance` it is negative: minus a distance by which the slider can be moved
        # out of the obstacle, not always the least. For a disk in a reflex corner of the slider it may be too small.
        flat = np.asarray(poses, float).reshape(-1, 3)
        found = np.full(len(flat), np.inf)
        for point, normal in zip(self.points, self.normals, strict=True):
            # how far the slider reaches toward the wall depends on its angle only
            facing = to_body(flat * np.array([0.0, 0.0, 1.0]), normal)
            found = np.minimum(found, (flat[:, :2] - point) @ normal + (facing @ vertices.T).min(-1))
        reach = np.linalg.norm(vertices, axis=1).max()
        # bounding circles; a disk is its own, and there is no polygon in it
        circles = [(body.mean(0), np.linalg.norm(body - body.mean(0), axis=1).max(), body) for body in self.bodies]
        circles += [(center, radius, None) for center, radius in zip(self.centers, self.radii, strict=True)]
        for middle, radius, body in circles:
            apart = np.linalg.norm(flat[:, :2] - middle, axis=1) - reach - radius
            near = np.flatnonzero(apart < enough)
            for some in np.array_split(near, len(near) // POSES_AT_A_TIME + 1):
                if body is None:
                    apart[some] = signed_distances(vertices, to_body(flat[some], middle)) - radius
                else:
                    apart[some] = _polygons_apart(vertices, flat[some], body, tolerance)
            found = np.minimum(found, apart)
        return found.reshape(np.shape(poses)[:-1])

    def _wall_clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of points (..., 2) from the nearest wall, negative behind it, (...,)."""
        found = np.full(points.shape[:-1], np.inf)
        for point, normal in zip(self.points, self.normals, strict=True):
            found = np.minimum(found, (points - point) @ normal)
        return found


def _distance_from_point(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the distance of segments from a point, (...,)."""
    (sx, sy), (ox, oy) = np.moveaxis(end - start, -1, 0), np.moveaxis(point - start, -1, 0)
    length2 = sx**2 + sy**2
    along = np.clip((ox * sx + oy * sy) / np.where(length2 > 0, length2, 1), 0, 1)
    return np.hypot(ox - along * sx, oy - along * sy)


def _polygons_apart(vertices: np.ndarray, poses: np.ndarray, body: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the distance between a polygon at each pose (poses, 3) and a convex one, as in `slider_clearance`."""
    corners, placed = to_world(poses[:, None], vertices), to_body(poses[:, None], body)
    apart = np.minimum(signed_distances(body, corners).min(1), signed_distances(vertices, placed).min(1))
    beyond = _edge_distances(body, corners)
    # Two polygons overlap if an edge of one has a part in the other, or if one is inside of the other. No part of an
    # edge that merely touches the body is in a body that is smaller by the tolerance.
    shrunk = beyond + tolerance
    slope = np.roll(shrunk, -1, axis=1) - shrunk
    crossing = -shrunk / np.where(slope == 0, 1.0, slope)
    enters = np.where(slope < 0, crossing, np.where((slope == 0) & (shrunk >= 0), np.inf, 0.0)).max(-1)
    leaves = np.where(slope > 0, crossing, 1.0).min(-1)
    overlap = (np.maximum(enters, 0) < np.minimum(leaves, 1)).any(1)
    overlap |= apart < -tolerance
    # The slider is out of the body when all of it is beyond one edge of the body, or when all of the body is beyond
    # an edge of the slider that is part of its convex hull.
    hull = _edge_distances(vertices, vertices).max(0) <= 1e-9 * np.abs(vertices).max()
    body_beyond = _edge_distances(vertices, placed)[..., hull]
    escape = np.maximum(beyond.min(1).max(-1), body_beyond.min(1).max(-1, initial=-np.inf))
    return np.where(overlap, np.minimum(escape, -tolerance), apart)


def _edge_distances(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances of points (..., 2) from the lines of a polygon's edges, positive outside, (..., edges)."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return points @ outward.T - (polygon * outward).sum(1)
