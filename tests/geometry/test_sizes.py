"""All shapes: sizes, boundaries, constructors, dtypes and bad input."""

import jax
import numpy as np
import pytest
from polygons import FILLED, POLYGONS, brute_closest, complex_of
from scipy.special import ellipe
from smooth import CURVES, ELLIPSES, Outline, closest, shape_of

from pushjax import Curve, Disk, Ellipse, Polygon
from pushjax._math.vec import Vec2

SQUARE = POLYGONS["square"]
SMOOTH = ELLIPSES | CURVES
POINTS = 500  # of boundaries


def sizes(shape) -> tuple:
    return shape.area, shape.centroid, shape.bounds, shape.perimeter, shape.boundary(POINTS)


@pytest.fixture(scope="module")
def found() -> dict[str, tuple]:
    """Return the `sizes` of all shapes but disks, in NumPy, by one program for each kind."""
    every = {}
    for make, shapes in ((Polygon, FILLED), (shape_of, ELLIPSES), (shape_of, CURVES)):
        many = jax.jit(jax.vmap(lambda numbers, make=make: sizes(make(numbers))))(np.stack(list(shapes.values())))
        every |= {name: jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], many) for k, name in enumerate(shapes)}
    return every


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


@pytest.mark.parametrize("name", POLYGONS)
def test_area_and_centroid_by_sampling(found, name):
    area, centroid, (low, high), *_ = found[name]
    vertices, rng = POLYGONS[name], np.random.default_rng(11)
    for polygon in (Polygon(vertices), Polygon(FILLED[name])):
        np.testing.assert_allclose(polygon.area, area, rtol=1e-12)
        np.testing.assert_allclose(polygon.centroid, centroid, atol=1e-15)
        np.testing.assert_array_equal(polygon.bounds, [low, high])
    np.testing.assert_array_equal([low, high], [vertices.min(axis=0), vertices.max(axis=0)])
    points = rng.uniform(low, high, (20_000, 2))
    inside = brute_closest(vertices, points)[0] <= 0
    share, box = inside.mean(), np.prod(high - low)
    error = 4 * np.sqrt(share * (1 - share) / len(points)) + 1e-12  # four standard errors
    assert abs(share - area / box) < error
    error = 4 * points[inside].std(axis=0) / np.sqrt(inside.sum())
    assert (np.abs(points[inside].mean(axis=0) - centroid) < error).all()


@pytest.mark.parametrize("name", SMOOTH)
def test_sizes_of_smooth_shapes(found, name):
    area, centroid, (low, high), perimeter, _ = found[name]
    dense = Outline(SMOOTH[name])
    z = dense.at(np.arange(40_000) / 40_000 * dense.period)
    after = np.roll(z, -1, axis=0)
    twice = z[:, 0] * after[:, 1] - after[:, 0] * z[:, 1]
    np.testing.assert_allclose(area, twice.sum() / 2, rtol=1e-6)  # a polygon's sagitta
    center = np.sum((z + after) * twice[:, None], axis=0) / (3 * twice.sum())
    np.testing.assert_allclose(centroid, center, atol=1e-7)
    np.testing.assert_allclose([low, high], [z.min(axis=0), z.max(axis=0)], atol=1e-9)
    assert (low <= z.min(axis=0) + 1e-15).all()
    assert (high >= z.max(axis=0) - 1e-15).all()
    np.testing.assert_allclose(perimeter, np.linalg.norm(after - z, axis=1).sum(), rtol=1e-6)


def test_perimeter_of_an_ellipse(found):
    for name in ("ellipse", "lens"):
        a, b = ELLIPSES[name]
        np.testing.assert_allclose(found[name][3], 4 * a * ellipe(1 - (b / a) ** 2), rtol=1e-10)
    assert float(Ellipse(0.05, 0.03).area) == pytest.approx(np.pi * 0.0015)


