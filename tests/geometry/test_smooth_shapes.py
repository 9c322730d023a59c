"""Ellipses and curves compared with brute force in numpy and scipy's splines, which share no code with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.special import ellipe

from pushjax._math.vec import Vec2
from pushjax.geometry.curve import Curve
from pushjax.geometry.disk import Disk
from pushjax.geometry.ellipse import Ellipse
from pushjax.geometry.polygon import Polygon

# Converged iterations on lengths of order 0.1 m, in units of roundoff of the dtype. For ellipses of 1 : 20 the
# curvature, 1 / 0.25 mm, amplifies the difference between along and across.
ROUNDINGS = 200
SIZE = 0.1
DTYPES = [np.float32, np.float64]
# Central differences of a second-order quantity, step 1e-6 m, relative to its size: roundoff 1e-16 / 1e-6.
DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 1e-6
RADII = [0.0, 0.00475, 0.02]


def batched(function, shared: int = 1, size: int = 500):
    """Apply `function` to a batch of any length with one compilation, in blocks of `size`; the last one is padded.

    The first `shared` arguments, and a radius at the end, are the same for the whole batch.
    """
    block = jax.jit(lambda shared, arrays, rest: jax.vmap(lambda *each: function(*shared, *each, *rest))(*arrays))

    def run(*arguments):
        same, arrays = arguments[:shared], [np.asarray(a) for a in arguments[shared:] if np.ndim(a) > 0]
        rest = [a for a in arguments[shared:] if np.ndim(a) == 0]
        count = len(arrays[0])
        padded = [np.concatenate([a, np.repeat(a[-1:], -count % size, axis=0)]) for a in arrays]
        blocks = [block(same, [a[k : k + size] for a in padded], rest) for k in range(0, len(padded[0]), size)]
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)

    return run


closest = batched(lambda shape, x: shape.closest(x))
distances = batched(lambda shape, x: shape.signed_distance(x), size=4000)
candidates_at = batched(lambda shape, x: shape.outline().contact_candidates(Vec2.of(x)))
boundary = jax.jit(lambda shape: shape.boundary(2000))


def lengths(dtype) -> float:
    return ROUNDINGS * SIZE * float(np.finfo(dtype).eps)


def wavy(controls: int, seed: int) -> np.ndarray:
    """Return control points about the origin, counterclockwise, at random radii."""
    angle = 2 * np.pi * np.arange(controls) / controls
    radius = np.random.default_rng(seed).uniform(0.03, 0.08, controls)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def waisted(controls: int = 24) -> np.ndarray:
    """Return the controls of a curve with two lobes and a waist, 0.1 m by 0.16 m, 0.06 m at the waist."""
    angle = 2 * np.pi * np.arange(controls) / controls
    radius = 0.055 - 0.025 * np.cos(2 * angle)
    return np.asarray(Curve.through(radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).control)


CURVES = {
    "waisted": waisted(),
    "wavy": wavy(24, 2),
    "oval": np.stack([0.06 * np.cos(np.arange(8) * np.pi / 4), 0.03 * np.sin(np.arange(8) * np.pi / 4)], axis=1),
}
ELLIPSES = {"ellipse": (0.05, 0.03), "lens": (0.1, 0.005), "circle": (0.05, 0.05)}
# shapes with the same number of controls share their compiled programs, and so do all ellipses
SHAPES = {**{name: Ellipse(*axes) for name, axes in ELLIPSES.items()}, **{n: Curve(c) for n, c in CURVES.items()}}


@pytest.fixture(params=SHAPES.values(), ids=list(SHAPES))
def shape(request):
    return request.param


@pytest.fixture(params=CURVES.values(), ids=list(CURVES))
def control(request) -> np.ndarray:
    return request.param


# --- brute force ---


class Outline:
    """Points and derivatives of an outline at parameters over one period, in numpy."""

    def __init__(self, shape):
        if isinstance(shape, Ellipse):
            a, b = float(shape.semi_x), float(shape.semi_y)
            turn, self.period = np.array([a, b]), 2 * np.pi
            quarter = np.array([0, np.pi / 2])
            self.at = lambda u, k=0: turn * np.cos(u[..., None] - quarter + k * np.pi / 2)
        else:
            c = np.asarray(shape.control, np.float64)
            self.period = len(c)
            spline = BSpline(np.arange(-3.0, len(c) + 4), np.concatenate([c[-1:], c, c[:2]]), 3)
            self.at = lambda u, k=0: spline(np.mod(u, len(c)), nu=k)
        self.u = np.arange(1200) * self.period / 1200
        self.points = self.at(self.u)

    def minima(self, x: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return, for each point, the distances of all local minima, and their parameters on the outline."""
        gap = np.linalg.norm(x[:, None] - self.points, axis=-1)
        which, start = np.nonzero((gap <= np.roll(gap, 1, axis=1)) & (gap < np.roll(gap, -1, axis=1)))
        u, step = self.u[start], 1.5 * self.period / 1200
        for _ in range(12):
            first, rel = self.at(u, 1), x[which] - self.at(u)
            speed = np.sum(first**2, axis=1)
            stiff = np.maximum(speed - np.sum(rel * self.at(u, 2), axis=1), 1e-3 * speed)
            u = np.clip(u + np.sum(rel * first, axis=1) / stiff, self.u[start] - step, self.u[start] + step)
        gap = np.linalg.norm(x[which] - self.at(u), axis=1)
        return [(gap[which == k], u[which == k]) for k in range(len(x))]

    def signed(self, x: np.ndarray) -> np.ndarray:
        """Return the signed distance, with the sign from the winding number."""
        z, p = (v[..., 0] + 1j * v[..., 1] for v in (x, self.points))
        rel = p - z[:, None]
        winding = np.angle(np.roll(rel, -1, axis=1) / rel).sum(axis=1) / (2 * np.pi)
        return np.where(np.abs(winding) > 0.5, -1, 1) * np.array([gap.min() for gap, _ in self.minima(x)])


