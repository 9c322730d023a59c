"""Distances from walls and fixed bodies, and transits of a finger among them, judged by shapely."""

import numpy as np
import pytest
from planning_parts import RADIUS, T

import pushjax as pj
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.planning import Workspace
from pushjax.planning.obstacles import Obstacles
from pushjax.planning.roadmap import Roadmap, TransitStatus

shapely = pytest.importorskip("shapely")

CLEARANCE = 0.005
APART = RADIUS + CLEARANCE
BAR = np.array([(-0.1, -0.004), (0.1, -0.004), (0.1, 0.004), (-0.1, 0.004)])
ROUNDED = 2e-5  # of a disk of 5 cm by a polygon


def star(rng):
    """Return a random polygon that is star-shaped about the origin, counterclockwise."""
    count = int(rng.integers(4, 10))
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(0, 0.6, count)) / count
    return rng.uniform(0.02, 0.08, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def fixed(rng):
    """Return a random triangle, disk, thin bar, or now and then a wall far enough away to leave some room."""
    pose, kind = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-3, 3)]), rng.choice(4, p=(0.35, 0.3, 0.25, 0.1))
    if kind == 0:
        angle = 2 * np.pi * (np.arange(3) + rng.uniform(0, 0.6, 3)) / 3
        return pj.Fixture(pj.Polygon(0.06 * np.stack([np.cos(angle), np.sin(angle)], axis=1)), pose)
    if kind == 1:
        return pj.Fixture(pj.Disk(rng.uniform(0.005, 0.05), (0.01, 0.02)), pose)
    if kind == 2:
        return pj.Fixture(pj.Polygon.rectangle(rng.uniform(0.05, 0.3), 0.01), pose)
    outward = np.array([np.cos(pose[2]), np.sin(pose[2])])
    return pj.Wall(-rng.uniform(0.1, 0.2) * outward, outward)


def body(fixture):
    """Return a fixture as shapely has it."""
    if isinstance(fixture, pj.Wall):
        point, normal = np.asarray(fixture.point), np.asarray(fixture.normal)
        along = 2 * np.array([-normal[1], normal[0]])
        return shapely.Polygon([point - along, point + along, point + along - 2 * normal, point - along - 2 * normal])
    pose = np.asarray(fixture.pose)
    if isinstance(fixture.shape, pj.Disk):
        center = shapely.Point(to_world(pose, np.asarray(fixture.shape.center)))
        return center.buffer(float(fixture.shape.radius), quad_segs=64)
    return shapely.Polygon(to_world(pose, np.asarray(fixture.shape.vertices)))


def test_distances_are_those_of_shapely():
    rng = np.random.default_rng(0)
    for world in range(40):
        fixtures = [fixed(rng) for _ in range(3)]
        obstacles, bodies = Obstacles.of(fixtures), shapely.union_all([body(each) for each in fixtures])
        points, ends = rng.uniform(-0.3, 0.3, (2, 50, 2))
        apart = np.array([bodies.distance(shapely.Point(p)) for p in points])
        np.testing.assert_allclose(np.maximum(obstacles.point_clearance(points), 0), apart, atol=ROUNDED)
        apart = [bodies.distance(shapely.LineString(pair)) for pair in zip(points, ends, strict=True)]
        np.testing.assert_allclose(np.maximum(obstacles.segment_clearance(points, ends), 0), apart, atol=ROUNDED)
        vertices = (T, BAR, star(rng))[world % 3]  # a bar may lie across a fixture with no corner of one in the other
        poses = np.column_stack([points, rng.uniform(-9, 9, 50)])
        placed = [shapely.Polygon(to_world(pose, vertices)) for pose in poses]
        found = obstacles.slider_clearance(vertices, poses, 1.0, 1e-5)
        apart, overlap = np.array([(bodies.distance(each), bodies.intersection(each).area) for each in placed]).T
        np.testing.assert_allclose(np.maximum(found, 0), apart, atol=ROUNDED)
        assert (found[overlap > 1e-7] < -1e-6).all()
        bound = obstacles.slider_clearance(vertices, poses, 0.03, 1e-5)
        assert (bound <= found + 1e-12).all()
        np.testing.assert_array_equal(bound[found < 0.03], found[found < 0.03])


def test_a_frame_changes_no_distance():
    rng = np.random.default_rng(1)
    obstacles = Obstacles.of([fixed(rng) for _ in range(8)])
    pose, points = np.array([0.3, -0.1, 2.0]), rng.uniform(-0.3, 0.3, (50, 2))
    there = obstacles.in_frame(pose).point_clearance(to_body(pose, points))
    np.testing.assert_allclose(there, obstacles.point_clearance(points), atol=1e-12)


def random_transits(count, seed):
    """Yield transits in random worlds: slider, fixtures (shapely), start, goal, transit, and whether it must exist.

    It must if start and goal are in one part of the plane that is a little farther away than the clearance.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        vertices, fixtures = star(rng), [fixed(rng) for _ in range(rng.integers(1, 5))]
        pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-4, 4)])
        slider, bodies = shapely.Polygon(to_world(pose, vertices)), shapely.union_all([body(each) for each in fixtures])
        if slider.intersects(bodies):
            continue
        limits = Workspace.rectangle((-0.4, -0.4), (0.4, 0.4))
        goals = rng.uniform(-0.3, 0.3, (8, 2))
        roadmap = Roadmap(vertices, RADIUS, CLEARANCE, to_body(pose, goals), Obstacles.of(fixtures))
        # as far as the points around the corners are, which are 45 degrees apart at most
        free = shapely.box(-0.4, -0.4, 0.4, 0.4).difference(slider.union(bodies).buffer(1.09 * APART, quad_segs=32))
        parts = getattr(free, "geoms", [free])
        for start in rng.uniform(-0.3, 0.3, (3, 2)):
            transits = roadmap.transits(start, pose, limits)
            for k, goal in enumerate(goals):
                ends = [shapely.Point(start), shapely.Point(goal)]
                joined = any(all(part.contains(end) for end in ends) for part in parts)
                yield slider, bodies, start, goal, roadmap.transit(transits, k, pose), joined


def check_transits(count, seed):
    """Check random transits, and return how many there are, and of how many that must exist."""
    found = must = 0
    for slider, bodies, start, goal, transit, joined in random_transits(count, seed):
        must += joined
        if transit.status != TransitStatus.FOUND:
            assert not joined
            assert np.isinf(transit.length)
            assert len(transit.points) == 1
            continue
        found += 1
        np.testing.assert_allclose(transit.points[[0, -1]], [start, goal], atol=1e-9)
        assert transit.length == pytest.approx(np.linalg.norm(np.diff(transit.points, axis=0), axis=1).sum())
        line, first = shapely.LineString(transit.points), shapely.Point(start)
        for each in (
            slider,
            bodies,
        ):  # a start that is nearer than the clearance is left by the transit that comes no nearer
            assert each.distance(line) >= min(APART, each.distance(first)) - ROUNDED
        if min(slider.distance(first), bodies.distance(first)) < APART - ROUNDED:
            after = (
                shapely.LineString(transit.points[1:]) if len(transit.points) > 2 else shapely.Point(transit.points[1])
            )
            assert slider.union(bodies).distance(after) >= APART - ROUNDED
    return found, must


def test_transits_among_fixtures():
    found, must = check_transits(60, 2)
    assert found > 400
    assert must > 400


@pytest.mark.long
def test_transits_in_thousands_of_worlds():
    found, must = check_transits(2000, 3)
    print(f"{found} transits; {must} must exist")
    assert found >= must > 10_000
