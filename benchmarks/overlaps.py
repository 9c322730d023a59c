"""Check by shapely that no finger ends a step inside the slider.

Shapely computes the penetration depth; it shares no code with the library. Every hand pushes outlines of many kinds,
convex or not, with corners or without, from random starts and with random friction, in fine and coarse steps and in
both floating types. A step is wrong if its status is MOVING, FREE, JAMMED or GRASPED, and a finger is deeper inside the
slider than before the step and deeper than a limit. The limit is 0.1 mm with 300 steps, and a fifth of the hand's
displacement in the step with 60 steps. A push that ends GRASPED or JAMMED has to be confirmed (see `unconfirmed`).

    python -m benchmarks overlaps --starts 500 --hands jaw two --shapes L T --steps 300 --dtype float64
"""

import argparse
import json
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from scipy.optimize import linprog

import pushjax as pj
from pushjax.simulation.hand import Pad, RoundFinger

MM = 1e-3
# Vertices of the polygon that replaces a smooth outline. Its chords are within 0.2 um of the outline.
FINE = 4000
# Parts into which the step of a jam is divided to confirm it.
FINER = 256


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
    """Return the outline as a polygon of shapely, which judges overlaps."""
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
    """Return the first and the last configuration of each push.

    Args:
        name: Name of the hand.
        rng: Generator of the pushes.
        starts: Number of pushes.

    Returns:
        Configurations, (starts, 2, dof).
    """
    if name == "one":
        angle, aside = rng.uniform(-np.pi, np.pi, starts), rng.uniform(-0.04, 0.04, starts)
        along, across = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)
        begin = -0.16 * along + aside[:, None] * across
        return np.stack([begin, begin + 0.3 * along], axis=1)
    first, last = {"two": (0.32, 0.02), "three": (0.17, 0.012), "jaw": (0.32, 0.02)}[name]
    still = np.zeros((starts, 2, 3))
    return np.concatenate([still, np.broadcast_to([[first], [last]], (starts, 2, 1))], axis=2)


class Survey(NamedTuple):
    """The pushes of one outline by one hand, and their trajectories.

    Attributes:
        hand: The hand.
        slider: The slider.
        path: Configurations of the hand, (starts, steps + 1, dof).
        pose: Start poses of the slider, (starts, 3).
        friction: Friction coefficients, (starts,).
        push: Trajectories, with a leading axis (starts,).
    """

    hand: pj.Hand
    slider: pj.Slider
    path: np.ndarray
    pose: np.ndarray
    friction: np.ndarray
    push: pj.Trajectory

    @property
    def shape(self):
        """The outline of the slider."""
        return self.slider.shape


def surface_of(shape, key) -> pj.LimitSurface:
    """Return the quartic of uniform pressure on 64 points of the outline."""
    support = pj.Support.uniform(shape, points=64, load=1.0)
    return pj.fit_limit_surface(*support.wrench_twist_pairs(key, 400), degree=4)


def run(shape_name: str, hand_name: str, starts: int, steps: int, dtype, seed: int = 0) -> Survey:
    """Simulate random pushes of one outline by one hand.

    Args:
        shape_name: One of `SHAPES`.
        hand_name: One of `HANDS`.
        starts: Number of pushes.
        steps: Number of steps of each push.
        dtype: Floating type.
        seed: Seed of the pushes.
    """
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
    push = jax.jit(jax.vmap(_rollout, (None, None, 0, 0, 0)))(slider, hand, path, pose, friction)
    return Survey(hand, slider, path, pose, friction, jax.tree.map(np.asarray, push))


# The slider is an argument so that polygons with the same number of vertices share a program in the compilation cache.
def _rollout(slider, hand, path, pose, friction) -> pj.Trajectory:
    return pj.rollout(slider, hand, path, pose=pose, friction=friction)


def seen_by_slider(hand: pj.Hand, poses: np.ndarray, configurations: np.ndarray) -> list[np.ndarray]:
    """Return the place of each finger in the body frame of the slider.

    Args:
        hand: The hand.
        poses: Poses of the slider, (..., 3).
        configurations: Configurations of the hand, (..., dof).

    Returns:
        For each finger its center, (..., 1, 2), or the corners of a pad, (..., corners, 2), m.

    Raises:
        TypeError: If a finger is neither a `RoundFinger` nor a `Pad`.
    """
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