def scattered(shape, seed: int, count: int = 300) -> np.ndarray:
    """Return points everywhere, far away, near the middle, on both axes, and a micrometer off the outline."""
    rng = np.random.default_rng(seed)
    line = np.linspace(-0.12, 0.12, 40)
    near = np.asarray(boundary(shape))[::40] + rng.normal(size=(50, 2)) * 1e-6
    return np.concatenate([
        rng.uniform(-0.15, 0.15, (count, 2)), 3 * rng.normal(size=(40, 2)), 0.01 * rng.normal(size=(40, 2)), near,
        np.stack([line, 0 * line], axis=1), np.stack([0 * line, line], axis=1), np.zeros((1, 2)),
    ])  # fmt: skip


# --- distance, closest point, normal ---


@pytest.mark.parametrize("dtype", DTYPES)
def test_closest_is_that_of_brute_force(shape, dtype):
    points = scattered(shape, 0)
    single = jax.tree.map(lambda leaf: leaf.astype(dtype), shape)
    distance, point, normal = closest(single, points.astype(dtype))
    assert {distance.dtype, point.dtype, normal.dtype} == {np.dtype(dtype)}
    size = 1 + np.abs(points).max(axis=1) / SIZE
    brute = Outline(shape).signed(points)
    # On the outline, the sign by brute force is that of a polygon. At a center of curvature it converges slowly.
    off = np.abs(np.where(np.abs(brute) < 1e-5, np.abs(brute) - np.abs(distance), brute - distance))
    assert (off <= np.maximum(lengths(dtype) * size, 1e-8)).all()
    assert (off <= lengths(dtype) * size).mean() > 0.99
    # the closest point and the normal lead back to the point; the closest point is on the outline
    back = np.asarray(point) + np.asarray(distance)[:, None] * np.asarray(normal) - points.astype(dtype)
    assert (np.abs(back).max(axis=1) <= np.maximum(lengths(dtype) * size, 1e-7)).all()
    assert (np.abs(back).max(axis=1) <= 10 * lengths(dtype) * size).mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=10 * np.finfo(dtype).eps)
    on_outline = [gap.min() for gap, _ in Outline(shape).minima(np.asarray(point, np.float64))]
    np.testing.assert_allclose(on_outline, 0, atol=lengths(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("axes", [(0.05, 0.03), (0.005, 0.1), (0.05, 0.05 * (1 - 1e-9))])
def test_hard_points_of_an_ellipse(axes, dtype):
    """Points on the evolute, near its cusps, near the axes, and from a nanometer to a meter off the outline."""
    rng, (a, b) = np.random.default_rng(1), axes
    angle = rng.uniform(0, 2 * np.pi, 2000)
    on = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
    out = np.stack([b * np.cos(angle), a * np.sin(angle)], axis=1)
    off = out / np.linalg.norm(out, axis=1, keepdims=True) * 10 ** rng.uniform(-9, 0, (2000, 1))
    evolute = (a * a - b * b) * np.stack([np.cos(angle) ** 3 / a, -(np.sin(angle) ** 3) / b], axis=1)
    tip = np.array([abs(a * a - b * b) / max(a, b), 0])
    cusp = tip + 10 ** rng.uniform(-16, -2, (2000, 2)) * rng.choice([-1, 1], (2000, 2))
    axis = np.stack([rng.uniform(-1, 1, 2000) * a, 10 ** rng.uniform(-25, -3, 2000)], axis=1)
    points = np.concatenate([on + off, on - off, evolute, cusp if a > b else cusp[:, ::-1], axis]).astype(dtype)
    distance, point, normal = map(np.asarray, closest(Ellipse(dtype(a), dtype(b)), points))
    size = SIZE + np.abs(points).max(axis=1)
    np.testing.assert_allclose(np.hypot(*(point / [a, b]).T), 1, atol=20 * np.finfo(dtype).eps)
    back = np.abs(point + distance[:, None] * normal - points).max(axis=1) / size
    assert back.max() < 2000 * np.finfo(dtype).eps
    near = np.linalg.norm(points[:, None] - Outline(Ellipse(a, b)).points, axis=-1).min(axis=1)
    assert (np.abs(distance) - near < ROUNDINGS * np.finfo(dtype).eps * size).all()  # no sample is nearer


def test_a_circle_is_a_disk():
    points = scattered(SHAPES["circle"], 2)[:-1]
    pair = Ellipse(0.05, 0.05, (0.01, 0.02)), Disk(0.05, (0.01, 0.02))
    for a, b in zip(*(closest(each, points) for each in pair), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


def test_the_distance_is_one_lipschitz_and_changes_sign_across_the_outline(shape):
    points = np.random.default_rng(3).uniform(-0.15, 0.15, (2, 400, 2))
    one, other = (np.asarray(distances(shape, p)) for p in points)
    assert (np.abs(one - other) <= np.linalg.norm(points[0] - points[1], axis=1) + 1e-15).all()
    on = np.asarray(boundary(shape))[::10]
    distance, _, normal = (np.asarray(part) for part in closest(shape, on))
    np.testing.assert_allclose(distance, 0, atol=1e-15)
    for step in (1e-5, -1e-5):
        np.testing.assert_allclose(distances(shape, on + step * normal), step, atol=1e-14)


def test_equivariance():
    turn = np.array([(0.6, -0.8), (0.8, 0.6)])
    shift, mirror = np.array([0.03, -0.2]), np.array([1.0, -1.0])
    for control in CURVES.values():
        points = scattered(Curve(control), 4, 100)[:-1]
        distance, _, normal = closest(Curve(control), points)
        clear = np.abs(np.asarray(distances(Curve(control), points + 1e-7 * normal)) - distance - 1e-7) < 1e-12
        clear &= np.abs(points).min(axis=1) > 1e-9  # off the medial axis, where any of the nearest points is right
        for moved, there, bend in (
            (control @ turn.T + shift, points @ turn.T + shift, np.asarray(normal) @ turn.T),
            (control * mirror, points * mirror, np.asarray(normal) * mirror),
        ):
            found = closest(Curve(moved), there)
            np.testing.assert_allclose(found[0], distance, atol=1e-9)
            np.testing.assert_allclose(np.asarray(found[2])[clear], bend[clear], atol=1e-6)
    points = scattered(SHAPES["ellipse"], 4)
    moved = closest(Ellipse(0.05, 0.03, shift), points + shift)
    np.testing.assert_allclose(moved[0], distances(SHAPES["ellipse"], points), atol=1e-14)
    np.testing.assert_allclose(distances(Ellipse(0.03, 0.05), points[:, ::-1]), moved[0], atol=1e-14)


# --- derivatives ---


stretches = batched(jax.jacfwd(lambda shape, x: shape.closest(x)[1], argnums=1))


def off_evolute(shape, points: np.ndarray) -> np.ndarray:
    """Return points whose closest point has moderate derivatives, with no second one within a millimeter."""
    least = Outline(shape).minima(points)
    clear = [gap.size == 1 or np.partition(gap, 1)[1] - gap.min() > 1e-3 for gap, _ in least]
    stretch = stretches(shape, points)
    return points[np.array(clear) & (np.abs(stretch).max(axis=(1, 2)) < 10)]


def parameters(shape):
    """Return the shape as a vector, and the function back."""
    leaves, tree = jax.tree.flatten(shape)
    flat = np.concatenate([np.ravel(leaf) for leaf in leaves])
    ends = np.cumsum([np.size(leaf) for leaf in leaves])[:-1]

    def back(vector):
        parts = jnp.split(vector, ends)
        return jax.tree.unflatten(tree, [p.reshape(leaf.shape) for p, leaf in zip(parts, leaves, strict=True)])

    return flat, back


@pytest.mark.parametrize("name", ["ellipse", "waisted"])
def test_first_and_second_derivatives_of_the_distance(name):
    """Derivatives by point and shape, along random directions, agree with central differences of value and slope."""
    shape, rng = SHAPES[name], np.random.default_rng(5)
    points = off_evolute(shape, rng.uniform(-0.12, 0.12, (60, 2)))
    assert len(points) > 15
    flat, back = parameters(shape)
    along = rng.normal(size=(len(points), flat.size + 2))

    def value(v):
        return back(v[:-2]).signed_distance(v[-2:])

    def slope(v, a):
        return jax.jvp(value, (v,), (a,))[1]

    at = np.concatenate([np.broadcast_to(flat, (len(points), flat.size)), points], axis=1)
    ahead, behind = at + DIFFERENCE_STEP * along, at - DIFFERENCE_STEP * along
    values, slopes = jax.jit(jax.vmap(value)), jax.jit(jax.vmap(slope))
    difference = (values(ahead) - values(behind)) / (2 * DIFFERENCE_STEP)
    np.testing.assert_allclose(slopes(at, along), difference, atol=1e-7)
    bend = jax.jit(jax.vmap(lambda v, a: jax.jvp(lambda u: slope(u, a), (v,), (a,))[1]))(at, along)
    difference = (slopes(ahead, along) - slopes(behind, along)) / (2 * DIFFERENCE_STEP)
    scale = 1 + np.abs(difference)
    np.testing.assert_allclose(bend / scale, difference / scale, atol=DIFFERENCE_TOLERANCE)
    reverse = np.asarray(jax.jit(jax.vmap(jax.grad(value)))(at))
    np.testing.assert_allclose(reverse[:, -2:], closest(shape, points)[2], atol=1e-9)
    np.testing.assert_allclose(np.sum(reverse * along, axis=1), slopes(at, along), atol=1e-9)


every_slope = batched(jax.jacrev(lambda shape, x: shape.closest(x), argnums=(0, 1)), size=20)


def test_derivatives_are_finite_where_they_are_singular(shape):
    """Derivatives are finite at the center, on the axes, at centers of curvature, and on the outline.

    They are tested in the precision in which this is harder.
    """
    rows = [(0, 0), (0.032, 0), (0, -0.032), (0.05, 0), (0, 0.05), (1e-30, 0), (0.01, 0), (0, 0.01)]
    points = np.concatenate([np.array(rows), np.asarray(boundary(shape))[::250]]).astype(np.float32)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), shape)
    every = every_slope(single, points)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(every))


