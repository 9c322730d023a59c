"""Outlines compared with brute force in complex numbers, which shares no code: distances, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.typing import ArrayLike

from pushjax import Disk, Polygon
from pushjax._internal.xla import compute_once, map_items, tree_where
from pushjax._math.vec import Vec2, Vec3, cos_sin

# Closed forms on lengths of order 0.1 m, in units of roundoff of the dtype.
ROUNDINGS = 100
SIZE = 0.1
# Central differences with a step of 1e-6 m: truncation 1e-12 / (1e-3 m)^2 at points at least 1 mm from a kink of the
# distance, roundoff 1e-17 / 1e-6.
DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 1e-5
KINK_MARGIN = 1e-3

DTYPES = [np.float32, np.float64]


def star(vertices: int, seed: int) -> np.ndarray:
    """Return a star-shaped outline about the origin, counterclockwise, mostly not convex."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(vertices) + rng.uniform(-0.3, 0.3, vertices)) / vertices
    radius = rng.uniform(0.03, 0.08, vertices)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


POLYGONS = {
    "triangle": np.array([(-0.03, -0.05), (0.0605, 0.0), (-0.03, 0.05)]),
    "needle": np.array([(-0.08, -0.001), (0.08, 0.0), (-0.08, 0.001)]),
    "square": np.array([(-0.045, -0.045), (0.045, -0.045), (0.045, 0.045), (-0.045, 0.045)]),
    "arrow": np.array([(0.06, 0.0), (-0.05, 0.05), (-0.02, 0.0), (-0.05, -0.05)]),
    "pentagon": star(5, 1),
    "L": np.array([(0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)]) - 0.04,
    "almost straight": np.array([(-5, -5), (0, -5 - 1e-7), (5, -5), (2, 0), (5, 5), (-5, 5)]) / 100,
    "star of 14": star(14, 2),
}  # fmt: skip
CORNERED = ["triangle", "L", "star of 14"]


@pytest.fixture(params=POLYGONS.values(), ids=list(POLYGONS))
def vertices(request) -> np.ndarray:
    return request.param


# --- brute force ---


def complex_of(points: ArrayLike) -> np.ndarray:
    pairs = np.asarray(points, np.float64)
    return pairs[..., 0] + 1j * pairs[..., 1]


