"""When a finger first touches a slider, compared with shapely, which shares no code."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

import pushjax as pj
from pushjax._math.vec import Vec2, Vec3
from pushjax.simulation.finger_motion import BodyFrame, FingerMotion
from pushjax.simulation.hand import Pad, RoundFinger
from pushjax.simulation.impact import time_of_impact

LENGTH = 0.04
ANGLE = 2 * np.pi * np.arange(14) / 14
STAR = np.where(np.arange(14) % 2, 0.02, 0.05)[:, None] * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
L = np.array([(0, 0), (120, 0), (120, 40), (40, 40), (40, 80), (0, 80)]) * 1e-3 - np.array([0.05, 0.03])
# with as many vertices as the star, so that they share programs
L = np.concatenate([np.linspace(L[0], L[1], 9, endpoint=False), L[1:]])
WAVY = (0.04 + 0.008 * np.cos(4 * ANGLE))[:, None] * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
SHAPES = {
    "disk": pj.Disk(0.045, (0.01, 0.0)),
    "ellipse": pj.Ellipse(0.06, 0.02),
    "square": pj.Polygon.rectangle(0.09, 0.09),
    "L": pj.Polygon(L),
    "star": pj.Polygon(STAR),
    "oval": pj.Curve(0.05 * np.array([1.4, 1.0]) * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)),
    "wavy": pj.Curve.through(WAVY),
}
PAD = Pad(pj.Polygon.rectangle(0.05, 0.01))


@functools.cache
def body(name: str) -> shapely.Polygon:
    """Return an outline as a dense polygon; its own vertices if it is one."""
    shape = SHAPES[name]
    return shapely.Polygon(shape.vertices if isinstance(shape, pj.Polygon) else shape.boundary(20_000))


def fraction(shape, finger, start, path, angle=None, turning=None):
    """Return the fraction after which a finger touches, from a start and along a path, (2,)."""
    zero = jnp.zeros_like(start[0])
    motion = FingerMotion(finger, zero, Vec2.of(start), Vec2.of(path), angle, turning)
    outline, frame = shape.outline(), BodyFrame.at(Vec3(zero, zero, zero))
    return time_of_impact((motion,), outline, frame, jnp.full_like(zero, LENGTH))


PATHS = 300  # of every batch
straight = jax.jit(jax.vmap(fraction, (None, None, 0, 0)))
turned_fractions = jax.jit(jax.vmap(fraction, (None, None, 0, 0, 0, 0)))


def fractions(shape, finger, start, path) -> np.ndarray:
    rows = (np.resize(x, (PATHS, 2)) for x in (start, path))
    return np.asarray(straight(shape, finger, *rows))[: len(start)]


def random_paths(rng, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and paths, (count, 2), from 1 mm to 1 m: all the way through. Half of them aim at the slider."""
    start, path = rng.uniform(-0.2, 0.2, (count, 2)), rng.normal(size=(count, 2)) * 10 ** rng.uniform(-3, 0, (count, 1))
    aimed = rng.uniform(0.8, 2, (count, 1)) * (rng.uniform(-0.05, 0.05, (count, 2)) - start)
    return start, np.where(np.arange(count)[:, None] % 2, aimed, path)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("radius", [0.0, 0.00475, 0.03])
@pytest.mark.parametrize("name", list(SHAPES))
def test_a_round_finger_touches_where_shapely_says(name, radius, dtype, rng):
    """It never touches earlier; and if pieces of the slider are known to be convex, never later."""
    shape = jax.tree.map(lambda leaf: leaf.astype(dtype), SHAPES[name])
    start, path = (x.astype(dtype) for x in random_paths(rng, PATHS))
    other = body(name)
    outside = shapely.distance(other, shapely.points(start)) > radius + 1e-5
    start, path = start[outside], path[outside]
    found = fractions(shape, RoundFinger(dtype(radius)), start, path)
    assert found.dtype == dtype
    end = start + found[:, None] * path.astype(float)
    free = shapely.linestrings(np.stack([start, end], axis=1))
    close, size = 2e-7 if dtype == np.float64 else 2e-6, 1 + np.linalg.norm(path, axis=1) / 0.2
    assert np.all(shapely.distance(other, free) >= radius - close * size)
    if radius == 0:
        assert np.all(shapely.length(shapely.intersection(other, free)) < 1e-4)
    gap = shapely.distance(other, shapely.points(end)) - radius
    hits = found < 1
    assert 20 < hits.sum() < len(hits) - 20
    if name == "wavy":
        assert np.mean(gap[hits] < 1e-4) > 0.95
    else:
        assert np.all(gap[hits] < close * size[hits])