# --- all points that a finger can touch ---


@pytest.mark.parametrize("name", ["waisted", "wavy"])
def test_the_second_touch_is_the_next_local_minimum_that_faces(name):
    shape = SHAPES[name]
    points = np.random.default_rng(6).uniform(-0.1, 0.1, (300, 2))
    first, second = candidates_at(shape, points)
    np.testing.assert_allclose(first.distance, distances(shape, points), atol=1e-15)
    brute, outline = Outline(shape), []
    for k, (gap, u) in enumerate(brute.minima(points)):
        velocity, rel = brute.at(u, 1), points[k] - brute.at(u)
        facing = velocity[:, 1] * rel[:, 0] - velocity[:, 0] * rel[:, 1] > 0
        others = gap[facing & (np.abs(gap - gap.min()) > 1e-12)]
        outline.append(others.min(initial=np.inf))
    outline = np.array(outline)
    there = np.isfinite(outline)
    assert 10 < there.sum() < 290
    np.testing.assert_allclose(second.distance[there], outline[there], atol=1e-9)
    perimeter = float(shape.perimeter)
    np.testing.assert_allclose(second.distance[~there], first.distance[~there] + perimeter, rtol=1e-9)
    np.testing.assert_allclose(np.hypot(*second.normal), 1, rtol=1e-12)


