"""Conversion of recordings to the arrays of `Pushes`, and the check which recorded pushes can be used at all.

The arrays are paths in equal steps, poses after equal parts of them, wrenches, and the motions under them. This module
uses NumPy, because each recording has its own number of samples and JAX would compile a program for each.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._internal.jit import quick_jit
from pushjax.datasets.pushes import Floats, LogError, nothing_usable, rotation
from pushjax.datasets.recordings import Recording, Recordings
from pushjax.geometry.shape import Shape
from pushjax.simulation.hand import Hand, RoundFinger

STRONG = 0.5  # of the mean force of a push: samples with a smaller force are not used for wrenches
MOVES = 2e-4  # m, smallest displacement under a wrench that gives a direction of motion

ROWS = 200  # rows of a path that are checked: a fixed number, so that one compiled program is enough
SHORTEST = 1e-4  # m, smallest distance that a hand moves
NEAR = 0.005  # m, largest gap of a hand that touches: trackers and outlines have errors of millimeters
MOVED = 5e-4  # m, displacement that exceeds the noise of a tracker
LARGEST = 2.0  # m, largest size of a slider
FAR = 30.0  # slider sizes, largest distance from the slider to the hand, and that the hand moves
TURN = 2 * np.pi  # rad, largest rotation of a slider in a push
ROOM = 0.01  # m, margin for a slider that moves farther than its hand, and for errors of the tracker


def screen(recordings: Recordings, shape: Shape, hand: Hand) -> Recordings:
    """Keep pushes that are physically possible; list the others in `problems` with the reason.

    Args:
        recordings: Recorded pushes.
        shape: Outline of the slider.
        hand: The hand that pushed.

    Returns:
        The recordings without the impossible pushes. `problems` names each of these with its index and the reason.

    Raises:
        ValueError: If the outline seems to be in another unit.
        LogError: If no push is left (a ValueError too).
    """
    low, high = (np.asarray(corner, float) for corner in shape.bounds)
    size = float(np.max(high - low))
    if not size <= LARGEST:
        raise ValueError(f"shape: {size:g} m across; expected at most {LARGEST:g} m: is it in millimeters?")
    kept: list[Recording] = []
    problems: list[LogError] = []
    for push in recordings.pushes:
        wrong = _wrong(push, size, shape, hand)
        if wrong is None:
            kept.append(push)
        else:
            problems.append(LogError(recordings.source, wrong, push=push.index))
    if not kept:
        raise nothing_usable(recordings.source, problems)
    return replace(recordings, pushes=tuple(kept), problems=(*recordings.problems, *problems))


def _wrong(push: Recording, size: float, shape: Shape, hand: Hand) -> str | None:
    """Return what is wrong with a push, or None. All comparisons fail for NaN."""
    start, end = push.pose[0], push.pose[-1]
    hop = np.linalg.norm(np.diff(push.hand[:, :2], axis=0), axis=1)
    travel, apart = float(hop.sum()), float(np.linalg.norm(push.hand[:, :2] - start[:2], axis=1).min())
    turned = push.hand.shape[1] > 2 and float(np.abs(np.diff(push.hand[:, 2:], axis=0)).sum()) > 1e-3
    moved, turn = float(np.linalg.norm(end[:2] - start[:2])), float(abs(end[2] - start[2]))
    if not (turn <= TURN and abs(start[2]) <= 2 * TURN):
        found = f"turns by {turn:.4g}" if not turn <= TURN else f"starts at {start[2]:.4g}"
        return f"the object {found} rad; expected at most a turn, from within two of zero: is it in degrees?"
    if not (travel <= FAR * size and apart <= FAR * size):
        what, found = ("the hand moves", travel) if travel > FAR * size else ("the hand stays away by", apart)
        return f"{what} {found:.4g} m, of an object {size:.3g} m across: are its coordinates in millimeters?"
    if not (travel >= SHORTEST or turned):
        return f"the hand moves {travel:.2g} m; expected at least {SHORTEST:g} m"
    if not (moved <= travel + size + ROOM):
        return f"the object moves {moved:.4g} m, the hand {travel:.4g} m: the tracker jumped"
    nearest = _gaps(shape, hand, push)
    if nearest.size and not nearest.min() <= NEAR:
        also = f", yet the object moves {moved:.3g} m" if moved > MOVED else ""
        return f"the hand never touches: it stays {nearest.min():.3g} m away from where the object starts{also}"
    if nearest.size and not nearest[0] >= -size / 4:
        return f"the hand starts {-nearest[0]:.3g} m inside the object"
    return None


def _gaps(shape: Shape, hand: Hand, push: Recording) -> np.ndarray:
    """Return the gaps (rows,) in m from the nearest finger to the initial outline; empty if a finger is not a disk."""
    if not all(isinstance(finger, RoundFinger) for finger in hand.fingers):
        return np.zeros(0)
    rows = np.linspace(0, len(push.hand) - 1, ROWS).round().astype(int)
    centers = np.asarray(hand.poses(jnp.asarray(push.hand[rows])))[..., :2]
    body = (centers - push.pose[0, :2]) @ rotation(push.pose[0, 2])
    distance = np.asarray(_distances(shape, jnp.asarray(body).reshape(-1, 2))).reshape(ROWS, -1)
    return (distance - np.asarray(hand.radius)).min(axis=1)


@quick_jit
def _distances(shape: Shape, points: jax.Array) -> jax.Array:
    """Return the signed distances of body points, as one compiled program."""
    return jax.vmap(shape.signed_distance)(points)


def push_arrays(recordings: Recordings, steps: int, parts: int, shape: Shape | None) -> dict[str, Floats]:
    """Return the arrays of `Pushes`, by name.

    Args:
        recordings: Recorded pushes.
        steps: Number of steps of each path.
        parts: Number of equal parts of each push. The slider's pose after each part is used, if it was tracked during
            all pushes. Otherwise only the final pose is used.
        shape: Outline of the slider. If it is given and the forces of a single finger were recorded, wrenches are used
            too.

    Returns:
        Arrays `start`, `path`, `end` and `poses_between`, and `wrench` and `twist` if they are used.

    Raises:
        ValueError: If `steps` or `parts` is less than one, or if `parts` is not less than `steps`.
    """
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")
    if not 1 <= parts < max(steps, 2):
        raise ValueError(f"parts must be at least 1, and fewer than the {steps} steps; got {parts}")
    pushes = recordings.pushes
    if not observed_often_enough(recordings, parts):
        parts = 1
    arcs = [_arc(push) for push in pushes]
    path = [_at(push.hand, arc, np.arange(steps + 1) / steps * arc[-1]) for push, arc in zip(pushes, arcs, strict=True)]
    # rounded to steps of the path
    shares = np.round(np.arange(parts + 1) / parts * steps) / steps
    poses = np.stack([_poses(push, arc, shares * arc[-1]) for push, arc in zip(pushes, arcs, strict=True)])
    pairs: dict[str, Floats] = {}
    if shape is not None and parts > 1 and has_wrenches(recordings):
        which = [np.clip(np.searchsorted(shares * arc[-1], arc, side="right") - 1, 0, parts - 1) for arc in arcs]
        pairs = _pairs(pushes, poses, which, shape)
    ends = {"start": poses[:, 0], "path": np.stack(path), "end": poses[:, -1]}
    return ends | {"poses_between": poses[:, 1:-1]} | pairs


def observed_often_enough(recordings: Recordings, parts: int) -> bool:
    """Return whether the slider was tracked often enough during every push to give a pose after each part."""
    return all(push.seen[1:-1].sum() >= parts - 1 for push in recordings.pushes)


def has_wrenches(recordings: Recordings) -> bool:
    """Return whether every push has forces of a single finger; with several, it is unknown which finger felt what."""
    return all(push.force is not None and push.hand.shape[1] == 2 for push in recordings.pushes)


def _arc(push: Recording) -> Floats:
    """Return the distance (m,) that the hand has moved at each sample, in the configuration's own units."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(push.hand, axis=0), axis=1))])