@pytest.mark.parametrize(
    ("name", "dtype"),
    [*((name, np.float64) for name in ("square", "L", "ellipse", "wavy")), ("L", np.float32), ("wavy", np.float32)],
)
def test_a_pad_that_turns_touches_where_shapely_says(name, dtype, rng):
    """On its way, which is an arc, it does not pass through; and a pad that stops early is near."""
    shape = jax.tree.map(lambda leaf: leaf.astype(dtype), SHAPES[name])
    start, path = random_paths(rng, 60)
    path /= np.maximum(1, np.linalg.norm(path, axis=1, keepdims=True) / 0.3)
    angle, turning = rng.uniform(-3, 3, 60), rng.uniform(-1, 1, 60)
    other, corners = body(name), np.asarray(PAD.shape.vertices, float)
    pad = jax.tree.map(lambda leaf: leaf.astype(dtype), PAD)
    numbers = (x.astype(dtype) for x in (start, path, angle, turning))
    found = np.asarray(turned_fractions(shape, pad, *numbers), float)

    def placed(k, t):
        chord = path[k] * np.sin(t * turning[k] / 2) / np.sin(turning[k] / 2)
        bend = (t - 1) * turning[k] / 2
        center = start[k] + chord @ np.array([[np.cos(bend), np.sin(bend)], [-np.sin(bend), np.cos(bend)]])
        now = angle[k] + t * turning[k]
        return shapely.Polygon(center + corners @ np.array([[np.cos(now), np.sin(now)], [-np.sin(now), np.cos(now)]]))

    gaps = []
    for k in range(60):
        if placed(k, 0.0).distance(other) > 1e-5:
            assert min(placed(k, t).distance(other) for t in np.linspace(0, found[k], 60)[:-1]) > 0
            overlap = placed(k, found[k]).intersection(other)
            assert overlap.is_empty or shapely.maximum_inscribed_circle(overlap).length < 3e-6
            if found[k] < 1:
                gaps.append(placed(k, found[k]).distance(other))
    assert len(gaps) > 8
    assert np.median(gaps) < 1e-6
    assert np.mean(np.array(gaps) < 1e-3) > 0.85


@pytest.mark.parametrize("name", ["square", "star", "ellipse"])
def test_derivatives_of_the_instant(name, rng):
    shape, finger = SHAPES[name], RoundFinger(0.004)
    start = 0.15 * np.exp(1j * rng.uniform(0, 2 * np.pi, 100))
    start = np.stack([start.real, start.imag], axis=1)
    path = -2 * start + rng.normal(size=(100, 2)) * 0.02
    slopes = jax.jit(jax.vmap(jax.grad(fraction, argnums=(0, 1, 2, 3)), (None, None, 0, 0)))
    slope = slopes(shape, finger, start, path)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    step = 1e-6 * np.eye(2)
    for k in range(2):
        ahead, behind = (fractions(shape, finger, start + s * step[k], path) for s in (1, -1))
        difference = (ahead - behind) / 2e-6
        off = np.abs(slope[2][:, k] - difference) / (1 + np.abs(difference))
        assert np.mean(off < 1e-4) > 0.95  # except if it grazes or changes edges within the step


@pytest.mark.parametrize("name", list(SHAPES))
def test_a_finger_that_touches_begins_at_once(name):
    """It does so whether it is pushed on or pulled away; one that rests elsewhere never touches."""
    shape, radius = SHAPES[name], 0.00475
    on = np.asarray(shape.boundary(40))
    normal = np.asarray(jax.vmap(lambda x: shape.closest(x)[2])(jnp.asarray(on)))
    found = fractions(shape, RoundFinger(radius), on + radius * normal, -0.02 * normal)
    np.testing.assert_allclose(found, 0, atol=1e-6)
    still = fractions(shape, RoundFinger(radius), on + 2 * radius * normal, 0 * normal)
    np.testing.assert_array_equal(still[still > 0], 1)
    assert np.mean(still == 1) > 0.7


@pytest.mark.parametrize("name", ["square", "L", "ellipse", "wavy"])
def test_a_path_that_is_nan_begins_at_once(name):
    """The fraction itself is a number; what follows makes the step INVALID."""
    start, path = np.array([[0.2, 0.0], [0.2, 0.0]]), np.array([[np.nan, 0.0], [-0.3, 0.0]])
    found = fractions(SHAPES[name], RoundFinger(0.005), start, path)
    assert found[0] == 0
    assert 0 < found[1] < 1
