"""Distances from polygons and disks, and their gradients, compared with brute force that shares no code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from polygons import (
    COUNT,
    FILLED,
    POINTS,
    POLYGONS,
    ROUNDINGS,
    brute_closest,
    complex_of,
    filled,
    lengths,
    outward,
    runner_up,
    scattered,
    sector_points,
    star,
    touches,
)

from pushjax import Disk, Polygon
from pushjax._math.vec import Vec2, Vec3, cos_sin

# Central differences with a step of 1e-6 m: truncation 1e-12 / (1e-3 m)^2 at points at least 1 mm from a kink of the
# distance, roundoff 1e-17 / 1e-6.
DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 1e-5
KINK_MARGIN = 1e-3

DTYPES = [np.float32, np.float64]
NAMES, OUTLINES = list(FILLED), list(FILLED.values())


@jax.jit
def slopes(vertices, points):
    """Return the derivatives of the distances of points from polygons, by vertices and points."""

    def distance(v, x):
        return Polygon(v).signed_distance(x)

    return jax.vmap(jax.vmap(jax.grad(distance, argnums=(0, 1)), (None, 0)))(vertices, points)


def every_slope(points) -> tuple[np.ndarray, np.ndarray]:
    """Return `slopes` of all polygons, (polygons, points, ...), for the same points or for points of their own."""
    points = np.broadcast_to(points, (COUNT, *np.shape(points)[-2:]))
    count = points.shape[1]
    found = slopes(np.stack(OUTLINES), np.stack([np.resize(p, (POINTS, 2)) for p in points]))
    by_vertices, by_point = (np.asarray(leaf)[:, :count] for leaf in found)
    return by_vertices, by_point


# --- distance, closest point, normal ---


@pytest.mark.parametrize("dtype", DTYPES)
def test_closest_is_that_of_brute_force(dtype):
    points, typed = scattered(0).astype(dtype), [v.astype(dtype) for v in OUTLINES]
    for v, seen in zip(typed, touches(typed, points, dtype), strict=True):
        assert {seen.distance.dtype, seen.point.dtype, seen.normal.dtype} == {np.dtype(dtype)}
        expected, foot = brute_closest(v, points)
        np.testing.assert_allclose(seen.distance, expected, rtol=0, atol=lengths(dtype))
        clear = runner_up(v, points) > 1e-5
        np.testing.assert_allclose(complex_of(seen.point)[clear], foot[clear], rtol=0, atol=lengths(dtype))
        # the closest point and the normal lead back to the point
        back = seen.point + seen.distance[:, None] * seen.normal
        np.testing.assert_allclose(back, points, rtol=0, atol=lengths(dtype))
        np.testing.assert_allclose(np.linalg.norm(seen.normal, axis=1), 1, atol=ROUNDINGS * np.finfo(dtype).eps)


def test_closest_of_random_polygons():
    points = scattered(1, 100)
    for seed in range(0, 40, COUNT):
        vertices = [filled(star(5 + (k % 10), k)) for k in range(seed, seed + COUNT)]
        for v, seen in zip(vertices, touches(vertices, points), strict=True):
            np.testing.assert_allclose(seen.distance, brute_closest(v, points)[0], rtol=0, atol=lengths(float))


def test_vertices_along_the_sides_change_nothing():
    square, points = Polygon(POLYGONS["square"]), scattered(1)
    alone = jax.jit(jax.vmap(square.closest))(points)
    (among,) = touches([FILLED["square"]], points)
    for a, b in zip(alone, among, strict=False):
        np.testing.assert_allclose(a, b, atol=lengths(float))


@pytest.mark.parametrize("dtype", DTYPES)
def test_on_edges_and_vertices(dtype):
    """There the distance is zero. The normal is that of the edge; at a vertex it is the bisector."""
    typed = [v.astype(dtype) for v in OUTLINES]
    edges = [np.roll(v, -1, axis=0) - v for v in typed]
    points = [np.concatenate([v + dtype(0.375) * edge, v]) for v, edge in zip(typed, edges, strict=True)]
    for v, own, seen in zip(typed, points, touches(typed, points, dtype), strict=True):
        np.testing.assert_allclose(seen.distance, 0, atol=lengths(dtype))
        np.testing.assert_allclose(seen.point, own, atol=lengths(dtype))
        bisector = outward(v) + np.roll(outward(v), 1, axis=0)
        bisector /= np.linalg.norm(bisector, axis=1, keepdims=True)
        expected = np.concatenate([outward(v), bisector])
        np.testing.assert_allclose(seen.normal, expected, atol=ROUNDINGS * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
def test_straight_out_from_a_corner(dtype):
    """Both edges at a corner are equally near: all fields must come from the same one, compiled or not."""
    typed = [FILLED[name].astype(dtype) for name in NAMES]
    sectors = []
    for v in typed:
        vertex, direction, height = sector_points(v.astype(np.float64), POINTS)
        clear = brute_closest(v, vertex + direction * height[:, None])[0] > height - 1e-6
        sectors.append((vertex[clear], direction[clear], height[clear]))
    points = [(vertex + direction * height[:, None]).astype(dtype) for vertex, direction, height in sectors]
    compiled = touches(typed, points, dtype)
    if dtype == np.float32:
        with jax.disable_jit():
            compiled.append(jax.vmap(Polygon(typed[0]).closest)(points[0]))
        sectors.append(sectors[0])
    for (vertex, direction, height), seen in zip(sectors, compiled, strict=True):
        distance, point, normal = seen[:3]
        np.testing.assert_allclose(distance, height, rtol=0, atol=lengths(dtype))
        np.testing.assert_allclose(point, vertex, rtol=0, atol=lengths(dtype))
        np.testing.assert_allclose(np.linalg.norm(normal - direction, axis=1) * height, 0, atol=lengths(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_corners_inside_a_larger_program(dtype):
    """A disk pushes a triangle, without friction, corner first.

    The outline is known to the compiler, and the query is computed from a moving pose. On the CPU the compiler fused
    the comparison of two equally near edges once for each field that it selects, with different roundoff. Normals were
    not of unit length, distances were those of no edge, and the triangle jumped. Without `compute_once` in the search
    this test fails.
    """
    polygon, radius, reach2 = Polygon(POLYGONS["triangle"].astype(dtype)), dtype(0.00475), dtype(0.03**2)

    def push(pose: Vec3, finger: Vec2):
        angle = cos_sin(pose.z)
        seen = polygon.outline().closest((finger - pose.xy).unrotate(angle))
        arm = seen.point.cross(seen.normal)
        share = -jnp.maximum(radius - seen.distance, 0) / (1 + arm * arm / reach2)
        moved = seen.normal.scale(share).rotate(angle)
        return Vec3(pose.x + moved.x, pose.y + moved.y, pose.z + share * arm / reach2), seen

    @jax.jit
    @jax.vmap
    def pushed(path):
        zero = jnp.zeros((), dtype)
        return jax.lax.scan(push, Vec3(zero, zero, zero), Vec2(path[:, 0], path[:, 1]))[1]

    rng = np.random.default_rng(0)
    corner = POLYGONS["triangle"][rng.integers(3, size=1000)]
    angle = rng.uniform(0, 2 * np.pi, 1000)
    start = 1.4 * corner + 0.002 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    path = start[:, None] + (0.6 * corner - start)[:, None] * np.linspace(0, 1, 41)[:, None]
    seen = pushed(path[:, :-1].astype(dtype))
    np.testing.assert_allclose(np.hypot(*seen.normal), 1, atol=ROUNDINGS * np.finfo(dtype).eps)
    # each step of about 1 mm is corrected at once: the disk is never deeper than that
    assert np.min(seen.distance) > float(radius) - 0.002


def test_on_the_medial_axis():
    """A point equally near to several edges gets one of them."""
    points = np.array([(0.0, 0.0), (0.01, 0.01), (-0.02, 0.02), (0.03, -0.03)])
    (seen,) = touches([FILLED["square"]], points)
    np.testing.assert_allclose(seen.distance, np.abs(points).max(axis=1) - 0.045, atol=lengths(float))
    np.testing.assert_allclose(seen.point + seen.distance[:, None] * seen.normal, points, atol=lengths(float))


def test_gradient_of_the_distance_is_the_normal():
    points = scattered(2)
    _, by_point = every_slope(points)
    for slope, seen in zip(by_point, touches(OUTLINES, points), strict=True):
        np.testing.assert_allclose(slope, seen.normal, atol=1e-9)  # 1e-17 m divided by 1e-7 m to a vertex


def test_gradients_are_finite_where_they_jump():
    """On the vertices and on the medial axis."""
    axis = np.array([(0.0, 0.0), (0.01, 0.01), (-0.02, 0.02), (0.03, -0.03)])
    points = np.stack([np.concatenate([v, axis]) for v in OUTLINES])
    assert all(np.isfinite(leaf).all() for leaf in every_slope(points))


def test_gradient_by_the_vertices():
    """Compared with differences of the distance by brute force."""
    points = scattered(3)
    by_vertices, _ = every_slope(points)
    for name, slope in zip(NAMES, by_vertices, strict=True):
        v = FILLED[name]
        far = np.abs(brute_closest(v, points)[0]) > KINK_MARGIN
        far &= runner_up(v, points) > KINK_MARGIN
        difference = np.zeros_like(slope[far])
        for k, axis in np.ndindex(v.shape):
            shift = np.zeros_like(v)
            shift[k, axis] = DIFFERENCE_STEP
            ahead, behind = (brute_closest(v + s * shift, points[far])[0] for s in (1, -1))
            difference[:, k, axis] = (ahead - behind) / (2 * DIFFERENCE_STEP)
        # The second derivatives of the distance jump where a point passes from an edge to its end: compare most.
        wrong = np.abs(slope[far] - difference).max(axis=(1, 2)) > DIFFERENCE_TOLERANCE
        assert far.sum() > 100
        assert wrong.mean() < 0.01


# --- disks ---


@pytest.mark.parametrize("dtype", DTYPES)
def test_disk(dtype):
    center = np.array([0.02, -0.01], dtype)
    disk = Disk(dtype(0.05), center)
    points = np.concatenate([scattered(4), [center, center + dtype(1e-12)]]).astype(dtype)

    def both(disk, x):
        return disk.closest(x), jax.grad(lambda disk, x: disk.signed_distance(x), argnums=(0, 1))(disk, x)

    found = jax.tree.map(np.asarray, jax.jit(jax.vmap(both, (None, 0)))(disk, points))
    (distance, point, normal), (by_disk, by_point) = found
    assert {distance.dtype, point.dtype, normal.dtype} == {np.dtype(dtype)}
    np.testing.assert_allclose(distance, np.linalg.norm(points - center, axis=1) - 0.05, atol=lengths(dtype))
    np.testing.assert_allclose(np.linalg.norm(point - center, axis=1), 0.05, atol=lengths(dtype))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=ROUNDINGS * np.finfo(dtype).eps)
    np.testing.assert_allclose(point + distance[:, None] * normal, points, atol=lengths(dtype))
    np.testing.assert_allclose(by_point, normal, atol=ROUNDINGS * np.finfo(dtype).eps)
    np.testing.assert_array_equal(by_disk.radius, -1)
    np.testing.assert_allclose(by_disk.center, -normal, atol=ROUNDINGS * np.finfo(dtype).eps)


def test_contains():
    arrow = Polygon(POLYGONS["arrow"])
    inside = jax.jit(jax.vmap(arrow.contains))(np.array([(0, 0), (-0.03, 0), (0.06, 0), (0.07, 0)]))
    assert inside.tolist() == [True, False, True, False]
