"""Ellipses and curves of the tests, which share their programs; and brute force in NumPy and SciPy's splines."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BSpline

from pushjax import Curve, Ellipse
from pushjax._math.vec import Vec2

# Converged iterations on lengths of order 0.1 m, in units of roundoff of the dtype. For ellipses of 1 : 20 the
# curvature, 1 / 0.25 mm, amplifies the difference between along and across.
ROUNDINGS = 200
SIZE = 0.1
COUNT, CONTROLS, POINTS = 3, 24, 2048  # of all programs


def lengths(dtype) -> float:
    return ROUNDINGS * SIZE * float(np.finfo(dtype).eps)


def around(radius_x, radius_y=None) -> np.ndarray:
    """Return points at these radii, a number or one for each, at equal angles, counterclockwise."""
    angle = 2 * np.pi * np.arange(CONTROLS) / CONTROLS
    radius_y = radius_x if radius_y is None else radius_y
    return np.stack([radius_x * np.cos(angle), radius_y * np.sin(angle)], axis=1)


def waisted() -> np.ndarray:
    """Return the controls of a curve with two lobes and a waist, 0.1 m by 0.16 m, 0.06 m at the waist."""
    return np.asarray(Curve.through(around(0.055 - 0.025 * np.cos(4 * np.pi * np.arange(CONTROLS) / CONTROLS))).control)


CURVES = {
    "waisted": waisted(),
    "wavy": around(np.random.default_rng(2).uniform(0.03, 0.08, CONTROLS)),
    "oval": around(0.06, 0.03),
}
ELLIPSES = {"ellipse": (0.05, 0.03), "lens": (0.1, 0.005), "circle": (0.05, 0.05)}


class Closest(NamedTuple):
    """What a program found of one shape, in NumPy, for all points."""

    distance: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    second: tuple[np.ndarray, ...]  # the second of the `contact_candidates` of a curve; empty for an ellipse


def _of_outline(shape, points):
    def at(x):
        found = shape.outline().contact_candidates(Vec2.of(x))
        others = [(each.distance, each.point.array(), each.normal.array()) for each in found[1:]]
        return shape.closest(x), *others

    return jax.vmap(at)(points)


@jax.jit
def _of_curves(controls, points):
    return jax.vmap(lambda control, xs: _of_outline(Curve(control), xs))(controls, points)


@jax.jit
def _of_ellipses(axes, center, points):
    return jax.vmap(lambda a, c, xs: _of_outline(Ellipse(*a, c), xs))(axes, center, points)


def closest(shapes: list, points: list[np.ndarray] | np.ndarray, dtype=np.float64) -> list[Closest]:
    """Return what each shape has for its points, by one program for ellipses (axes) and one for curves (controls).

    An ellipse is given as (semi_x, semi_y) or with its center as (semi_x, semi_y, x, y). The points may be the same for
    all shapes.
    """
    points = points if isinstance(points, list) else [points] * len(shapes)
    every = np.stack([np.resize(p, (POINTS, 2)) for p in points])
    wide = [np.resize(a, (COUNT, *np.shape(a)[1:])).astype(dtype) for a in (np.stack(shapes), every)]
    if np.ndim(shapes[0]) == 2:
        found = _of_curves(*wide)
    else:
        rows = np.pad(wide[0], [(0, 0), (0, 4 - len(shapes[0]))])
        found = _of_ellipses(rows[:, :2], rows[:, 2:], wide[1])
    found, every = jax.tree.map(np.asarray, found), []
    for k, own in enumerate(points):
        nearest, *others = (tuple(leaf[k][: len(own)] for leaf in part) for part in found)
        every.append(Closest(*nearest, others[0] if others else ()))
    return every


class Outline:
    """Points and derivatives of an outline at parameters over one period: of axes of an ellipse, or of controls."""

    def __init__(self, shape):
        if np.ndim(shape) == 1:
            turn, self.period = np.array(shape[:2], np.float64), 2 * np.pi
            quarter = np.array([0, np.pi / 2])
            self.at = lambda u, k=0: turn * np.cos(u[..., None] - quarter + k * np.pi / 2)
        else:
            c = np.asarray(shape, np.float64)
            self.period = len(c)
            spline = BSpline(np.arange(-3.0, len(c) + 4), np.concatenate([c[-1:], c, c[:2]]), 3)
            self.at = lambda u, k=0: spline(np.mod(u, len(c)), nu=k)
        self.u = np.arange(1200) * self.period / 1200
        self.points = self.at(self.u)

    def minima(self, x: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return, for each point, the distances of all local minima, and their parameters on the outline."""
        gap = np.linalg.norm(x[:, None] - self.points, axis=-1)
        which, start = np.nonzero((gap <= np.roll(gap, 1, axis=1)) & (gap < np.roll(gap, -1, axis=1)))
        u, step = self.u[start], 1.5 * self.period / 1200
        for _ in range(12):
            first, rel = self.at(u, 1), x[which] - self.at(u)
            speed = np.sum(first**2, axis=1)
            stiff = np.maximum(speed - np.sum(rel * self.at(u, 2), axis=1), 1e-3 * speed)
            u = np.clip(u + np.sum(rel * first, axis=1) / stiff, self.u[start] - step, self.u[start] + step)
        gap = np.linalg.norm(x[which] - self.at(u), axis=1)
        return [(gap[which == k], u[which == k]) for k in range(len(x))]

    def signed(self, x: np.ndarray) -> np.ndarray:
        """Return the signed distance, with the sign from the winding number."""
        z, p = (v[..., 0] + 1j * v[..., 1] for v in (x, self.points))
        rel = p - z[:, None]
        winding = np.angle(np.roll(rel, -1, axis=1) / rel).sum(axis=1) / (2 * np.pi)
        return np.where(np.abs(winding) > 0.5, -1, 1) * np.array([gap.min() for gap, _ in self.minima(x)])

    def is_regular(self, x: np.ndarray) -> np.ndarray:
        """Return where the closest point moves by at most ten times the point, with no second one within 1 mm."""
        regular = []
        for point, (gap, u) in zip(x, self.minima(x), strict=True):
            at = u[gap.argmin()]
            first, second = self.at(at, 1), self.at(at, 2)
            stretch = first @ first / (first @ first - (point - self.at(at)) @ second)
            alone = gap.size == 1 or np.partition(gap, 1)[1] - gap.min() > 1e-3
            regular.append(alone and abs(stretch) < 10)
        return np.array(regular)


def scattered(shape, seed: int, count: int = 300) -> np.ndarray:
    """Return points everywhere, far away, near the middle, on both axes, and a micrometer off the outline."""
    rng = np.random.default_rng(seed)
    line = np.linspace(-0.12, 0.12, 40)
    near = Outline(shape).points[::24] + rng.normal(size=(50, 2)) * 1e-6
    return np.concatenate([
        rng.uniform(-0.15, 0.15, (count, 2)), 3 * rng.normal(size=(40, 2)), 0.01 * rng.normal(size=(40, 2)), near,
        np.stack([line, 0 * line], axis=1), np.stack([0 * line, line], axis=1), np.zeros((1, 2)),
    ])  # fmt: skip


def shape_of(numbers) -> Ellipse | Curve:
    """Return the shape with these axes or controls."""
    return Curve(jnp.asarray(numbers)) if np.ndim(numbers) == 2 else Ellipse(*numbers)
