"""Random pushes and grasps of many outlines by four hands, free or among fixtures, for the survey `overlaps`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely

import pushjax as pj
from pushjax.simulation.hand import Pad, RoundFinger

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
# Fixtures around the slider: walls as (point, normal), m; disks as (radius, center) and rectangles as (size, pose).
SCENES = {
    "free": (),
    "wall": (("wall", (0.0, -0.14), (0.0, 1.0)),),
    "corner": (("wall", (0.0, -0.14), (0.0, 1.0)), ("wall", (0.15, 0.0), (-1.0, 0.0))),
    "wedge": (("wall", (0.0, -0.14), (0.3, 1.0)), ("wall", (0.15, 0.0), (-1.0, 0.4))),
    "room": tuple(
        ("wall", (-0.15 * x, -0.15 * y), (x, y)) for x, y in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
    ),
    "peg": (("disk", 0.02, (0.15, 0.0)),),
    "pegs": (("disk", 0.02, (0.15, 0.06)), ("disk", 0.02, (0.15, -0.06)), ("disk", 0.03, (-0.12, 0.14))),
    "block": (("rectangle", (0.06, 0.04), (0.16, 0.01, 0.4)), ("wall", (0.0, -0.14), (0.0, 1.0))),
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


def fixtures_of(scene: str, friction) -> tuple[pj.Wall | pj.Fixture, ...]:
    """Return the fixtures of a scene, all with the same friction."""
    found = []
    for kind, first, second in SCENES[scene]:
        if kind == "wall":
            found.append(pj.Wall(first, second, friction))
        elif kind == "disk":
            found.append(pj.Fixture(pj.Disk(first), (*second, 0.0), friction))
        else:
            found.append(pj.Fixture(pj.Polygon.rectangle(*first), second, friction))
    return tuple(found)


# The slider is an argument so that polygons with the same number of vertices share a program in the compilation cache.
def rollout(slider, hand, path, pose, friction, scene="free") -> pj.Trajectory:
    """Simulate one push."""
    fixtures = fixtures_of(scene, friction)
    return pj.rollout(slider, hand, path, pose=pose, friction=friction, fixtures=fixtures)


def fixtures_seen_by_slider(scene: str, poses: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return the radius and place of each fixture in the body frame of the slider, at poses (..., 3)."""
    # A disk has its radius, m, and its center, (..., 1, 2). A rectangle, or a wall as a rectangle of 2 m by 1 m, has
    # zero and its corners, (..., 4, 2), m.
    c, s = np.cos(poses[..., None, 2]), np.sin(poses[..., None, 2])
    found = []
    for kind, first, second in SCENES[scene]:
        if kind == "wall":
            normal = np.asarray(second) / np.linalg.norm(second)
            along = np.array([normal[1], -normal[0]])
            points = np.asarray(first) + np.array([along, -along, -along - normal, along - normal])[::-1]
        elif kind == "disk":
            points = np.asarray(second)[None]
        else:
            half, angle = np.asarray(first) / 2, second[2]
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            points = second[:2] + (half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])) @ turn.T
        away = points - poses[..., None, :2]
        local = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]], axis=-1)
        found.append((float(first) if kind == "disk" else 0.0, local))
    return found


def seen_by_slider(hand: pj.Hand, poses: np.ndarray, configurations: np.ndarray) -> list[np.ndarray]:
    """Return the center of each finger or the corners of a pad, (..., points, 2), m, in the slider's body frame."""
    where = np.asarray(hand.poses(jnp.asarray(configurations)), float)
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    found = []
    for k, finger in enumerate(hand.fingers):
        away = where[..., k, :2] - poses[..., :2]
        local = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]], axis=-1)
        placed = local[..., None, :]
        if isinstance(finger, Pad):
            turn = where[..., k, 2] - poses[..., 2]
            corners = np.asarray(finger.shape.vertices, float)
            cs, sn = np.cos(turn)[..., None], np.sin(turn)[..., None]
            placed = placed + np.stack(
                [cs * corners[:, 0] - sn * corners[:, 1], sn * corners[:, 0] + cs * corners[:, 1]], axis=-1
            )
        elif not isinstance(finger, RoundFinger):
            raise TypeError(f"not a finger: {finger!r}")
        found.append(placed)
    return found