def test_area_and_centroid_far_from_the_origin():
    away = np.array([100.0, -50.0])
    polygon = Polygon((SQUARE + away).astype(np.float32))
    # the corners themselves are rounded to 4e-6 m there
    np.testing.assert_allclose(polygon.area, 0.0081, rtol=2e-4)
    np.testing.assert_allclose(polygon.centroid, away, rtol=1e-6)
    near, far = (Curve((OVAL + shift).astype(np.float32)) for shift in (0, away))
    np.testing.assert_allclose(far.area, near.area, rtol=5e-4)
    np.testing.assert_allclose(far.centroid - away, near.centroid, atol=2e-5)


# --- boundaries ---


@pytest.mark.parametrize("name", POLYGONS)
def test_perimeter_and_boundary_of_polygons(found, name):
    *_, perimeter, points = found[name]
    vertices = POLYGONS[name]
    np.testing.assert_allclose(perimeter, np.abs(np.roll(complex_of(vertices), -1) - complex_of(vertices)).sum())
    np.testing.assert_allclose(brute_closest(vertices, points)[0], 0, atol=1e-15)
    gaps = np.abs(np.roll(complex_of(points), -1) - complex_of(points))
    assert gaps.max() <= perimeter / POINTS * (1 + 1e-9)
    assert np.isclose(gaps, perimeter / POINTS).sum() >= POINTS - len(vertices)  # all except those across a corner
    assert signed_area(points) > 0  # counterclockwise


@pytest.mark.parametrize("name", SMOOTH)
def test_boundary_of_smooth_shapes_is_equally_spaced(found, name):
    *_, perimeter, points = found[name]
    np.testing.assert_allclose(closest([SMOOTH[name]], points)[0].distance, 0, atol=1e-15)
    outline = Outline(SMOOTH[name])
    u = np.array([at[gap.argmin()] for gap, at in outline.minima(points)])
    dense = np.linspace(0, outline.period, 400_001)
    arc = np.append(0, np.cumsum(np.linalg.norm(np.diff(outline.at(dense), axis=0), axis=1)))
    along = np.unwrap(np.interp(np.mod(u, outline.period), dense, arc), period=arc[-1])
    np.testing.assert_allclose(np.diff(along), perimeter / POINTS, rtol=1e-3)
    np.testing.assert_allclose(along - along[0], np.arange(POINTS) * perimeter / POINTS, atol=1e-4 * perimeter / POINTS)
    assert signed_area(points) > 0  # counterclockwise


def signed_area(points: np.ndarray) -> float:
    after = np.roll(points, -1, axis=0)
    return float(np.sum(points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]))


def test_perimeter_and_boundary_of_a_disk():
    disk = Disk(0.05, (0.1, 0.2))
    points = complex_of(disk.boundary(7)) - (0.1 + 0.2j)
    np.testing.assert_allclose(np.roll(points, -1) / points, np.exp(2j * np.pi / 7))
    np.testing.assert_allclose(np.abs(points), 0.05)
    assert float(disk.perimeter) == pytest.approx(np.pi * 0.1)


# --- constructors ---


@pytest.mark.parametrize("vertices", POLYGONS.values(), ids=list(POLYGONS))
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


def test_convexity_of_polygons_is_found_out():
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


def test_dtype_is_the_input_s():
    single = np.float32

    def results(shape, point):
        sizes = shape.area, shape.centroid, shape.bounds, shape.boundary(5), shape.perimeter
        # Python numbers do not widen it
        touched = shape.outline().contact_candidates(Vec2.of(shape.centroid))
        return shape, sizes, shape.closest([0.3, 0.2]), shape.closest(point), touched

    for shape in (
        Polygon.rectangle(single(0.1), 0.2),
        Polygon.rectangle(0.1, single(0.2)),
        Polygon.regular(5, single(0.1)),
        Polygon(POLYGONS["star of 14"].astype(single)),
        Disk(single(0.1)),
        Disk(0.1, np.zeros(2, single)),
        Ellipse(single(0.1), 0.05),
        Ellipse(0.1, 0.05, np.zeros(2, single)),
        Curve.fit(CURVES["waisted"].astype(single), 8),
    ):
        found = jax.eval_shape(results, shape, np.zeros(2, single))
        assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {np.dtype(single)}
        assert jax.eval_shape(lambda s, x: s.closest(x), shape, np.zeros(2))[0].dtype == np.float64
    assert Polygon.rectangle(1, 2).vertices.dtype == np.float64
    assert Polygon([(0, 0), (1, 0), (0, 1)]).vertices.dtype == np.float64


