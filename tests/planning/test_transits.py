"""Distances from polygons, walls and fixed bodies, and transits of a finger among them; shapely is the judge."""

import numpy as np
import pytest
from planning_parts import PLUS, RADIUS, L, T

import pushjax as pj
from pushjax.geometry.polygon_numpy import inside, offset_curve, segment_distances, signed_distances
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.planning import Workspace
from pushjax.planning.obstacles import Obstacles
from pushjax.planning.roadmap import Roadmap, TransitStatus, run_ups

shapely = pytest.importorskip("shapely")

CLEARANCE = 0.005
APART = RADIUS + CLEARANCE
BAR = np.array([(-0.1, -0.004), (0.1, -0.004), (0.1, 0.004), (-0.1, 0.004)])
LIMITS, LIMITED = Workspace.rectangle((-0.28, -0.28), (0.28, 0.28)), shapely.box(-0.28, -0.28, 0.28, 0.28)
ROUNDED = 2e-5  # of a disk of 5 cm by a polygon


def star(rng):
    """Return a random polygon that is star-shaped about the origin, counterclockwise."""
    count = int(rng.integers(4, 10))
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(0, 0.6, count)) / count
    return rng.uniform(0.02, 0.08, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def fixed(rng):
    """Return a random star or disk, a thin bar, or now and then a wall far enough away to leave some room."""
    pose, kind = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-3, 3)]), rng.choice(4, p=(0.35, 0.3, 0.25, 0.1))
    if kind == 0:
        return pj.Fixture(pj.Polygon(star(rng)), pose)
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


def polygons(count):
    """Return blocks with reflex corners, and star-shaped polygons, counterclockwise."""
    rng = np.random.default_rng(0)
    return [L, PLUS, T, *(star(rng) for _ in range(count))]


def test_distances_from_a_polygon_are_those_of_shapely():
    rng = np.random.default_rng(1)
    for vertices in polygons(20):
        polygon = shapely.Polygon(vertices)
        points = rng.uniform(-0.15, 0.15, (200, 2))
        ends = rng.uniform(-0.15, 0.15, (200, 2))
        assert np.array_equal(inside(vertices, points), shapely.contains_xy(polygon, points))
        apart = np.array([polygon.exterior.distance(shapely.Point(p)) for p in points])
        np.testing.assert_allclose(np.abs(signed_distances(vertices, points)), apart, atol=1e-12)
        wanted = [shapely.LineString(pair).distance(polygon) for pair in zip(points, ends, strict=True)]
        np.testing.assert_allclose(np.maximum(segment_distances(vertices, points, ends), 0), wanted, atol=1e-12)


def test_offset_curve_is_at_its_distance():
    for vertices in polygons(20):
        curve = offset_curve(vertices, 0.02, 150)
        polygon = shapely.Polygon(vertices)
        apart = [polygon.distance(shapely.Point(p)) for p in curve.points]
        np.testing.assert_allclose(apart, 0.02, rtol=1e-6)
        on_outline = curve.points + 0.02 * curve.normals
        assert max(polygon.exterior.distance(shapely.Point(p)) for p in on_outline) < 1e-9


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

    It must if start and goal are in one part of the workspace that is a little farther away than the clearance.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        vertices, fixtures = star(rng), [fixed(rng) for _ in range(rng.integers(0, 5))]
        pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-4, 4)])
        slider, bodies = shapely.Polygon(to_world(pose, vertices)), shapely.union_all([body(each) for each in fixtures])
        if slider.intersects(bodies):
            continue
        goals = rng.uniform(-0.3, 0.3, (8, 2))
        roadmap = Roadmap(vertices, RADIUS, CLEARANCE, to_body(pose, goals), Obstacles.of(fixtures))
        # as far as the points around the corners are, which are 45 degrees apart at most
        free = LIMITED.difference(slider.union(bodies).buffer(1.09 * APART, quad_segs=32))
        parts = getattr(free, "geoms", [free])
        pushed = offset_curve(vertices, RADIUS + 1e-6, 3).points[:1]  # where a finger may be after a push
        for start in np.concatenate([rng.uniform(-0.28, 0.28, (3, 2)), to_world(pose, pushed)]):
            transits = roadmap.transits(start, pose, LIMITS)
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
        assert LIMITS.allows_finger(transit.points[1:]).all()
        solid = [slider] if bodies.is_empty else [slider, bodies]
        for each in solid:  # a start that is nearer than the clearance is left without coming nearer
            assert each.distance(line) >= min(APART, each.distance(first)) - ROUNDED
        if min(each.distance(first) for each in solid) < APART - ROUNDED:
            after = shapely.LineString([*transit.points[1:], transit.points[-1]])
            assert slider.union(bodies).distance(after) >= APART - ROUNDED
    return found, must


def test_transits_in_random_worlds():
    found, must = check_transits(60, 2)
    assert found > 400
    assert must > 400


@pytest.mark.slow
def test_transits_in_many_worlds():
    found, must = check_transits(500, 3)
    print(f"{found} transits; {must} must exist")
    assert found >= must > 4_000


def test_transits_are_shortest():
    """Around a square, from the middle of one side to that of the other: two straight pieces and two quarter arcs."""
    square = 0.05 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    apart = RADIUS + CLEARANCE
    roadmap = Roadmap(square, RADIUS, CLEARANCE, np.array([[0.0, 0.05 + 1.01 * apart]]))
    transits = roadmap.transits(np.array([0.0, -0.05 - 1.01 * apart]), np.zeros(3))
    best = 2 * 0.05 + 0.1 + np.pi * apart
    assert best < transits.lengths[0] < 1.06 * best


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
    curve = offset_curve(T, RADIUS + 0.002, 80)
    lengths = run_ups(T, RADIUS, CLEARANCE, curve.points, curve.normals, 0.02)
    assert np.isfinite(lengths).mean() > 0.9
    for point, normal, length in zip(curve.points, curve.normals, lengths, strict=True):
        if np.isfinite(length):
            begin = point - length * normal
            assert polygon.distance(shapely.LineString([begin, point])) >= RADIUS
            assert polygon.distance(shapely.Point(begin)) >= RADIUS + CLEARANCE - 1e-9