def test_a_finger_in_the_waist_touches_both_flanks():
    """A finger too wide for the waist touches both sides; half a millimeter to one side it still finds the other."""
    first, second = candidates_at(SHAPES["waisted"], np.array([(0.075, 0.0), (0.075, 5e-4), (0.075, -5e-4)]))
    assert (np.abs(first.distance - second.distance) < 2e-3).all()
    assert (first.normal.y * second.normal.y < 0).all()
    assert (first.point.y * second.point.y < 0).all()
    assert (np.minimum(first.normal.x, second.normal.x) > 0).all()
    for convex in (SHAPES["oval"], SHAPES["ellipse"]):
        assert len(candidates_at(convex, np.array([(0.075, 0.0)]))) == 1


# --- sizes ---


def test_area_centroid_and_bounds(shape):
    dense = Outline(shape)
    u = np.arange(40_000) / 40_000 * dense.period
    z = dense.at(u)
    after = np.roll(z, -1, axis=0)
    twice = z[:, 0] * after[:, 1] - after[:, 0] * z[:, 1]
    np.testing.assert_allclose(shape.area, twice.sum() / 2, rtol=1e-6)  # a polygon's sagitta
    center = np.sum((z + after) * twice[:, None], axis=0) / (3 * twice.sum())
    np.testing.assert_allclose(shape.centroid, center, atol=1e-7)
    low, high = shape.bounds
    np.testing.assert_allclose([low, high], [z.min(axis=0), z.max(axis=0)], atol=1e-9)
    assert (low <= z.min(axis=0) + 1e-15).all()
    assert (high >= z.max(axis=0) - 1e-15).all()
    np.testing.assert_allclose(shape.perimeter, np.linalg.norm(after - z, axis=1).sum(), rtol=1e-6)


