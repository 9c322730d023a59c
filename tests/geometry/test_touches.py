"""All points at which a round finger can touch a polygon, compared with the walls of corners and with brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from polygons import (
    CONVEX,
    FILLED,
    POLYGONS,
    REFLEX,
    ROUNDINGS,
    complex_of,
    lengths,
    outward,
    scattered,
    sector_points,
    touches,
    turns,
)

from pushjax import Disk, Polygon
from pushjax._math.vec import Vec2

DTYPES = [np.float32, np.float64]


def perimeter(vertices: np.ndarray) -> float:
    return float(np.abs(np.roll(complex_of(vertices), -1) - complex_of(vertices)).sum())


def reflex_corners(v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the reflex vertices of counterclockwise `v`, and the outward normals of the edges before and after."""
    normal, reflex = outward(v), turns(v) < -1e-3
    return v[reflex], np.roll(normal, 1, axis=0)[reflex], normal[reflex]


def against(vertex: np.ndarray, one: np.ndarray, other: np.ndarray, heights: tuple[float, float]) -> np.ndarray:
    """Return the points at these heights over the two walls of each corner."""
    walls = np.stack([one, other], axis=1)
    return vertex + np.linalg.solve(walls, np.broadcast_to(heights, (len(vertex), 2))[..., None])[..., 0]


def at_corners(heights: tuple[float, float], dtype=np.float64):
    """Return, for each polygon with reflex corners, the points over their walls, the walls, and what is touched."""
    typed = [FILLED[name].astype(dtype) for name in REFLEX]
    corners = [reflex_corners(v.astype(np.float64)) for v in typed]
    points = [against(*corner, heights) for corner in corners]
    found = touches(typed, points, dtype)
    return zip(points, [corner[1:] for corner in corners], found, strict=True)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("heights", [(0.002, 0.002), (0.002, 0.0021), (0.0021, 0.002), (0.0, 0.0)])
def test_both_walls_of_a_reflex_corner_are_touched(heights, dtype):
    for points, walls, found in at_corners(heights, dtype):
        same = slice(None) if heights[0] != heights[1] else slice(1)  # either, if equally near
        for a, b in zip(found.first[same], found[:3][same], strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=max(lengths(dtype), 4 * np.finfo(dtype).eps))
        (near, _, first), (far, foot, second) = found.first, found.second
        expected = np.sort(heights)[:, None]
        np.testing.assert_allclose(np.sort([near, far], axis=0) - expected, 0, atol=lengths(dtype))
        normals = np.stack([first, second])
        if heights[1] == 0:  # at the vertex itself the first normal is its bisector
            off = np.min([np.abs(second - wall).max(axis=1) for wall in walls], axis=0)
        else:
            straight, crossed = (np.abs(normals - np.stack(order)).max(axis=(0, 2)) for order in (walls, walls[::-1]))
            off = np.minimum(straight, crossed)
        np.testing.assert_allclose(off, 0, atol=ROUNDINGS * np.finfo(dtype).eps)
        np.testing.assert_allclose(foot + far[:, None] * second, points, rtol=0, atol=lengths(dtype))


@pytest.mark.parametrize("heights", [(-1e-5, 2e-3), (2e-3, -1e-5), (-1e-5, -2e-5), (-2e-5, -1e-5), (-1e-5, 1e-7)])
def test_a_point_pressed_into_a_reflex_corner_is_stopped_by_the_other_wall(heights):
    for _, walls, found in at_corners(heights):
        distance, _, normal = found.second
        assert (found.first[0] < 0).all()
        at = np.argmin([np.abs(normal - wall).max(axis=1) for wall in walls], axis=0)
        np.testing.assert_allclose(normal, np.stack(walls)[at, np.arange(len(at))], atol=1e-12)
        np.testing.assert_allclose(distance, np.array(heights)[at], atol=lengths(float))
        if heights[0] * heights[1] < 0:  # the first is then the wall that it is inside, the second the other
            assert (distance > 0).all()