def brute_closest(vertices: ArrayLike, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return signed distance and closest point (complex): project on every edge, sign by the winding number."""
    z, a = complex_of(points)[..., None], complex_of(vertices)
    edge = np.roll(a, -1) - a
    foot = a + np.clip(((z - a) / edge).real, 0, 1) * edge
    gap = np.abs(z - foot)
    nearest = gap.argmin(axis=-1)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        turns = np.angle((np.roll(a, -1) - z) / (a - z)).sum(axis=-1) / (2 * np.pi)
    inside = np.abs(np.nan_to_num(turns)) > 0.5
    distance = np.take_along_axis(gap, nearest, -1)[..., 0]
    return np.where(inside, -distance, distance), np.take_along_axis(foot, nearest, -1)[..., 0]


def runner_up(vertices: ArrayLike, points: ArrayLike) -> np.ndarray:
    """Return how much farther the next boundary feature is, away from the nearest one: zero on the medial axis."""
    z, a = complex_of(points)[..., None], complex_of(vertices)
    edge = np.roll(a, -1) - a
    foot = a + np.clip(((z - a) / edge).real, 0, 1) * edge
    gap = np.abs(z - foot)
    nearest = gap.argmin(axis=-1)[..., None]
    apart = np.abs(foot - np.take_along_axis(foot, nearest, -1)) > 1e-9
    return np.where(apart, gap - np.take_along_axis(gap, nearest, -1), np.inf).min(axis=-1)


def scattered(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.12, 0.12, (count, 2))


closest = jax.jit(jax.vmap(lambda shape, x: shape.closest(x), (None, 0)))
distances = jax.jit(jax.vmap(lambda shape, x: shape.signed_distance(x), (None, 0)))
distance_slope = jax.jit(jax.vmap(jax.grad(lambda shape, x: shape.signed_distance(x), argnums=(0, 1)), (None, 0)))


def lengths(dtype) -> float:
    return ROUNDINGS * SIZE * float(np.finfo(dtype).eps)


# --- distance, closest point, normal ---


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("flip", [False, True])
def test_closest_is_that_of_brute_force(vertices, dtype, flip):
    polygon = Polygon((vertices[::-1] if flip else vertices).astype(dtype))
    points = scattered(0).astype(dtype)
    distance, point, normal = closest(polygon, points)
    assert {distance.dtype, point.dtype, normal.dtype} == {np.dtype(dtype)}
    expected, foot = brute_closest(np.asarray(polygon.vertices), points)
    np.testing.assert_allclose(distance, expected, rtol=0, atol=lengths(dtype))
    clear = runner_up(vertices, points) > 1e-5
    np.testing.assert_allclose(complex_of(point)[clear], foot[clear], rtol=0, atol=lengths(dtype))
    # the closest point and the normal lead back to the point
    back = np.asarray(point) + np.asarray(distance)[:, None] * np.asarray(normal)
    np.testing.assert_allclose(back, points, rtol=0, atol=lengths(dtype))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=ROUNDINGS * np.finfo(dtype).eps)


star_closest = jax.jit(jax.vmap(lambda vertices, x: Polygon(vertices).closest(x), (None, 0)))


@given(st.integers(0, 10**6), st.sampled_from([5, 14]))
@settings(max_examples=40, derandomize=True, deadline=None)
def test_closest_of_random_polygons(seed, count):
    vertices, points = star(count, seed), scattered(seed, 100)
    distance, *_ = star_closest(vertices, points)
    np.testing.assert_allclose(distance, brute_closest(vertices, points)[0], rtol=0, atol=lengths(float))


def test_edges_written_out_or_in_an_array_agree():
    """The square gives the same results as the same square with 20 vertices along its sides."""
    square, points = Polygon(POLYGONS["square"]), scattered(1)
    side = np.linspace(-0.045, 0.045, 6)[:-1]
    first = np.stack([side, np.full(5, -0.045)], axis=1)
    quarter = np.array([(0, 1), (-1, 0)])
    fine = Polygon(np.concatenate([first @ np.linalg.matrix_power(quarter, k) for k in range(4)]))
    for a, b in zip(closest(square, points), closest(fine, points), strict=True):
        np.testing.assert_allclose(a, b, atol=lengths(float))


@pytest.mark.parametrize("dtype", DTYPES)
def test_on_the_edges(vertices, dtype):
    v = np.asarray(Polygon(vertices.astype(dtype)).vertices)
    edge = np.roll(v, -1, axis=0) - v
    points = v + dtype(0.375) * edge
    distance, point, normal = closest(Polygon(v), points)
    np.testing.assert_allclose(distance, 0, atol=lengths(dtype))
    np.testing.assert_allclose(point, points, atol=lengths(dtype))
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    np.testing.assert_allclose(normal, outward, atol=ROUNDINGS * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
def test_on_the_vertices(vertices, dtype):
    """At the vertices the distance is zero, the normal is the bisector, and the gradient is finite."""
    polygon = Polygon(vertices.astype(dtype))
    v = np.asarray(polygon.vertices)
    distance, point, normal = closest(polygon, v)
    np.testing.assert_allclose(distance, 0, atol=lengths(dtype))
    np.testing.assert_allclose(point, v, atol=lengths(dtype))
    edge = np.roll(v, -1, axis=0) - v
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    bisector = outward + np.roll(outward, 1, axis=0)
    bisector /= np.linalg.norm(bisector, axis=1, keepdims=True)
    np.testing.assert_allclose(normal, bisector, atol=ROUNDINGS * np.finfo(dtype).eps)
    slope = distance_slope(polygon, v)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def sector_points(v: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return points whose nearest point is a convex vertex of counterclockwise `v`: vertex, direction, distance."""
    rng = np.random.default_rng(seed)
    edge = np.roll(v, -1, axis=0) - v
    before = np.roll(edge, 1, axis=0)
    convex = np.flatnonzero(before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0] > 0)
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    at = rng.choice(convex, count)
    share = rng.uniform(0.02, 0.98, (count, 1))
    direction = (1 - share) * np.roll(normal, 1, axis=0)[at] + share * normal[at]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return v[at], direction, 10 ** rng.uniform(-4, -2.3, count)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", CORNERED)
