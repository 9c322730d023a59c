"""Transits of a finger between pushes, and its motion in time, judged by shapely."""

import numpy as np
import pytest
from planning_parts import transits_around_one

import pushjax as pj
from pushjax.geometry.se2_numpy import compose, inverse, to_world
from pushjax.planning import finger_motion
from pushjax.planning.roadmap import TransitStatus

shapely = pytest.importorskip("shapely")

RADIUS, CLEARANCE, TRAVEL = 0.005, 0.008, 0.03
SQUARE = 0.04 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
L = np.array([(0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.12), (0, 0.12)])
NOTCHED = 0.04 * np.array([(-1, -1), (1, -1), (1, 1), (0.1, 1), (0.1, 0), (-0.1, 0), (-0.1, 1), (-1, 1)], float)


def translations(vertices, pushes, scatter):
    """Pushes from random sides whose slider does not turn, as if the finger stuck to it, and samples around them."""
    rng = np.random.default_rng(0)
    polygon, pose = shapely.Polygon(vertices), np.array([0.2, -0.1, 1.0])
    poses, paths = [pose], []
    for _ in range(pushes):
        ahead = np.array([np.cos(angle := rng.uniform(-np.pi, np.pi)), np.sin(angle)])
        at = to_world(pose, polygon.centroid.coords[0])
        line = at - np.linspace(0.3, 0.0, 3001)[:, None] * ahead
        placed = shapely.Polygon(to_world(pose, vertices))
        touch = line[np.argmax(shapely.distance(placed, shapely.points(line)) <= RADIUS)]
        paths.append(touch + np.linspace(-CLEARANCE, TRAVEL, 9)[:, None] * ahead)
        pose = pose + np.array([*(TRAVEL * ahead), 0.0])
        poses.append(pose)
    noise = scatter * rng.normal(size=(50, pushes + 1, 3)) * [1, 1, 20]
    noise[:, 0] = 0
    return np.array(paths), np.array(poses), np.array(poses) + noise


@pytest.mark.parametrize("vertices", [SQUARE, L], ids=["square", "L"])
@pytest.mark.parametrize("scatter", [0.0, 5e-4])
def test_the_finger_touches_no_sample_between_pushes(vertices, scatter):
    paths, poses, samples = translations(vertices, 12, scatter)
    found = transits_around_one(vertices, RADIUS, CLEARANCE, paths, poses, samples, start=np.array([0.0, 0.2]))
    assert found.status == TransitStatus.FOUND
    assert not found.touched.any()
    for k, transit in enumerate(found.transits):
        if k:
            np.testing.assert_allclose(transit.points[0], paths[k - 1, -1], atol=1e-12)
        if k < len(paths):
            np.testing.assert_allclose(transit.points[-1], paths[k, 0], atol=1e-12)
        line = shapely.LineString(transit.points)
        for pose in [poses[k], *samples[:, k]]:
            placed = shapely.Polygon(to_world(pose, vertices))
            # a finger that has just pushed is in contact, and may overlap a sample by the scatter
            begins = min(RADIUS, placed.distance(shapely.Point(transit.points[0])))
            assert placed.distance(line) >= begins - 1e-6
            if k == len(paths):  # the retreat ends with the whole clearance, also from the samples
                assert placed.distance(shapely.Point(transit.points[-1])) >= RADIUS + CLEARANCE - 1e-6


