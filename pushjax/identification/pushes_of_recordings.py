"""Conversion of recordings to the arrays of `Pushes`, and the check which recorded pushes can be used at all.

The arrays are paths in equal steps, poses after equal parts of them, wrenches, and the motions under them. This module
uses NumPy, because each recording has its own number of samples and JAX would compile a program for each.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._internal.jit import quick_jit
from pushjax.datasets.planar import cross, in_body, interpolated, rotation
from pushjax.datasets.recordings import Floats, LogError, Recording, Recordings, nothing_usable
from pushjax.geometry.shape import Shape
from pushjax.simulation.hand import Hand, RoundFinger

# Wrenches
MIN_FORCE_FRACTION = 0.5  # samples whose force is below this fraction of the push's mean force are not used
MIN_DISPLACEMENT = 2e-4  # m, smallest displacement under a wrench that gives a direction of motion

# Limits of what is physically possible
CHECKED_ROWS = 200  # rows of a path that are checked: a fixed number, so that one compiled program is enough
MIN_TRAVEL = 1e-4  # m, smallest distance that a hand moves
MAX_CONTACT_GAP = 0.005  # m, largest gap of a hand that touches: trackers and outlines have errors of millimeters
TRACKER_NOISE = 5e-4  # m, largest displacement that may be noise of the tracker
MAX_SLIDER_SIZE = 2.0  # m, largest extent of a slider
# In units of the slider's size: largest distance from slider to hand, and largest travel of the hand.
MAX_DISTANCE = 30.0
MAX_TURN = 2 * np.pi  # rad, largest rotation of a slider in a push
TRAVEL_MARGIN = 0.01  # m, margin for a slider that moves farther than its hand, and for errors of the tracker

TURN_LENGTH = 0.05  # m/rad, travel of a hand that turns


def screen(recordings: Recordings, shape: Shape, hand: Hand, parts: int = 1) -> Recordings:
    """Keep pushes that are physically possible; list the others in `problems` with the reason.

    Args:
        recordings: Recorded pushes.
        shape: Outline of the slider.
        hand: The hand that pushed.
        parts: Number of parts of each push that are asked for (see `push_arrays`). If the slider was tracked often
            enough for them in at least half of the pushes, the others are not kept.

    Returns:
        The recordings without the other pushes. `problems` names each of these with its index and the reason.

    Raises:
        ValueError: If the outline seems to be in another unit.
        LogError: If no push is left (a ValueError too).
    """
    low, high = (np.asarray(corner, float) for corner in shape.bounds)
    size = float(np.max(high - low))
    if not size <= MAX_SLIDER_SIZE:
        raise ValueError(f"shape: {size:g} m across; expected at most {MAX_SLIDER_SIZE:g} m: is it in millimeters?")
    pushes = recordings.pushes
    reasons = [_implausibility(push, size, shape, hand) for push in pushes]
    sparse = [
        reason is None and not _is_observed_often_enough(push, parts)
        for push, reason in zip(pushes, reasons, strict=True)
    ]
    if 2 * sum(sparse) <= reasons.count(None):
        for k in np.flatnonzero(sparse):
            count = pushes[k].tracked[1:-1].sum()
            reasons[k] = f"the object was tracked {count} times on the way; {parts} parts need {parts - 1}"
    kept = tuple(push for push, reason in zip(pushes, reasons, strict=True) if reason is None)
    problems = tuple(
        LogError(recordings.source, reason, push=push.index)
        for push, reason in zip(pushes, reasons, strict=True)
        if reason is not None
    )
    if not kept:
        raise nothing_usable(recordings.source, problems)
    return replace(recordings, pushes=kept, problems=(*recordings.problems, *problems))


def _implausibility(push: Recording, size: float, shape: Shape, hand: Hand) -> str | None:
    """Return why a push is physically impossible, or None."""
    # the comparisons are written so that NaN fails them
    start, end = push.pose[0], push.pose[-1]
    travel = float(_hand_travel(push)[-1])
    distance = float(np.linalg.norm(push.hand[:, :2] - start[:2], axis=1).min())
    moved, turn = float(np.linalg.norm(end[:2] - start[:2])), float(abs(end[2] - start[2]))
    if not (turn <= MAX_TURN and abs(start[2]) <= 2 * MAX_TURN):
        found = f"turns by {turn:.4g}" if not turn <= MAX_TURN else f"starts at {start[2]:.4g}"
        return f"the object {found} rad; expected at most a turn, and a start within two turns of 0: is it in degrees?"
    if not (travel <= MAX_DISTANCE * size and distance <= MAX_DISTANCE * size):
        what, found = (
            ("the hand moves", travel) if travel > MAX_DISTANCE * size else ("the hand stays away by", distance)
        )
        return f"{what} {found:.4g} m, of an object {size:.3g} m across: are its coordinates in millimeters?"
    if not travel >= MIN_TRAVEL:
        return f"the hand moves {travel:.2g} m; expected at least {MIN_TRAVEL:g} m"
    if not (moved <= travel + size + TRAVEL_MARGIN):
        return f"the object moves {moved:.4g} m, the hand {travel:.4g} m: the tracker jumped"
    gaps = _finger_gaps(shape, hand, push)
    if gaps.size and not gaps.min() <= MAX_CONTACT_GAP:
        addition = f", yet the object moves {moved:.3g} m" if moved > TRACKER_NOISE else ""
        return f"the hand never touches: it stays {gaps.min():.3g} m away from where the object starts{addition}"
    if gaps.size and not gaps[0] >= -size / 4:
        return f"the hand starts {-gaps[0]:.3g} m inside the object"
    return None


def _finger_gaps(shape: Shape, hand: Hand, push: Recording) -> np.ndarray:
    """Return the gaps (CHECKED_ROWS,) in m from the nearest finger to the initial outline, negative inside."""
    if not all(isinstance(finger, RoundFinger) for finger in hand.fingers):
        return np.zeros(0)  # not known for fingers that are not round
    rows = np.linspace(0, len(push.hand) - 1, CHECKED_ROWS).round().astype(int)
    centers = np.asarray(hand.poses(jnp.asarray(push.hand[rows])))[..., :2]
    body = (centers - push.pose[0, :2]) @ rotation(push.pose[0, 2])
    distance = np.asarray(_signed_distances(shape, jnp.asarray(body).reshape(-1, 2))).reshape(CHECKED_ROWS, -1)
    return (distance - np.asarray(hand.radius)).min(axis=1)


@quick_jit
def _signed_distances(shape: Shape, points: jax.Array) -> jax.Array:
    """Return the signed distances (n,) in m of points (n, 2), body frame, from the outline."""
    return jax.vmap(shape.signed_distance)(points)


def push_arrays(
    recordings: Recordings,
    steps: int,  # of each path
    parts: int,
    shape: Shape | None,  # outline of the slider, for wrenches
) -> dict[str, Floats]:
    """Return the arrays `start`, `path`, `end`, `poses_between`, and maybe `wrench` and `twist`, of `Pushes`."""
    # The slider's pose after each of `parts` equal parts of a push is used, if it was tracked often enough during all
    # pushes; otherwise only the final pose. With a shape, the mean wrench of each of several parts is used too, if the
    # forces of a single finger were recorded.
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")
    if not 1 <= parts < max(steps, 2):
        raise ValueError(f"parts must be at least 1, and fewer than the {steps} steps; got {parts}")
    pushes = recordings.pushes
    if not observed_often_enough(recordings, parts):
        parts = 1
    arcs = [_hand_travel(push) for push in pushes]
    path = [
        interpolated(np.arange(steps + 1) / steps * arc[-1], arc, push.hand)
        for push, arc in zip(pushes, arcs, strict=True)
    ]
    # Parts end at steps of the path, because the prediction has poses only there.
    fractions = np.round(np.arange(parts + 1) / parts * steps) / steps
    poses = np.stack([_slider_poses(push, arc, fractions * arc[-1]) for push, arc in zip(pushes, arcs, strict=True)])
    pairs: dict[str, Floats] = {}
    if shape is not None and parts > 1 and has_wrenches(recordings):
        part_of_sample = [
            np.clip(np.searchsorted(fractions * arc[-1], arc, side="right") - 1, 0, parts - 1) for arc in arcs
        ]
        pairs = _wrench_motion_pairs(pushes, poses, part_of_sample, shape)
    arrays = {"start": poses[:, 0], "path": np.stack(path), "end": poses[:, -1]}
    return arrays | {"poses_between": poses[:, 1:-1]} | pairs


def observed_often_enough(recordings: Recordings, parts: int) -> bool:
    """Return whether the slider was tracked often enough during every push to give a pose after each part."""
    return all(_is_observed_often_enough(push, parts) for push in recordings.pushes)


def _is_observed_often_enough(push: Recording, parts: int) -> bool:
    return bool(push.tracked[1:-1].sum() >= parts - 1)


def has_wrenches(recordings: Recordings) -> bool:
    """Return whether every push has forces of a single finger; with several, it is unknown which finger felt what."""
    return all(push.force is not None and push.hand.shape[1] == 2 for push in recordings.pushes)


def in_meters(configurations: Any) -> Any:
    """Return configurations (m, dof) of a hand with the angle as a length: their distances are its travel."""
    lengths = np.where(np.arange(configurations.shape[1]) == 2, TURN_LENGTH, 1.0)  # the third coordinate is an angle
    return configurations * lengths.astype(configurations.dtype)[None]


def _hand_travel(push: Recording) -> Floats:
    """Return the distance (m,) that the hand has traveled at each sample, m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(in_meters(push.hand), axis=0), axis=1))])


