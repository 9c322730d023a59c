"""Where the forces of a trajectory act.

A trajectory keeps forces along normal and tangent of each contact, not the contacts' places. These are found again,
halfway through each step, where the forces are stated. A pad's contacts come in an order that a step chose as it
began; of all orders that one is right with which the forces add up to the step's wrench.
"""

from itertools import chain, pairwise, product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._programs import quickly_compiled
from pushjax._vec import Vec3
from pushjax.advance import Placed, columns, grips_of
from pushjax.contacts import choose, count, places, taken
from pushjax.hands import Hand
from pushjax.rollout import Trajectory
from pushjax.shapes import Shape


class ContactForces(NamedTuple):
    """The forces on the slider at each contact of each step, in its body frame.

    point: (steps, contacts, 2), m. force: (steps, contacts, 2), N, x and y; zero where nothing pushes.
    """

    point: np.ndarray
    force: np.ndarray


def contact_forces(shape: Shape, hand: Hand, push: Trajectory) -> ContactForces:
    """The forces of a trajectory of that shape and hand, with where they act, halfway through each step."""
    low, high = (np.asarray(corner, float) for corner in shape.bounds)
    size = float(np.linalg.norm(high - low)) / 4  # about the radius of gyration
    each = _touches(shape, hand, push.pose, push.configuration, jnp.asarray(size, push.pose.dtype))
    point, normal = (np.asarray(part, float) for part in each)
    along = np.asarray(push.force, float)
    if along.shape[:2] != point.shape[:2]:
        raise ValueError(f"the trajectory has {along.shape[1]} contacts; this hand and shape have {point.shape[1]}")
    wrench = np.asarray(push.wrench, float)
    best = np.full(len(along), np.inf)
    found = ContactForces(point.copy(), np.zeros_like(along))
    for order in _orders([count(finger, shape.outline()) for finger in hand.fingers]):
        p, n = point[:, order], normal[:, order]
        force = along[..., :1] * n + along[..., 1:] * np.stack([-n[..., 1], n[..., 0]], axis=-1)
        torque = p[..., 0] * force[..., 1] - p[..., 1] * force[..., 0]
        total = np.concatenate([force, torque[..., None] / size], axis=-1).sum(axis=1)
        off = np.linalg.norm(total - wrench / [1, 1, size], axis=1)
        nearer = off < best
        best = np.where(nearer, off, best)
        found.point[nearer], found.force[nearer] = p[nearer], force[nearer]
    return found


def _orders(counts: list[int]) -> list[list[int]]:
    """In which orders contacts may be meant, so many of each finger: those of a finger stay together."""
    first = np.cumsum([0, *counts])
    mine = [[list(range(a, b)), list(range(a, b))[::-1]][: b - a] for a, b in pairwise(first.tolist())]
    return [list(chain(*order)) for order in product(*mine)]


@quickly_compiled
def _touches(shape: Shape, hand: Hand, pose: jax.Array, configuration: jax.Array, size: jax.Array):
    """Points and inward normals (steps, contacts, 2), body frame, halfway through each step."""
    outline, fingers = shape.outline(), hand.poses(configuration)
    half = jnp.full((), 0.5, pose.dtype)

    def one(pose, before, after):
        there = Placed.at(Vec3.of(pose))
        found = []
        for grip in grips_of(hand, jnp.zeros(len(hand.fingers), pose.dtype), columns(before), columns(after)):
            at, path = grip.seen(there, half), grip.path.unrotate(there.angle)
            touches = places(grip.finger, outline, at, path, size)
            found += taken(touches, choose(touches, size, outline, path))
        return tuple(
            jnp.stack([v.array() for v in part]) for part in zip(*((t.point, t.normal) for t in found), strict=True)
        )

    return jax.vmap(one)((pose[:-1] + pose[1:]) / 2, fingers[:-1], fingers[1:])
