"""Check by shapely that no finger and no fixture ends a step inside the slider.

Shapely computes the penetration depth; it shares no code with the library. Every hand pushes outlines of many kinds,
convex or not, with corners or without, from random starts and with random friction, in fine and coarse steps and in
both floating types. A step is wrong if its status is MOVING, FREE, JAMMED or GRASPED, and a finger is deeper inside the
slider than before the step and deeper than a limit. The limit is 0.1 mm with 300 steps, and a fifth of the hand's
displacement in the step with 60 steps. A push that ends GRASPED or JAMMED has to be confirmed (see `held.unconfirmed`).
"""

from collections.abc import Callable
from itertools import product
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import shapely

import pushjax as pj
from benchmarks.held import unconfirmed
from benchmarks.survey import (
    HANDS,
    MM,
    SCENES,
    SHAPES,
    Survey,
    fixtures_seen_by_slider,
    outline_of,
    seen_by_slider,
    simulate,
)
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.simulation.hand import RoundFinger

Dtype = Literal["float64", "float32"]
SHOWN = 6  # wrong, failed and unconfirmed pushes of each row that are printed


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
    """Simulate and judge random pushes of every outline by every hand.

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
        The record, with the figures of `judged` for each scene, hand, outline, number of steps and floating type.

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
        found = judged(simulate(shape, hand, starts, count, np.dtype(kind), seed, scene), count)
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
        told = [row[kind][:SHOWN] for kind in ("steps_wrong", "failures", "unconfirmed")]
        if any(told):
            lines.append(f"       {told}")
    return "\n".join(lines)


def allowed(survey: Survey, steps: int) -> float:
    """Return the largest penetration depth that is not wrong, m (see the head of this module)."""
    if steps >= 300:
        return 0.1 * MM
    where = np.asarray(survey.hand.poses(jnp.asarray(survey.path)), float)[..., :2]
    return 0.2 * float(np.max(np.linalg.norm(np.diff(where, axis=1), axis=-1)))


def judged(survey: Survey, steps: int) -> dict[str, Any]:
    """Return which pushes are wrong, failed or unconfirmed, and how many end with each status."""
    depth = penetration_depths(survey)
    status = survey.push.status
    told = np.isin(status, [pj.Status.MOVING, pj.Status.FREE, pj.Status.JAMMED, pj.Status.GRASPED])
    limit = allowed(survey, steps)
    wrong = told & (depth[:, 1:] > limit) & (depth[:, 1:] > depth[:, :-1] + 0.01 * limit)
    bad = np.flatnonzero(wrong.any(axis=1)).tolist()
    failed = np.flatnonzero((~told).any(axis=1)).tolist()
    first = [int(np.argmax(~told[i])) for i in failed]
    return {
        "wrong": len(bad),
        "deepest_mm": float(1e3 * np.max(np.where(told, depth[:, 1:], 0))),
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
    seen = seen_by_slider(survey.hand, pose, np.asarray(survey.push.configuration))
    radii = [float(finger.radius) if isinstance(finger, RoundFinger) else 0.0 for finger in survey.hand.fingers]
    for radius, placed in [*zip(radii, seen, strict=True), *fixtures_seen_by_slider(survey.scene, pose)]:
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