def test_straight_out_from_a_corner(name, dtype):
    """Both edges at a corner are equally near: all fields must come from the same one, compiled or not."""
    polygon = Polygon(POLYGONS[name].astype(dtype))
    vertex, direction, height = sector_points(np.asarray(polygon.vertices, np.float64), 2000)
    clear = brute_closest(np.asarray(polygon.vertices), vertex + direction * height[:, None])[0] > height - 1e-6
    vertex, direction, height = vertex[clear], direction[clear], height[clear]
    points = (vertex + direction * height[:, None]).astype(dtype)
    compiled = closest(polygon, points)
    with jax.disable_jit():
        eager = jax.vmap(polygon.closest)(points)
    tolerance = lengths(dtype)
    for distance, point, normal in (compiled, eager):
        np.testing.assert_allclose(distance, height, rtol=0, atol=tolerance)
        np.testing.assert_allclose(point, vertex, rtol=0, atol=tolerance)
        np.testing.assert_allclose(np.linalg.norm(normal - direction, axis=1) * height, 0, atol=tolerance)


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
    """A point equally near to several edges gets one of them, with finite derivatives."""
    square = Polygon(POLYGONS["square"])
    points = np.array([(0.0, 0.0), (0.01, 0.01), (-0.02, 0.02), (0.03, -0.03)])
    distance, point, normal = closest(square, points)
    np.testing.assert_allclose(distance, np.abs(points).max(axis=1) - 0.045, atol=lengths(float))
    np.testing.assert_allclose(point + -distance[:, None] * normal, 2 * np.asarray(point) - points, atol=lengths(float))
    slope = distance_slope(square, points)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def test_gradient_of_the_distance_is_the_normal(vertices):
    polygon = Polygon(vertices)
    points = scattered(2)
    _, slope = distance_slope(polygon, points)
    np.testing.assert_allclose(slope, closest(polygon, points)[2], atol=1e-9)  # 1e-17 m divided by 1e-7 m to a vertex


@pytest.mark.parametrize("name", CORNERED)
def test_gradient_by_the_vertices(name):
    polygon = Polygon(POLYGONS[name])
    points = scattered(3)
    far = np.abs(brute_closest(polygon.vertices, points)[0]) > KINK_MARGIN
    points = points[far & (runner_up(np.asarray(polygon.vertices), points) > KINK_MARGIN)]
    slope, _ = distance_slope(polygon, points)

    @jax.jit
    @jax.vmap
    def moved(shift):
        ends = [jax.vmap(Polygon(polygon.vertices + s * shift).signed_distance)(points) for s in (1, -1)]
        return (ends[0] - ends[1]) / (2 * DIFFERENCE_STEP)

    count = 2 * len(POLYGONS[name])
    shifts = DIFFERENCE_STEP * np.eye(count).reshape(count, -1, 2)
    difference = np.moveaxis(np.asarray(moved(shifts)), 0, 1).reshape(len(points), -1, 2)
    # The second derivatives of the distance jump where a point passes from an edge to its end: compare most of them.
    wrong = np.abs(np.asarray(slope.vertices) - difference).max(axis=(1, 2)) > DIFFERENCE_TOLERANCE
    assert len(points) > 100
    assert wrong.mean() < 0.01


# --- all points that a finger can touch ---

candidates_at = jax.jit(jax.vmap(lambda shape, x: shape.outline().contact_candidates(Vec2.of(x)), (None, 0)))
REFLEX = ["arrow", "L", "star of 14"]


