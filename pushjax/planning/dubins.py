"""Shortest paths forward with a bound on the curvature to either side.

A shortest path has at most three parts, arcs of the tightest turn (L, R) and straight lines (S), in one of six words:
LSL, LSR, RSL, RSR, LRL and RLR. This module tries all of them. The tightest left and right turn may have different
radii, and the words stay the same.

A turn has a sign (+1 left, -1 right) and a center, at the radius along the normal n(theta) = (-sin, cos) times the
sign. Let D lead from the center of the first turn to that of the last.

- With a straight middle of heading phi and length s, D = s (cos phi, sin phi) + k n(phi), where k is the signed radius
  of the last turn minus that of the first. So s = sqrt(|D|^2 - k^2), and phi = angle(D) - atan2(k, s).
- With a turn in the middle, its center and the other two form a triangle with two sides that are the sum of the radii.
  It may lie on either side of D.

Reference: Dubins 1957. Bakolas & Tsiotras 2011 have the case of two radii.
"""

from typing import NamedTuple

import numpy as np

from pushjax._internal.checks import ArrayLike

WORDS = ("LSL", "LSR", "RSL", "RSR", "LRL", "RLR")
SIGN = {"L": 1.0, "S": 0.0, "R": -1.0}
FULL_TURN = 2 * np.pi
ROUNDOFF = 1e-9  # rad. An arc that is less than this short of a full turn is no arc.


class DubinsPath(NamedTuple):
    """A path of three parts, each of constant curvature."""

    word: str  # the parts, such as "LSL": left turn, straight, left turn
    start: np.ndarray  # pose at the start, (3,), m and rad
    curvature: np.ndarray  # signed, of the parts, (3,), 1/m, positive to the left
    lengths: np.ndarray  # of the parts, (3,), m; zero for a part that is not needed

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return float(self.lengths.sum())

    def poses(self, steps: int) -> np.ndarray:
        """Return poses along the path, (steps + 1, 3), m and rad; the angle is continuous."""
        # The ends of the parts are among them, so that no step has two curvatures.
        counts = _steps_of_parts(self.lengths, steps)
        pose, parts = self.start, [self.start[None]]
        for curvature, length, count in zip(self.curvature, self.lengths, counts, strict=True):
            if count:
                parts.append(_arc(pose, curvature, length * np.arange(1, count + 1) / count))
                pose = parts[-1][-1]
        return np.concatenate(parts)


def dubins(
    start: ArrayLike,  # pose (x, y, heading), (3,), m and rad
    goal: ArrayLike,  # pose, (3,); its heading modulo a full turn
    left: float,  # radius of the tightest left turn, m; infinite if it cannot turn left
    right: float,  # of the tightest right turn
) -> DubinsPath | None:
    """Find the shortest path between two poses that goes forward, or None if it can turn to neither side."""
    poses = np.asarray(start, np.float64), np.asarray(goal, np.float64)
    radii = {"L": left, "R": right}
    best: DubinsPath | None = None
    for word in WORDS:
        if all(np.isfinite(radii[turn]) for turn in word if turn != "S"):
            for lengths in _lengths(word, poses[0], poses[1], radii):
                if best is None or lengths.sum() < best.length:
                    curvature = np.array([SIGN[part] / radii[part] if part != "S" else 0.0 for part in word])
                    best = DubinsPath(word, poses[0], curvature, lengths)
    return best


def _lengths(word: str, start: np.ndarray, goal: np.ndarray, radii: dict[str, float]) -> list[np.ndarray]:
    """Return the lengths (3,) of the parts of each path of a word from start to goal, m."""
    first, middle, last = word
    a, b = SIGN[first] * radii[first], SIGN[last] * radii[last]  # signed radii
    center = start[:2] + a * _normal(start[2])
    between = goal[:2] + b * _normal(goal[2]) - center
    distance = float(np.hypot(between[0], between[1]))
    # between two turns about one point any heading does; the first one needs no turn
    angle = np.arctan2(between[1], between[0]) if distance > ROUNDOFF * abs(a) else start[2]
    if middle == "S":
        straight = distance**2 - (b - a) ** 2
        if straight < 0:
            return []
        heading = angle - np.arctan2(b - a, np.sqrt(straight))
        ends = (_turn(first, start[2], heading), _turn(last, heading, goal[2]))
        return [np.array([abs(a) * ends[0], np.sqrt(straight), abs(b) * ends[1]])]
    side = radii["L"] + radii["R"]
    if distance > 2 * side:
        return []
    found = []
    for apex in (1, -1):
        # angle between D and the side of the triangle on which the first turn touches the middle one
        corner = apex * np.arccos(distance / (2 * side))
        # where the tangent point lies in direction u of the center, the heading has the normal -sign * u
        quarter = SIGN[first] * np.pi / 2
        headings = (angle + corner + quarter, angle + np.pi - corner + quarter)
        turns = _turn(first, start[2], headings[0]), _turn(middle, *headings), _turn(last, headings[1], goal[2])
        found.append(np.array([radii[part] * turn for part, turn in zip(word, turns, strict=True)]))
    return found


def _turn(part: str, before: float, after: float) -> float:
    """Return the angle of a turn between two headings, rad, from zero to a full turn."""
    angle = (SIGN[part] * (after - before)) % FULL_TURN
    return 0.0 if FULL_TURN - angle < ROUNDOFF else angle


def _normal(heading: float) -> np.ndarray:
    return np.array([-np.sin(heading), np.cos(heading)])


def _arc(pose: np.ndarray, curvature: float, lengths: np.ndarray) -> np.ndarray:
    """Return the poses (k, 3) at some lengths (k,) along an arc or a straight line that begins at `pose`."""
    half = curvature * lengths / 2
    chord = lengths * np.sinc(half / np.pi)
    return np.stack(
        [pose[0] + chord * np.cos(pose[2] + half), pose[1] + chord * np.sin(pose[2] + half), pose[2] + 2 * half], axis=1
    )


def _steps_of_parts(lengths: np.ndarray, steps: int) -> np.ndarray:
    """Divide `steps` among the parts that have a length, such that the longest step is as short as it can be."""
    counts = (lengths > 0).astype(int)
    if steps < max(counts.sum(), 1):
        raise ValueError(f"steps must be at least {max(counts.sum(), 1)}, one for each part of the path; got {steps}")
    counts[0] += counts.sum() == 0  # a path of no length stays where it is
    for _ in range(steps - counts.sum()):
        counts[np.argmax(lengths / np.maximum(counts, 1))] += 1
    return counts