def test_the_boundary_is_equally_spaced(shape):
    points, dense = np.asarray(boundary(shape)), np.asarray(jax.jit(lambda s: s.boundary(8000))(shape))
    np.testing.assert_allclose(distances(shape, points), 0, atol=1e-15)
    # each of 2000 points is half way between the middle two of four of 8000
    one, other = (np.linalg.norm(points - dense[k::4], axis=1) for k in (1, 2))
    np.testing.assert_allclose(one, float(shape.perimeter) / 16_000, rtol=1e-3)
    np.testing.assert_allclose(one, other, rtol=1e-3)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    np.testing.assert_allclose(np.diff(arc[::400]), float(shape.perimeter) / 20, rtol=1e-4)
    after = np.roll(points, -1, axis=0)
    assert np.sum(points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]) > 0  # counterclockwise


def test_perimeter_of_an_ellipse():
    for a, b in ((0.05, 0.03), (0.1, 0.005), (0.1, 0.001)):
        np.testing.assert_allclose(Ellipse(a, b).perimeter, 4 * a * ellipe(1 - (b / a) ** 2), rtol=1e-10)
    assert float(Ellipse(0.05, 0.03).area) == pytest.approx(np.pi * 0.0015)


def test_area_and_centroid_far_from_the_origin():
    away = np.array([100.0, -50.0])
    near, far = (Curve((c).astype(np.float32)) for c in (CURVES["oval"], CURVES["oval"] + away))
    # the control points themselves are rounded to 4e-6 m there
    np.testing.assert_allclose(far.area, near.area, rtol=5e-4)
    np.testing.assert_allclose(far.centroid - away, near.centroid, atol=2e-5)


