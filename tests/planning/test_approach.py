"""Transits of a round finger around polygons, judged by shapely."""

import numpy as np
import pytest
from planning_parts import PLUS, RADIUS, L, T

from pushjax.geometry.polygon_numpy import inside, offset_curve, segment_distances, signed_distances
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.planning.roadmap import Roadmap, TransitStatus, run_ups
from pushjax.planning.workspace import Workspace

shapely = pytest.importorskip("shapely")

CLEARANCE = 0.005


def star(rng):
    """Return a random polygon that is star-shaped about the origin, with narrow notches among others."""
    count = int(rng.integers(4, 12))
    angle = np.sort(rng.uniform(0, 2 * np.pi, count) * 0.3 + 2 * np.pi * np.arange(count) / count * 0.7)
    radius = rng.uniform(0.01, 0.1, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def polygons(count):
    rng = np.random.default_rng(0)
    stars = [star(rng) for _ in range(count)]
    return [L, PLUS, T] + [
        each for each in stars if shapely.Polygon(each).is_valid and shapely.Polygon(each).area > 1e-4
    ]


def counterclockwise(vertices):
    return vertices if shapely.Polygon(vertices).exterior.is_ccw else vertices[::-1]


def test_distances_are_those_of_shapely():
    rng = np.random.default_rng(1)
    for vertices in map(counterclockwise, polygons(20)):
        polygon = shapely.Polygon(vertices)
        points = rng.uniform(-0.15, 0.15, (200, 2))
        ends = rng.uniform(-0.15, 0.15, (200, 2))
        assert np.array_equal(inside(vertices, points), shapely.contains_xy(polygon, points))
        apart = np.array([polygon.exterior.distance(shapely.Point(p)) for p in points])
        np.testing.assert_allclose(np.abs(signed_distances(vertices, points)), apart, atol=1e-12)
        wanted = [shapely.LineString(pair).distance(polygon) for pair in zip(points, ends, strict=True)]
        np.testing.assert_allclose(np.maximum(segment_distances(vertices, points, ends), 0), wanted, atol=1e-12)


def test_offset_curve_is_at_its_distance():
    for vertices in map(counterclockwise, polygons(20)):
        curve = offset_curve(vertices, 0.02, 150)
        polygon = shapely.Polygon(vertices)
        apart = [polygon.distance(shapely.Point(p)) for p in curve.points]
        np.testing.assert_allclose(apart, 0.02, rtol=1e-6)
        on_outline = curve.points + 0.02 * curve.normals
        assert max(polygon.exterior.distance(shapely.Point(p)) for p in on_outline) < 1e-9


@pytest.fixture(scope="module")
def found_transits():
    """Transits around many polygons from anywhere, also from where the finger has just pushed."""
    rng = np.random.default_rng(2)
    found = []
    for vertices in map(counterclockwise, polygons(40)):
        anywhere = rng.uniform(-0.2, 0.2, (20, 2))
        touching = offset_curve(vertices, RADIUS + 1e-6, 30).points
        starts = np.concatenate([anywhere[signed_distances(vertices, anywhere) > RADIUS], touching[::6]])
        roadmap = Roadmap(vertices, RADIUS, CLEARANCE, np.concatenate([anywhere, touching]))
        pose = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-4, 4)])
        for start in to_world(pose, starts):
            transits = roadmap.transits(start, pose)
            for goal in rng.choice(len(roadmap.goals), 8, replace=False):
                found.append(
                    (vertices, pose, start, roadmap.goals[goal], roadmap.transit(transits, int(goal), pose), transits)
                )
    return found


def test_no_transit_touches_the_slider(found_transits):
    count = 0
    for vertices, pose, start, goal, transit, _ in found_transits:
        if transit.status != TransitStatus.FOUND:
            continue
        polygon = shapely.Polygon(to_world(pose, vertices))
        assert polygon.distance(shapely.LineString(transit.points)) >= RADIUS - 1e-9
        np.testing.assert_allclose(transit.points[0], start, atol=1e-12)
        np.testing.assert_allclose(transit.points[-1], to_world(pose, goal), atol=1e-12)
        pieces = np.linalg.norm(np.diff(transit.points, axis=0), axis=1)
        assert transit.length == pytest.approx(pieces.sum())
        count += 1
    assert count > 1000


