"""Transits of a round finger from one planned push to the next, and its whole motion as points in time.

After a push the slider is not exactly where it was predicted to be. The samples of the prediction tell how far any
point of it may be displaced; that is largest at a vertex. A finger that keeps this distance beside its clearance from
the predicted slider touches none of the samples. Where there is no such transit, smaller distances are tried, and the
samples that the finger would touch are counted.

A transit ends in a run-up: from where the finger has its full distance, straight ahead to where the push starts.

Fixtures are where they are known to be: the finger keeps its clearance from them, and no more. It keeps no more from
other sliders either, but samples in which it would touch one are counted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pushjax._internal.checks import check_positive
from pushjax.geometry.polygon_numpy import segment_distances, signed_distances
from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.planning.obstacles import Obstacles
from pushjax.planning.roadmap import Roadmap, Transit, TransitStatus, run_ups
from pushjax.simulation.fixtures import Fixtures

# Quantiles of the samples' displacement that the finger keeps in addition to its clearance, in the order of attempts.
QUANTILES = (1.0, 0.9, 0.5)
TIGHT = 0.25  # the last attempt is made with this fraction of the clearance
RUN_UPS = (1.0, 2.0, 4.0)  # longest run-ups, in units of the distance that the finger's center keeps
TOUCH = 1e-4  # overlap that does not count as touching, in units of the finger's radius


class Transits(NamedTuple):
    """Transits of a finger before, between and after pushes."""

    transits: tuple[Transit, ...]  # to the start of each push, and the retreat after the last one
    # (samples,), whether the finger touches the slider in any transit that was found, for each predicted sample
    touched: np.ndarray

    @property
    def status(self) -> TransitStatus:
        """FOUND, or why the first missing transit is missing."""
        return next(
            (transit.status for transit in self.transits if transit.status != TransitStatus.FOUND), TransitStatus.FOUND
        )


class FingerMotion(NamedTuple):
    """The motion of a finger through all pushes of a plan, straight from each point to the next."""

    time: np.ndarray  # at each point, (points,), s, from zero
    position: np.ndarray  # center of the finger, (points, 2), world, m
    push: np.ndarray  # number of the push that the finger makes up to each point, from one; zero between pushes


def transits_between(
    outlines: Sequence[np.ndarray],  # (vertices, 2) of each slider, counterclockwise, body frame, m
    radius: float,  # of the finger, m
    clearance: float,  # that the finger keeps from sliders and fixtures, m
    paths: np.ndarray,  # (pushes, steps + 1, 2), world, m
    predicted: np.ndarray,  # (pushes + 1, sliders, 3), poses before the first push and after each, world, m and rad
    samples: np.ndarray,  # (samples, pushes + 1, sliders, 3), of these poses
    start: np.ndarray | None = None,  # (2,), of the finger, world, m; None: where the first run-up begins
    fixtures: Fixtures = (),
    pushed: Sequence[int] | np.ndarray | None = None,  # index of the slider that each push is made on; None: the first
) -> Transits:
    """Find the transits of a finger to the start of each push, and away from the slider after the last one."""
    # There are none if there is neither a push nor a start.
    paths, predicted, samples = (np.asarray(each, float) for each in (paths, predicted, samples))
    if start is None and not len(paths):
        return Transits((), np.zeros(len(samples), bool))
    fixed = Obstacles.of(fixtures)
    transits, touched = [], np.zeros(len(samples), bool)
    origins = [None if start is None else np.asarray(start, float), *paths[:, -1]]
    # the last retreat is from the slider of the last push
    ones = [0] * len(origins) if pushed is None or not len(pushed) else [*pushed, pushed[-1]]
    for k, (poses, origin, one) in enumerate(zip(predicted, origins, ones, strict=True)):
        # the other sliders are obstacles, which stay where they are predicted to be
        others = [to_world(poses[j], each) for j, each in enumerate(outlines) if j != one]
        around = _Surroundings(outlines[one], radius, clearance, fixed._replace(bodies=(*fixed.bodies, *others)))
        scatter = _displacement(outlines[one], poses[one], samples[:, k, one])
        margins = [*(clearance + np.quantile(scatter, q) for q in QUANTILES), clearance, TIGHT * clearance]
        for margin in margins:  # the last attempt is the least demanding, and tells why there is none
            transit = _transit(around, margin, paths[k : k + 1], poses[one], origin)
            if transit.status == TransitStatus.FOUND:
                for j, vertices in enumerate(outlines):
                    touched |= _touches(vertices, radius, transit.points, samples[:, k, j])
                break
        transits.append(transit)
    return Transits(tuple(transits), touched)


def finger_motion(transits: tuple[Transit, ...], paths: np.ndarray, *, free: float, push: float) -> FingerMotion:
    """Return the motion of a finger through all transits and pushes, at one speed in pushes and another in transits.

    Args:
        transits: The transits: one to the start of each push, and the last retreat.
        paths: Paths of the pushes, (pushes, steps + 1, 2), world, m.
        free: Speed between pushes, m/s.
        push: Speed in pushes, m/s.

    Returns:
        Points with `time`, (points,), s, `position` of the finger's center, (points, 2), world, m, and number of the
        `push` that it makes up to each point, from one; zero between pushes.

    Raises:
        ValueError: For a speed that is not positive, if a transit was not found, and if there is none.
    """
    check_positive("free", free)
    check_positive("push", push)
    if not transits:
        raise ValueError("transits must have one transit to each push, and the last retreat; got none")
    for k, transit in enumerate(transits):
        if transit.status != TransitStatus.FOUND:
            raise ValueError(f"transits[{k}] must be a transit that was found; its status is {transit.status.name}")
    position, number = [transits[0].points], [np.zeros(len(transits[0].points), int)]
    for k, path in enumerate(np.asarray(paths, float)):
        after = transits[k + 1].points[1:]
        position += [path[1:], after]
        number += [np.full(len(path) - 1, k + 1), np.zeros(len(after), int)]
    points, pushes = np.concatenate(position), np.concatenate(number)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    duration = length / np.where(pushes[1:] > 0, push, free)
    return FingerMotion(np.concatenate([[0.0], np.cumsum(duration)]), points, pushes)


class _Surroundings(NamedTuple):
    """What transits are planned in."""

    vertices: np.ndarray  # (vertices, 2), of the slider, body frame, m
    radius: float  # of the finger, m
    clearance: float  # of the finger, m
    obstacles: Obstacles

    def roadmap(self, margin: float, goals: np.ndarray) -> Roadmap:
        """Return the roadmap for a distance from the slider, m; from fixtures no more than the clearance is kept."""
        return Roadmap(self.vertices, self.radius, margin, goals, self.obstacles, min(margin, self.clearance))


def _transit(
    around: _Surroundings, margin: float, paths: np.ndarray, pose: np.ndarray, origin: np.ndarray | None
) -> Transit:
    """Return the transit to the start of the first of `paths`, or the retreat if there are none."""
    if len(paths):
        return _approach(around, margin, paths[0], pose, origin)
    assert origin is not None  # a retreat begins where a push ends
    return around.roadmap(margin, np.zeros((0, 2))).retreat(origin, pose)


def _approach(
    around: _Surroundings, margin: float, path: np.ndarray, pose: np.ndarray, origin: np.ndarray | None
) -> Transit:
    """Return the transit to the start of a push, with a run-up from where the finger has its full distance."""
    first, second = to_body(pose, path[:2])
    ahead = (second - first) / np.linalg.norm(second - first)
    blocked = Transit(
        path[:1] if origin is None else np.asarray(origin, float)[None], np.inf, TransitStatus.GOAL_BLOCKED
    )
    if signed_distances(around.vertices, first) < (1 - TOUCH) * around.radius:
        return blocked
    for part in RUN_UPS:
        longest = part * (around.radius + margin)
        run_up = float(run_ups(around.vertices, around.radius, margin, first[None], ahead[None], longest)[0])
        begin = (first - run_up * ahead)[None]
        if np.isfinite(run_up) and _keeps_out(around, margin, to_world(pose, begin[0]), path[0]):
            break
    else:
        return blocked
    if origin is None:
        transit = Transit(to_world(pose, begin), 0.0, TransitStatus.FOUND)
    else:
        roadmap = around.roadmap(margin, begin)
        transit = roadmap.transit(roadmap.transits(origin, pose), 0, pose)
    if transit.status != TransitStatus.FOUND or run_up == 0:
        return transit
    return Transit(np.concatenate([transit.points, path[:1]]), transit.length + run_up, TransitStatus.FOUND)


def _keeps_out(around: _Surroundings, margin: float, begin: np.ndarray, start: np.ndarray) -> bool:
    """Return whether a run-up begins with the clearance from fixtures, and touches none."""
    if around.obstacles.point_clearance(begin) < around.radius + min(margin, around.clearance):
        return False
    return bool(around.obstacles.segment_clearance(begin, start) >= around.radius)


def _displacement(vertices: np.ndarray, pose: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the largest displacement of any point of the slider from `pose`, for each sample, (samples,), m."""
    moved = to_world(samples[:, None], vertices[None]) - to_world(pose, vertices)
    return np.linalg.norm(moved, axis=-1).max(axis=1)


def _touches(vertices: np.ndarray, radius: float, points: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return whether a finger touches the slider along a transit, for each sample of its pose, (samples,)."""
    placed = to_body(samples[:, None], points[None])  # (samples, points, 2)
    apart = segment_distances(vertices, placed[:, :-1], placed[:, 1:])
    at_start = signed_distances(vertices, placed[:, 0])
    # a finger that has just pushed touches the slider, so there only what comes nearer counts
    allowed = np.full(apart.shape, radius)
    if apart.shape[1]:
        allowed[:, 0] = np.minimum(at_start, radius)
    return np.any(apart < allowed - TOUCH * radius, axis=1)