def _at(values: Floats, arc: Floats, at: Floats) -> Floats:
    """Interpolate each column of `values` at the arc lengths `at`."""
    return np.stack([np.interp(at, arc, column) for column in values.T], axis=1)


def _poses(push: Recording, arc: Floats, at: Floats) -> Floats:
    """Return the slider's poses at the hand's arc lengths `at`."""
    pose = _at(push.pose[push.seen], arc[push.seen], at)
    # a tracker that lags may show the slider moving after the hand has stopped
    pose[0], pose[-1] = push.pose[0], push.pose[-1]
    return pose


def _pairs(pushes: tuple[Recording, ...], poses: Floats, which: list[np.ndarray], shape: Shape) -> dict[str, Floats]:
    """Return the mean wrench and the displacement in each part of each push, in the body frame; zero where unknown.

    Args:
        pushes: Recorded pushes.
        poses: (pushes, parts + 1, 3) slider's poses between the parts.
        which: For each push, the part that each sample is in.
        shape: Outline of the slider.
    """
    rows = [np.arange(len(push.hand), dtype=float) for push in pushes]
    every = [_at(push.pose[push.seen], row[push.seen], row) for push, row in zip(pushes, rows, strict=True)]
    tips = [np.einsum("kji,kj->ki", rotation(q[:, 2]), p.hand - q[:, :2]) for p, q in zip(pushes, every, strict=True)]
    # all pushes at once: otherwise each number of samples would need its own compiled program
    feet = np.split(np.asarray(_feet(shape, jnp.asarray(np.concatenate(tips)))), np.cumsum([len(t) for t in tips])[:-1])
    wrench, twist = np.zeros_like(poses[:, 1:]), np.zeros_like(poses[:, 1:])
    for k, (push, pose, arm) in enumerate(zip(pushes, every, feet, strict=True)):
        force = np.asarray(push.force)
        there = np.isfinite(force[:, 0]) & np.isfinite(force[:, 1])
        pushed = np.einsum("kji,kj->ki", rotation(pose[:, 2]), np.where(there[:, None], force, 0.0))
        strength = np.hypot(pushed[:, 0], pushed[:, 1])
        strong = there & (strength >= STRONG * np.sum(strength) / max(int(there.sum()), 1))
        for part, (before, after) in enumerate(zip(poses[k, :-1], poses[k, 1:], strict=True)):
            mine = strong & (which[k] == part)
            moved = rotation((before[2] + after[2]) / 2).T @ (after - before)[:2]
            if mine.any() and np.hypot(*moved) >= MOVES:
                f, r = pushed[mine], arm[mine]
                wrench[k, part] = *f.mean(axis=0), (r[:, 0] * f[:, 1] - r[:, 1] * f[:, 0]).mean()
                twist[k, part] = *moved, after[2] - before[2]
    return {"wrench": wrench, "twist": twist}


@quick_jit
def _feet(shape: Shape, points: jax.Array) -> jax.Array:
    """Return the nearest point of the outline to each point, which is where a finger touches."""
    return jax.vmap(lambda point: shape.closest(point)[1])(points)