def reflex_corners(v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the reflex vertices of counterclockwise `v`, and the outward normals of the edges before and after."""
    edge = np.roll(v, -1, axis=0) - v
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    before = np.roll(edge, 1, axis=0)
    reflex = np.flatnonzero(before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0] < 0)
    return v[reflex], np.roll(normal, 1, axis=0)[reflex], normal[reflex]


def against(vertex: np.ndarray, one: np.ndarray, other: np.ndarray, heights: tuple[float, float]) -> np.ndarray:
    """Return the points at these heights over the two walls of each corner."""
    walls = np.stack([one, other], axis=1)
    return vertex + np.linalg.solve(walls, np.broadcast_to(heights, (len(vertex), 2))[..., None])[..., 0]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", REFLEX)
@pytest.mark.parametrize("heights", [(0.002, 0.002), (0.002, 0.0021), (0.0021, 0.002), (0.0, 0.0)])
def test_both_walls_of_a_reflex_corner_are_touched(name, heights, dtype):
    polygon = Polygon(POLYGONS[name].astype(dtype))
    vertex, *walls = reflex_corners(np.asarray(polygon.vertices, np.float64))
    points = against(vertex, *walls, heights)
    first, second = candidates_at(polygon, points.astype(dtype))
    alone = closest(polygon, points.astype(dtype))
    same = (alone[0], *alone[1].T, *alone[2].T) if heights[0] != heights[1] else alone[:1]  # either, if equally near
    for a, b in zip(jax.tree.leaves(first), same, strict=False):
        np.testing.assert_allclose(a, b, rtol=0, atol=max(lengths(dtype), 4 * np.finfo(dtype).eps))
    found, expected = np.sort([first.distance, second.distance], axis=0), np.sort(heights)[:, None]
    np.testing.assert_allclose(found - expected, 0, atol=lengths(dtype))
    normals = np.stack([np.stack(first.normal, axis=1), np.stack(second.normal, axis=1)])
    if heights[1] == 0:  # at the vertex itself the first normal is its bisector
        off = np.min([np.abs(normals[1] - wall).max(axis=1) for wall in walls], axis=0)
    else:
        straight, crossed = (np.abs(normals - np.stack(order)).max(axis=(0, 2)) for order in (walls, walls[::-1]))
        off = np.minimum(straight, crossed)
    np.testing.assert_allclose(off, 0, atol=ROUNDINGS * np.finfo(dtype).eps)
    foot = np.stack(second.point, axis=1) + np.asarray(second.distance)[:, None] * normals[1]
    np.testing.assert_allclose(foot, points, rtol=0, atol=lengths(dtype))


@pytest.mark.parametrize("name", REFLEX)
@pytest.mark.parametrize("heights", [(-1e-5, 2e-3), (2e-3, -1e-5), (-1e-5, -2e-5), (-2e-5, -1e-5), (-1e-5, 1e-7)])
def test_a_point_pressed_into_a_reflex_corner_is_stopped_by_the_other_wall(name, heights):
    polygon = Polygon(POLYGONS[name])
    vertex, *walls = reflex_corners(np.asarray(polygon.vertices, np.float64))
    points = against(vertex, *walls, heights)
    first, second = candidates_at(polygon, points)
    assert (first.distance < 0).all()
    normal = np.stack(second.normal, axis=1)
    at = np.argmin([np.abs(normal - wall).max(axis=1) for wall in walls], axis=0)
    np.testing.assert_allclose(normal, np.stack(walls)[at, np.arange(len(at))], atol=1e-12)
    np.testing.assert_allclose(second.distance, np.array(heights)[at], atol=lengths(float))
    if heights[0] * heights[1] < 0:  # the first is then the wall that it is inside, the second the other
        assert (np.asarray(second.distance) > 0).all()


def test_the_second_touch_is_the_next_local_minimum(vertices):
    """The second touch agrees with brute force: the next local minimum of the distance along a sampled outline."""
    polygon, points = Polygon(vertices, convex=False), scattered(12, 150)
    outline = complex_of(polygon.boundary(4000))
    perimeter = float(polygon.perimeter)
    first, second = candidates_at(polygon, points)
    found = np.asarray(second.distance) < np.asarray(first.distance) + 0.99 * perimeter
    np.testing.assert_allclose(second.distance[~found], first.distance[~found] + perimeter, rtol=1e-12)
    for k in np.flatnonzero(brute_closest(vertices, points)[0] > 0):
        rel = complex_of(points[k]) - outline
        tangent = np.roll(outline, -1) - np.roll(outline, 1)
        gap = np.abs(rel)
        least = (gap < np.roll(gap, 1)) & (gap <= np.roll(gap, -1)) & ((tangent.conj() * rel).imag < 0)
        far = np.abs(outline - (first.point.x[k] + 1j * first.point.y[k])) > 2 * perimeter / 4000
        next_one = gap[least & far].min(initial=np.inf)
        assert np.isfinite(next_one) == found[k]
        if found[k]:
            np.testing.assert_allclose(second.distance[k], next_one, atol=perimeter / 8000)  # the samples miss a vertex


@pytest.mark.parametrize("name", ["triangle", "square", "needle"])
def test_convex_outlines_are_touched_once(name):
    shape = Polygon(POLYGONS[name])
    (only,) = candidates_at(shape, scattered(13))
    np.testing.assert_array_equal(only.distance, distances(shape, scattered(13)))
    # Even if two candidates are asked for, there is no second one at a vertex, where two edges share the closest point,
    # nor through material.
    vertex, direction, height = sector_points(POLYGONS[name], 200)
    inside = 0.4 * vertex
    for points in (scattered(13), vertex + direction * height[:, None], vertex, inside):
        first, second = candidates_at(Polygon(POLYGONS[name], convex=False), points)
        np.testing.assert_allclose(second.distance - first.distance, shape.perimeter, rtol=1e-9)
        np.testing.assert_allclose(np.hypot(*second.normal), 1, rtol=1e-9)
    assert len(candidates_at(Disk(0.05), scattered(13))) == 1


@pytest.mark.parametrize("name", ["L", "star of 14"])
def test_gradients_of_the_second_touch_are_finite(name):
    polygon = Polygon(POLYGONS[name])
    points = np.concatenate([scattered(14, 100), np.asarray(polygon.vertices), [polygon.centroid]])

    def second(shape, x):
        return jnp.stack(jax.tree.leaves(shape.outline().contact_candidates(Vec2.of(x))[1]))

    slope = jax.jit(jax.vmap(jax.jacfwd(second, argnums=(0, 1)), (None, 0)))(polygon, points)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    seen = candidates_at(polygon, points)
    own = np.asarray(seen[1].distance) < np.asarray(seen[0].distance) + 0.99 * float(polygon.perimeter)
    np.testing.assert_allclose(slope[1][own, 0], np.stack(seen[1].normal, axis=1)[own], atol=1e-9)


def test_convexity_is_found_out():
    convex = {name: Polygon(v).convex for name, v in POLYGONS.items()}
    assert [name for name, flag in convex.items() if flag] == ["triangle", "needle", "square", "pentagon"]
    assert Polygon(POLYGONS["square"][::-1]).convex
    rounded = Polygon.regular(400, np.float32(0.05))
    assert Polygon(rounded.vertices).convex  # its vertices are rounded, and its angles almost straight
    assert not Polygon(POLYGONS["square"], convex=False).convex

    @jax.jit
    def flags(v):
        kinds = Polygon(v), Polygon(v, convex=True), Polygon.rectangle(v[0, 0], 1.0), Polygon.regular(5, v[0, 0])
        assert [kind.convex for kind in kinds] == [False, True, True, True]
        return kinds

    flags(POLYGONS["square"])


# --- disks ---


@pytest.mark.parametrize("dtype", DTYPES)
def test_disk(dtype):
    center = np.array([0.02, -0.01], dtype)
    disk = Disk(dtype(0.05), center)
    points = np.concatenate([scattered(4), [center, center + dtype(1e-12)]]).astype(dtype)
    distance, point, normal = map(np.asarray, closest(disk, points))
    assert {distance.dtype, point.dtype, normal.dtype} == {np.dtype(dtype)}
    np.testing.assert_allclose(distance, np.linalg.norm(points - center, axis=1) - 0.05, atol=lengths(dtype))
    np.testing.assert_allclose(np.linalg.norm(point - center, axis=1), 0.05, atol=lengths(dtype))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=ROUNDINGS * np.finfo(dtype).eps)
    np.testing.assert_allclose(point + distance[:, None] * normal, points, atol=lengths(dtype))
    by_disk, by_point = distance_slope(disk, points)
    np.testing.assert_allclose(by_point, normal, atol=ROUNDINGS * np.finfo(dtype).eps)
    np.testing.assert_array_equal(by_disk.radius, -1)
    np.testing.assert_allclose(by_disk.center, -normal, atol=ROUNDINGS * np.finfo(dtype).eps)


def test_disk_is_the_limit_of_polygons():
    """A regular 400-gon lies within r (1 - cos(pi / 400)) of its circle."""
    points = scattered(5)
    sag = 0.05 * (1 - np.cos(np.pi / 400))
    off = np.asarray(distances(Polygon.regular(400, 0.05), points) - distances(Disk(0.05), points))
    assert off.min() >= -lengths(float)
    assert off.max() <= sag + lengths(float)


def test_contains():
    arrow = Polygon(POLYGONS["arrow"])
    inside = jax.vmap(arrow.contains)(np.array([(0, 0), (-0.03, 0), (0.06, 0), (0.07, 0)]))
    assert inside.tolist() == [True, False, True, False]


# --- sizes ---


def test_area_and_centroid():
    area = [float(Polygon(POLYGONS[name]).area) for name in ("triangle", "square", "L")]
    np.testing.assert_allclose(area, [0.0905 * 0.1 / 2, 0.09**2, 0.1 * 0.03 + 0.07 * 0.03], rtol=1e-12)
    np.testing.assert_allclose(Polygon(POLYGONS["triangle"]).centroid, [0.0005 / 3, 0], atol=1e-15)
    x = (0.003 * 0.05 + 0.0021 * 0.015) / 0.0051 - 0.04
    np.testing.assert_allclose(Polygon(POLYGONS["L"]).centroid, [x, x], atol=1e-14)
    disk = Disk(0.05, (0.1, 0.2))
    np.testing.assert_allclose(disk.area, np.pi * 0.0025)
    np.testing.assert_array_equal(disk.centroid, [0.1, 0.2])
    np.testing.assert_allclose(disk.bounds, [(0.05, 0.15), (0.15, 0.25)])


def test_area_and_centroid_by_sampling(vertices):
    polygon = Polygon(vertices)
    rng = np.random.default_rng(11)
    low, high = map(np.asarray, polygon.bounds)
    np.testing.assert_array_equal([low, high], [vertices.min(axis=0), vertices.max(axis=0)])
    points = rng.uniform(low, high, (20_000, 2))
    inside = brute_closest(vertices, points)[0] <= 0
    share, box = inside.mean(), np.prod(high - low)
    error = 4 * np.sqrt(share * (1 - share) / len(points)) + 1e-12  # four standard errors
    assert abs(share - float(polygon.area) / box) < error
    error = 4 * points[inside].std(axis=0) / np.sqrt(inside.sum())
    assert (np.abs(points[inside].mean(axis=0) - polygon.centroid) < error).all()


def test_area_and_centroid_far_from_the_origin():
    away = np.array([100.0, -50.0])
    polygon = Polygon((POLYGONS["square"] + away).astype(np.float32))
    # the corners themselves are rounded to 4e-6 m there
    np.testing.assert_allclose(polygon.area, 0.0081, rtol=2e-4)
    np.testing.assert_allclose(polygon.centroid, away, rtol=1e-6)


def test_perimeter_and_boundary(vertices):
    polygon = Polygon(vertices)
    a = complex_of(vertices)
    perimeter = np.abs(np.roll(a, -1) - a).sum()
    np.testing.assert_allclose(polygon.perimeter, perimeter, rtol=1e-12)
    points = polygon.boundary(500)
    np.testing.assert_allclose(brute_closest(vertices, points)[0], 0, atol=1e-15)
    gaps = np.abs(np.roll(complex_of(points), -1) - complex_of(points))
    assert gaps.max() <= perimeter / 500 * (1 + 1e-9)
    assert np.isclose(gaps, perimeter / 500).sum() >= 500 - len(vertices)  # all except those across a corner
    about = complex_of(points) - complex_of(polygon.centroid)
    assert np.imag(about.conj() * np.roll(about, -1)).sum() > 0  # counterclockwise


def test_boundary_of_a_disk():
    disk = Disk(0.05, (0.1, 0.2))
    points = complex_of(disk.boundary(7)) - (0.1 + 0.2j)
    np.testing.assert_allclose(np.roll(points, -1) / points, np.exp(2j * np.pi / 7))
    np.testing.assert_allclose(np.abs(points), 0.05)


# --- constructors ---


def test_stored_counter_clockwise(vertices):
    kept, flipped = Polygon(vertices), Polygon(vertices[::-1])
    np.testing.assert_array_equal(kept.vertices, vertices)
    np.testing.assert_array_equal(flipped.vertices[0], vertices[-1])
    np.testing.assert_array_equal(flipped.vertices, np.roll(vertices, 1, axis=0))
    assert float(kept.area) > 0
    assert float(flipped.area) == pytest.approx(float(kept.area), rel=1e-12)


def test_rectangle_and_regular():
    expected = [(-0.2, -0.1), (0.2, -0.1), (0.2, 0.1), (-0.2, 0.1)]
    np.testing.assert_array_equal(Polygon.rectangle(0.4, 0.2).vertices, expected)
    hexagon = complex_of(Polygon.regular(6, 0.3).vertices)
    np.testing.assert_allclose(hexagon, 0.3 * np.exp(2j * np.pi * np.arange(6) / 6), atol=1e-16)


def test_dtype_is_the_input_s():
    single = np.float32

    def results(shape, point):
        sizes = shape.area, shape.centroid, shape.bounds, shape.boundary(5)
        return shape, sizes, shape.closest([0.3, 0.2]), shape.closest(point)  # Python numbers do not widen it

    for shape in (
        Polygon.rectangle(single(0.1), 0.2),
        Polygon.rectangle(0.1, single(0.2)),
        Polygon.regular(5, single(0.1)),
        Polygon(POLYGONS["star of 14"].astype(single)),
        Disk(single(0.1)),
        Disk(0.1, np.zeros(2, single)),
    ):
        found = jax.eval_shape(results, shape, np.zeros(2, single))
        assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {np.dtype(single)}
        assert jax.eval_shape(results, shape, np.zeros(2))[-1][0].dtype == np.float64
    assert Polygon.rectangle(1, 2).vertices.dtype == np.float64
    assert Polygon([(0, 0), (1, 0), (0, 1)]).vertices.dtype == np.float64


SQUARE = POLYGONS["square"]
BAD = {
    "no area": (lambda: Polygon([(0, 0), (1, 1), (2, 2)]), "vertices lie on one line and enclose no area"),
    "bow tie": (
        lambda: Polygon(SQUARE[[0, 2, 1, 3]]),
        "crosses or touches itself: the edge from vertex 0 to vertex 1, and the edge from vertex 2 to vertex 3",
    ),
    "uneven bow tie": (
        lambda: Polygon([(0, 0), (4, 0), (1, 3), (1, -1)]),
        "the edge from vertex 0 to vertex 1, and the edge from vertex 2 to vertex 3, counted from 0",
    ),
    "crossing": (lambda: Polygon([(0, 0), (4, 0), (4, 3), (1, -1), (0, 3)]), "vertices: the outline crosses"),
    "touching": (lambda: Polygon([(0, 0), (4, 0), (4, 3), (2, 0), (0, 3)]), "vertices: the outline crosses or touches"),
    "spike": (lambda: Polygon([(0, 0), (4, 0), (4, 3), (4, 5), (4, 3.5), (0, 3)]), "vertices: the outline"),
    "repeated": (lambda: Polygon(SQUARE[[0, 1, 1, 2, 3]]), "vertices: 1 and 2 are the same"),
    "closed": (lambda: Polygon(SQUARE[[0, 1, 2, 3, 0]]), "vertices: 0 and 4 are the same"),
    "one point": (lambda: Polygon(np.zeros((3, 2))), "vertices"),
    "two": (lambda: Polygon(SQUARE[:2]), "vertices.*at least three"),
    "NaN": (lambda: Polygon([(0, 0), (1, 0), (np.nan, 1)]), r"vertices.*NaN.*\(2, 0\)"),
    "infinite": (lambda: Polygon([(0, 0), (1, 0), (np.inf, 1)]), "vertices"),
    "three columns": (lambda: Polygon(np.zeros((4, 3))), r"vertices has shape \(4, 3\)"),
    "flat": (lambda: Polygon(np.zeros(6)), "vertices has shape"),
    "not convex": (lambda: Polygon(POLYGONS["L"], convex=True), "convex is True.*vertex 3"),
    "width": (lambda: Polygon.rectangle(-1, 1), "width"),
    "height": (lambda: Polygon.rectangle(1, 0), "height"),
    "height NaN": (lambda: Polygon.rectangle(1, np.nan), "height"),
    "width array": (lambda: Polygon.rectangle(np.ones(2), 1), "width has shape"),
    "sides": (lambda: Polygon.regular(2, 1), "sides"),
    "circumradius": (lambda: Polygon.regular(5, -1), "circumradius"),
    "circumradius array": (lambda: Polygon.regular(5, np.ones(5)), "circumradius has shape"),
    "radius": (lambda: Disk(0), "radius"),
    "radius infinite": (lambda: Disk(np.inf), "radius"),
    "radius array": (lambda: Disk([1.0, 2.0]), "radius has shape"),
    "center": (lambda: Disk(1, (0, 0, 0)), "center has shape"),
    "center NaN": (lambda: Disk(1, (0, np.nan)), "center"),
    "point": (lambda: Disk(1).closest(np.zeros(3)), "point has shape"),
    "point NaN": (lambda: Polygon(SQUARE).closest([0, np.nan]), "point"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_values_do_not_raise():
    """Traced values cannot be checked; shapes are still checked."""

    @jax.jit
    def area(vertices, radius):
        return Polygon(vertices).area + Disk(radius).signed_distance(vertices[0]) + Polygon.rectangle(radius, 1.0).area

    assert np.isnan(area(np.full((4, 2), np.nan), -1.0))
    with pytest.raises(ValueError, match="vertices has shape"):
        area(np.zeros((4, 3)), 1.0)


# --- helpers for XLA ---


def test_settle_returns_its_values():
    def kept(x, y, flag):
        return compute_once((Vec2(x, y), flag, ~flag), x)

    for dtype in DTYPES:
        (x, y), yes, no = jax.jit(kept)(dtype(0.1), dtype(-3e5), True)
        assert (x, y, bool(yes), bool(no)) == (dtype(0.1), dtype(-3e5), True, False)
        assert x.dtype == dtype
        assert yes.dtype == bool
    assert not bool(compute_once(jnp.array(True), jnp.array(np.nan)))
    assert float(jax.grad(lambda x: compute_once(x * x, x))(3.0)) == 6
    with pytest.raises(TypeError, match="int32"):
        compute_once(jnp.zeros((), jnp.int32), jnp.ones(()))


def test_select():
    a, b = Vec2(jnp.array(1.0), jnp.array(2.0)), Vec2(jnp.array(3.0), jnp.array(4.0))
    assert tree_where(jnp.array(True), a, b) == a
    assert tree_where(jnp.array(False), a, b) == b


def test_each_of():
    """`map_items` loops over items of the same type, with the same values and derivatives; others run one by one."""

    def of(item):
        v, k = item
        return v.dot(v) * v.x, k + 1

    def items(scale, kinds):
        return tuple((Vec2(k * scale, scale), jnp.asarray(k, kind)) for k, kind in enumerate(kinds, start=1))

    def once(scale, kinds):
        return map_items(of, items(scale, kinds))

    def apart(scale, kinds):
        return tuple(of(item) for item in items(scale, kinds))

    for kinds, loops in (((np.int8,) * 3, True), ((np.int8, np.int8, np.int32), False), ((np.int8,), False)):
        found, expected = (way(jnp.array(0.7), kinds) for way in (once, apart))
        assert [int(k) for _, k in found] == [int(k) for _, k in expected]
        assert [k.dtype for _, k in found] == list(kinds)
        np.testing.assert_allclose([v for v, _ in found], [v for v, _ in expected], rtol=1e-14)
        assert ("scan" in str(jax.make_jaxpr(once, static_argnums=1)(0.7, kinds))) == loops
        slopes = (
            jax.grad(lambda s, way=way, kinds=kinds: sum(v for v, _ in way(s, kinds)))(0.7) for way in (once, apart)
        )
        assert next(slopes) == pytest.approx(float(next(slopes)), rel=1e-14)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (0.03, r"depth: 0.03 m is too much, edge \d vanishes"),  # an edge would have the length zero
        (0.05, r"depth: 0.05 m is too much, edge \d vanishes"),  # all edges would be turned around: again a rectangle
        (np.nan, "depth must be finite"),
        ([0.01, 0.02], "depth has shape"),
    ],
)
def test_too_deep_an_inset(depth, message):
    with pytest.raises(ValueError, match=message):
        Polygon.rectangle(0.06, 0.06).inset(depth)


def test_disks_have_a_perimeter():
    points = np.asarray(Disk(0.02, (0.01, 0.0)).boundary(10_000))
    lengths = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    assert float(Disk(0.02).perimeter) == pytest.approx(lengths.sum(), rel=1e-6)
