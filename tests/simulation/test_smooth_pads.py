"""Pads against smooth outlines: the points that face them, when they meet, and where a jaw closes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax._math.vec import Vec2, Vec3
from pushjax.experiments.grasps import butterfly
from pushjax.simulation.candidate import FingerPose
from pushjax.simulation.detection import pair_of
from pushjax.simulation.finger_motion import BodyFrame, FingerMotion
from pushjax.simulation.hand import Pad
from pushjax.simulation.impact import time_of_impact

SEMI = np.array([0.02, 0.014])
LENGTH = 0.015


def wavy() -> pj.Curve:
    """Return a curve with four hollows of different depths."""
    angle = 2 * np.pi * np.arange(32) / 32
    r = 0.02 + 0.003 * np.cos(4 * angle) + 0.001 * np.cos(3 * angle)
    return pj.Curve.through(np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1))


@functools.cache
def shapes():
    disk, square = pj.Disk(0.02, center=(0.002, -0.001)), pj.Polygon.rectangle(0.03, 0.03)
    angle = np.pi * np.arange(10) / 5
    star = np.where(np.arange(10) % 2, 0.009, 0.02)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    smooth = {"ellipse": pj.Ellipse(*SEMI, center=(0.002, -0.001)), "curve": wavy(), "butterfly": butterfly().shape}
    return smooth | {"disk": disk, "square": square, "star": pj.Polygon(star)}


@functools.cache
def dense(name: str, count: int = 40_000) -> np.ndarray:
    return np.asarray(jax.jit(lambda shape: shape.boundary(count))(shapes()[name]))


@functools.cache
def outline_of(name: str):
    return eqx.filter_jit(lambda shape: shape.outline())(shapes()[name])


@eqx.filter_jit
def facing_all(shape, directions):
    return jax.vmap(lambda d: shape.outline().facing(Vec2.of(d)))(directions)


@pytest.mark.parametrize("name", ["ellipse", "curve", "butterfly", "disk"])
def test_facing_is_every_place_that_stands_out(name):
    """`facing` finds all local maxima of the height over a direction where a dense outline is convex, and no others."""
    points = dense(name)
    # the outward normal: clockwise from the direction of travel
    velocity = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    # the axes of the ellipse and of the butterfly are where their pieces join
    angle = np.concatenate([np.linspace(0.01, 6.2, 12), np.arange(4) * np.pi / 2])
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = jax.tree.map(np.asarray, facing_all(shapes()[name], directions))
    for k, d in enumerate(directions):
        height = points @ d
        outward = velocity[:, 1] * d[0] - velocity[:, 0] * d[1] > 0
        peaks = (height > np.roll(height, 1)) & (height >= np.roll(height, -1)) & outward
        mine = np.stack([found.point.x[k], found.point.y[k]], axis=1)[found.valid[k]]
        assert len(np.unique(np.round(mine / 1e-5), axis=0)) >= peaks.sum() > 0
        apart = np.linalg.norm(mine[:, None] - points[peaks][None], axis=-1)
        assert np.all(apart.min(axis=1) < 1e-5)
        assert np.all(apart.min(axis=0) < 1e-5)


def test_derivatives_of_facing():
    @jax.jit
    def point(angle):
        facing = wavy().outline().facing(Vec2(jnp.cos(angle), jnp.sin(angle)))
        return jnp.stack([jnp.where(facing.valid, facing.point.x, 0.0), jnp.where(facing.valid, facing.point.y, 0.0)])

    angle, h = 0.7, 1e-6
    slope = jax.jit(jax.jacfwd(point))(angle)
    np.testing.assert_allclose(slope, (point(angle + h) - point(angle - h)) / (2 * h), atol=1e-8)
    assert np.abs(np.asarray(slope)).max() > 1e-3


def pad() -> Pad:
    return pj.Hand.parallel_jaw(0.027, 0.010).fingers[0]


@eqx.filter_jit
def depth_of(finger, outline, pose):
    return -pair_of(finger, outline).distance(finger, outline, pose)[0]


@eqx.filter_jit
def candidates(finger, outline, pose, displacement):
    """Return where a pad and an outline may touch, with a pad that moves as a whole."""
    found = pair_of(finger, outline).candidates(finger, outline, pose, lambda _: displacement, jnp.asarray(LENGTH))
    return found.touches


def inside(points: np.ndarray, bounds, center, turn: float) -> float:
    """Return the deepest overlap by brute force: outline points in the pad, from `bounds`, about `center`."""
    cos, sin = np.cos(turn), np.sin(turn)
    local = (points - center) @ np.array([[cos, -sin], [sin, cos]])
    return float(np.max(np.minimum(local - bounds[0], bounds[1] - local).min(axis=1)))


def placed(x, y, turn) -> FingerPose:
    return FingerPose(Vec2(jnp.asarray(x), jnp.asarray(y)), Vec2(jnp.asarray(np.cos(turn)), jnp.asarray(np.sin(turn))))


@pytest.mark.parametrize("name", ["ellipse", pytest.param("butterfly", marks=pytest.mark.slow)])
def test_meets_where_brute_force_does(name, rng):
    finger, points = pad(), dense(name, 4000)
    outline, bounds = outline_of(name), [np.asarray(b) for b in finger.shape.bounds]
    resting, zero = BodyFrame.at(Vec3(*jnp.zeros(3))), jnp.zeros(())

    def met_at(center, angle, path):
        motion = FingerMotion(finger, zero, center, path, angle, zero)
        return time_of_impact((motion,), outline, resting, jnp.asarray(LENGTH))

    met = jax.jit(met_at)
    hits = 0
    for _ in range(25):
        turn, aside = rng.uniform(-0.6, 0.6), rng.uniform(-0.03, 0.03)
        at, path = placed(aside, 0.04, turn), Vec2(jnp.asarray(rng.uniform(-0.01, 0.01)), jnp.asarray(-0.05))
        start = float(met(at.center, jnp.asarray(turn), path))
        shares, begin, way = np.linspace(0, 1, 101), np.array([aside, 0.04]), np.array([float(path.x), float(path.y)])
        depth = np.array([inside(points, bounds, begin + share * way, turn) for share in shares])
        first = shares[np.argmax(depth > 0)] if (depth > 0).any() else 1.0
        hits += start < 1
        # brute force uses outline points only, and detects late a corner that enters between two of them
        assert start - 0.002 <= first <= start + 0.0125 or (first == 1.0 and start > 0.98)
        touching = placed(*(begin + start * way), turn)
        if start < 1:
            assert abs(float(depth_of(finger, outline, touching))) < 1e-9
    assert hits > 10


@pytest.mark.parametrize("name", ["ellipse", "butterfly"])
def test_places_are_at_their_distance(name):
    """With a pad over the outline, contacts lie on it, at their stated distance from the pad along the normal."""
    outline, finger, points = outline_of(name), pad(), dense(name)
    still = Vec2(jnp.zeros(()), jnp.zeros(()))
    for aside, turn in ((0.0, 0.0), (0.004, 0.1), (0.016, -0.2), (0.02, 0.3)):
        at = placed(aside, 0.025, turn)
        touches = jax.tree.map(np.asarray, candidates(finger, outline, at, still))
        near = np.flatnonzero(touches.exists)
        assert near.size
        for k in near:
            point = np.array([touches.point.x[k], touches.point.y[k]])
            assert np.linalg.norm(points - point, axis=1).min() < 1e-5
            assert np.hypot(touches.normal.x[k], touches.normal.y[k]) == pytest.approx(1)
        deepest = float(depth_of(finger, outline, at))
        assert np.min(touches.distance[near]) == pytest.approx(-deepest, abs=1e-9)


@pytest.mark.parametrize("name", ["ellipse", "butterfly", "disk", "square", "star"])
def test_the_gradient_of_an_overlap_has_length_one(name, rng):
    """The derivative of a maximum must not lose parts where the compiler rounds what it compares in two ways."""
    outline = outline_of(name)

    def depth(center, turn):
        pose = FingerPose(Vec2.of(center), Vec2(jnp.cos(turn), jnp.sin(turn)))
        return depth_of(pad(), outline, pose)

    centers, turns = rng.uniform(-0.035, 0.035, (400, 2)), rng.uniform(-3, 3, 400)
    depths, slopes = jax.jit(jax.vmap(jax.value_and_grad(depth)))(centers, turns)
    deepest = 0 if name in ("square", "star") else 0.004  # the depth of edges that cross is that of a chord's middle
    near = (depths > -0.004) & (depths < deepest)
    assert near.sum() > 30
    np.testing.assert_allclose(np.linalg.norm(slopes[near], axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize("shift", [0, 1, 3])
def test_a_corner_on_a_vertex_touches_the_edge_that_it_is_pressed_against(shift):
    """It does so whichever of the two edges is longer, and wherever the vertices begin."""
    vertices = 1e-3 * np.array([(0, 0), (120, 0), (120, 40), (40, 40), (40, 80), (0, 80)], float)
    outline = pj.Polygon(np.roll(vertices, shift, axis=0)).outline()
    corner = np.asarray(pad().shape.vertices)[np.argmax(np.asarray(pad().shape.vertices) @ [-1, 1])]
    pose = placed(0.12 - corner[0], -corner[1], 0.0)
    for push, normal in (((0.0, 1e-3), (0, 1)), ((-1e-3, 0.0), (-1, 0))):
        displacement, of_pad = Vec2.of(jnp.asarray(push)), len(pad().shape.vertices)
        found = candidates(pad(), outline, pose, displacement)
        near = np.where(found.exists, np.abs(found.distance), np.inf)
        touching = int(np.argmin(near[:of_pad]))
        np.testing.assert_allclose(found.distance[touching], 0, atol=1e-12)
        np.testing.assert_allclose([found.normal.x[touching], found.normal.y[touching]], normal, atol=1e-12)


@pytest.mark.slow
def test_a_jaw_closes_to_the_width():
    """A wide jaw closes to the ellipse's width.

    In float32, the opening is never less than the width of the ellipse at its angle. It ends at that width, near the
    short axis.
    """
    dtype = "float32"
    slider = pj.Slider(pj.Ellipse(*SEMI.astype(dtype)), pj.Ellipsoid(np.eye(3, dtype=dtype), np.asarray(LENGTH, dtype)))
    hand = pj.Hand.parallel_jaw(np.asarray(0.08, dtype), np.asarray(0.01, dtype))
    path = np.linspace((0, 0, 0, 0.05), (0, 0, 0, 0.027), 400).astype(dtype)
    poses = np.array([(0, 0.003, 0.9), (0.004, -0.002, -0.4), (0, 0, 1.3)], dtype)
    mu = jnp.asarray(0.1, dtype)
    grasps = jax.jit(jax.vmap(lambda pose: pj.rollout(slider, hand, path, pose=pose, friction=mu)))(poses)
    assert not np.asarray(grasps.failed).any()
    assert np.all(np.asarray(grasps.status[:, -1]) == pj.Status.GRASPED)
    pose, opening = np.asarray(grasps.pose, float), np.asarray(grasps.configuration, float)[..., 3]
    width = 2 * np.hypot(SEMI[0] * np.sin(pose[..., 2]), SEMI[1] * np.cos(pose[..., 2]))
    assert np.all(opening >= width - 5e-6)
    step = 0.023 / 399
    np.testing.assert_allclose(opening[:, -1], width[:, -1], atol=1.1 * step)
    # friction of 0.1 leaves this tilt
    assert np.all(np.abs(pose[:, -1, 2]) < 0.2)