# --- constructors of curves ---


def test_stored_counter_clockwise(control):
    kept, flipped = Curve(control), Curve(control[::-1])
    np.testing.assert_array_equal(kept.control, control)
    np.testing.assert_array_equal(flipped.control, np.roll(control, 1, axis=0))
    assert float(flipped.area) == pytest.approx(float(kept.area), rel=1e-12)


def test_the_curve_is_that_of_scipy(control):
    np.testing.assert_allclose(
        distances(Curve(control), Outline(Curve(control)).points), 0, atol=1e-15
    )  # fmt: skip


def test_through_points():
    points = wavy(12, 4)
    curve = Curve.through(points)
    np.testing.assert_allclose(distances(curve, points), 0, atol=1e-15)
    np.testing.assert_allclose(Outline(curve).at(np.arange(12.0)), points, atol=1e-15)
    assert Curve.through(points[::-1]).convex == curve.convex
    assert Curve.through(points.astype(np.float32)).control.dtype == np.float32
    area = jax.jit(lambda p: Curve.through(p).area)
    slope = jax.jit(jax.grad(area))(points)
    ahead, behind = (area(points + s * np.eye(24)[5].reshape(12, 2)) for s in (1e-6, -1e-6))
    np.testing.assert_allclose(slope[2, 1], (ahead - behind) / 2e-6, rtol=1e-7)


def test_a_fit_recovers_a_curve_from_its_points():
    curve = Curve(CURVES["waisted"])
    points = Outline(curve).at(np.sort(np.random.default_rng(11).uniform(0, 24, 500)))
    fitted = Curve.fit(points, 24)
    assert np.abs(np.asarray(distances(fitted, points))).max() < 5e-5
    assert float(fitted.area) == pytest.approx(float(curve.area), rel=1e-4)
    ellipse = Curve.fit(boundary(Ellipse(0.05, 0.03))[::5], 24)
    assert ellipse.convex
    assert np.abs(np.asarray(distances(Ellipse(0.05, 0.03), boundary(ellipse)))).max() < 5e-5


def test_convexity_is_found_out():
    assert [name for name, c in CURVES.items() if Curve(c).convex] == ["oval"]
    assert [name for name, c in CURVES.items() if Curve(c.astype(np.float32)).convex] == ["oval"]
    assert not Curve(CURVES["oval"], convex=False).convex

    @jax.jit
    def flags(c):
        assert not Curve(c).convex
        assert Curve.through(c, convex=True).convex
        return Curve(c)

    np.testing.assert_array_equal(flags(CURVES["oval"]).control, CURVES["oval"])
    # a convex curve has no second touch, even if two are asked for
    points = scattered(Curve(CURVES["oval"]), 12, 100)
    outside = points[np.asarray(distances(Curve(CURVES["oval"]), points)) > 1e-5]
    first, second = candidates_at(Curve(CURVES["oval"], convex=False), outside)
    np.testing.assert_allclose(second.distance - first.distance, Curve(CURVES["oval"]).perimeter, rtol=1e-9)


def test_the_real_butterfly(data):
    """Fit 636 vertices of an outline whose corners, seven millimeters apart, turn by up to fifteen degrees."""
    path = data / "mit_push" / "abs_butter.npz"
    if not path.is_file():
        pytest.skip(f"{path} does not exist")
    vertices = np.load(path)["vertices_body"]
    curve, polygon = Curve.fit(vertices, 24), Polygon(vertices)
    assert not curve.convex
    off = 1e3 * np.abs(np.asarray(distances(curve, vertices)))
    # a smooth curve cannot follow the corners more closely than half their sagitta, 0.12 mm
    assert off.max() < 0.15
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert float(curve.area) == pytest.approx(float(polygon.area), rel=1e-4)
    low, high = curve.bounds
    np.testing.assert_allclose(high - low, np.ptp(vertices, axis=0), atol=5e-4)
    points = np.random.default_rng(13).uniform(-0.1, 0.1, (200, 2))
    np.testing.assert_allclose(distances(curve, points), distances(polygon, points), atol=2.5e-4)