def test_a_transit_is_found_where_there_is_one(found_transits):
    """If start and goal are in one part of the plane that is a little farther away than the clearance."""
    missing = 0
    for vertices, pose, start, goal, transit, _ in found_transits:
        if transit.status == TransitStatus.FOUND:
            assert np.isfinite(transit.length)
            continue
        assert np.isinf(transit.length)
        assert len(transit.points) == 1
        fat = shapely.Polygon(vertices).buffer(1.02 * (RADIUS + CLEARANCE), quad_segs=64)
        free = shapely.box(-9, -9, 9, 9).difference(fat)
        parts = getattr(free, "geoms", [free])
        ends = [shapely.Point(to_body(pose, start)), shapely.Point(goal)]
        assert not any(all(part.contains(end) for end in ends) for part in parts)
        missing += 1
    assert missing > 100


def test_transits_are_shortest():
    """Around a square, from the middle of one side to that of the other: two straight pieces and two quarter arcs."""
    square = 0.05 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    apart = RADIUS + CLEARANCE
    roadmap = Roadmap(square, RADIUS, CLEARANCE, np.array([[0.0, 0.05 + 1.01 * apart]]))
    transits = roadmap.transits(np.array([0.0, -0.05 - 1.01 * apart]), np.zeros(3))
    best = 2 * 0.05 + 0.1 + np.pi * apart
    assert best < transits.lengths[0] < 1.06 * best


def test_transits_stay_in_the_workspace():
    rng = np.random.default_rng(3)
    limits = Workspace.rectangle((-0.1, -0.1), (0.1, 0.1))
    goals = offset_curve(L, RADIUS + 1.1 * CLEARANCE, 60).points
    roadmap = Roadmap(L, RADIUS, CLEARANCE, goals)
    found = blocked = 0
    for _ in range(60):
        pose = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(-4, 4)])
        start = rng.uniform(-0.1, 0.1, 2)
        if signed_distances(L, to_body(pose, start)) < RADIUS:
            continue
        transits = roadmap.transits(start, pose, limits)
        for goal in range(0, len(goals), 7):
            transit = roadmap.transit(transits, goal, pose)
            if transit.status == TransitStatus.FOUND:
                assert limits.allows_finger(transit.points[1:]).all()
                assert shapely.Polygon(to_world(pose, L)).distance(shapely.LineString(transit.points)) >= RADIUS - 1e-9
            found, blocked = found + np.isfinite(transit.length), blocked + np.isinf(transit.length)
    assert found > 50
    assert blocked > 50


def test_why_there_is_no_way():
    pose = np.zeros(3)
    near = offset_curve(L, RADIUS + 0.2 * CLEARANCE, 20).points
    roadmap = Roadmap(L, RADIUS, CLEARANCE, np.concatenate([[[0.3, 0.3]], near]))
    in_slider = roadmap.transits(np.array([0.01, 0.01]), pose)
    assert roadmap.transit(in_slider, 0, pose).status == TransitStatus.START_IN_SLIDER
    free = roadmap.transits(np.array([-0.2, 0.0]), pose)
    assert roadmap.transit(free, 0, pose).status == TransitStatus.FOUND
    assert roadmap.transit(free, 3, pose).status == TransitStatus.GOAL_BLOCKED
    walls = Workspace.rectangle((-0.3, -0.3), (0.2, 0.2))
    assert (
        roadmap.transit(roadmap.transits(np.array([-0.2, 0.0]), pose, walls), 0, pose).status
        == TransitStatus.NO_TRANSIT
    )
    narrow = Workspace.rectangle((-RADIUS - 1e-3, -0.3), (-RADIUS, 0.3))
    stuck = roadmap.transits(np.array([-RADIUS - 1e-4, 0.05]), pose, narrow)
    assert roadmap.transit(stuck, 0, pose).status == TransitStatus.NO_RETREAT
    with pytest.raises(ValueError, match="clearance must be positive"):
        Roadmap(L, RADIUS, 0.0, near)


def test_run_ups_do_not_touch():
    polygon = shapely.Polygon(T)
    curve = offset_curve(counterclockwise(T), RADIUS + 0.002, 80)
    lengths = run_ups(counterclockwise(T), RADIUS, CLEARANCE, curve.points, curve.normals, 0.02)
    assert np.isfinite(lengths).mean() > 0.9
    for point, normal, length in zip(curve.points, curve.normals, lengths, strict=True):
        if np.isfinite(length):
            begin = point - length * normal
            assert polygon.distance(shapely.LineString([begin, point])) >= RADIUS
            assert polygon.distance(shapely.Point(begin)) >= RADIUS + CLEARANCE - 1e-9