def test_the_finger_keeps_out_of_fixtures_between_pushes():
    """Posts between the slider and where the finger goes; a wall leaves no transit."""
    paths, poses, samples = translations(L, 6, 2e-4)
    free = transits_around_one(L, RADIUS, CLEARANCE, paths, poses, samples, start=np.array([0.0, 0.2]))
    start, first = free.transits[0].points[0], free.transits[0].points[1]
    posts = [pj.Fixture(pj.Disk(0.01), (*(start + share * (first - start)), 0.0)) for share in (0.3, 0.6)]
    bodies = shapely.union_all([shapely.Point(np.asarray(each.pose[:2])).buffer(0.01, quad_segs=64) for each in posts])
    assert bodies.distance(shapely.LineString(free.transits[0].points)) == 0
    found = transits_around_one(L, RADIUS, CLEARANCE, paths, poses, samples, start=start, fixtures=tuple(posts))
    assert found.status == TransitStatus.FOUND
    for transit in found.transits:
        assert bodies.distance(shapely.LineString(transit.points)) >= RADIUS + CLEARANCE - 1e-4
    assert found.transits[0].length > free.transits[0].length
    behind = pj.Wall(start + 0.001 * (first - start), first - start)
    shut = transits_around_one(L, RADIUS, CLEARANCE, paths, poses, samples, start=start, fixtures=(behind,))
    assert shut.status == TransitStatus.START_IN_FIXTURE
    away = pj.Wall(0.5 * (start + first), start - first)
    shut = transits_around_one(L, RADIUS, CLEARANCE, paths, poses, samples, start=start, fixtures=(away,))
    assert shut.status == TransitStatus.GOAL_BLOCKED


def test_what_would_be_touched_is_counted():
    """Half of the samples are so far aside that the finger, on its way around the others, runs into some of them."""
    paths, poses, _ = translations(SQUARE, 1, 0.0)
    samples = np.repeat(poses[None], 40, axis=0)
    samples[20:, 0, :2] += np.random.default_rng(1).uniform(-0.2, 0.2, (20, 2))
    found = transits_around_one(SQUARE, RADIUS, CLEARANCE, paths, poses, samples, start=poses[0, :2] + [0.3, 0.3])
    line = shapely.LineString(found.transits[0].points)
    placed = [shapely.Polygon(to_world(pose, SQUARE)) for pose in samples[:, 0]]
    np.testing.assert_array_equal(found.touched, [each.distance(line) < RADIUS for each in placed])
    assert 0 < found.touched.sum() < 20


def test_a_push_in_a_notch_that_the_finger_does_not_fit_into_has_no_way():
    path = np.array([[(0.0, 0.02), (0.0, 0.0)]])
    still = np.zeros((2, 3))
    found = transits_around_one(NOTCHED, RADIUS, CLEARANCE, path, still, still[None], start=np.array([0.2, 0.2]))
    assert found.status == TransitStatus.GOAL_BLOCKED
    with pytest.raises(ValueError, match=r"transits\[0\] must be a transit that was found; its status is GOAL_BLOCKED"):
        finger_motion(found.transits, path, free=0.1, push=0.02)


def test_motion_has_the_speeds():
    paths, poses, samples = translations(SQUARE, 4, 0.0)
    transits = transits_around_one(SQUARE, RADIUS, CLEARANCE, paths, poses, samples).transits
    motion = finger_motion(transits, paths, free=0.1, push=0.02)
    speed = np.linalg.norm(np.diff(motion.position, axis=0), axis=1) / np.diff(motion.time)
    np.testing.assert_allclose(speed, np.where(motion.push[1:] > 0, 0.02, 0.1))
    assert motion.time[0] == 0
    for k, path in enumerate(paths):
        np.testing.assert_allclose(motion.position[motion.push == k + 1], path[1:], atol=1e-12)
    assert np.sum(np.diff(motion.push) != 0) == 2 * len(paths)
    whole = sum(transit.length for transit in transits) / 0.1 + len(paths) * (CLEARANCE + TRAVEL) / 0.02
    assert motion.time[-1] == pytest.approx(whole)
    with pytest.raises(ValueError, match="push must be positive; got 0"):
        finger_motion(transits, paths, free=0.1, push=0.0)


def test_transits_do_not_depend_on_the_frame():
    paths, poses, samples = translations(L, 3, 3e-4)
    moved = np.array([0.4, -0.3, 2.0])
    there = [to_world(moved, paths), compose(moved, poses), compose(moved, samples)]
    transits = transits_around_one(L, RADIUS, CLEARANCE, paths, poses, samples).transits
    again = transits_around_one(L, RADIUS, CLEARANCE, *there).transits
    for here, other in zip(transits, again, strict=True):
        assert other.length == pytest.approx(here.length, rel=1e-6)
        np.testing.assert_allclose(to_world(inverse(moved), other.points), here.points, atol=1e-6)
