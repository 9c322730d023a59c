"""Why a run ends elsewhere than the recorded one: named classes, each by its own experiment."""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pushjax.datasets.pushes import rotation
from pushjax.datasets.three_finger import ThreeFingerLog
from pushjax.experiments.three_finger.law import (
    BROKEN,
    DRIFTED,
    OTHER,
    TOUCHING,
    ZERO,
    law_residual,
    motions_at,
    touching,
)
from pushjax.experiments.three_finger.runs import CHUNK, NUDGE, Runs, along, difference, last_distance, rollouts
from pushjax.status import Status

# Beyond the first pair a run is asked for its cause; beyond the second it counts as different. mm and degrees.
NEAR, FAR = (0.5, 1.0), (2.0, 5.0)
FINER = 4  # times as many steps
LATE = 5e-6  # m, inside the object just after a finger came: a step of theirs went past the contact
CLASSES = {
    "their motion breaks the contact law": "no forces in the friction cones give it; ours is the only one with such",
    "they stop early": "together to the end of theirs, where just one motion satisfies every condition",
    "we stop early": "together to the end of ours, and they go on",
    "second solution": "where they part, the recorded motion, or another than ours, satisfies every condition",
    "our steps too coarse": f"with {FINER} times as many steps we end where they do",
    "late contact": "they part where a finger comes between two samples, and after that it is inside, in the recording",
    "their contact drift": f"a finger enters the object by more than {1e3 * DRIFTED:g} mm in the recording",
    "sensitive start": f"our own end moves by as much if the start does by {1e6 * NUDGE:g} micrometre",
    "unexplained": "none of these",
}


class Parting(NamedTuple):
    """The recorded interval in which each run's motion differs most from ours at the same state: its sample, by how
    much (relative), how far theirs is from the law, and of our answer there what `Answers` says."""

    sample: np.ndarray
    other: np.ndarray
    residual: np.ndarray
    clean: np.ndarray
    unique: np.ndarray
    cancel: np.ndarray

    def breaks(self) -> np.ndarray:
        """(n,): whether theirs is no answer there, and ours is the only one."""
        return (self.other > OTHER) & (self.residual > BROKEN) & self.clean & self.unique


def parting(log: ThreeFingerLog, which: np.ndarray, friction: float) -> Parting:
    """For runs `which` (n,); only intervals within which no finger comes or goes."""
    pose, distance = log.pose[which], log.distance[which]
    on = np.abs(touching(log, pose, distance).gap) < TOUCHING
    last = np.arange(1, pose.shape[1]) <= log.stop[which][:, None]
    steady = last & np.any(on[:, 1:], axis=2) & np.all(on[:, 1:] == on[:, :-1], axis=2)
    middle, between = (pose[:, 1:] + pose[:, :-1]) / 2, (distance[:, 1:] + distance[:, :-1]) / 2
    steady &= np.all((np.abs(touching(log, middle, between).gap) < TOUCHING) == on[:, 1:], axis=2)
    run, sample = np.nonzero(steady)
    step = distance[run, sample] - distance[run, sample + 1]
    if not len(run):
        nothing, never = np.zeros(len(which)), np.zeros(len(which), bool)
        return Parting(nothing.astype(int), nothing, nothing, never, never, nothing)
    answers = motions_at(log, middle[steady], between[steady], step, friction)
    change = pose[run, sample + 1] - pose[run, sample]
    turn = rotation(middle[steady][:, 2])
    twist = np.concatenate([np.einsum("nji,nj->ni", turn, change[:, :2]), change[:, 2:]], axis=1)
    scale = np.array([1.0, 1.0, log.length])
    size = step + np.linalg.norm(answers.twist * scale, axis=1)
    other = np.zeros(steady.shape)
    other[steady] = np.linalg.norm((twist - answers.twist) * scale, axis=1) / size
    place = np.argmax(other, axis=1)
    back = np.full(steady.shape, -1)
    back[steady] = np.arange(len(run))
    at = back[np.arange(len(which)), place]
    any_steady = at >= 0  # else nothing, and not the last run's
    residual = law_residual(log, answers.problem.take(at), twist[at])
    found = (other.max(axis=1), residual, answers.clean[at], answers.unique[at], answers.cancel[at])
    return Parting(place, *(np.where(any_steady, part, np.zeros_like(part)) for part in found))


