"""Distances from a polygon and curves at a given distance around it, in NumPy.

The functions serve thousands of points at a time, outside of compiled programs. All points are in the polygon's frame,
in m, and all vertices run counterclockwise.
"""

from typing import NamedTuple

import numpy as np

from pushjax.geometry.polygon import Polygon
from pushjax.geometry.shape import Shape

CURVE_POINTS = 96  # vertices of the polygon that stands for a curved outline


def outline_vertices(shape: Shape) -> np.ndarray:
    """Return the vertices of a polygon, or points on another outline, (vertices, 2), body frame, m."""
    # A convex curved outline reaches a little beyond the polygon of these points.
    points = shape.vertices if isinstance(shape, Polygon) else shape.boundary(CURVE_POINTS)
    return np.asarray(points, np.float64)


def signed_distances(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distances of points (..., 2) from a polygon, (...,), m, negative inside."""
    # edges come first, so that the longest loops run over the points
    edges = np.roll(vertices, -1, axis=0) - vertices
    (ax, ay), (ex, ey) = (_by_edge(each, points.ndim) for each in (vertices, edges))
    dx, dy = points[..., 0] - ax, points[..., 1] - ay
    fraction = np.clip((dx * ex + dy * ey) / (ex**2 + ey**2), 0, 1)
    distance = np.sqrt(np.min((dx - fraction * ex) ** 2 + (dy - fraction * ey) ** 2, axis=0))
    return np.where(inside(vertices, points), -distance, distance)


def _by_edge(vectors: np.ndarray, ndim: int) -> np.ndarray:
    """Return the components (2, edges, 1, ...) of vectors (edges, 2), to be used with points of `ndim` axes."""
    return vectors.T.reshape(2, len(vectors), *(1,) * (ndim - 1))


def inside(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return whether points (..., 2) are inside of a polygon, by the crossings of a ray along +x, (...,)."""
    (ax, ay), (bx, by) = (_by_edge(each, points.ndim) for each in (vertices, np.roll(vertices, -1, axis=0)))
    x, y = points[..., 0], points[..., 1]
    spans = (ay <= y) != (by <= y)
    crosses = (x - ax) * np.abs(by - ay) < (y - ay) * (bx - ax) * np.sign(by - ay)
    return np.sum(spans & crosses, axis=0) % 2 == 1


def triangles(vertices: np.ndarray) -> list[np.ndarray]:
    """Divide a polygon without crossing edges into triangles, each (3, 2), by cutting off one ear after the other."""
    rest, found, roundoff = list(vertices), [], 1e-6 * np.ptp(vertices)
    while len(rest) > 2:
        # of all ears, the one with the largest angle at its tip, so that no triangle is thinner than need be
        ears = []
        for k in range(len(rest)):
            ear = np.array([rest[k - 1], rest[k], rest[(k + 1) % len(rest)]])
            back, onward = ear[0] - ear[1], ear[2] - ear[1]
            turn = onward[0] * back[1] - onward[1] * back[0]
            others = np.array([rest[(k + j) % len(rest)] for j in range(2, len(rest) - 1)]).reshape(-1, 2)
            is_flat = abs(turn) <= roundoff**2  # the tip is on the line between its neighbors
            if is_flat or (turn > 0 and np.all(signed_distances(ear, others) > roundoff)):
                ears.append((np.arctan2(turn, onward @ back), k, [] if is_flat else [ear]))
        _, tip, ear = max(ears, key=lambda each: each[:2])
        found += ear
        del rest[tip]
    return found


def segment_distances(
    vertices: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    start_distance: np.ndarray | None = None,  # `signed_distances` of the ends, computed if not given
    end_distance: np.ndarray | None = None,
) -> np.ndarray:
    """Return the distances of segments from a polygon, (...,), m, zero or negative where they touch it."""
    start, end = np.broadcast_arrays(start, end)
    start_distance = signed_distances(vertices, start) if start_distance is None else start_distance
    end_distance = signed_distances(vertices, end) if end_distance is None else end_distance
    (xv, yv), (ex, ey) = vertices.T, (np.roll(vertices, -1, axis=0) - vertices).T
    (sx, sy), (ox, oy) = np.split(end - start, 2, axis=-1), (xv - start[..., :1], yv - start[..., 1:])
    length2 = sx**2 + sy**2
    along = np.clip((ox * sx + oy * sy) / np.where(length2 > 0, length2, 1), 0, 1)
    from_vertices = np.sqrt(((ox - along * sx) ** 2 + (oy - along * sy) ** 2).min(-1))
    # a segment crosses an edge if each of the two has its ends on both sides of the other
    side = sx * oy - sy * ox
    start_side = ey * ox - ex * oy
    end_side = start_side + ex * sy - ey * sx
    crosses = (side * np.roll(side, -1, axis=-1) < 0) & (start_side * end_side < 0)
    apart = np.minimum(np.minimum(start_distance, end_distance), from_vertices)
    return np.where(crosses.any(-1), np.minimum(apart, 0.0), apart)


class OffsetCurve(NamedTuple):
    """Points at one distance from a polygon, in order around it."""

    points: np.ndarray  # (points, 2), m
    normals: np.ndarray  # (points, 2), unit vectors toward the nearest point of the polygon


def offset_curve(vertices: np.ndarray, distance: float, count: int) -> OffsetCurve:
    """Return points all around a polygon at one positive distance from it, m."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    length = np.linalg.norm(edge, axis=1)
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / length[:, None]
    turn = exterior_angles(vertices)
    arc = distance * np.maximum(np.roll(turn, -1), 0)  # at the end of each edge
    # `count` points are equally spaced on the curve made of shifted edges and of arcs around convex corners.
    ends = np.cumsum(np.stack([length, arc], axis=1).ravel())
    arc_length = (np.arange(count) + 0.5) / count * ends[-1]
    piece = np.searchsorted(ends, arc_length, side="right")
    along = arc_length - np.where(piece > 0, ends[piece - 1], 0.0)
    k, on_arc = piece // 2, piece % 2 == 1
    angle = np.where(on_arc, along / distance, 0.0)
    c, s = np.cos(angle), np.sin(angle)
    away = np.stack([c * outward[k, 0] - s * outward[k, 1], s * outward[k, 0] + c * outward[k, 1]], axis=1)
    fraction = np.where(on_arc, 1.0, along / length[k])
    points = vertices[k] + fraction[:, None] * edge[k] + distance * away
    # Near reflex corners, parts of the curve are nearer to another edge and drop out, so fewer points remain.
    keep = signed_distances(vertices, points) > distance * (1 - 1e-9) - 1e-12
    return OffsetCurve(points[keep], -away[keep])


def exterior_angles(vertices: np.ndarray) -> np.ndarray:
    """Return the angle by which the outline turns at each vertex, rad, positive at convex corners, (vertices,)."""
    after = np.roll(vertices, -1, axis=0) - vertices
    before = np.roll(after, 1, axis=0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.arctan2(cross, (before * after).sum(1))
