"""From recordings to arrays: paths in equal steps, poses after equal parts of them, wrenches and the motions there."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pushjax.datasets.pushes import Floats, rotation
from pushjax.datasets.recordings import Recording, Recordings
from pushjax.hands import resample
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
    if not 1 <= parts < max(steps, 2):
        raise ValueError(f"parts must be at least 1, and fewer than the {steps} steps; got {parts}")
    pushes = recordings.pushes
    if any(push.seen[1:-1].sum() < parts - 1 for push in pushes):
        parts = 1
    path = np.stack([resample(push.hand, steps) for push in pushes])
    seen = [_seen_after(push, parts, steps) for push in pushes]
    poses = np.stack([one.pose for one in seen])
    start, along, end = poses[:, 0], poses[:, 1:-1], poses[:, -1]
    wrench = twist = None
    if shape is not None and parts > 1 and all(p.force is not None and p.hand.shape[1] == 2 for p in pushes):
        pairs = [_pairs(push, one, shape) for push, one in zip(pushes, seen, strict=True)]
        wrench, twist = (np.stack([pair[k] for pair in pairs]) for k in range(2))
    return Pushes(start, path, end, along=along, wrench=wrench, twist=twist)


class _Seen(NamedTuple):
    """pose: (parts + 1, 3), the first is the start's. part: (m,), in which part of the push each sample is."""

    pose: Floats
    part: np.ndarray


def _seen_after(push: Recording, parts: int, steps: int) -> _Seen:
    hop = np.linalg.norm(np.diff(push.hand, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(hop)])
    # as the steps of the path are
    at = np.round(np.arange(parts + 1) / parts * steps) / steps * arc[-1]
    pose = np.stack([np.interp(at, arc[push.seen], column[push.seen]) for column in push.pose.T], axis=1)
    # the slider may be seen to move on after the hand has stopped, by a tracker that lags
    pose[0], pose[-1] = push.pose[0], push.pose[-1]
    return _Seen(pose, np.clip(np.searchsorted(at, arc, side="right") - 1, 0, parts - 1))


def _pairs(push: Recording, seen: _Seen, shape: Shape) -> tuple[Floats, Floats]:
    """(parts, 3) the mean wrench in each part, and the displacement, both in the body frame; zero where not told."""
    force = np.asarray(push.force)
    rows = np.arange(len(push.hand))
    pose = np.stack([np.interp(rows, rows[push.seen], column[push.seen]) for column in push.pose.T], axis=1)
    body_from_world = rotation(pose[:, 2]).swapaxes(1, 2)
    there = np.asarray(np.isfinite(force).all(axis=1))
    pushed = np.einsum("kij,kj->ki", body_from_world, np.where(there[:, None], force, 0.0))
    tip = np.einsum("kij,kj->ki", body_from_world, push.hand - pose[:, :2])
    arm = np.asarray(_feet(shape, jnp.asarray(tip)))
    strength = np.linalg.norm(pushed, axis=1)
    strong = there & (strength >= STRONG * strength[there].mean()) if there.any() else there
    wrench, twist = np.zeros((2, len(seen.pose) - 1, 3))
    for part, (before, after) in enumerate(zip(seen.pose[:-1], seen.pose[1:], strict=True)):
        mine = strong & (seen.part == part)
        moved = rotation((before[2] + after[2]) / 2).T @ (after - before)[:2]
        if mine.any() and np.linalg.norm(moved) >= MOVES:
            f, r = pushed[mine], arm[mine]
            wrench[part] = *f.mean(axis=0), (r[:, 0] * f[:, 1] - r[:, 1] * f[:, 0]).mean()
            twist[part] = *moved, after[2] - before[2]
    return wrench, twist


@eqx.filter_jit
def _feet(shape: Shape, points: jax.Array) -> jax.Array:
    """Of each point the nearest one of the outline: where a finger touches."""
    return jax.vmap(lambda point: shape.closest(point)[1])(points)
