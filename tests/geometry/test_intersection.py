"""Areas of intersections, compared with Shapely, and their derivatives with differences of Shapely's areas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax.geometry.intersection import intersection_area

shapely = pytest.importorskip("shapely")

T = np.array([(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)], float)
L = np.array([(0, 0), (100, 0), (100, 30), (30, 30), (30, 100), (0, 100)], float)
PLUS = 25.0 * np.array(
    [(1, 1), (1, 3), (-1, 3), (-1, 1), (-3, 1), (-3, -1), (-1, -1), (-1, -3), (1, -3), (1, -1), (3, -1), (3, 1)]
)


def star(vertices: int, seed: int) -> np.ndarray:
    """Return a star-shaped polygon about the origin, counterclockwise, mostly not convex."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(vertices) + rng.uniform(-0.4, 0.4, vertices)) / vertices
    return rng.uniform(20, 90, (vertices, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


PAIRS = {
    "T, T": (T, T),
    "L, L": (L, L),
    "plus, T": (PLUS, T),
    "star, L": (star(9, 1), L),
    "star, star": (star(13, 2), star(5, 3)),
}
RANDOM_PAIRS = 2000  # for each pair of shapes
# Relative to the smaller polygon. The coordinates are rounded to 1e-16 and 6e-8 of twice its size.
TOLERANCE = {np.float64: 1e-12, np.float32: 1e-5}
SHARED_EDGES = [
    (0, 0, 0),  # identical
    (0, 0, np.pi / 2),
    (0, 0, np.pi),
    (30, 0, 0),  # edges on one line, shared corners
    (0, 30, 0),
    (-30, 90, np.pi),
    (120, 0, 0),  # a whole edge touches from outside
    (15, 30, np.pi / 2),
    (60, 120, 0),  # one corner
    (1000, 0, 0.3),
    (0, 1e-13, 0),  # nearly identical
    (1e-13, 0, 1e-15),
    (1e-6, -1e-6, 1e-7),
]


def placed(vertices, pose):
    """Return vertices at a pose (x, y, angle), for one pose or an array of poses."""
    xp = jnp if isinstance(pose, jax.Array) else np
    c, s = xp.cos(pose[..., 2]), xp.sin(pose[..., 2])
    turn = xp.stack([xp.stack([c, s], axis=-1), xp.stack([-s, c], axis=-1)], axis=-2)
    return vertices @ turn + pose[..., None, :2]


@jax.jit
def compiled(first, second, first_poses, second_poses):
    def area(pose, other):
        return intersection_area(placed(first, pose), placed(second, other))

    return jax.vmap(jax.value_and_grad(area))(first_poses, second_poses)


def areas_and_gradients(first, second, first_poses, second_poses, dtype=np.float64):
    """Return areas and their gradients with respect to the first poses, both as NumPy arrays.

    All calls are padded to one size, with repeated vertices and poses, and share one compiled program.
    """
    padded = [np.concatenate([part, np.repeat(part[-1:], 13 - len(part), axis=0)]) for part in (first, second)]
    poses = [np.resize(part, (RANDOM_PAIRS, 3)) for part in (first_poses, second_poses)]
    area, gradient = compiled(*(jnp.asarray(part, dtype) for part in (*padded, *poses)))
    assert area.dtype == dtype
    return np.asarray(area)[: len(first_poses)], np.asarray(gradient)[: len(first_poses)]


def shapely_areas(first, second, first_poses, second_poses):
    a, b = shapely.polygons(placed(first, first_poses)), shapely.polygons(placed(second, second_poses))
    return shapely.area(shapely.intersection(a, b))


def random_poses(rng, count, spread):
    return np.concatenate([256 + rng.uniform(-spread, spread, (count, 2)), rng.uniform(-4, 4, (count, 1))], axis=1)


def smaller_area(first, second):
    return min(shapely.Polygon(first).area, shapely.Polygon(second).area)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("first", "second"), PAIRS.values(), ids=list(PAIRS))
def test_random_pairs_agree_with_shapely(first, second, dtype, rng):
    poses, others = (random_poses(rng, RANDOM_PAIRS, 60).astype(dtype) for _ in range(2))
    area, gradient = areas_and_gradients(first, second, poses, others, dtype)
    expected = shapely_areas(first, second, poses.astype(float), others.astype(float))
    assert np.mean(expected > 0) > 0.5
    np.testing.assert_allclose(area, expected, rtol=0, atol=TOLERANCE[dtype] * smaller_area(first, second))
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("base", [0.0, np.pi / 4, 0.7])
def test_shared_edges_and_corners(base, dtype, rng):
    c, s = np.cos(base), np.sin(base)
    shift = np.array(SHARED_EDGES)
    second_poses = np.tile([256.0, 256.0, base], (len(shift), 1))
    first_poses = second_poses + np.stack(
        [c * shift[:, 0] - s * shift[:, 1], s * shift[:, 0] + c * shift[:, 1], shift[:, 2]], axis=1
    )
    # Perturbations of the size of the roundoff, at which a test for inside and outside would be arbitrary.
    rounding = 4 * np.finfo(dtype).eps * np.array([256, 256, 4])
    repeated = np.repeat(first_poses, 100, axis=0)
    first_poses = np.concatenate([first_poses, repeated + rounding * rng.uniform(-1, 1, repeated.shape)])
    second_poses = np.tile(second_poses[:1], (len(first_poses), 1))
    area, gradient = areas_and_gradients(T, T, first_poses, second_poses, dtype)
    expected = shapely_areas(T, T, first_poses, second_poses)
    tolerance = 1e-12 if dtype == np.float64 else 2e-5  # the perturbed poses themselves are rounded to float32
    np.testing.assert_allclose(area, expected, rtol=0, atol=tolerance * 6300)
    assert np.all(np.isfinite(gradient))
    # A motion along an axis of the T moves it across at most 120 px of its outline.
    assert np.all(np.linalg.norm(gradient[:, :2], axis=1) < 170)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, 1e-7])
