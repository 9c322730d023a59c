"""Coulomb friction of support points: direct sums, the principle of maximum dissipation, statics, grids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax import Disk, Ellipse, Polygon, Support
from pushjax.friction.support_grid import _distances

ROUNDINGS = 200  # sums over some hundred points
DTYPES = [np.float32, np.float64]
# Four standard errors of the statistics below; randomness is seeded.
SIGMAS = 4


@pytest.fixture(scope="module")
def support() -> Support:
    rng = np.random.default_rng(0)
    return Support(rng.uniform(-0.05, 0.05, (15, 2)), rng.uniform(0.1, 1, 15))


wrenches = jax.jit(jax.vmap(lambda s, v: s.wrench(v), (None, 0)))
drawn = jax.jit(jax.vmap(lambda s, v, key: s.wrench(v, key), (None, None, 0)))
contained = jax.jit(jax.vmap(lambda shape, x: shape.contains(x), (None, 0)))


def brute_wrench(support: Support, twist: np.ndarray) -> np.ndarray:
    """Sum the wrench point by point, in complex numbers."""
    total = np.zeros(3)
    for (x, y), limit in zip(np.asarray(support.point, np.float64), np.asarray(support.limit), strict=True):
        r = x + 1j * y
        v = twist[0] + 1j * twist[1] + 1j * twist[2] * r
        f = limit * v / abs(v)
        total += [f.real, f.imag, (r.conjugate() * f).imag]
    return total


def about(point, spin: float = 1.0) -> np.ndarray:
    """Return the twist that rotates about `point`."""
    return spin * np.array([point[1], -point[0], 1.0])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])  # only the direction of the twist matters
def test_wrench_is_the_sum_over_the_points(support, dtype, scale):
    twist = np.random.default_rng(1).normal(size=(40, 3)) * [0.05, 0.05, 1]
    typed = jax.tree.map(lambda leaf: leaf.astype(dtype), support)
    found = wrenches(typed, (scale * twist).astype(dtype))
    assert found.dtype == dtype
    expected = np.array([brute_wrench(support, v) for v in twist])
    # float32 rounds the points; near the center of rotation this rotates their velocity
    np.testing.assert_allclose(found, expected, atol=ROUNDINGS * np.finfo(dtype).eps * float(support.load))


def test_translation_gives_the_load_at_its_center(support):
    (force,) = np.asarray(wrenches(support, np.array([[2.0, 0, 0]])))
    np.testing.assert_allclose(force, [support.load, 0, -support.load * support.center[1]], rtol=1e-12)
    np.testing.assert_allclose(support.load, np.sum(support.limit), rtol=1e-14)
    np.testing.assert_allclose(support.center, np.average(support.point, axis=0, weights=support.limit), rtol=1e-12)


def test_radius_of_gyration(support):
    offset = np.asarray(support.point) - np.average(support.point, axis=0, weights=support.limit)
    squared = np.average(np.sum(offset**2, axis=1), weights=support.limit)
    np.testing.assert_allclose(support.radius_of_gyration, np.sqrt(squared), rtol=1e-12)
    fine = Support.uniform(Polygon.rectangle(0.09, 0.06), 5400)
    np.testing.assert_allclose(fine.radius_of_gyration, np.hypot(0.09, 0.06) / np.sqrt(12), rtol=1e-3)


def test_facet(support):
    """In a rotation about a support point, its friction is any force up to its limit: a flat facet of that radius."""
    r, limit = np.asarray(support.point)[4], float(support.limit[4])
    v = about(r)
    (middle,) = np.asarray(wrenches(support, v[None]))
    others = Support(np.delete(support.point, 4, axis=0), np.delete(support.limit, 4))
    np.testing.assert_allclose(middle, brute_wrench(others, v), atol=1e-12)

    count = 500
    keys = jax.random.split(jax.random.key(0), count)
    away = np.asarray(drawn(support, v, keys)) - middle
    np.testing.assert_allclose(away[:, 2], r[0] * away[:, 1] - r[1] * away[:, 0], atol=1e-12)  # a force at that point
    size = np.hypot(away[:, 0], away[:, 1]) / limit
    assert size.max() <= 1 + 1e-9
    # uniform over a disk: the square of the radius is uniform on (0, 1), and directions cancel
    assert abs(np.mean(size**2) - 0.5) < SIGMAS / np.sqrt(12 * count)
    assert (np.abs(np.mean(away[:, :2], axis=0)) < SIGMAS * limit / 2 / np.sqrt(count)).all()
    np.testing.assert_allclose(away @ v, 0, atol=1e-12)  # all wrenches of a facet have the same power


def test_wrenches_dissipate_most(support):
    """(F - F') . V >= 0 for the wrench F of V and any F' within the friction limits, facets included."""
    rng = np.random.default_rng(2)
    free = rng.normal(size=(100, 3)) * [0.05, 0.05, 1]
    pivots = np.array([about(r, s) for r in np.asarray(support.point) for s in (1, -1)])
    twist = np.concatenate([free, pivots])
    keys = jax.random.split(jax.random.key(1), len(twist))
    wrench = np.asarray(jax.jit(jax.vmap(support.wrench))(twist, keys))
    assert not np.allclose(wrench[100:], wrenches(support, pivots))  # these are sampled from the facets
    gain = np.einsum("ik,ik->i", wrench, twist)[:, None] - twist @ wrench.T
    assert gain.min() > -1e-12
    assert np.diag(gain) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
def test_pairs(dtype):
    support = Support.uniform(Polygon.rectangle(dtype(0.09), 0.09), 64, load=3.0)
    pairs = support.wrench_twist_pairs(jax.random.key(3), 400)
    assert {leaf.dtype for leaf in jax.tree.leaves(pairs)} == {np.dtype(dtype)}
    np.testing.assert_allclose(pairs.length, support.radius_of_gyration, rtol=1e-6)
    wrench, twist = np.asarray(pairs.wrench, np.float64), np.asarray(pairs.twist, np.float64)
    scaled = twist * [1, 1, float(pairs.length)]
    np.testing.assert_allclose(np.linalg.norm(scaled, axis=1), 1, rtol=1e-6)

    # some pairs rotate about a support point: those whose center of rotation is one
    center = np.stack([-twist[:, 1], twist[:, 0]], axis=1) / twist[:, 2:]
    gap = np.linalg.norm(center[:, None] - np.asarray(support.point, np.float64), axis=-1).min(axis=1)
    facet = gap < 1e-6
    assert facet.sum() == 40
    assert len(np.unique(np.round(center[facet], 5), axis=0)) > 20
    assert 5 < (twist[facet, 2] > 0).sum() < 35
    assert 5 < facet[:200].sum() < 35  # in random order

    # The others have the wrench of their own twist. The wrenches on facets are not all at the facet's middle.
    own = np.array([brute_wrench(support, v) for v in twist[~facet]])
    np.testing.assert_allclose(wrench[~facet], own, atol=1e-3 if dtype == np.float32 else 1e-10)
    middle = np.asarray(wrenches(support, pairs.twist))[facet]
    assert (np.abs(wrench[facet] - middle).max(axis=1) > 1e-4).mean() > 0.9

    # uniform directions: each mean square is a third
    free = scaled[~facet]
    assert (np.abs(np.mean(free**2, axis=0) - 1 / 3) < SIGMAS * np.sqrt(4 / 45 / len(free))).all()
    assert (np.abs(np.mean(free, axis=0)) < SIGMAS / np.sqrt(3 * len(free))).all()


def test_pairs_are_on_the_limit_surface_and_repeat_by_their_key(support):
    one, same, other = (support.wrench_twist_pairs(jax.random.key(k), 200) for k in (4, 4, 1))
    gain = np.einsum("ik,ik->i", one.wrench, one.twist)[:, None] - np.asarray(one.twist) @ one.wrench.T
    assert gain.min() > -1e-12
    np.testing.assert_array_equal(one.wrench, same.wrench)
    np.testing.assert_array_equal(one.twist, same.twist)
    assert not np.isclose(one.twist, other.twist).all(axis=1).any()


def test_length_of_pairs(support):
    pairs = support.wrench_twist_pairs(jax.random.key(0), 200, length=0.2)
    assert float(pairs.length) == 0.2
    np.testing.assert_allclose(np.linalg.norm(pairs.twist * np.array([[1, 1, 0.2]]), axis=1), 1, rtol=1e-12)
    for load in (0.7, 1.3, 14.9):  # one point has no radius of gyration
        alone = Support.points([(0.031, 0.0237)], load=load).wrench_twist_pairs(jax.random.key(0), 50)
        assert float(alone.length) == 1
        assert np.isfinite(alone.wrench).all()


def test_load_scales_the_wrench():
    one, ten = (Support.uniform(Disk(0.05), 60, load=load) for load in (1.0, 10.0))
    twist = np.array([[0.01, 0.02, 0.5]])
    np.testing.assert_allclose(wrenches(ten, twist), 10 * wrenches(one, twist), rtol=1e-12)
    np.testing.assert_allclose([one.load, ten.load], [1, 10], rtol=1e-14)
    weighted = Support.points([(0, 0), (1, 0)], weights=[1, 3], load=2)
    np.testing.assert_allclose(weighted.limit, [0.5, 1.5])


def test_zero_twist(support):
    np.testing.assert_array_equal(wrenches(support, np.zeros((1, 3))), 0)
    np.testing.assert_array_equal(drawn(support, np.zeros(3), jax.random.split(jax.random.key(0), 500)), 0)


def test_gradient_at_a_facet_is_finite(support):
    slope = jax.jit(jax.jacfwd(lambda s, v: s.wrench(v), argnums=(0, 1)))(support, about(support.point[4]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


# --- where the points are ---


def test_square_grid():
    support = Support.uniform(Polygon.rectangle(0.08, 0.08), points=64)
    cells = (np.arange(8) + 0.5) * 0.01 - 0.04
    expected = np.stack(np.meshgrid(cells, cells, indexing="ij"), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(support.point, expected, atol=1e-15)
    np.testing.assert_allclose(support.limit, 1 / 64, rtol=1e-14)


@pytest.mark.parametrize(("size", "points"), [((0.06, 0.04), 6), ((0.06, 0.04), 54), ((0.1, 0.05), 50)])
def test_grid_of_a_rectangle_is_exact(size, points):
    assert len(Support.uniform(Polygon.rectangle(*size), points).point) == points


ARROW = [(0.06, 0.0), (-0.05, 0.05), (-0.02, 0.0), (-0.05, -0.05)]


@pytest.mark.parametrize(
    "shape", [Disk(0.05, (0.01, 0)), Polygon([(-0.03, -0.05), (0.0605, 0), (-0.03, 0.05)]), Polygon(ARROW)]
)
@pytest.mark.parametrize("points", [40, 300])
def test_grid_of_a_shape(shape, points):
    support = Support.uniform(shape, points, load=2.0)
    assert abs(len(support.point) - points) <= 0.15 * points
    assert np.asarray(contained(shape, np.resize(support.point, (400, 2)))).all()
    np.testing.assert_allclose(support.load, 2, rtol=1e-12)
    # the outline cuts cells, which are kept or dropped as a whole: this moves the center by a fraction of a cell
    np.testing.assert_allclose(support.center, shape.centroid, atol=0.2 * float(shape.area / points) ** 0.5)


def test_rim():
    support = Support.rim(Disk(0.05), points=36, load=3.0)
    np.testing.assert_allclose(np.linalg.norm(support.point, axis=1), 0.05)
    np.testing.assert_allclose(wrenches(support, np.array([[0, 0, -1.0]])), [[0, 0, -0.05 * 3]], atol=1e-12)
    np.testing.assert_allclose(support.radius_of_gyration, 0.05)


@pytest.mark.parametrize("dtype", DTYPES)
def test_tripod_statics(dtype):
    """Forces and moments of the three shares of the load balance the weight."""
    rng = np.random.default_rng(5)
    for flip in (1, -1):
        point = np.array([(0.05, 0.01), (-0.03, 0.04), (-0.02, -0.05)])[::flip]
        share = rng.dirichlet(np.ones(3))
        support = Support.tripod(point.astype(dtype), load=dtype(2.0), center=(share @ point).astype(dtype))
        assert support.limit.dtype == dtype
        np.testing.assert_allclose(support.limit, 2 * share, atol=ROUNDINGS * np.finfo(dtype).eps)
    corner = Support.tripod(point.astype(dtype), center=point[1].astype(dtype))
    np.testing.assert_allclose(corner.limit, [0, 1, 0], atol=ROUNDINGS * np.finfo(dtype).eps)


def test_dtype_is_the_points():
    point = np.ones((3, 2), np.float32) * [[0], [1], [2]]
    single = point.astype(np.float32)
    for support in (
        Support(single, [1, 1, 1]),
        Support([(0, 0), (1, 0), (0, 1)], np.ones(3, np.float32)),
        Support.points(single, [1, 2, 3], 2.0),
        Support.rim(Disk(np.float32(1)), 5),
    ):
        assert support.point.dtype == support.limit.dtype == np.float32
        wrench = jax.eval_shape(lambda support: support.wrench([0, 0, 1]), support)
        assert wrench.dtype == support.radius_of_gyration.dtype == np.float32


THREE = np.array([(0, 0), (1, 0), (0, 1.0)])
BAD = {
    "point shape": (lambda: Support(np.zeros((3, 3)), np.ones(3)), "point has shape"),
    "limit shape": (lambda: Support(THREE, np.ones(2)), "limit has shape"),
    "negative limit": (lambda: Support(THREE, [1, 1, -1]), "limit must not be negative"),
    "no limit": (lambda: Support(THREE, np.zeros(3)), "limit.*at least one"),
    "NaN": (lambda: Support(THREE * np.nan, np.ones(3)), "point must be finite"),
    "NaN limit": (lambda: Support(THREE, [1, np.nan, 1]), "limit must be finite"),
    "weights": (lambda: Support.points(THREE, np.ones(4)), "weights has shape"),
    "negative weights": (lambda: Support.points(THREE, [1, 1, -1]), "weights"),
    "no weights": (lambda: Support.points(THREE, [0, 0, 0]), "weights must not all be zero"),
    "no load": (lambda: Support.points(THREE, load=0), "load must be positive"),
    "load NaN": (lambda: Support.points(THREE, load=np.nan), "load must be finite"),
    "loads": (lambda: Support.points(THREE, load=np.ones(3)), "load has shape"),
    "tripod": (lambda: Support.tripod(np.zeros((4, 2))), "point has shape"),
    "tripod outside": (lambda: Support.tripod(THREE, center=(1, 1)), "center must lie inside"),
    "tripod center": (lambda: Support.tripod(THREE, center=(1, 1, 1)), "center has shape"),
    "tripod NaN": (lambda: Support.tripod(THREE, center=(np.nan, 1)), "center must be finite"),
    "tripod line": (lambda: Support.tripod([(0, 0), (1, 1), (2, 2)]), "point.*on a line"),
    "uniform": (lambda: Support.uniform(Disk(1), 0), "points must be a whole number, at least 1"),
    "rim": (lambda: Support.rim(Disk(1), 0), "points must be a whole number, at least 1"),
    "uniform load": (lambda: Support.uniform(Disk(1), 4, load=-1), "load must be positive"),
    "twist": (lambda: Support(THREE, np.ones(3)).wrench(np.zeros(2)), "twist has shape"),
    "twist NaN": (lambda: Support(THREE, np.ones(3)).wrench([0, 0, np.nan]), "twist must be finite"),
    "pairs": (
        lambda: Support.points(THREE).wrench_twist_pairs(jax.random.key(0), 0),
        "pairs must be a whole number, at least 1",
    ),
    "length": (lambda: Support.points(THREE).wrench_twist_pairs(jax.random.key(0), 5, 0.0), "length must be positive"),
    "lengths": (lambda: Support.points(THREE).wrench_twist_pairs(jax.random.key(0), 5, [1, 1]), "length has shape"),
    "traced": (lambda: jax.jit(lambda r: Support.uniform(Disk(r)).load)(1.0), "shape must be known"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_traced_values_do_not_raise():
    load = jax.jit(lambda limit: Support(jnp.zeros((2, 2)), limit).load)(np.array([-1.0, 0.5]))
    assert float(load) == -0.5


def test_uniform_pressure_is_centered_on_the_centroid():
    """Cells that slanted edges cut carry their share: without it, the center was off by 1.5 mm, and not symmetric."""
    triangle = Polygon([[0.0, 0.0], [0.15, 0.0], [0.0, 0.15]])
    for points in (64, 100, 400):
        support = Support.uniform(triangle, points=points)
        center = np.asarray(support.center)
        # sampling leaves an error of at most a sixteenth of a cell along the outline
        assert np.allclose(center, triangle.centroid, atol=0.15 / np.sqrt(points) / 16)
        assert center[0] == pytest.approx(center[1], abs=1e-9)
        assert abs(len(support.point) - points) <= 0.1 * points


@pytest.mark.parametrize(
    "shape",
    [
        Disk(0.05, (0.01, 0.02)),
        Ellipse(0.06, 0.03, (0.01, 0.0)),
        Polygon([[0.0, 0.0], [0.09, 0.0], [0.09, 0.03], [0.03, 0.03], [0.03, 0.09], [0.0, 0.09]]),
    ],
    ids=["disk", "ellipse", "L"],
)
def test_what_is_inside_agrees_with_the_distance(shape):
    """Points are classified with NumPy as by the signed distance that contacts use, on the outline too."""
    outline = np.asarray(jax.jit(lambda: shape.boundary(40))())
    points = np.concatenate([np.random.default_rng(0).uniform(-0.08, 0.1, (500, 2)), outline, [shape.centroid]])
    distance = np.asarray(jax.jit(jax.vmap(shape.signed_distance))(points))
    found = _distances(shape, points)
    np.testing.assert_array_equal(found < -1e-9, distance < -1e-9)
    np.testing.assert_array_equal(found > 1e-9, distance > 1e-9)
    assert (np.abs(found[500:540]) <= 1e-9).all()
    assert 0 < (found < 0).sum() < 500
    # beyond the outline they may be too small, never too large: no cell is left out that has a part inside
    assert np.all(found <= np.maximum(distance, 1e-9) * (1 + 1e-6))


def test_a_thin_strip_askew_takes_memory_in_proportion_to_its_length():
    width = np.array([1e-4, 1e-6])[:, None, None]
    along, across = np.array([0.8, 0.6]) * 0.15, np.array([-0.6, 0.8]) / 2
    strips = np.array([-1, 1, 1, -1])[:, None] * along + np.array([-1, -1, 1, 1])[:, None] * across * width
    support = Support.uniform(Polygon(strips[0]))
    np.testing.assert_allclose(support.center, 0, atol=1e-6)
    np.testing.assert_allclose(support.radius_of_gyration, 0.3 / np.sqrt(12), rtol=0.01)
    with pytest.raises(ValueError, match="shape covers too little of the box around it"):
        Support.uniform(Polygon(strips[1]))