def overlaps(survey: Survey) -> np.ndarray:
    """Return the largest penetration depth of any finger at each pose, by shapely.

    Args:
        survey: The pushes.

    Returns:
        Depths, (starts, steps + 1), m.
    """
    body = outline_of(survey.shape)
    shapely.prepare(body)
    edge = body.exterior
    shapely.prepare(edge)
    pose = np.asarray(survey.push.pose, float)
    deepest = np.full(pose.shape[:-1], -np.inf)
    for finger, placed in zip(
        survey.hand.fingers, seen_by_slider(survey.hand, pose, np.asarray(survey.push.configuration)), strict=True
    ):
        if isinstance(finger, RoundFinger):
            centers = shapely.points(placed[..., 0, :])
            distance = shapely.distance(edge, centers)
            depth = float(finger.radius) - np.where(shapely.contains(body, centers), -distance, distance)
        else:
            depth = _pads(body, edge, placed)
        deepest = np.maximum(deepest, depth)
    return deepest


def _pads(body: shapely.Polygon, edge, corners: np.ndarray) -> np.ndarray:
    """Return the penetration depths of pads with these corners, (…, corners, 2).

    The depth is that of a corner of the body in the pad, or of the pad in the body. Where no corner lies in the other,
    it is the width of their intersection.
    """
    shape = corners.shape[:-2]
    flat = corners.reshape(-1, *corners.shape[-2:])
    pads = np.asarray(shapely.polygons(flat))
    depth = np.zeros(len(flat))
    near = np.flatnonzero(shapely.intersects(body, pads))
    points = shapely.points(flat[near])
    inside = shapely.contains(body, points)
    depth[near] = np.max(np.where(inside, shapely.distance(edge, points), 0.0), axis=1)
    theirs = np.asarray(body.exterior.coords)[:-1]
    # Depth of the body's vertices in each pad, from their distances to the lines of the pad's edges.
    a, b = flat[near], np.roll(flat[near], -1, axis=1)
    along = (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)
    for first in range(0, len(near), 500):
        part = slice(first, first + 500)
        rel = theirs[None, :, None] - a[part, None]
        height = along[part, None, :, 0] * rel[..., 1] - along[part, None, :, 1] * rel[..., 0]
        depth[near[part]] = np.maximum(depth[near[part]], np.max(np.min(height, axis=-1), axis=1))
    shared = shapely.intersection(pads[near], body)
    width = 2 * shapely.area(shared) / np.maximum(shapely.length(shared), 1e-12)  # between half the width and the width
    depth[near] = np.maximum(depth[near], 2 * width * (width > 2 * depth[near]))
    return depth.reshape(shape)


def unconfirmed(survey: Survey) -> list[tuple[int, str]]:
    """Find pushes that end GRASPED or JAMMED although the slider is not held.

    GRASPED promises that every finger is within reach of the slider: within four times the largest displacement in the
    step, or 1e-4 of the surface's length. A jam needs forces at the places in reach, inside their friction cones, that
    balance each other and on which the hand does work. A linear program searches for them, for polygons only.

    A hand that jams stops at the start of that step. If nothing holds the slider there yet, the step is repeated in
    `FINER` parts. It has to jam in one of them, with such forces.

    Args:
        survey: The pushes.

    Returns:
        The number of each such push, and the reason.
    """
    status = survey.push.status[:, -1]
    ended = np.flatnonzero((status == pj.Status.GRASPED) | (status == pj.Status.JAMMED)).tolist()
    body, found = outline_of(survey.shape), []
    where = np.asarray(survey.hand.poses(jnp.asarray(survey.path)), float)
    for i in ended:
        at = int(np.argmax(survey.push.status[i] == status[i]))
        step = where[i, at + 1, :, :2] - where[i, at, :, :2]
        reach = max(1e-4 * float(survey.slider.surface.length), 4 * float(np.max(np.abs(step).sum(axis=-1))))
        pose = np.asarray(survey.push.pose[i, -1], float)
        fingers = _placed(survey, pose, np.asarray(survey.push.configuration[i, -1]))
        away = [finger.away(body) for finger in fingers]
        if status[i] == pj.Status.GRASPED and max(away) > 1.01 * reach:
            found.append((int(i), f"a finger is {1e3 * max(away):.3f} mm away"))
        elif isinstance(survey.shape, pj.Polygon):
            mu = float(survey.friction[i])
            if not _jams(body, fingers, _turned(step, pose), mu, reach) and not _jams_later(survey, body, i, at, reach):
                found.append((int(i), "nothing holds it"))
    return found


