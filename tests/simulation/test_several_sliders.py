"""Several sliders that push each other: closed forms, what must not matter, overlaps judged by shapely, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS

import pushjax as pj
from pushjax.geometry.se2_numpy import compose, to_world
from pushjax.simulation.several_sliders import SlidersFriction

shapely = pytest.importorskip("shapely")

SIDE, RADIUS, STEPS = 0.06, 0.005, 32
SURFACE = pj.Ellipsoid(np.diag([1.0, 1.3, 0.8]), length=0.022)
DISK = pj.Slider(pj.Disk(SIDE / 2), SURFACE)
SQUARE = pj.Slider(pj.Polygon.rectangle(SIDE, SIDE), SURFACE)
T = pj.Slider(
    pj.Polygon(0.015 * np.array([(-2, 1), (-2, 0), (-0.5, 0), (-0.5, -3), (0.5, -3), (0.5, 0), (2, 0), (2, 1)])),
    SURFACE,
)
OVAL = pj.Slider(pj.Ellipse(0.03, 0.02), SURFACE)
FINGER, FRICTION, BETWEEN = pj.Hand.finger(RADIUS), 0.3, 0.2


def push(sliders, path, poses, **options):
    return pj.rollout(
        sliders, options.pop("hand", FINGER), path, pose=poses, friction=FRICTION, between=BETWEEN, **options
    )


def two_disks(gap: float, height: float):
    """Two disks in a row, and a path that pushes the first one at this height for 40 mm."""
    poses = np.array([[0.0, 0.0, 0.3], [SIDE + gap, 0.0, -0.8]])
    start = -SIDE / 2 - RADIUS
    return poses, np.asarray(pj.line((start, height), (start + 0.04, height), STEPS))


def test_a_row_moves_straight():
    """Pushed through both centers, the second disk starts to move when the gap is closed."""
    round_one = pj.Slider(DISK.shape, pj.Ellipsoid(np.eye(3), length=0.022))
    poses, path = two_disks(0.0111, 0.0)
    found = push((round_one, round_one), path, poses)
    travel = np.asarray(path[:, 0] - path[0, 0])
    expected = np.broadcast_to(poses, (STEPS + 1, 2, 3)).copy()
    expected[:, 0, 0] += travel
    expected[:, 1, 0] += np.maximum(travel - 0.0111, 0)
    np.testing.assert_allclose(found.pose, expected, atol=1e-9)
    assert np.all(found.status == pj.Status.MOVING)
    np.testing.assert_array_equal(found.pose[:8, 1], np.broadcast_to(poses[1], (8, 3)))  # bit for bit
    # one limit surface in the force at first, then two
    np.testing.assert_allclose(found.force[0, 0, 0], 1, rtol=1e-6)
    np.testing.assert_allclose(found.force[-1, 0, 0], 2, rtol=1e-6)


@pytest.mark.slow
def test_one_slider_in_a_tuple_moves_as_alone():
    poses, path = two_disks(0.01, 0.012)
    poses[0, 2] = 0.0
    alone = pj.rollout(SQUARE, FINGER, path, pose=poses[0], friction=FRICTION)
    found = push((SQUARE,), path, poses[:1])
    np.testing.assert_allclose(found.pose[:, 0], alone.pose, atol=1e-8)
    np.testing.assert_array_equal(found.status, alone.status)
    np.testing.assert_allclose(found.force[:, 0], alone.force[:, 0], atol=1e-6)


@pytest.mark.slow
def test_order_and_frame_do_not_matter():
    poses, path = two_disks(0.008, 0.009)
    sliders = (DISK, SQUARE)
    poses[1, 2] = 0.2
    plain = push(sliders, path, poses)
    swapped = push(sliders[::-1], path, poses[::-1])
    # to second order, because contacts are found in the frame of one of the two
    np.testing.assert_allclose(swapped.pose[:, ::-1], plain.pose, atol=1e-5)
    place = np.array([0.3, -0.2, 1.1])
    moved = push(sliders, to_world(place, path), compose(place, poses))
    np.testing.assert_allclose(moved.pose, compose(place, np.asarray(plain.pose)), atol=1e-8)
    # a rollout goes on where another one has ended
    first = push(sliders, path[:17], poses)
    rest = push(sliders, path[16:], first.pose[-1])
    np.testing.assert_allclose(rest.pose[-1], plain.pose[-1], atol=1e-8)


@pytest.mark.slow
def test_pads_that_close_on_two_squares_hold_them():
    jaw = pj.Hand.parallel_jaw(width=0.05, thickness=0.01)
    poses = np.array([[0.0, -SIDE / 2, 0.0], [0.0, SIDE / 2 + 0.002, 0.0]])
    path = np.asarray(pj.line((0.0, 0.0, 0.0, 0.13), (0.0, 0.0, 0.0, 0.11), STEPS))
    found = push((SQUARE, SQUARE), path, poses, hand=jaw)
    assert found.status[-1] == pj.Status.GRASPED
    np.testing.assert_allclose(found.configuration[-1, 3], 2 * SIDE, atol=1e-5)
    np.testing.assert_allclose(found.pose[-1, :, 1], [-SIDE / 2, SIDE / 2], atol=1e-5)


def outlines(sliders, poses):
    found = []
    for slider, pose in zip(sliders, poses, strict=True):
        if slider is DISK:
            found.append(shapely.Point(pose[:2]).buffer(SIDE / 2, quad_segs=64))
        else:
            found.append(shapely.Polygon(to_world(pose, np.asarray(slider.shape.vertices))))
    return found


def scattered(sliders, count: int, seed: int):
    """Return random poses near each other without overlaps, and paths of a finger through their middle."""
    rng, poses, paths = np.random.default_rng(seed), [], []
    while len(poses) < count:
        pose = np.column_stack([rng.uniform(-0.06, 0.06, (len(sliders), 2)), rng.uniform(-3, 3, len(sliders))])
        bodies = outlines(sliders, pose)
        way = rng.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(way), np.sin(way)])
        start = pose[:, :2].mean(0) - 0.12 * direction + 0.02 * rng.normal(size=2)
        apart = [a.distance(b) for k, a in enumerate(bodies) for b in bodies[:k]]
        if min(apart) > 1e-4 and min(b.distance(shapely.Point(start)) for b in bodies) > RADIUS + 1e-3:
            poses.append(pose)
            paths.append(np.asarray(pj.line(start, start + 0.16 * direction, STEPS)))
    return np.array(poses), np.array(paths)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sliders", "dtype"),
    [
        ((T, SQUARE, DISK), np.float32),
        ((T, T), np.float64),
    ],
)
def test_nothing_overlaps(sliders, dtype):
    """Random pushes through a pile, judged by shapely at every step that moves."""
    poses, paths = (x.astype(dtype) for x in scattered(sliders, 60, 0))
    given = jax.tree.map(lambda leaf: leaf.astype(dtype), sliders)
    run = jax.jit(jax.vmap(lambda path, pose: push(given, path, pose)), compiler_options=AS_USERS)
    found = jax.tree.map(np.asarray, run(paths, poses))
    assert np.all(np.isfinite(found.pose))
    assert np.mean(found.status == pj.Status.NOT_CONVERGED) < 0.01
    moved = np.abs(found.pose[:, -1] - found.pose[:, 0]).max(2) > 1e-3
    assert np.mean(moved.sum(1) >= 2) > 0.3  # many pushes move more than one
    deepest = 0.0
    for push_number, step in np.argwhere(found.status == pj.Status.MOVING):
        bodies = outlines(sliders, found.pose[push_number, step + 1].astype(float))
        finger = shapely.Point(found.configuration[push_number, step + 1].astype(float))
        for k, body in enumerate(bodies):
            deepest = max(deepest, RADIUS - body.distance(finger))
            for other in bodies[:k]:
                area = body.intersection(other).area
                deepest = max(deepest, np.sqrt(area) / 10)
    assert deepest < 5e-4
    print(f"deepest {1e3 * deepest:.3f} mm, {np.unique(found.status, return_counts=True)}")


@pytest.mark.slow
def test_derivatives_through_another_slider():
    """The pose of the second disk by the path of the finger and by all frictions, forward and reverse."""
    poses, path = two_disks(0.008, 0.006)

    def last(x):
        moved = path + jnp.outer(jnp.linspace(0, 1, STEPS + 1), x[:2])
        found = pj.rollout((DISK, DISK), FINGER, moved, pose=poses, friction=x[2], between=x[3])
        return found.pose[-1, 1]

    x = jnp.array([0.0, 0.0, FRICTION, BETWEEN])
    forward = jax.jit(jax.jacfwd(last))(x)
    weight = jnp.array([1.0, -2.0, 0.01])
    reverse = jax.jit(jax.grad(lambda x: weight @ last(x)))(x)
    np.testing.assert_allclose(reverse, weight @ forward, rtol=1e-7, atol=1e-10)
    step = 1e-6 * jnp.array([1e-2, 1e-2, 1.0, 1.0])
    moved = jax.jit(jax.vmap(last))(x[None] + jnp.concatenate([jnp.diag(step), -jnp.diag(step)]))
    central = ((moved[:4] - moved[4:]) / (2 * step[:, None])).T
    np.testing.assert_allclose(central, forward, rtol=1e-4, atol=1e-5)
    assert np.abs(forward).max() > 0.1


def test_bad_arguments():
    poses, path = two_disks(0.01, 0.0)
    for arguments, message in (
        ({"between": None}, "between: several sliders need"),
        ({"between": -0.1}, "between must not be negative"),
        ({"between": np.array([[0.1, 0.2], [0.3, 0.1]])}, "between must be symmetric"),
        ({"pose": poses[0]}, r"pose .*\(2, 3\)"),
        ({"slider": (OVAL, OVAL)}, r"one must be a disk or a polygon; sliders \[0, 1\] are not"),
        ({"slider": ()}, "needs at least one"),
        ({"solver": pj.Exhaustive()}, "solver and table are for one slider"),
        ({"pose": 0.5 * poses}, r"pose: sliders 0 and 1 start inside each other, by 25 mm; at most 4.4 mm"),
    ):
        given = {"slider": (DISK, DISK), "pose": poses, "between": 0.1} | arguments
        with pytest.raises(ValueError, match=message):
            pj.rollout(hand=FINGER, path=path, friction=0.2, **given)
    with pytest.raises(ValueError, match="between is for several sliders"):
        pj.rollout(DISK, FINGER, path, pose=poses[0], friction=0.2, between=0.1)
    with pytest.raises(TypeError, match="slider"):
        pj.rollout((DISK, SURFACE), FINGER, path, pose=poses, friction=0.2, between=0.1)


@pytest.mark.slow
def test_random_friction():
    """A push of a Monte Carlo run is a random rollout; its friction is within the ranges."""
    sliders = (
        DISK,
        pj.Slider.on(SQUARE.shape, pj.Support.tripod([[-0.02, -0.02], [0.02, -0.02], [0, 0.02]]), exact=True),
    )
    poses, path = two_disks(0.008, 0.006)
    poses[1, 2] = 0.2
    model = pj.FrictionModel(40.0, (0.2, 0.4))
    given = {"pose": poses, "model": model, "between": (0.1, 0.3)}
    runs = pj.monte_carlo(jax.random.key(0), 64, sliders, FINGER, path, **given, trajectories=True)
    assert runs.pose.shape == (64, 2, 3)
    assert runs.trajectory.shape == (64, STEPS + 1, 2, 3)
    assert runs.outcomes()["failed"] == 0
    assert np.all(runs.pose[:, :, :2].std(axis=0).max(axis=1) > 1e-5)
    summary = runs.summary()["pose"]
    np.testing.assert_allclose([one["x"]["mean"] for one in summary], runs.pose[:, :, 0].mean(axis=0))
    one = pj.random_rollout(jax.random.fold_in(jax.random.key(0), 5), sliders, FINGER, path, **given)
    np.testing.assert_allclose(one.push.pose[-1], runs.pose[5], atol=1e-7)
    assert one.draws.between is not None
    assert 0.1 <= float(one.draws.between[0, 0, 1]) <= 0.3
    assert len(one.draws.surface) == 2
    np.testing.assert_array_equal(one.draws.surface[1].point[0], sliders[1].surface.point)
    assert np.all(one.draws.surface[1].limit[0] != sliders[1].surface.limit)
    # each push from its own start
    starts = np.broadcast_to(poses, (64, 2, 3)) + np.linspace(0, 0.002, 64)[:, None, None] * [1.0, 0.0, 0.0]
    runs = pj.monte_carlo(jax.random.key(0), 64, sliders, FINGER, path, **(given | {"pose": starts}), trajectories=True)
    one = pj.random_rollout(
        jax.random.fold_in(jax.random.key(0), 5), sliders, FINGER, path, **(given | {"pose": starts[5]})
    )
    np.testing.assert_allclose(one.push.pose[-1], runs.pose[5], atol=1e-7)
    with pytest.raises(ValueError, match="between must be"):
        pj.random_rollout(jax.random.key(0), sliders, FINGER, path, **(given | {"between": (0.3, 0.1)}))


@pytest.mark.slow
def test_a_step_is_a_rollout_of_one_step():
    poses, path = two_disks(0.0, 0.004)
    given = {"pose": poses, "friction": FRICTION, "between": BETWEEN}
    one = pj.step((DISK, DISK), FINGER, path[0], path[2], **given)
    whole = pj.rollout((DISK, DISK), FINGER, path[:3:2], **given)
    assert one.pose.shape == (2, 3)
    assert float(jnp.abs(one.twist[1]).max()) > 1e-4
    np.testing.assert_allclose(one.pose, whole.pose[-1], atol=1e-12)
    np.testing.assert_allclose(one.force, whole.force[-1], atol=1e-9)
    with pytest.raises(ValueError, match="q1"):
        pj.step((DISK, DISK), FINGER, path[0], (0.0, 0.0, 0.0), **given)
    with pytest.raises(ValueError, match="between is for several sliders"):
        pj.step(DISK, FINGER, path[0], path[1], **(given | {"pose": poses[0]}))


@pytest.mark.parametrize("between", [np.nan, np.inf, -0.1])
def test_friction_that_is_no_number(between):
    """It makes every step INVALID, also where it is traced."""
    given = jnp.full((2, 2), 0.2).at[1, 0].set(between)
    found = SlidersFriction.of((SURFACE, SURFACE), jnp.array([0.3]), given)
    assert np.all(np.isnan(found.fingers))
    assert np.all(np.isfinite(found.between))


def test_bodies_of_contacts():
    poses, path = two_disks(0.01, 0.0)
    wall = pj.Wall((0.2, 0.0), (-1.0, 0.0), 0.2)
    found = push((DISK, SQUARE), path, poses, fixtures=(wall,))
    fingers = [("slider 0", "finger 0"), ("slider 1", "finger 0")]
    fixed = [("slider 0", "fixture 0"), *[("slider 1", "fixture 0")] * 2]
    assert found.contacts[:5] == (*fingers, *fixed)
    assert set(found.contacts[5:]) == {("slider 1", "slider 0")}
    assert len(found.contacts) == found.force.shape[1]
    alone = pj.rollout(SQUARE, FINGER, path, pose=poses[0], friction=FRICTION, fixtures=(wall,))
    assert alone.contacts == (("slider 0", "finger 0"), *[("slider 0", "fixture 0")] * 2)


@pytest.mark.slow
def test_exact_and_fitted_surfaces_push_each_other():
    support = pj.Support.tripod([[-0.02, -0.012], [0.02, -0.012], [0.0, 0.02]])
    box = pj.Polygon.rectangle(0.06, 0.04)
    sliders = pj.Slider.on(box, support, exact=True), pj.Slider.uniform(pj.Disk(0.02))
    start = np.array([[0.0, 0.0, 0.0], [0.055, 0.004, 0.0]])
    path = pj.line((-0.036, 0.004), (0.0, 0.004), steps=32)
    push = pj.rollout(sliders, pj.Hand.finger(0.005), path, pose=start, friction=0.3, between=0.2)
    assert not np.any(push.failed)
    assert np.linalg.norm(push.pose[-1, 1, :2] - start[1, :2]) > 0.02
    # a wrench inside the exact limit surface moves nothing, and one that moves the slider is on it
    wrench, moves = np.asarray(push.wrench[:, 0]), np.any(np.asarray(push.twist[:, 0]) != 0, axis=1)
    value = np.array([sliders[0].surface.value(each) for each in wrench])
    np.testing.assert_allclose(value[moves], 1.0, rtol=1e-8)
