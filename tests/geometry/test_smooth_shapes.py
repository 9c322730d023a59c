"""Ellipses and curves compared with brute force in numpy and scipy's splines, which share no code with them."""

import jax
import numpy as np
import pytest
from polygons import brute_closest
from smooth import CURVES, ELLIPSES, ROUNDINGS, SIZE, Outline, around, closest, lengths, scattered, shape_of

from pushjax.geometry.curve import Curve
from pushjax.geometry.ellipse import Ellipse
from pushjax.geometry.polygon import Polygon

DTYPES = [np.float32, np.float64]
# Central differences of a second-order quantity, step 1e-6 m, relative to its size: roundoff 1e-16 / 1e-6.
DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 1e-6
KINDS = pytest.mark.parametrize("shapes", [ELLIPSES, CURVES], ids=["ellipses", "curves"])


# --- distance, closest point, normal ---


@KINDS
@pytest.mark.parametrize("dtype", DTYPES)
def test_closest_is_that_of_brute_force(shapes, dtype):
    every = [scattered(shape, 0) for shape in shapes.values()]
    for shape, points, seen in zip(shapes.values(), every, closest(list(shapes.values()), every, dtype), strict=True):
        assert {seen.distance.dtype, seen.point.dtype, seen.normal.dtype} == {np.dtype(dtype)}
        size = 1 + np.abs(points).max(axis=1) / SIZE
        brute = Outline(shape).signed(points)
        # On the outline, the sign by brute force is that of a polygon. At a center of curvature it converges slowly.
        off = np.abs(np.where(np.abs(brute) < 1e-5, np.abs(brute) - np.abs(seen.distance), brute - seen.distance))
        assert (off <= np.maximum(lengths(dtype) * size, 1e-8)).all()
        assert (off <= lengths(dtype) * size).mean() > 0.99
        # the closest point and the normal lead back to the point; the closest point is on the outline
        back = seen.point + seen.distance[:, None] * seen.normal - points.astype(dtype)
        assert (np.abs(back).max(axis=1) <= np.maximum(lengths(dtype) * size, 1e-7)).all()
        assert (np.abs(back).max(axis=1) <= 10 * lengths(dtype) * size).mean() > 0.99
        np.testing.assert_allclose(np.linalg.norm(seen.normal, axis=1), 1, atol=10 * np.finfo(dtype).eps)
        on_outline = [gap.min() for gap, _ in Outline(shape).minima(seen.point.astype(np.float64))]
        np.testing.assert_allclose(on_outline, 0, atol=lengths(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_hard_points_of_an_ellipse(dtype):
    """Points on the evolute, near its cusps, near the axes, and from a nanometer to a meter off the outline."""
    many = [(0.05, 0.03), (0.005, 0.1), (0.05, 0.05 * (1 - 1e-9))]
    groups = []
    for a, b in many:
        rng = np.random.default_rng(1)
        angle = rng.uniform(0, 2 * np.pi, 2000)
        on = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
        out = np.stack([b * np.cos(angle), a * np.sin(angle)], axis=1)
        off = out / np.linalg.norm(out, axis=1, keepdims=True) * 10 ** rng.uniform(-9, 0, (2000, 1))
        evolute = (a * a - b * b) * np.stack([np.cos(angle) ** 3 / a, -(np.sin(angle) ** 3) / b], axis=1)
        tip = np.array([abs(a * a - b * b) / max(a, b), 0])
        cusp = tip + 10 ** rng.uniform(-16, -2, (2000, 2)) * rng.choice([-1, 1], (2000, 2))
        axis = np.stack([rng.uniform(-1, 1, 2000) * a, 10 ** rng.uniform(-25, -3, 2000)], axis=1)
        groups.append([on + off, on - off, evolute, cusp if a > b else cusp[:, ::-1], axis])
    for points in zip(*groups, strict=True):
        typed = [p.astype(dtype) for p in points]
        for (a, b), x, seen in zip(many, typed, closest(many, typed, dtype), strict=True):
            size = SIZE + np.abs(x).max(axis=1)
            np.testing.assert_allclose(np.hypot(*(seen.point / [a, b]).T), 1, atol=20 * np.finfo(dtype).eps)
            back = np.abs(seen.point + seen.distance[:, None] * seen.normal - x).max(axis=1) / size
            assert back.max() < 2000 * np.finfo(dtype).eps
            near = np.linalg.norm(x[:, None] - Outline((a, b)).points, axis=-1).min(axis=1)
            # no sample is nearer
            assert (np.abs(seen.distance) - near < ROUNDINGS * np.finfo(dtype).eps * size).all()


def test_a_circle_is_a_disk():
    points, center = scattered(ELLIPSES["circle"], 2)[:-1], np.array([0.01, 0.02])
    (seen,) = closest([(0.05, 0.05, *center)], points)
    far = np.linalg.norm(points - center, axis=1)
    normal = (points - center) / far[:, None]
    for found, expected in zip(seen, (far - 0.05, center + 0.05 * normal, normal), strict=False):
        np.testing.assert_allclose(found, expected, atol=1e-14)


@KINDS
def test_the_distance_is_one_lipschitz_and_changes_sign_across_the_outline(shapes):
    every, points = list(shapes.values()), np.random.default_rng(3).uniform(-0.15, 0.15, (2, 400, 2))
    for one, other in zip(closest(every, points[0]), closest(every, points[1]), strict=True):
        apart = np.linalg.norm(points[0] - points[1], axis=1)
        assert (np.abs(one.distance - other.distance) <= apart + 1e-15).all()
    on = [Outline(shape).points[::6] for shape in every]
    seen = closest(every, on)
    for found in seen:
        np.testing.assert_allclose(found.distance, 0, atol=1e-15)
    for step in (1e-5, -1e-5):
        for found in closest(every, [x + step * at.normal for x, at in zip(on, seen, strict=True)]):
            np.testing.assert_allclose(found.distance, step, atol=1e-14)


def test_equivariance():
    turn = np.array([(0.6, -0.8), (0.8, 0.6)])
    shift, mirror = np.array([0.03, -0.2]), np.array([1.0, -1.0])
    controls = list(CURVES.values())
    points = [scattered(control, 4, 100)[:-1] for control in controls]
    seen = closest(controls, points)
    off = closest(controls, [x + 1e-7 * at.normal for x, at in zip(points, seen, strict=True)])
    for moved, turned in ((lambda x: x @ turn.T + shift, lambda n: n @ turn.T), (lambda x: x * mirror,) * 2):
        # the mirror image of a curve runs clockwise, so its controls are taken in the other order
        order = slice(None) if np.linalg.det(turned(np.eye(2))) > 0 else slice(None, None, -1)
        there = closest([moved(control)[order] for control in controls], [moved(x) for x in points])
        for x, at, beside, found in zip(points, seen, off, there, strict=True):
            np.testing.assert_allclose(found.distance, at.distance, atol=1e-9)
            clear = np.abs(beside.distance - at.distance - 1e-7) < 1e-12
            clear &= np.abs(x).min(axis=1) > 1e-9  # off the medial axis, where any of the nearest points is right
            np.testing.assert_allclose(found.normal[clear], turned(at.normal)[clear], atol=1e-6)
    x = scattered(ELLIPSES["ellipse"], 4)
    same = closest([(0.05, 0.03, 0, 0), (0.05, 0.03, *shift), (0.03, 0.05, 0, 0)], [x, x + shift, x[:, ::-1]])
    for other in same[1:]:
        np.testing.assert_allclose(other.distance, same[0].distance, atol=1e-14)


# --- derivatives ---


@pytest.mark.parametrize("name", ["ellipse", pytest.param("waisted", marks=pytest.mark.slow)])
def test_first_and_second_derivatives_of_the_distance(name):
    """Derivatives by point and shape, along random directions, agree with central differences of value and slope."""
    numbers, rng = (ELLIPSES | CURVES)[name], np.random.default_rng(5)
    points = rng.uniform(-0.12, 0.12, (60, 2))
    points = points[Outline(numbers).is_regular(points)]
    assert len(points) > 15
    numbers = np.asarray((*numbers, 0.0, 0.0) if name == "ellipse" else numbers)  # with its center

    def value(v):
        shape = v[:-2].reshape(numbers.shape)
        return (Ellipse(*shape[:2], shape[2:]) if name == "ellipse" else Curve(shape)).signed_distance(v[-2:])

    def slope(v, a):
        return jax.jvp(value, (v,), (a,))

    @jax.jit
    @jax.vmap
    def every(v, a):
        (distance, first), (_, second) = jax.jvp(lambda u: slope(u, a), (v,), (a,))
        return distance, first, second, jax.grad(value)(v)

    at = np.concatenate([np.broadcast_to(numbers.ravel(), (len(points), numbers.size)), points], axis=1)
    along = rng.normal(size=at.shape)
    (_, slopes, bend, reverse), ahead, behind = (every(at + DIFFERENCE_STEP * s * along, along) for s in (0, 1, -1))
    difference = (ahead[0] - behind[0]) / (2 * DIFFERENCE_STEP)
    np.testing.assert_allclose(slopes, difference, atol=1e-7)
    difference = (ahead[1] - behind[1]) / (2 * DIFFERENCE_STEP)
    scale = 1 + np.abs(difference)
    np.testing.assert_allclose(bend / scale, difference / scale, atol=DIFFERENCE_TOLERANCE)
    reverse = np.asarray(reverse)
    np.testing.assert_allclose(reverse[:, -2:], closest([numbers], points)[0].normal, atol=1e-9)
    np.testing.assert_allclose(np.sum(reverse * along, axis=1), slopes, atol=1e-9)


@KINDS
def test_derivatives_are_finite_where_they_are_singular(shapes):
    """Derivatives are finite at the center, on the axes, at centers of curvature, and on the outline.

    They are tested in the precision in which this is harder.
    """
    rows = [(0, 0), (0.032, 0), (0, -0.032), (0.05, 0), (0, 0.05), (1e-30, 0), (0.01, 0), (0, 0.01)]
    points = np.stack([np.concatenate([rows, Outline(shape).points[::150]]) for shape in shapes.values()])
    slope = jax.jacrev(lambda numbers, x: shape_of(numbers).closest(x), argnums=(0, 1))
    every = jax.jit(jax.vmap(jax.vmap(slope, (None, 0))))
    found = every(np.stack(list(shapes.values())).astype(np.float32), points.astype(np.float32))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


# --- all points that a finger can touch ---


def test_the_second_touch_is_the_next_local_minimum_that_faces():
    points = np.random.default_rng(6).uniform(-0.1, 0.1, (300, 2))
    for control, seen in zip(CURVES.values(), closest(list(CURVES.values()), points), strict=True):
        brute, outline = Outline(control), []
        for k, (gap, u) in enumerate(brute.minima(points)):
            velocity, rel = brute.at(u, 1), points[k] - brute.at(u)
            facing = velocity[:, 1] * rel[:, 0] - velocity[:, 0] * rel[:, 1] > 0
            outline.append(gap[facing & (np.abs(gap - gap.min()) > 1e-12)].min(initial=np.inf))
        outline, (distance, _, normal) = np.array(outline), seen.second
        there = np.isfinite(outline)
        if control is CURVES["oval"]:  # convex: no second touch outside, even if two are asked for
            outside = seen.distance > 1e-5
            assert not there[outside].any()
            there, none = np.zeros_like(there), outside
        else:
            assert 10 < there.sum() < 290
            none = ~there
        np.testing.assert_allclose(distance[there], outline[there], atol=1e-9)
        perimeter = float(Curve(control).perimeter)
        np.testing.assert_allclose(distance[none], seen.distance[none] + perimeter, rtol=1e-9)
        np.testing.assert_allclose(np.hypot(*normal.T), 1, rtol=1e-12)


def test_a_finger_in_the_waist_touches_both_flanks():
    """A finger too wide for the waist touches both sides; half a millimeter to one side it still finds the other."""
    (seen,) = closest([CURVES["waisted"]], np.array([(0.075, 0.0), (0.075, 5e-4), (0.075, -5e-4)]))
    distance, point, normal = seen.second
    assert (np.abs(seen.distance - distance) < 2e-3).all()
    assert (seen.normal[:, 1] * normal[:, 1] < 0).all()
    assert (seen.point[:, 1] * point[:, 1] < 0).all()
    assert (np.minimum(seen.normal[:, 0], normal[:, 0]) > 0).all()
    for convex in (CURVES["oval"], ELLIPSES["ellipse"]):
        assert shape_of(convex).outline().max_touches == 1


# --- constructors of curves ---


def test_stored_counter_clockwise():
    for control in CURVES.values():
        kept, flipped = Curve(control), Curve(control[::-1])
        np.testing.assert_array_equal(kept.control, control)
        np.testing.assert_array_equal(flipped.control, np.roll(control, 1, axis=0))
        assert float(flipped.area) == pytest.approx(float(kept.area), rel=1e-12)


def test_through_points():
    points = around(np.random.default_rng(4).uniform(0.03, 0.08, 24))
    curve = Curve.through(points)
    np.testing.assert_allclose(closest([curve.control], points)[0].distance, 0, atol=1e-15)
    np.testing.assert_allclose(Outline(curve.control).at(np.arange(24.0)), points, atol=1e-15)
    assert Curve.through(points[::-1]).convex == curve.convex
    assert Curve.through(points.astype(np.float32)).control.dtype == np.float32
    area = jax.jit(lambda p: Curve.through(p).area)
    slope = jax.jit(jax.grad(area))(points)
    ahead, behind = (area(points + s * np.eye(48)[5].reshape(24, 2)) for s in (1e-6, -1e-6))
    np.testing.assert_allclose(slope[2, 1], (ahead - behind) / 2e-6, rtol=1e-7)


def test_a_fit_recovers_a_curve_from_its_points():
    control = CURVES["waisted"]
    points = Outline(control).at(np.sort(np.random.default_rng(11).uniform(0, 24, 500)))
    fitted = Curve.fit(points, 24)
    assert np.abs(closest([fitted.control], points)[0].distance).max() < 5e-5
    assert float(fitted.area) == pytest.approx(float(Curve(control).area), rel=1e-4)
    ellipse = Curve.fit(Outline(ELLIPSES["ellipse"]).points[::3], 24)
    assert ellipse.convex
    on = Outline(ellipse.control).points
    assert np.abs(closest([ELLIPSES["ellipse"]], on)[0].distance).max() < 5e-5


def test_convexity_is_found_out():
    for dtype in DTYPES:
        assert [name for name, c in CURVES.items() if Curve(c.astype(dtype)).convex] == ["oval"]
    assert not Curve(CURVES["oval"], convex=False).convex

    @jax.jit
    def flags(c):
        assert not Curve(c).convex
        assert Curve.through(c, convex=True).convex
        return Curve(c)

    np.testing.assert_array_equal(flags(CURVES["oval"]).control, CURVES["oval"])


def test_the_real_butterfly(data):
    """Fit 636 vertices of an outline whose corners, seven millimeters apart, turn by up to fifteen degrees."""
    path = data / "mit_push" / "abs_butter.npz"
    if not path.is_file():
        pytest.skip(f"{path} does not exist")
    vertices = np.load(path)["vertices_body"]
    curve, polygon = Curve.fit(vertices, 24), Polygon(vertices)
    assert not curve.convex
    off = 1e3 * np.abs(closest([curve.control], vertices)[0].distance)
    # a smooth curve cannot follow the corners more closely than half their sagitta, 0.12 mm
    assert off.max() < 0.15
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert float(curve.area) == pytest.approx(float(polygon.area), rel=1e-4)
    low, high = curve.bounds
    np.testing.assert_allclose(high - low, np.ptp(vertices, axis=0), atol=5e-4)
    points = np.random.default_rng(13).uniform(-0.1, 0.1, (200, 2))
    expected = brute_closest(polygon.vertices, points)[0]
    np.testing.assert_allclose(closest([curve.control], points)[0].distance, expected, atol=2.5e-4)