def _turned(steps: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the steps (fingers, 2) in the body frame of the slider."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return steps @ np.array([[c, -s], [s, c]])


def _jams_later(survey: Survey, body: shapely.Polygon, i: int, at: int, reach: float) -> bool:
    """Return whether push `i` jams within step `at`, done in `FINER` parts."""
    path = pj.line(survey.path[i, at], survey.path[i, at + 1], FINER)
    push = jax.jit(_rollout)(survey.slider, survey.hand, path, survey.push.pose[i, at], survey.friction[i])
    stopped = int(push.stopped)
    if stopped < 0:
        return False
    pose = np.asarray(push.pose[-1], float)
    fingers = _placed(survey, pose, np.asarray(push.configuration[-1]))
    where = np.asarray(survey.hand.poses(path[stopped : stopped + 2]), float)[..., :2]
    # It jams within that part, or while an overlap is pushed out. Until then the slider turns as it did before.
    if stopped > 0:
        turns = np.ptp(push.pose[stopped - 1 : stopped + 1, 2])
    else:
        way = np.max(np.linalg.norm(where[1] - where[0], axis=-1))  # displacement in one part
        turns = np.ptp(survey.push.pose[i, at - 1 : at + 1, 2]) * max(1.0, survey.push.overlap[i, at - 1] / way) / FINER
    friction = 1.01 * float(survey.friction[i]) + float(turns)
    return _jams(body, fingers, _turned(where[1] - where[0], pose), friction, reach)


class Disc(NamedTuple):
    """A round finger in the body frame of the slider.

    Attributes:
        center: Center, (2,), m.
        radius: Radius, m.
    """

    center: np.ndarray
    radius: float

    def away(self, body: shapely.Polygon) -> float:
        """Return the distance from the body, m; not more than -radius if the center lies inside the body."""
        return body.distance(shapely.Point(self.center)) - self.radius

    def places(self, body: shapely.Polygon, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Find the edges and vertices of the body that are within reach.

        Args:
            body: Outline of the slider.
            reach: Largest distance from the finger, m.

        Returns:
            For each of them the closest point, (2,), m, and the normal from there into the body, (2,).
        """
        found = []
        for a, b in pairwise(_ring(body)):
            length = np.linalg.norm(b - a)
            along = (b - a) / length
            at = (self.center - a) @ along
            for point in (a, a + along * at) if 0 < at < length else (a,):
                off = point - self.center
                size = float(np.linalg.norm(off))
                if abs(size - self.radius) <= reach and size > 0:
                    found.append((point, off / size))
        return found


class Plate(NamedTuple):
    """A pad in the body frame of the slider."""

    solid: shapely.Polygon

    def away(self, body: shapely.Polygon) -> float:
        """Return the distance from the body, m."""
        return body.distance(self.solid)

    def places(self, body: shapely.Polygon, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Find the corners of pad and body within reach of an edge of the other; returns are those of `Disc.places`."""
        return _corners(body, self.solid, reach) + [(p, -n) for p, n in _corners(self.solid, body, reach)]


def _placed(survey: Survey, pose: np.ndarray, configuration: np.ndarray) -> list[Disc | Plate]:
    """Return the fingers in the body frame of the slider."""
    seen = seen_by_slider(survey.hand, pose, configuration)
    return [
        Disc(where[0], float(finger.radius)) if isinstance(finger, RoundFinger) else Plate(shapely.Polygon(where))
        for finger, where in zip(survey.hand.fingers, seen, strict=True)
    ]


def _jams(body: shapely.Polygon, fingers: list[Disc | Plate], steps: np.ndarray, mu: float, reach: float) -> bool:
    """Return whether forces at the places in reach can balance each other while the fingers do work on them.

    Args:
        body: Outline of the slider.
        fingers: Fingers in the body frame.
        steps: Displacements of the fingers in the body frame, (fingers, 2), m.
        mu: Friction coefficient, which limits the forces to their friction cones.
        reach: Distance within which a place counts as a contact, m.
    """
    wrenches, works = [], []
    for finger, step in zip(fingers, steps, strict=True):
        for point, normal in finger.places(body, reach):
            tangent = np.array([-normal[1], normal[0]])
            for force in (normal + mu * tangent, normal - mu * tangent):
                wrenches.append([*force, (point[0] * force[1] - point[1] * force[0]) / 0.05])
                works.append(force @ step)
    if not wrenches:
        return False
    columns = np.array(wrenches).T
    balance = np.vstack([columns, np.ones(columns.shape[1])])  # forces that balance and are not all zero
    best = linprog(-np.array(works), A_eq=balance, b_eq=[0, 0, 0, 1], bounds=(0, None))
    return best.success and -best.fun > 0


def _ring(body: shapely.Polygon) -> np.ndarray:
    """Return the vertices of a polygon, counter-clockwise, with the first one again at the end."""
    return np.asarray(shapely.geometry.polygon.orient(body).exterior.coords)


def _corners(body: shapely.Polygon, other: shapely.Polygon, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Find corners of `other` within reach of an edge of `body`: the points on the edge, and the normals into it."""
    tips = np.asarray(other.exterior.coords)[:-1]
    found = []
    for a, b in pairwise(_ring(body)):
        size = np.linalg.norm(b - a)
        along = (b - a) / size
        normal = np.array([-along[1], along[0]])
        height, at = (tips - a) @ normal, (tips - a) @ along
        near = (np.abs(height) <= reach) & (at >= -reach) & (at <= size + reach)
        found += [(a + along * at[k], normal) for k in np.flatnonzero(near)]
    return found


def allowed(survey: Survey, steps: int) -> float:
    """Return the largest penetration depth that is not wrong, m (see the header of this module)."""
    if steps >= 300:
        return 0.1 * MM
    where = np.asarray(survey.hand.poses(jnp.asarray(survey.path)), float)[..., :2]
    return 0.2 * float(np.max(np.linalg.norm(np.diff(where, axis=1), axis=-1)))


def judged(survey: Survey, steps: int) -> dict:
    """Return which pushes are wrong, failed or unconfirmed, and how many end with each status."""
    depth = overlaps(survey)
    status = survey.push.status
    told = np.isin(status, [pj.Status.MOVING, pj.Status.FREE, pj.Status.JAMMED, pj.Status.GRASPED])
    limit = allowed(survey, steps)
    wrong = told & (depth[:, 1:] > limit) & (depth[:, 1:] > depth[:, :-1] + 0.01 * limit)
    bad = np.flatnonzero(wrong.any(axis=1))
    failed = np.flatnonzero((~told).any(axis=1))
    first = [int(np.argmax(~told[i])) for i in failed]
    return {
        "wrong": len(bad),
        "deepest_mm": float(1e3 * np.max(np.where(told, depth[:, 1:], 0))),
        "steps_wrong": [(int(i), int(np.argmax(wrong[i])), round(1e3 * float(depth[i, 1:][wrong[i]].max()), 3))
                        for i in bad][:40],
        "failed": len(failed),
        "failures": [(int(i), k, pj.Status(int(status[i, k])).name) for i, k in zip(failed, first, strict=True)][:40],
        "unconfirmed": unconfirmed(survey),
        "ends": {s.name: int(np.sum(status[:, -1] == s)) for s in pj.Status if np.any(status[:, -1] == s)},
    }  # fmt: skip


def _line(row: dict) -> str:
    """Return the line that is printed for a row."""
    cell = f"{row['hand']:6}{row['shape']:10}{row['steps']:4} {row['dtype']}"
    counts = f"{row['wrong']:3} wrong, deepest {row['deepest_mm']:.3f} mm; {row['failed']:3} failed, "
    counts += f"{len(row['unconfirmed'])} unconfirmed"
    return f"{cell}: {counts}; {row['ends']}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=SHAPES)
    parser.add_argument("--hands", nargs="+", choices=HANDS, default=HANDS)
    parser.add_argument("--steps", nargs="+", type=int, default=(300, 60))
    parser.add_argument("--dtype", nargs="+", choices=("float64", "float32"), default=("float64", "float32"))
    parser.add_argument("--starts", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for hand in asked.hands:
        for shape in asked.shapes:
            for steps in asked.steps:
                for dtype in asked.dtype:
                    found = judged(run(shape, hand, asked.starts, steps, np.dtype(dtype), asked.seed), steps)
                    rows.append({"hand": hand, "shape": shape, "steps": steps, "dtype": dtype} | found)
                    print(_line(rows[-1]), flush=True)
                    told = [found[kind][:6] for kind in ("steps_wrong", "failures", "unconfirmed")]
                    if any(told):
                        print("      ", *told, flush=True)
                    if asked.json:
                        asked.json.write_text(json.dumps(rows, indent=1))
                jax.clear_caches()


if __name__ == "__main__":
    main()
