"""Find where the forces of a trajectory act.

A trajectory holds the forces along normal and tangent of each contact, but not the points of contact. Its forces are
those halfway through each step, so the points are computed again for that moment.

The contacts of a pad are in an order that was chosen at the start of the step. Halfway through the step, they may be
found in another order. So several orders are tried. In the right one, the forces sum to the wrench of the step.
"""

from itertools import chain, pairwise, product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._internal.jit import quick_jit
from pushjax._math.vec import Vec3
from pushjax.geometry.shape import Shape
from pushjax.simulation.detection import contact_candidates, num_contacts, select_contacts, selected_candidates
from pushjax.simulation.hand import Hand
from pushjax.simulation.rollout import Trajectory
from pushjax.simulation.step import BodyFrame, finger_motions, unstack_finger_poses


class ContactForces(NamedTuple):
    """The forces on the slider at each contact of each step, in its body frame.

    Attributes:
        point: (steps, contacts, 2), points of contact, m.
        force: (steps, contacts, 2), N, along x and y; zero where nothing pushes.
    """

    point: np.ndarray
    force: np.ndarray


def contact_forces(shape: Shape, hand: Hand, push: Trajectory) -> ContactForces:
    """Return the forces of a trajectory, and the points where they act halfway through each step.

    Args:
        shape: Outline of the slider in the trajectory.
        hand: The hand in the trajectory.
        push: The trajectory.

    Raises:
        ValueError: If the trajectory has a different number of contacts than this hand on this shape.
    """
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
    for order in _orders([num_contacts(finger, shape.outline()) for finger in hand.fingers]):
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
    """Return the orders that are tried for the contacts, given the number of contacts of each finger.

    The contacts of a finger stay together, in their own order or reversed.
    """
    first = np.cumsum([0, *counts])
    mine = [[list(range(a, b)), list(range(a, b))[::-1]][: b - a] for a, b in pairwise(first.tolist())]
    return [list(chain(*order)) for order in product(*mine)]


@quick_jit
def _touches(shape: Shape, hand: Hand, pose: jax.Array, configuration: jax.Array, size: jax.Array):
    """Return contact points and inward normals, both (steps, contacts, 2), body frame, halfway through each step."""
    outline, fingers = shape.outline(), hand.poses(configuration)
    half = jnp.full((), 0.5, pose.dtype)

    def one(pose, before, after):
        there = BodyFrame.at(Vec3.of(pose))
        found = []
        for grip in finger_motions(
            hand, jnp.zeros(len(hand.fingers), pose.dtype), unstack_finger_poses(before), unstack_finger_poses(after)
        ):
            at, path = grip.seen(there, half), grip.path.unrotate(there.angle)
            touches = contact_candidates(grip.finger, outline, at, path, size)
            found += selected_candidates(touches, select_contacts(touches, size, outline, path))
        return tuple(
            jnp.stack([v.array() for v in part]) for part in zip(*((t.point, t.normal) for t in found), strict=True)
        )

    return jax.vmap(one)((pose[:-1] + pose[1:]) / 2, fingers[:-1], fingers[1:])