EIGHT = np.stack([0.05 * np.cos(np.arange(12) * np.pi / 6), 0.05 * np.sin(np.arange(12) * np.pi / 3)], axis=1)
OVAL = np.stack([0.06 * np.cos(np.arange(8) * np.pi / 4), 0.03 * np.sin(np.arange(8) * np.pi / 4)], axis=1)
BAD = {
    "polygon, no area": (lambda: Polygon([(0, 0), (1, 1), (2, 2)]), "vertices lie on one line and enclose no area"),
    "polygon, bow tie": (
        lambda: Polygon(SQUARE[[0, 2, 1, 3]]),
        "crosses or touches itself: the edge from vertex 0 to vertex 1, and the edge from vertex 2 to vertex 3",
    ),
    "polygon, uneven bow tie": (
        lambda: Polygon([(0, 0), (4, 0), (1, 3), (1, -1)]),
        "the edge from vertex 0 to vertex 1, and the edge from vertex 2 to vertex 3, counted from 0",
    ),
    "polygon, crossing": (lambda: Polygon([(0, 0), (4, 0), (4, 3), (1, -1), (0, 3)]), "vertices: the outline crosses"),
    "polygon, touching": (
        lambda: Polygon([(0, 0), (4, 0), (4, 3), (2, 0), (0, 3)]),
        "vertices: the outline crosses or touches",
    ),
    "polygon, spike": (lambda: Polygon([(0, 0), (4, 0), (4, 3), (4, 5), (4, 3.5), (0, 3)]), "vertices: the outline"),
    "polygon, repeated": (lambda: Polygon(SQUARE[[0, 1, 1, 2, 3]]), "vertices: 1 and 2 are the same"),
    "polygon, closed": (lambda: Polygon(SQUARE[[0, 1, 2, 3, 0]]), "vertices: 0 and 4 are the same"),
    "polygon, one point": (lambda: Polygon(np.zeros((3, 2))), "vertices"),
    "polygon, two": (lambda: Polygon(SQUARE[:2]), "vertices.*at least three"),
    "polygon, NaN": (lambda: Polygon([(0, 0), (1, 0), (np.nan, 1)]), r"vertices.*NaN.*\(2, 0\)"),
    "polygon, infinite": (lambda: Polygon([(0, 0), (1, 0), (np.inf, 1)]), "vertices"),
    "polygon, three columns": (lambda: Polygon(np.zeros((4, 3))), r"vertices has shape \(4, 3\)"),
    "polygon, flat": (lambda: Polygon(np.zeros(6)), "vertices has shape"),
    "polygon, not convex": (lambda: Polygon(POLYGONS["L"], convex=True), "convex is True.*vertex 3"),
    "polygon, width": (lambda: Polygon.rectangle(-1, 1), "width"),
    "polygon, height": (lambda: Polygon.rectangle(1, 0), "height"),
    "polygon, height NaN": (lambda: Polygon.rectangle(1, np.nan), "height"),
    "polygon, width array": (lambda: Polygon.rectangle(np.ones(2), 1), "width has shape"),
    "polygon, sides": (lambda: Polygon.regular(2, 1), "sides"),
    "polygon, circumradius": (lambda: Polygon.regular(5, -1), "circumradius"),
    "polygon, circumradius array": (lambda: Polygon.regular(5, np.ones(5)), "circumradius has shape"),
    "disk, radius": (lambda: Disk(0), "radius"),
    "disk, radius infinite": (lambda: Disk(np.inf), "radius"),
    "disk, radius array": (lambda: Disk([1.0, 2.0]), "radius has shape"),
    "disk, center": (lambda: Disk(1, (0, 0, 0)), "center has shape"),
    "disk, center NaN": (lambda: Disk(1, (0, np.nan)), "center"),
    "disk, point": (lambda: Disk(1).closest(np.zeros(3)), "point has shape"),
    "polygon, point NaN": (lambda: Polygon(SQUARE).closest([0, np.nan]), "point"),
    "inset to nothing": (
        lambda: Polygon.rectangle(0.06, 0.06).inset(0.03),
        r"depth: 0.03 m is too much, edge \d vanishes",
    ),
    # all edges would be turned around: again a rectangle
    "inset beyond": (lambda: Polygon.rectangle(0.06, 0.06).inset(0.05), r"depth: 0.05 m is too much, edge \d vanishes"),
    "inset NaN": (lambda: Polygon.rectangle(0.06, 0.06).inset(np.nan), "depth must be finite"),
    "inset array": (lambda: Polygon.rectangle(0.06, 0.06).inset([0.01, 0.02]), "depth has shape"),
    "ellipse, semi_x": (lambda: Ellipse(0, 1), "semi_x must be positive"),
    "ellipse, semi_y": (lambda: Ellipse(1, -1), "semi_y must be positive"),
    "ellipse, semi_y NaN": (lambda: Ellipse(1, np.nan), "semi_y must be finite"),
    "ellipse, semi_x array": (lambda: Ellipse([1.0, 2.0], 1), "semi_x has shape"),
    "ellipse, center": (lambda: Ellipse(1, 1, (0, 0, 0)), "center has shape"),
    "ellipse, center NaN": (lambda: Ellipse(1, 1, (0, np.nan)), "center"),
    "curve, three": (lambda: Curve(OVAL[:3]), "control: a curve needs at least 4; got 3"),
    "curve, NaN": (lambda: Curve(np.where(np.arange(8)[:, None] == 2, np.nan, OVAL)), r"control.*NaN.*\(2, 0\)"),
    "curve, columns": (lambda: Curve(np.zeros((8, 3))), "control has shape"),
    "curve, repeated": (lambda: Curve(OVAL[[0, 1, 1, 2, 3, 4, 5, 6, 7]]), "control: 1 and 2 are the same"),
    "curve, closed": (lambda: Curve(OVAL[[0, 1, 2, 3, 4, 5, 6, 7, 0]]), "control: 8 and 0 are the same"),
    "curve, no area": (lambda: Curve([(0, 0), (1, 0), (2, 0), (3, 0), (2.5, 0), (1.5, 0)]), "control: .*no area"),
    "curve, eight": (lambda: Curve(EIGHT + [0.01, 0] * np.sin(np.arange(12))[:, None]), "control: .*"),
    "curve, crossing": (lambda: Curve([(0, 0), (4, 0), (4, 3), (1, -2), (-1, -2), (0, 3)]), "control: .*crosses"),
    "curve, not convex": (lambda: Curve(CURVES["waisted"], convex=True), "convex is True"),
    "curve, through": (lambda: Curve.through(OVAL[:2]), "points: a curve needs"),
    "curve, through repeated": (lambda: Curve.through(OVAL[[0, 0, 1, 2, 3, 4]]), "points: 0 and 1"),
    "curve, fit few": (lambda: Curve.fit(OVAL, 5), "controls must be from 4 to .* 4; got 5"),
    "curve, fit traced": (lambda: jax.jit(Curve.fit)(OVAL), "points are traced"),
    "curve, point": (lambda: Curve(OVAL).closest(np.zeros(3)), "point has shape"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_values_do_not_raise():
    """Traced values cannot be checked; shapes are still checked."""

    @jax.jit
    def area(points, radius):
        round_shapes = Disk(radius).signed_distance(points[0]) + Ellipse(radius, 1.0).signed_distance(points[0])
        return Polygon(points).area + Curve(points).area + Polygon.rectangle(radius, 1.0).area + round_shapes

    assert np.isnan(area(np.full((4, 2), np.nan), -1.0))
    for make, name in ((Polygon, "vertices"), (Curve, "control")):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            jax.eval_shape(make, np.zeros((4, 3)))
