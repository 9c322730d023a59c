"""From recordings to arrays: paths in equal steps, poses after equal parts of them, wrenches and the motions there.

In numpy, for recordings have as many samples as they have: JAX would compile anew for each.
"""

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._programs import quickly_compiled
from pushjax.datasets.pushes import Floats, rotation
from pushjax.datasets.recordings import Recording, Recordings
from pushjax.identify.pushes import STEPS, Pushes
from pushjax.shapes import Shape

STRONG = 0.5  # of a push's mean force, that a sample is at least, for its wrench to count
MOVES = 2e-4  # m, that the slider moves at least under a wrench, for its direction to be told


def recorded(recordings: Recordings, steps: int = STEPS, parts: int = 1, shape: Shape | None = None) -> Pushes:
    """The pushes of recordings, their paths in `steps`. parts: of a push, after each of which the slider's pose counts,
    if all recordings saw it on the way; else only the end's does. shape: with it, and with forces of a single finger,
    wrenches count too.

    Raises ValueError for fewer than one part, or not fewer than steps.
    """
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")
    if not 1 <= parts < max(steps, 2):
        raise ValueError(f"parts must be at least 1, and fewer than the {steps} steps; got {parts}")
    pushes = recordings.pushes
    if not seen_after(recordings, parts):
        parts = 1
    arcs = [_arc(push) for push in pushes]
    path = [_at(push.hand, arc, np.arange(steps + 1) / steps * arc[-1]) for push, arc in zip(pushes, arcs, strict=True)]
    # as the steps of the path are
    shares = np.round(np.arange(parts + 1) / parts * steps) / steps
    poses = np.stack([_poses(push, arc, shares * arc[-1]) for push, arc in zip(pushes, arcs, strict=True)])
    pairs: dict[str, Floats] = {}
    if shape is not None and parts > 1 and paired(recordings):
        which = [np.clip(np.searchsorted(shares * arc[-1], arc, side="right") - 1, 0, parts - 1) for arc in arcs]
        pairs = _pairs(pushes, poses, which, shape)
    return Pushes(poses[:, 0], np.stack(path), poses[:, -1], along=poses[:, 1:-1], **pairs)


def seen_after(recordings: Recordings, parts: int) -> bool:
    """Whether every push was seen on the way as often as its `parts` ask for."""
    return all(push.seen[1:-1].sum() >= parts - 1 for push in recordings.pushes)


def paired(recordings: Recordings) -> bool:
    """Whether every push has forces, of a single finger: of several one does not know which felt what."""
    return all(push.force is not None and push.hand.shape[1] == 2 for push in recordings.pushes)


def _arc(push: Recording) -> Floats:
    """(m,) how far the hand has come, in the configuration's own units."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(push.hand, axis=0), axis=1))])


def _at(values: Floats, arc: Floats, at: Floats) -> Floats:
    return np.stack([np.interp(at, arc, column) for column in values.T], axis=1)


def _poses(push: Recording, arc: Floats, at: Floats) -> Floats:
    pose = _at(push.pose[push.seen], arc[push.seen], at)
    # the slider may be seen to move on after the hand has stopped, by a tracker that lags
    pose[0], pose[-1] = push.pose[0], push.pose[-1]
    return pose


def _pairs(pushes: tuple[Recording, ...], poses: Floats, which: list[np.ndarray], shape: Shape) -> dict[str, Floats]:
    """The mean wrench in each part of each push, and the displacement, both in the body frame; zero where not told.
    which: the part that each sample is in."""
    rows = [np.arange(len(push.hand), dtype=float) for push in pushes]
    every = [_at(push.pose[push.seen], row[push.seen], row) for push, row in zip(pushes, rows, strict=True)]
    tips = [np.einsum("kji,kj->ki", rotation(q[:, 2]), p.hand - q[:, :2]) for p, q in zip(pushes, every, strict=True)]
    # all at once: for samples of every number there would be another program
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


@quickly_compiled
def _feet(shape: Shape, points: jax.Array) -> jax.Array:
    """Of each point the nearest one of the outline: where a finger touches."""
    return jax.vmap(lambda point: shape.closest(point)[1])(points)