def sampled(vertices: np.ndarray, count: int) -> np.ndarray:
    """Return points along an outline, equally spaced, as complex numbers."""
    closed = np.append(complex_of(vertices), complex_of(vertices[:1]))
    arc = np.append(0, np.cumsum(np.abs(np.diff(closed))))
    return np.interp((np.arange(count) + 0.5) / count * arc[-1], arc, closed)


def test_the_second_touch_is_the_next_local_minimum():
    """The second touch agrees with brute force: the next local minimum of the distance along a sampled outline."""
    points = scattered(12, 150)
    every = list(POLYGONS.values())
    for vertices, seen in zip(every, touches(list(FILLED.values()), points), strict=True):
        outline, around = sampled(vertices, 4000), perimeter(vertices)
        distance = seen.second[0]
        found = distance < seen.first[0] + 0.99 * around
        np.testing.assert_allclose(distance[~found], seen.first[0][~found] + around, rtol=1e-12)
        tangent = np.roll(outline, -1) - np.roll(outline, 1)
        for k in np.flatnonzero(seen.distance > 0):
            rel = complex_of(points[k]) - outline
            gap = np.abs(rel)
            least = (gap < np.roll(gap, 1)) & (gap <= np.roll(gap, -1)) & ((tangent.conj() * rel).imag < 0)
            far = np.abs(outline - complex_of(seen.first[1][k])) > 2 * around / 4000
            next_one = gap[least & far].min(initial=np.inf)
            assert np.isfinite(next_one) == found[k]
            if found[k]:
                np.testing.assert_allclose(distance[k], next_one, atol=around / 8000)  # the samples miss a vertex


def test_convex_outlines_are_touched_once():
    """Also if two candidates are asked for: at a vertex two edges share the closest point; inside is material."""
    for shape in (Disk(0.05), *(Polygon(POLYGONS[name]) for name in CONVEX)):
        assert shape.outline().max_touches == 1
    vertices, points = [FILLED[name] for name in CONVEX], []
    for v in vertices:
        vertex, direction, height = sector_points(v, 100)
        points.append(
            np.concatenate([scattered(13), vertex + direction * height[:, None], vertex[:6], 0.4 * vertex[:6]])
        )
    for v, found in zip(vertices, touches(vertices, points), strict=True):
        np.testing.assert_allclose(found.second[0] - found.first[0], perimeter(v), rtol=1e-9)
        np.testing.assert_allclose(np.hypot(*found.second[2].T), 1, rtol=1e-9)


def test_gradients_of_the_second_touch_are_finite():
    names = ["L", "star of 14"]
    vertices = np.stack([FILLED[name] for name in names])
    points = np.stack([np.concatenate([scattered(14, 100), v, [Polygon(v).centroid]]) for v in vertices])

    def second(v, x):
        return jnp.stack(jax.tree.leaves(Polygon(v).outline().contact_candidates(Vec2.of(x))[1]))

    slope = jax.jit(jax.vmap(jax.vmap(jax.jacfwd(second, argnums=(0, 1)), (None, 0))))(vertices, points)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    for v, seen, by_point in zip(vertices, touches(list(vertices), list(points)), slope[1], strict=True):
        own = seen.second[0] < seen.first[0] + 0.99 * perimeter(v)
        np.testing.assert_allclose(by_point[own, 0], seen.second[2][own], atol=1e-9)


def test_a_vertex_in_a_straight_side_touches_nothing_through_the_material():
    """A vertex in the middle of each side of a T changes no distance, also at points exactly beyond that vertex."""
    corners = 1e-3 * np.array([(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)])
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    divided = Polygon(np.stack([corners, middles], axis=1).reshape(-1, 2))
    x, y = np.meshgrid(1e-3 * np.linspace(-80, 80, 33), 1e-3 * np.linspace(-20, 150, 35))
    points = jnp.asarray(np.stack([x.ravel(), y.ravel()], axis=1))

    def distances(polygon):
        def of(point):
            return jnp.stack([c.distance for c in polygon.outline().contact_candidates(Vec2.of(point))])

        return np.asarray(jax.jit(jax.vmap(of))(points))

    expected = distances(Polygon(corners))
    outside = expected[:, 0] >= 0
    np.testing.assert_allclose(distances(divided)[outside], expected[outside], rtol=0, atol=1e-15)