def test_dtype_is_the_input_s():
    single = np.float32

    def results(shape, point):
        sizes = shape.area, shape.centroid, shape.bounds, shape.boundary(5), shape.perimeter
        outline, x = shape.outline(), Vec2.of(shape.centroid)
        return (
            shape,
            sizes,
            shape.closest([0.3, 0.2]),
            shape.closest(point),
            outline.contact_candidates(x),
        )

    for shape in (
        Ellipse(single(0.1), 0.05),
        Ellipse(0.1, 0.05, np.zeros(2, single)),
        Curve.fit(CURVES["waisted"].astype(single), 8),
    ):
        found = jax.eval_shape(results, shape, np.zeros(2, single))
        assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {np.dtype(single)}
        wide = jax.eval_shape(lambda s, x: s.closest(x), shape, np.zeros(2))
        assert wide[0].dtype == np.float64


EIGHT = np.stack([0.05 * np.cos(np.arange(12) * np.pi / 6), 0.05 * np.sin(np.arange(12) * np.pi / 3)], axis=1)
OVAL = CURVES["oval"]
BAD = {
    "semi_x": (lambda: Ellipse(0, 1), "semi_x must be positive"),
    "semi_y": (lambda: Ellipse(1, -1), "semi_y must be positive"),
    "semi_y NaN": (lambda: Ellipse(1, np.nan), "semi_y must be finite"),
    "semi_x array": (lambda: Ellipse([1.0, 2.0], 1), "semi_x has shape"),
    "center": (lambda: Ellipse(1, 1, (0, 0, 0)), "center has shape"),
    "center NaN": (lambda: Ellipse(1, 1, (0, np.nan)), "center"),
    "three": (lambda: Curve(OVAL[:3]), "control: a curve needs at least 4; got 3"),
    "NaN": (lambda: Curve(np.where(np.arange(8)[:, None] == 2, np.nan, OVAL)), r"control.*NaN.*\(2, 0\)"),
    "columns": (lambda: Curve(np.zeros((8, 3))), "control has shape"),
    "repeated": (lambda: Curve(OVAL[[0, 1, 1, 2, 3, 4, 5, 6, 7]]), "control: 1 and 2 are the same"),
    "closed": (lambda: Curve(OVAL[[0, 1, 2, 3, 4, 5, 6, 7, 0]]), "control: 8 and 0 are the same"),
    "no area": (lambda: Curve([(0, 0), (1, 0), (2, 0), (3, 0), (2.5, 0), (1.5, 0)]), "control: .*no area"),
    "eight": (lambda: Curve(EIGHT + [0.01, 0] * np.sin(np.arange(12))[:, None]), "control: .*"),
    "crossing": (lambda: Curve([(0, 0), (4, 0), (4, 3), (1, -2), (-1, -2), (0, 3)]), "control: .*crosses"),
    "not convex": (lambda: Curve(CURVES["waisted"], convex=True), "convex is True"),
    "through": (lambda: Curve.through(OVAL[:2]), "points: a curve needs"),
    "through repeated": (lambda: Curve.through(OVAL[[0, 0, 1, 2, 3, 4]]), "points: 0 and 1"),
    "fit few": (lambda: Curve.fit(OVAL, 5), "controls must be from 4 to .* 4; got 5"),
    "fit traced": (lambda: jax.jit(Curve.fit)(OVAL), "points are traced"),
    "point": (lambda: Curve(OVAL).closest(np.zeros(3)), "point has shape"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_values_do_not_raise():
    """Traced values cannot be checked; shapes are still checked."""

    @jax.jit
    def area(control, semi):
        return Curve(control).area + Ellipse(semi, 1.0).signed_distance(control[0])

    assert np.isnan(area(np.full((4, 2), np.nan), -1.0))
    with pytest.raises(ValueError, match="control has shape"):
        area(np.zeros((4, 3)), 1.0)