def _slider_poses(push: Recording, arc: Floats, query: Floats) -> Floats:
    """Return the slider's poses (k, 3) at the hand's arc lengths `query` (k,), the first and last being the ends."""
    pose = interpolated(query, arc[push.tracked], push.pose[push.tracked])
    # A tracker that lags may show the slider moving after the hand has stopped, at equal arc lengths.
    pose[0], pose[-1] = push.pose[0], push.pose[-1]
    return pose


def _wrench_motion_pairs(
    pushes: tuple[Recording, ...],
    poses: Floats,  # (pushes, parts + 1, 3), of the slider, between the parts
    part_of_sample: list[np.ndarray],  # for each push, the index of the part that each sample is in
    shape: Shape,
) -> dict[str, Floats]:
    """Return the mean wrench and the displacement in each part of each push, body frame; zero where unknown."""
    rows = [np.arange(len(push.hand), dtype=float) for push in pushes]
    all_poses = [
        interpolated(row, row[push.tracked], push.pose[push.tracked]) for push, row in zip(pushes, rows, strict=True)
    ]
    fingertips = [in_body(pose, push.hand - pose[:, :2]) for push, pose in zip(pushes, all_poses, strict=True)]
    # all pushes at once: otherwise each number of samples would need its own compiled program
    contacts = np.split(
        np.asarray(_nearest_on_outline(shape, jnp.asarray(np.concatenate(fingertips)))),
        np.cumsum([len(t) for t in fingertips])[:-1],
    )
    wrench, twist = np.zeros_like(poses[:, 1:]), np.zeros_like(poses[:, 1:])
    lever = float(np.min(shape.bounds[1] - shape.bounds[0])) / 2  # that of the outline's nearest point, about
    for k, (push, pose, contact) in enumerate(zip(pushes, all_poses, contacts, strict=True)):
        force = np.asarray(push.force)
        measured = np.isfinite(force[:, 0]) & np.isfinite(force[:, 1])
        body_force = in_body(pose, np.where(measured[:, None], force, 0.0))
        magnitude = np.hypot(body_force[:, 0], body_force[:, 1])
        usable = measured & (magnitude >= MIN_FORCE_FRACTION * np.sum(magnitude) / max(int(measured.sum()), 1))
        for part, (before, after) in enumerate(zip(poses[k, :-1], poses[k, 1:], strict=True)):
            in_part = usable & (part_of_sample[k] == part)
            translation = rotation((before[2] + after[2]) / 2).T @ (after - before)[:2]
            turn = abs(after[2] - before[2]) * lever
            if in_part.any() and max(np.hypot(*translation), turn) >= MIN_DISPLACEMENT:
                forces = body_force[in_part]
                wrench[k, part] = *forces.mean(axis=0), cross(contact[in_part], forces).mean()
                twist[k, part] = *translation, after[2] - before[2]
    return {"wrench": wrench, "twist": twist}


@quick_jit
def _nearest_on_outline(shape: Shape, points: jax.Array) -> jax.Array:
    """Return the points (n, 2) of the outline nearest to points (n, 2), body frame, m: where a finger touches."""
    return jax.vmap(lambda point: shape.closest(point)[1])(points)
