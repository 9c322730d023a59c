"""Polygons of the tests, filled up to one number of vertices, so that they share their programs; and brute force.

Brute force is NumPy with complex numbers, and shares no code with the library.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from pushjax import Polygon
from pushjax._math.vec import Vec2

# Closed forms on lengths of order 0.1 m, in units of roundoff of the dtype.
ROUNDINGS = 100
SIZE = 0.1
VERTICES, COUNT, POINTS = 14, 8, 512  # of all programs


def star(vertices: int, seed: int) -> np.ndarray:
    """Return a star-shaped outline about the origin, counterclockwise, mostly not convex."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(vertices) + rng.uniform(-0.3, 0.3, vertices)) / vertices
    radius = rng.uniform(0.03, 0.08, vertices)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


POLYGONS = {
    "triangle": np.array([(-0.03, -0.05), (0.0605, 0.0), (-0.03, 0.05)]),
    "needle": np.array([(-0.08, -0.001), (0.08, 0.0), (-0.08, 0.001)]),
    "square": np.array([(-0.045, -0.045), (0.045, -0.045), (0.045, 0.045), (-0.045, 0.045)]),
    "arrow": np.array([(0.06, 0.0), (-0.05, 0.05), (-0.02, 0.0), (-0.05, -0.05)]),
    "pentagon": star(5, 1),
    "L": np.array([(0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)]) - 0.04,
    "almost straight": np.array([(-5, -5), (0, -5 - 1e-7), (5, -5), (2, 0), (5, 5), (-5, 5)]) / 100,
    "star of 14": star(14, 2),
}  # fmt: skip
CONVEX = ["triangle", "needle", "square"]
REFLEX = ["arrow", "L", "star of 14"]


def filled(vertices: np.ndarray) -> np.ndarray:
    """Return the same outline with `VERTICES` vertices: the additional ones divide the edges."""
    parts = np.diff(np.linspace(0, VERTICES, len(vertices) + 1).round().astype(int))
    ends = zip(vertices, np.roll(vertices, -1, axis=0), parts, strict=True)
    return np.concatenate([a + (b - a) * np.arange(n)[:, None] / n for a, b, n in ends])


FILLED = {name: filled(vertices) for name, vertices in POLYGONS.items()}


class Touches(NamedTuple):
    """What a program found of one polygon, in NumPy, for all points."""

    distance: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    first: tuple[np.ndarray, np.ndarray, np.ndarray]  # the same from `contact_candidates`
    second: tuple[np.ndarray, np.ndarray, np.ndarray]


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0))
def _touches(vertices, points):
    polygon = Polygon(vertices)

    def at(x):
        found = polygon.outline().contact_candidates(Vec2.of(x))
        return polygon.closest(x), *((each.distance, each.point.array(), each.normal.array()) for each in found)

    return jax.vmap(at)(points)


def touches(vertices: list[np.ndarray], points: list[np.ndarray] | np.ndarray, dtype=np.float64) -> list[Touches]:
    """Return what each polygon has for its points, all by one program; `points` may be the same for all."""
    points = [np.asarray(p) for p in points] if isinstance(points, list) else [points] * len(vertices)
    every = np.stack([np.resize(p, (POINTS, 2)) for p in points])
    wide = (np.resize(a, (COUNT, *a.shape[1:])).astype(dtype) for a in (np.stack(vertices), every))
    closest, first, second = jax.tree.map(np.asarray, _touches(*wide))
    found = []
    for k, own in enumerate(points):
        assert len(own) <= POINTS
        parts = (tuple(leaf[k, : len(own)] for leaf in part) for part in (closest, first, second))
        nearest, one, other = parts
        found.append(Touches(*nearest, one, other))
    return found


def complex_of(points: ArrayLike) -> np.ndarray:
    pairs = np.asarray(points, np.float64)
    return pairs[..., 0] + 1j * pairs[..., 1]


def brute_closest(vertices: ArrayLike, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return signed distance and closest point (complex): project on every edge, sign by the winding number."""
    z, a = complex_of(points)[..., None], complex_of(vertices)
    edge = np.roll(a, -1) - a
    foot = a + np.clip(((z - a) / edge).real, 0, 1) * edge
    gap = np.abs(z - foot)
    nearest = gap.argmin(axis=-1)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        turns = np.angle((np.roll(a, -1) - z) / (a - z)).sum(axis=-1) / (2 * np.pi)
    inside = np.abs(np.nan_to_num(turns)) > 0.5
    distance = np.take_along_axis(gap, nearest, -1)[..., 0]
    return np.where(inside, -distance, distance), np.take_along_axis(foot, nearest, -1)[..., 0]


def runner_up(vertices: ArrayLike, points: ArrayLike) -> np.ndarray:
    """Return how much farther the next boundary feature is, away from the nearest one: zero on the medial axis."""
    z, a = complex_of(points)[..., None], complex_of(vertices)
    edge = np.roll(a, -1) - a
    foot = a + np.clip(((z - a) / edge).real, 0, 1) * edge
    gap = np.abs(z - foot)
    nearest = gap.argmin(axis=-1)[..., None]
    apart = np.abs(foot - np.take_along_axis(foot, nearest, -1)) > 1e-9
    return np.where(apart, gap - np.take_along_axis(gap, nearest, -1), np.inf).min(axis=-1)


def outward(vertices: np.ndarray) -> np.ndarray:
    """Return the outward unit normal of each edge of counterclockwise vertices."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    return np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)


def turns(vertices: np.ndarray) -> np.ndarray:
    """Return the sine of the angle by which the outline turns at each vertex."""
    after = outward(vertices)
    before = np.roll(after, 1, axis=0)
    return before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]


def scattered(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.12, 0.12, (count, 2))


def sector_points(v: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return points whose nearest point is a convex vertex of counterclockwise `v`: vertex, direction, distance."""
    rng, normal = np.random.default_rng(seed), outward(v)
    at = rng.choice(np.flatnonzero(turns(v) > 1e-3), count)
    share = rng.uniform(0.02, 0.98, (count, 1))
    direction = (1 - share) * np.roll(normal, 1, axis=0)[at] + share * normal[at]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return v[at], direction, 10 ** rng.uniform(-4, -2.3, count)


def lengths(dtype) -> float:
    return ROUNDINGS * SIZE * float(np.finfo(dtype).eps)
