"""Check by shapely that no finger and no fixture ends a step inside the slider.

Shapely computes the penetration depth; it shares no code with the library. Every hand pushes outlines of many kinds,
convex or not, with corners or without, from random starts and with random friction, in fine and coarse steps and in
both floating types. A step is wrong if its status is MOVING, FREE, JAMMED or GRASPED, and a finger is deeper inside the
slider than before the step and deeper than a limit. The limit is 0.1 mm with 300 steps, and a fifth of the hand's
displacement in the step with 60 steps. A push that ends GRASPED or JAMMED has to be confirmed by
shapely and linear programs (see `unconfirmed`).
"""

from collections.abc import Callable
from itertools import pairwise, product
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from scipy.optimize import linprog

import pushjax as pj
from benchmarks.random_pushes import (
    HANDS,
    MM,
    SCENES,
    SHAPES,
    Survey,
    outline_of,
    rollout,
    seen_by_slider,
    simulate,
)
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.geometry.se2_numpy import to_body

Dtype = Literal["float64", "float32"]
SHOWN = 6  # wrong, failed and unconfirmed pushes of each row that are printed
FINER = 256  # parts into which the step of a jam is divided to confirm it


def run(
    shapes: tuple[str, ...] = SHAPES,
    hands: tuple[str, ...] = HANDS,
    steps: tuple[int, ...] = (300, 60),
    dtype: tuple[Dtype, ...] = get_args(Dtype),
    starts: int = 500,
    seed: int = 0,
    scenes: tuple[str, ...] = ("free",),
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Simulate and check random pushes of every outline by every hand.

    Args:
        shapes: Names of outlines.
        hands: Names of hands.
        steps: Numbers of steps of a push.
        dtype: Floating types.
        starts: Number of pushes of each row.
        seed: Seed of the pushes.
        scenes: Names of scenes: "free", or fixtures around the slider.
        progress: Called with the number of rows done and their total.
        keep: Called with the record so far.

    Returns:
        The record, with the figures of `checked` for each scene, hand, outline, number of steps and floating type.

    Raises:
        ValueError: If an outline, a hand or a scene is unknown.
    """
    for kind, names, known in (("shapes", shapes, SHAPES), ("hands", hands, HANDS), ("scenes", scenes, tuple(SCENES))):
        if unknown := sorted(set(names) - set(known)):
            raise ValueError(f"{kind} must be of {', '.join(known)}; got {', '.join(unknown)}")
    jax.config.update("jax_enable_x64", True)
    rows: list[dict[str, Any]] = []
    record = result_record("overlaps", {"starts": starts, "seed": seed}, rows=rows)
    cells = list(product(scenes, hands, shapes, steps, dtype))
    for scene, hand, shape, count, kind in cells:
        found = checked(simulate(shape, hand, starts, count, np.dtype(kind), seed, scene), count)
        rows.append({"scene": scene, "hand": hand, "shape": shape, "steps": count, "dtype": kind} | found)
        keep(record)
        progress(len(rows), len(cells))
        if (count, kind) == (steps[-1], dtype[-1]):
            jax.clear_caches()
    return record


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = []
    for row in record["rows"]:
        lines.append(
            f"{row['scene']:7}{row['hand']:6}{row['shape']:10}{row['steps']:4} {row['dtype']}: {row['wrong']:3} wrong, "
            f"deepest {row['deepest_mm']:.3f} mm; {row['failed']:3} failed, {len(row['unconfirmed'])} unconfirmed; "
            f"{row['ends']}"
        )
        listed = [row[kind][:SHOWN] for kind in ("steps_wrong", "failures", "unconfirmed")]
        if any(listed):
            lines.append(f"       {listed}")
    return "\n".join(lines)


def allowed(survey: Survey, steps: int) -> float:
    """Return the largest penetration depth that is not wrong, m (see the head of this module)."""
    if steps >= 300:
        return 0.1 * MM
    where = np.asarray(survey.hand.poses(jnp.asarray(survey.path)), float)[..., :2]
    return 0.2 * float(np.max(np.linalg.norm(np.diff(where, axis=1), axis=-1)))


def checked(survey: Survey, steps: int) -> dict[str, Any]:
    """Return which pushes are wrong, failed or unconfirmed, and how many end with each status."""
    depth = penetration_depths(survey)
    status = survey.push.status
    answered = np.isin(status, [pj.Status.MOVING, pj.Status.FREE, pj.Status.JAMMED, pj.Status.GRASPED])
    limit = allowed(survey, steps)
    wrong = answered & (depth[:, 1:] > limit) & (depth[:, 1:] > depth[:, :-1] + 0.01 * limit)
    bad = np.flatnonzero(wrong.any(axis=1)).tolist()
    failed = np.flatnonzero((~answered).any(axis=1)).tolist()
    first = [int(np.argmax(~answered[i])) for i in failed]
    return {
        "wrong": len(bad),
        "deepest_mm": float(1e3 * np.max(np.where(answered, depth[:, 1:], 0))),
        "steps_wrong": [
            (i, int(np.argmax(wrong[i])), round(1e3 * float(depth[i, 1:][wrong[i]].max()), 3)) for i in bad
        ],
        "failed": len(failed),
        "failures": [(i, k, pj.Status(int(status[i, k])).name) for i, k in zip(failed, first, strict=True)],
        "unconfirmed": unconfirmed(survey),
        "ends": {s.name: int(np.sum(status[:, -1] == s)) for s in pj.Status if np.any(status[:, -1] == s)},
    }


def penetration_depths(survey: Survey) -> np.ndarray:
    """Return the largest penetration depth of any finger or fixture at each pose by shapely, (starts, steps + 1), m."""
    body = outline_of(survey.shape)
    shapely.prepare(body)
    edge = body.exterior
    shapely.prepare(edge)
    pose = np.asarray(survey.push.pose, float)
    deepest = np.full(pose.shape[:-1], -np.inf)
    for radius, placed in seen_by_slider(survey.hand, survey.scene, pose, np.asarray(survey.push.configuration)):
        if placed.shape[-2] == 1:
            centers = shapely.points(placed[..., 0, :])
            distance = shapely.distance(edge, centers)
            depth = radius - np.where(shapely.contains(body, centers), -distance, distance)
        else:
            depth = _pads(body, edge, placed)
        deepest = np.maximum(deepest, depth)
    return deepest


def _pads(body: shapely.Polygon, edge, corners: np.ndarray) -> np.ndarray:
    """Return the penetration depths of pads with these corners, (…, corners, 2), m."""
    # The depth is that of a corner of the body in the pad, or of the pad in the body. Where no corner lies in the
    # other, it is the width of their intersection.
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
    """Return the index of each push that ends GRASPED or JAMMED although the slider is not held, and the reason."""
    # GRASPED promises that every finger is within reach of the slider: within four times the largest displacement in
    # the step, or 1e-4 of the surface's length. A jam needs forces at the places in reach, inside their friction cones,
    # that balance each other and on which the hand does work. A linear program searches for them, for polygons only. A
    # hand that jams stops at the start of that step. If nothing holds the slider there yet, the step is repeated in
    # `FINER` parts. It has to jam in one of them, with such forces.
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
        away = [finger.away(body) for finger in fingers[: len(step)]]
        if status[i] == pj.Status.GRASPED and max(away) > 1.01 * reach:
            found.append((int(i), f"a finger is {1e3 * max(away):.3f} mm away"))
        elif isinstance(survey.shape, pj.Polygon):
            mu = float(survey.friction[i])
            if not _jams(body, fingers, _turned(step, pose), mu, reach) and not _jams_later(survey, body, i, at, reach):
                found.append((int(i), "nothing holds it"))
    return found


def _turned(steps: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the steps (fingers, 2) in the body frame of the slider."""
    return to_body(pose * [0, 0, 1], steps)


def _jams_later(survey: Survey, body: shapely.Polygon, i: int, at: int, reach: float) -> bool:
    """Return whether push `i` jams within step `at`, done in `FINER` parts."""
    path = pj.line(survey.path[i, at], survey.path[i, at + 1], FINER)
    again = jax.jit(rollout, static_argnums=5)
    push = again(survey.slider, survey.hand, path, survey.push.pose[i, at], survey.friction[i], survey.scene)
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


class Disk(NamedTuple):
    """A round finger in the body frame of the slider."""

    center: np.ndarray  # (2,), m
    radius: float  # m

    def away(self, body: shapely.Polygon) -> float:
        """Return the distance from the body, m; not more than -radius if the center lies inside the body."""
        return body.distance(shapely.Point(self.center)) - self.radius

    def places(self, body: shapely.Polygon, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the closest point (2,), m, and inward normal (2,) of each edge and vertex of the body within reach."""
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
        """Find the corners of pad and body within reach of an edge of the other; returns are those of `Disk.places`."""
        return _corners(body, self.solid, reach) + [(p, -n) for p, n in _corners(self.solid, body, reach)]


def _placed(survey: Survey, pose: np.ndarray, configuration: np.ndarray) -> list[Disk | Plate]:
    """Return the fingers, and then the fixtures, in the body frame of the slider."""
    seen = seen_by_slider(survey.hand, survey.scene, pose, configuration)
    return [Disk(where[0], radius) if len(where) == 1 else Plate(shapely.Polygon(where)) for radius, where in seen]


def _jams(body: shapely.Polygon, fingers: list[Disk | Plate], steps: np.ndarray, mu: float, reach: float) -> bool:
    """Return whether forces at the places in reach can balance each other while the fingers do work on them."""
    # steps: displacements of the fingers, (fingers, 2), m, body frame; the fixtures at the end of `fingers` have none
    wrenches, works = [], []
    still = np.zeros((len(fingers) - len(steps), 2))
    for finger, step in zip(fingers, np.concatenate([steps, still]), strict=True):
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
    """Return the vertices of a polygon, counterclockwise, with the first one again at the end."""
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