def test_contained_and_disjoint(angle):
    pose = np.array([[0.0, 0.0, angle]])
    small = 0.1 * star(7, 4) + np.array([0, 15])
    inside, _ = areas_and_gradients(small, T, pose, pose)
    np.testing.assert_allclose(inside, shapely.Polygon(small).area, rtol=1e-12)
    notch = np.array([30.0, 31.0]) + np.array([(0, 0), (20, 0), (20, 20), (0, 20)])  # beside the T's stem
    outside, gradient = areas_and_gradients(notch, T, pose, pose)
    np.testing.assert_allclose(outside, 0, atol=1e-9)
    np.testing.assert_allclose(gradient, 0, atol=1e-9)
    apart = pose + np.array([1e4, 0, 0])
    area, gradient = areas_and_gradients(small, T, apart, pose)
    assert area == 0
    assert np.all(gradient == 0)


@pytest.mark.parametrize("special", [False, True], ids=["any angle", "vertical edges"])
@pytest.mark.parametrize(("first", "second"), [(T, T), (star(9, 1), L)], ids=["T, T", "star, L"])
def test_gradient_agrees_with_differences_of_shapely(first, second, special, rng):
    poses, others = (random_poses(rng, RANDOM_PAIRS, 50) for _ in range(2))
    if special:
        poses[:, 2], others[:, 2] = np.pi / 2 * rng.integers(0, 4, RANDOM_PAIRS), 0
    _, gradient = areas_and_gradients(first, second, poses, others)

    def differences(step):
        return np.stack(
            [
                shapely_areas(first, second, poses + step * axis, others)
                - shapely_areas(first, second, poses - step * axis, others)
                for axis in np.eye(3)
            ],
            axis=1,
        ) / (2 * step)

    coarse, fine = differences(2e-5), differences(1e-5)
    scale = 120 * np.array([1, 1, 100])
    smooth = np.all(np.abs(coarse - fine) < 1e-6 * scale, axis=1)  # no kink within the steps
    assert np.mean(smooth) > 0.9
    np.testing.assert_allclose((gradient / scale)[smooth], (fine / scale)[smooth], atol=1e-6)


def test_clockwise_polygons_and_mirror_images():
    pose = np.array([40.0, 20.0, 0.3])
    other = placed(T, pose)
    expected = shapely.Polygon(T).intersection(shapely.Polygon(other)).area
    np.testing.assert_allclose(intersection_area(T[::-1], other[::-1]), expected, rtol=1e-12)
    mirror = np.array([1, -1])
    np.testing.assert_allclose(intersection_area(T * mirror, other * mirror), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("first", "message"),
    [
        (T[:2], "first: a polygon needs at least three vertices; got 2"),
        (T[:, 0], r"first has shape \(8,\)"),
        (T * np.nan, "first must be finite"),
        (T[::-1], "one polygon runs counterclockwise and the other clockwise"),
    ],
)
def test_invalid_arguments(first, message):
    with pytest.raises(ValueError, match=message):
        intersection_area(first, T)
