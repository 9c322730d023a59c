"""Confirmation by shapely and linear programs that a push which ends GRASPED or JAMMED holds the slider."""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from scipy.optimize import linprog

import pushjax as pj
from benchmarks.survey import Survey, fixtures_seen_by_slider, outline_of, rollout, seen_by_slider
from pushjax.simulation.hand import RoundFinger

FINER = 256  # parts into which the step of a jam is divided to confirm it


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
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return steps @ np.array([[c, -s], [s, c]])


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
    seen = seen_by_slider(survey.hand, pose, configuration)
    radii = [float(finger.radius) if isinstance(finger, RoundFinger) else 0.0 for finger in survey.hand.fingers]
    bodies = [*zip(radii, seen, strict=True), *fixtures_seen_by_slider(survey.scene, pose)]
    return [Disk(where[0], radius) if len(where) == 1 else Plate(shapely.Polygon(where)) for radius, where in bodies]


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