def explain(
    log: ThreeFingerLog, which: np.ndarray, ours: Runs, friction: float, apart: np.ndarray
) -> list[dict[str, Any]]:
    """Every run that ends further apart than `NEAR`: its class of `CLASSES`, and the numbers that put it there."""
    rows = np.flatnonzero(np.any(apart > NEAR, axis=1))
    if not len(rows):
        return []
    runs, ends, ended = which[rows], log.distance[which[rows], -1], ours.distance[rows, -1]
    common = np.maximum(ends, ended)
    theirs_then = along(log.distance[runs], log.pose[runs], common)
    ours_then = along(ours.distance[rows], ours.pose[rows], common)
    then = difference(theirs_then, ours_then)
    together = np.all(then <= NEAR, axis=1)
    goes_on = motions_at(log, log.pose[runs, -1], ends, np.full(len(runs), NUDGE), friction)
    parts = parting(log, runs, friction)
    deepest = -touching(log, log.pose[runs], log.distance[runs]).gap.min(axis=(1, 2))
    finer = difference(_finer(log, runs, friction, ours.pose.shape[1] - 1), log.pose[runs, -1])
    late = _late(log, runs, Runs(*(part[rows] for part in ours)))
    spread = _spread(log, runs, Runs(*(part[rows] for part in ours)), friction)
    causes = []
    for k, run in enumerate(runs):
        lawful = parts.residual[k] < ZERO
        parted = parts.other[k] > OTHER
        tests = {
            "their motion breaks the contact law": parts.breaks()[k],
            "they stop early": together[k] & (ends[k] > ended[k] + NUDGE) & goes_on.clean[k] & goes_on.unique[k],
            "we stop early": together[k] & (ended[k] > ends[k] + NUDGE),
            "second solution": parted & (lawful | ~parts.unique[k]),
            "our steps too coarse": np.all(finer[k] <= NEAR),
            "late contact": late[k],
            "their contact drift": deepest[k] > DRIFTED,
            "sensitive start": np.any((spread[k] > apart[rows[k]] / 2) & (apart[rows[k]] > NEAR)),
        }
        name = next((name for name, holds in tests.items() if holds), "unexplained")
        numbers = {
            "run": int(log.index[run]),
            "class": name,
            "mm": float(apart[rows[k], 0]),
            "deg": float(apart[rows[k], 1]),
            "together_mm_deg": then[k].tolist(),
            "sample": int(parts.sample[k]),
            "other": float(parts.other[k]),
            "residual": float(parts.residual[k]),
            "net_over_normal": float(parts.cancel[k]),
            "unique": bool(parts.unique[k]),
            "clean": bool(parts.clean[k]),
            "deepest_mm": float(1e3 * deepest[k]),
            "finer_mm_deg": finer[k].tolist(),
            "nudged_mm_deg": spread[k].tolist(),
            "stop_mm": [float(1e3 * ends[k]), float(1e3 * ended[k])],
        }
        causes.append(numbers)
    return causes


def _spread(log: ThreeFingerLog, runs: np.ndarray, ours: Runs, friction: float) -> np.ndarray:
    """(n, 2): how far our own ends move, mm and degrees, at most, as the start moves by `NUDGE` to four sides."""
    sides = NUDGE * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    starts = (log.pose[runs, 0] + sides[:, None]).reshape(-1, 3)
    # the same way down, past where this one stopped
    paths = np.array([_onward(d, last_distance(log)) for d in ours.distance])
    ends = rollouts(log, starts, np.tile(paths, (4, 1)), friction).pose[:, -1].reshape(4, -1, 3)
    return difference(ends, ours.pose[:, -1]).max(axis=0)


def _onward(distance: np.ndarray, end: float) -> np.ndarray:
    """A path that stopped, going on to `end`."""
    stays = np.flatnonzero(np.diff(distance) == 0)
    if not len(stays):
        return distance
    first = stays[0]
    return np.concatenate([distance[:first], np.linspace(distance[first], end, len(distance) - first)])


def _finer(log: ThreeFingerLog, runs: np.ndarray, friction: float, steps: int) -> np.ndarray:
    """(n, 3): our final poses with `FINER` times as many equal steps, in as many portions."""
    knots = np.linspace(log.distance[0, 0], last_distance(log), FINER + 1)
    pose, going = log.pose[runs, 0], np.ones(len(runs), bool)
    for begin, end in pairwise(knots):
        part = rollouts(log, pose, np.tile(np.linspace(begin, end, steps + 1), (len(runs), 1)), friction)
        pose = np.where(going[:, None], part.pose[:, -1], pose)
        going &= ~np.isin(part.status, (Status.JAMMED, Status.GRASPED))
    return pose


def _late(log: ThreeFingerLog, runs: np.ndarray, ours: Runs) -> np.ndarray:
    """(n,): whether most of the difference comes up in an interval at whose end a new finger is inside, in theirs."""
    pose, distance = log.pose[runs], log.distance[runs]
    apart = np.einsum("nti,i->nt", difference(along(ours.distance, ours.pose, distance), pose), 1 / np.array(NEAR))
    at = np.argmax(np.diff(apart, axis=1), axis=1)[:, None, None]
    gap = touching(log, pose, distance).gap
    before, after = np.take_along_axis(gap, at, axis=1)[:, 0], np.take_along_axis(gap, at + 1, axis=1)[:, 0]
    return np.any((before > TOUCHING) & (after < -LATE), axis=1)


def control(
    log: ThreeFingerLog, which: np.ndarray, friction: float, apart: np.ndarray, seed: int = 0
) -> dict[str, int]:
    """The test of the contact law on runs that end together and have two fingers touching: it should find few."""
    good = which[np.all(apart < np.array(NEAR) / 5, axis=1)]
    many = np.abs(touching(log, log.pose[good, -1], log.distance[good, -1]).gap) < TOUCHING
    good = good[many.sum(axis=1) > 1][:CHUNK]
    broken = int(parting(log, good, friction).breaks().sum()) if len(good) else 0
    return {"runs": len(good), "broken": broken}
