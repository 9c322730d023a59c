"""Which recorded pushes can be learned from, and what is wrong with the others."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._programs import quickly_compiled
from pushjax.datasets.pushes import LogError, nothing_usable, rotation
from pushjax.datasets.recordings import Recording, Recordings
from pushjax.hands import Hand, RoundFinger
from pushjax.shapes import Shape

ROWS = 200  # of a path that are looked at: always as many, so that one compiled program does
SHORTEST = 1e-4  # m, that a hand moves at least
NEAR = 0.005  # m, as near as a hand comes that touches: trackers and outlines are off by millimetres
MOVED = 5e-4  # m, more than a tracker's noise
LARGEST = 2.0  # m, that a slider is across
FAR = 30.0  # slider sizes, from the slider to the hand, or that it moves
TURN = 2 * np.pi  # rad, that no push turns a slider by
ROOM = 0.01  # m, that a slider may move farther than its hand, and a tracker be off


def screened(recordings: Recordings, shape: Shape, hand: Hand) -> Recordings:
    """The recordings whose pushes can be: the rest become problems, each with its push and the reason.

    Raises ValueError if the outline is in another unit, LogError (a ValueError too) if no push is left.
    """
    low, high = (np.asarray(corner, float) for corner in shape.bounds)
    size = float(np.max(high - low))
    if not size <= LARGEST:
        raise ValueError(f"shape: {size:g} m across; expected at most {LARGEST:g} m: is it in millimetres?")
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
    """What is wrong with a push, if anything. Comparisons are such that NaN fails."""
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
        return f"{what} {found:.4g} m, of an object {size:.3g} m across: are its coordinates in millimetres?"
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
    """(rows,) m, from the nearest finger to the outline where it starts; empty where a finger is no disc."""
    if not all(isinstance(finger, RoundFinger) for finger in hand.fingers):
        return np.zeros(0)
    rows = np.linspace(0, len(push.hand) - 1, ROWS).round().astype(int)
    centers = np.asarray(hand.poses(jnp.asarray(push.hand[rows])))[..., :2]
    body = (centers - push.pose[0, :2]) @ rotation(push.pose[0, 2])
    distance = np.asarray(_distances(shape, jnp.asarray(body).reshape(-1, 2))).reshape(ROWS, -1)
    return (distance - np.asarray(hand.radius)).min(axis=1)


@quickly_compiled
def _distances(shape: Shape, points: jax.Array) -> jax.Array:
    return jax.vmap(shape.signed_distance)(points)
