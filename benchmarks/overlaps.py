"""Whether any finger ends a step inside the slider, judged by shapely, which shares no code with the library.

Random starts and frictions of every hand on outlines of many kinds, convex or not, with corners or without, in fine
and coarse steps and both floating types. A step is wrong if its status says MOVING, FREE, JAMMED or GRASPED, and a
finger is deeper inside than it was before, and than 0.1 mm (300 steps) or a fifth of the hand's displacement in the
step (60 steps).

    python benchmarks/overlaps.py --starts 500 --hands jaw two --shapes L T --steps 300 --dtype float64
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely

import pushjax as pj
from pushjax.hands import Pad, RoundFinger

MM = 1e-3
# Vertices of a polygon in place of a smooth outline: its chords are within 0.2 um of it.
FINE = 4000


def _around(radius, count: int = 16) -> np.ndarray:
    """Points, m, of the polar outline radius(angle) in mm."""
    angle = 2 * np.pi * np.arange(count) / count
    return MM * radius(angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _comb() -> list[tuple[float, float]]:
    """Three teeth of 18 mm with gaps of 24 mm."""
    tops = [(x + a, y) for x in (84, 42, 0) for a, y in ((18, 50), (0, 50), (0, 15), (-24, 15))][:-2]
    return [(0, 0), (102, 0), *tops]


def _star() -> np.ndarray:
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
    if name in SMOOTH:
        return SMOOTH[name]()
    vertices = MM * np.asarray(POLYGONS[name], float)
    middle = np.asarray(shapely.Polygon(vertices).centroid.coords[0])
    return pj.Polygon(vertices - middle)


def outline_of(shape) -> shapely.Polygon:
    """The same for the judge."""
    points = shape.vertices if isinstance(shape, pj.Polygon) else shape.boundary(FINE)
    return shapely.Polygon(np.asarray(points, float))


def hand_of(name: str) -> pj.Hand:
    return {
        "one": lambda: pj.Hand.finger(FINGER),
        "two": lambda: pj.Hand.two_fingers(FINGER),
        "three": lambda: pj.Hand.three_fingers(FINGER),
        "jaw": lambda: pj.Hand.parallel_jaw(*PAD),
    }[name]()


def ends_of(name: str, rng: np.random.Generator, starts: int) -> np.ndarray:
    """First and last configurations (starts, 2, dof)."""
    if name == "one":
        angle, aside = rng.uniform(-np.pi, np.pi, starts), rng.uniform(-0.04, 0.04, starts)
        along, across = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)
        begin = -0.16 * along + aside[:, None] * across
        return np.stack([begin, begin + 0.3 * along], axis=1)
    first, last = {"two": (0.32, 0.02), "three": (0.17, 0.012), "jaw": (0.32, 0.02)}[name]
    still = np.zeros((starts, 2, 3))
    return np.concatenate([still, np.broadcast_to([[first], [last]], (starts, 2, 1))], axis=2)


class Survey(NamedTuple):
    """The pushes of one cell: hand and slider, starts, and what became of them."""

    hand: pj.Hand
    shape: object
    path: np.ndarray
    pose: np.ndarray
    friction: np.ndarray
    push: pj.Trajectory


def surface_of(shape, key) -> pj.LimitSurface:
    support = pj.Support.uniform(shape, points=64, load=1.0)
    return pj.fit_limit_surface(*support.wrench_twist_pairs(key, 400), degree=4)


def run(shape_name: str, hand_name: str, starts: int, steps: int, dtype, seed: int = 0) -> Survey:
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
    push = jax.jit(jax.vmap(lambda path, pose, mu: pj.rollout(slider, hand, path, pose=pose, friction=mu)))(
        path, pose, friction
    )
    return Survey(hand, shape, path, pose, friction, jax.tree.map(np.asarray, push))


def overlaps(survey: Survey) -> np.ndarray:
    """How deep a finger is inside the slider, m, at each of the poses (starts, steps + 1), by shapely."""
    body = outline_of(survey.shape)
    shapely.prepare(body)
    edge = body.exterior
    shapely.prepare(edge)
    pose = np.asarray(survey.push.pose, float)
    where = np.asarray(jax.vmap(survey.hand.poses)(jnp.asarray(survey.push.configuration)), float)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    deepest = np.full(pose.shape[:-1], -np.inf)
    for k, finger in enumerate(survey.hand.fingers):
        away = where[..., k, :2] - pose[..., :2]
        local = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]], axis=-1)
        if isinstance(finger, Pad):
            turn = where[..., k, 2] - pose[..., 2]
            corners = np.asarray(finger.shape.vertices, float)
            cs, sn = np.cos(turn)[..., None], np.sin(turn)[..., None]
            placed = np.stack([cs * corners[:, 0] - sn * corners[:, 1], sn * corners[:, 0] + cs * corners[:, 1]], -1)
            depth = _pads(body, edge, placed + local[..., None, :])
        elif isinstance(finger, RoundFinger):
            centers = shapely.points(local)
            distance = shapely.distance(edge, centers)
            depth = float(finger.radius) - np.where(shapely.contains(body, centers), -distance, distance)
        else:
            raise TypeError(f"not a finger: {finger!r}")
        deepest = np.maximum(deepest, depth)
    return deepest


def _pads(body: shapely.Polygon, edge, corners: np.ndarray) -> np.ndarray:
    """Of pads with these corners (…, corners, 2): how deep a corner of either is in the other, or how wide what they
    share is where no corner is."""
    shape = corners.shape[:-2]
    flat = corners.reshape(-1, *corners.shape[-2:])
    pads = np.asarray(shapely.polygons(flat))
    depth = np.zeros(len(flat))
    near = np.flatnonzero(shapely.intersects(body, pads))
    points = shapely.points(flat[near])
    inside = shapely.contains(body, points)
    depth[near] = np.max(np.where(inside, shapely.distance(edge, points), 0.0), axis=1)
    theirs = np.asarray(body.exterior.coords)[:-1]
    # the body's vertices in each pad: distances to the lines of the pad's edges
    a, b = flat[near], np.roll(flat[near], -1, axis=1)
    along = (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)
    for first in range(0, len(near), 500):
        part = slice(first, first + 500)
        rel = theirs[None, :, None] - a[part, None]
        height = along[part, None, :, 0] * rel[..., 1] - along[part, None, :, 1] * rel[..., 0]
        depth[near[part]] = np.maximum(depth[near[part]], np.max(np.min(height, axis=-1), axis=1))
    shared = shapely.intersection(pads[near], body)
    width = 2 * shapely.area(shared) / np.maximum(shapely.length(shared), 1e-12)  # at most what it is, at least half
    depth[near] = np.maximum(depth[near], 2 * width * (width > 2 * depth[near]))
    return depth.reshape(shape)


def allowed(survey: Survey, steps: int) -> float:
    """How deep, m: see the header."""
    if steps >= 300:
        return 0.1 * MM
    where = np.asarray(jax.vmap(survey.hand.poses)(jnp.asarray(survey.path)), float)[..., :2]
    return 0.2 * float(np.max(np.linalg.norm(np.diff(where, axis=1), axis=-1)))


def judged(survey: Survey, steps: int) -> dict:
    """What is wrong, and how often."""
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
        "ends": {s.name: int(np.sum(status[:, -1] == s)) for s in pj.Status if np.any(status[:, -1] == s)},
    }  # fmt: skip


def _line(row: dict) -> str:
    cell = f"{row['hand']:6}{row['shape']:10}{row['steps']:4} {row['dtype']}"
    counts = f"{row['wrong']:3} wrong, deepest {row['deepest_mm']:.3f} mm; {row['failed']:3} failed"
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
                    if found["wrong"] or found["failed"]:
                        print("      ", found["steps_wrong"][:6], found["failures"][:6], flush=True)
                    if asked.json:
                        asked.json.write_text(json.dumps(rows, indent=1))
                jax.clear_caches()


if __name__ == "__main__":
    main()
