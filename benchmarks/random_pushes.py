"""Random pushes and grasps of many outlines by four hands, free or among fixtures, for the survey `overlaps`."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely

import pushjax as pj
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.simulation.hand import Pad

MM = 1e-3
# Vertices of the polygon that replaces a smooth outline. Its chords are within 0.2 um of the outline.
FINE = 4000


def _around(radius, count: int = 16) -> np.ndarray:
    """Return `count` points (m) of the outline whose radius in mm is given as a function of the polar angle."""
    angle = 2 * np.pi * np.arange(count) / count
    return MM * radius(angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _comb() -> list[tuple[float, float]]:
    """Return the vertices, in mm, of a comb with three teeth of 18 mm and gaps of 24 mm."""
    tops = [(x + a, y) for x in (84, 42, 0) for a, y in ((18, 50), (0, 50), (0, 15), (-24, 15))][:-2]
    return [(0, 0), (102, 0), *tops]


def _star() -> np.ndarray:
    """Return the vertices, in mm, of a star with five points."""
    angle = np.pi * np.arange(10) / 5
    return np.where(np.arange(10) % 2, 28, 60)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


POLYGONS = {
    "L": [(0, 0), (120, 0), (120, 40), (40, 40), (40, 80), (0, 80)],
    "T": [(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)],
    "U": [(0, 0), (120, 0), (120, 80), (80, 80), (80, 30), (40, 30), (40, 80), (0, 80)],
    "plus": [(-20, -60), (20, -60), (20, -20), (60, -20), (60, 20), (20, 20), (20, 60), (-20, 60), (-20, 20),
             (-60, 20), (-60, -20), (-20, -20)],
    "Z": [(0, 0), (80, 0), (80, 40), (120, 40), (120, 80), (40, 80), (40, 40), (0, 40)],
    "arrow": [(-40, -50), (70, 0), (-40, 50), (-10, 0)],
    "comb": _comb(),
    "star": _star(),
    "rectangle": [(-45, -30), (45, -30), (45, 30), (-45, 30)],
    "hexagon": [(50 * np.cos(np.pi * k / 3), 50 * np.sin(np.pi * k / 3)) for k in range(6)],
}  # fmt: skip
SMOOTH = {
    "bean": lambda: pj.Curve.through(_around(lambda a: 45 + 14 * np.cos(2 * a) - 12 * np.sin(a))),
    "clover": lambda: pj.Curve.through(_around(lambda a: 45 + 11 * np.cos(3 * a), 24)),
    "peanut": lambda: pj.Curve.through(_around(lambda a: 42 + 18 * np.cos(2 * a), 20)),
    "ellipse": lambda: pj.Ellipse(0.06, 0.035),
    "disk": lambda: pj.Disk(0.045),
}
SHAPES = (*POLYGONS, *SMOOTH)
HANDS = ("one", "two", "three", "jaw")
Fixtures = tuple[pj.Wall | pj.Fixture, ...]


def _walls(mu, *walls: tuple) -> Fixtures:
    """Return walls, each given by a point (m) and its normal."""
    return tuple(pj.Wall(point, normal, mu) for point, normal in walls)


def _disks(mu, *disks: tuple) -> Fixtures:
    """Return disks, each given by its radius and center, m."""
    return tuple(pj.Fixture(pj.Disk(radius), (*center, 0.0), mu) for radius, center in disks)


BELOW = (0.0, -0.14), (0.0, 1.0)
# Fixtures around the slider, as functions of their friction.
SCENES: dict[str, Callable[..., Fixtures]] = {
    "free": _walls,
    "wall": lambda mu: _walls(mu, BELOW),
    "corner": lambda mu: _walls(mu, BELOW, ((0.15, 0.0), (-1.0, 0.0))),
    "wedge": lambda mu: _walls(mu, ((0.0, -0.14), (0.3, 1.0)), ((0.15, 0.0), (-1.0, 0.4))),
    "room": lambda mu: _walls(mu, *(((-0.15 * x, -0.15 * y), (x, y)) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)))),
    "peg": lambda mu: _disks(mu, (0.02, (0.15, 0.0))),
    "pegs": lambda mu: _disks(mu, (0.02, (0.15, 0.06)), (0.02, (0.15, -0.06)), (0.03, (-0.12, 0.14))),
    "block": lambda mu: (pj.Fixture(pj.Polygon.rectangle(0.06, 0.04), (0.16, 0.01, 0.4), mu), *_walls(mu, BELOW)),
}
FINGER = 8 * MM
PAD = (50 * MM, 10 * MM)


def shape_of(name: str) -> pj.Polygon | pj.Curve | pj.Ellipse | pj.Disk:
    """Return the outline of that name, one of `SHAPES`; polygons have their centroid at the origin."""
    if name in SMOOTH:
        return SMOOTH[name]()
    vertices = MM * np.asarray(POLYGONS[name], float)
    middle = np.asarray(shapely.Polygon(vertices).centroid.coords[0])
    return pj.Polygon(vertices - middle)


def outline_of(shape) -> shapely.Polygon:
    """Return the outline as a polygon of shapely."""
    points = shape.vertices if isinstance(shape, pj.Polygon) else shape.boundary(FINE)
    return shapely.Polygon(np.asarray(points, float))


def hand_of(name: str) -> pj.Hand:
    """Return the hand of that name, one of `HANDS`."""
    return {
        "one": lambda: pj.Hand.finger(FINGER),
        "two": lambda: pj.Hand.two_fingers(FINGER),
        "three": lambda: pj.Hand.three_fingers(FINGER),
        "jaw": lambda: pj.Hand.parallel_jaw(*PAD),
    }[name]()


def ends_of(name: str, rng: np.random.Generator, starts: int) -> np.ndarray:
    """Return the first and the last configuration of each push by the named hand, (starts, 2, dof)."""
    if name == "one":
        angle, aside = rng.uniform(-np.pi, np.pi, starts), rng.uniform(-0.04, 0.04, starts)
        along, across = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)
        begin = -0.16 * along + aside[:, None] * across
        return np.stack([begin, begin + 0.3 * along], axis=1)
    first, last = {"two": (0.32, 0.02), "three": (0.17, 0.012), "jaw": (0.32, 0.02)}[name]
    still = np.zeros((starts, 2, 3))
    return np.concatenate([still, np.broadcast_to([[first], [last]], (starts, 2, 1))], axis=2)


class Survey(NamedTuple):
    """The pushes of one outline by one hand, and their trajectories."""

    hand: pj.Hand
    slider: pj.Slider
    path: np.ndarray  # configurations of the hand, (starts, steps + 1, dof)
    pose: np.ndarray  # start poses of the slider, (starts, 3)
    friction: np.ndarray  # coefficients, (starts,)
    push: pj.Trajectory  # with a leading axis (starts,)
    scene: str = "free"  # name of the fixtures

    @property
    def shape(self):
        """The outline of the slider."""
        return self.slider.shape


def surface_of(shape, key) -> pj.LimitSurface:
    """Return the quartic of uniform pressure on 64 points of the outline."""
    support = pj.Support.uniform(shape, points=64, load=1.0)
    return pj.fit_limit_surface(*support.wrench_twist_pairs(key, 400), degree=4)


def simulate(
    shape_name: str, hand_name: str, starts: int, steps: int, dtype, seed: int = 0, scene: str = "free"
) -> Survey:
    """Simulate random pushes of one of `SHAPES` by one of `HANDS` in one of `SCENES`."""
    shape, hand = shape_of(shape_name), hand_of(hand_name)
    seeds = (seed, SHAPES.index(shape_name), HANDS.index(hand_name))
    rng = np.random.default_rng(seeds)
    surface = surface_of(shape, jax.random.key(seed))
    slider, hand = (jax.tree.map(lambda leaf: leaf.astype(dtype), tree) for tree in (pj.Slider(shape, surface), hand))
    ends = ends_of(hand_name, rng, starts)
    pose = np.concatenate([rng.uniform(-0.02, 0.02, (starts, 2)), rng.uniform(-np.pi, np.pi, (starts, 1))], axis=1)
    friction = rng.uniform(0.05, 0.6, starts)
    t = np.linspace(0, 1, steps + 1)[:, None]
    path = (ends[:, :1] * (1 - t) + ends[:, 1:] * t).astype(dtype)
    pose, friction = pose.astype(dtype), friction.astype(dtype)
    push_all = jax.jit(jax.vmap(rollout, (None, None, 0, 0, 0, None)), static_argnums=5)
    push = push_all(slider, hand, path, pose, friction, scene)
    return Survey(hand, slider, path, pose, friction, jax.tree.map(np.asarray, push), scene)


# The slider is an argument so that polygons with the same number of vertices share a program in the compilation cache.
def rollout(slider, hand, path, pose, friction, scene="free") -> pj.Trajectory:
    """Simulate one push."""
    return pj.rollout(slider, hand, path, pose=pose, friction=friction, fixtures=SCENES[scene](friction))


def seen_by_slider(
    hand: pj.Hand, scene: str, poses: np.ndarray, configurations: np.ndarray
) -> list[tuple[float, np.ndarray]]:
    """Return the radius and place of each finger and fixture in the body frame of the slider, at poses (..., 3)."""
    # A round body has its radius, m, and its center, (..., 1, 2). A pad, or a wall as a rectangle of 2 m by 1 m, has
    # zero and its corners, (..., 4, 2), m.
    where = np.asarray(hand.poses(jnp.asarray(configurations)), float)
    bodies: list[tuple] = [(finger, where[..., k, None, :]) for k, finger in enumerate(hand.fingers)]
    for fixture in SCENES[scene](0.0):
        if isinstance(fixture, pj.Wall):
            nx, ny = normal = np.asarray(fixture.normal, float)
            pose = np.append(np.asarray(fixture.point, float) - normal / 2, np.arctan2(-nx, ny))
            bodies.append((Pad(pj.Polygon.rectangle(2.0, 1.0)), pose))
        else:
            bodies.append((fixture.body, np.asarray(fixture.pose, float)[None]))
    found = []
    for body, pose in bodies:
        is_pad = isinstance(body, Pad)
        points = to_world(pose, np.asarray(body.shape.vertices, float)) if is_pad else pose[..., :2]
        found.append((0.0 if is_pad else float(body.radius), to_body(poses[..., None, :], points)))
    return found
