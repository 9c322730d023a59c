"""Forces on the slider as vectors: those of a trajectory, and the squeeze that holds a slider at the end of a grasp.

The squeeze is made of contact forces that cancel through the slider. How hard the hand squeezes is not part of the
model, so they are per unit of normal force: the normal forces of all contacts sum to one. Of all such forces within the
friction cones, these are the ones on which the closing hand does the most work, as in the certificate of a jam
(`pushjax.contact.jam_certificate`). Where several do as much, for example along the whole edge of a flat grasp, these
are the most evenly distributed ones.
"""

from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import linprog, nnls

from pushjax.geometry.se2_numpy import to_body, to_world
from pushjax.geometry.shape import Shape
from pushjax.plot.parts import finger_poses, vertices
from pushjax.simulation.hand import Hand, Pad
from pushjax.simulation.trajectory import Trajectory

# Largest gap of a contact, in units of the slider's size. The motion of the hand in its last step is added to it.
TOUCH = 1e-3
BALANCE = 1e-3  # largest resultant of forces that count as balanced, relative to the normal forces
SQUEEZE_LABEL = "forces that hold it, per unit of squeeze"
STIFF = 1e4  # weight of the equations in the search for the most even forces


class Forces(NamedTuple):
    """Forces on the slider, and where they act.

    Attributes:
        point: (..., contacts, 2), points of contact, m.
        force: (..., contacts, 2), forces along x and y.
    """

    point: np.ndarray
    force: np.ndarray


def contact_forces(push: Trajectory) -> Forces:
    """Return the forces of a trajectory on the slider, halfway through each step, in its body frame of that moment.

    Args:
        push: The trajectory.

    Returns:
        Points and forces (steps, contacts, 2), m and N; zero where nothing pushes.
    """
    components, normal = np.asarray(push.force, float), np.asarray(push.contact_normal, float)
    force = components[..., :1] * normal + components[..., 1:] * _tangent(normal)
    return Forces(np.asarray(push.contact_point, float), force)


def squeeze_forces(shape: Shape, hand: Hand, grasp: Trajectory, friction: float) -> Forces | None:
    """Return the squeeze by which a hand holds the slider where it stopped, or None where it does not.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        grasp: The grasp.
        friction: Coefficient of friction of all contacts.

    Returns:
        Points and forces (contacts, 2) that cancel, world frame: m, and per unit of normal force of all contacts.
    """
    stop, configurations = int(grasp.stopped), np.asarray(grasp.configuration)
    moved = np.flatnonzero(np.any(np.diff(configurations[: stop + 2], axis=0) != 0, axis=1))
    if stop < 0 or not len(moved):
        return None
    before, after = finger_poses(hand, configurations[moved[-1] : moved[-1] + 2])
    point, normal, motion = _contacts(shape, hand, np.asarray(grasp.pose[-1], float), before, after)
    edge_weights = _balanced(point, normal, motion, friction)
    if edge_weights is None:
        return None
    left, right = edge_weights.T[..., None]
    return Forces(point, (left + right) * normal + friction * (left - right) * _tangent(normal))


def _tangent(normal: np.ndarray) -> np.ndarray:
    """Return the normals (..., 2) turned by +90 degrees."""
    return np.stack([-normal[..., 1], normal[..., 0]], axis=-1)


def _contacts(
    shape: Shape,
    hand: Hand,
    pose: np.ndarray,  # (3,), of the slider, world, m and rad
    before: np.ndarray,  # (fingers, 3), poses before the hand's last motion
    after: np.ndarray,  # (fingers, 3), poses after it
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, normals into the slider, and displacements of the fingers at all contacts, (contacts, 2) each."""
    # corners of pads and of the slider are compared with the outline of the other
    outline = vertices(shape)
    size = float(np.ptp(outline, axis=0).max())
    slack = TOUCH * size + float(np.abs(after - before)[:, :2].max())
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for finger, start, end in zip(hand.fingers, before, after, strict=True):
        if isinstance(finger, Pad):
            corners = to_world(end, np.asarray(finger.shape.vertices, float))
            candidates = [
                *_touching(shape, pose, corners, slack, 1),
                *_touching(finger.shape, end, to_world(pose, outline), slack, -1),
            ]
        else:
            candidates = _touching(shape, pose, end[None, :2], slack + float(finger.radius), 1)
        for point, normal in candidates:
            carried = to_world(start, to_body(end, point))  # where this point of the finger was before
            if all(np.linalg.norm(point - other) > TOUCH * size for other, *_ in found):
                found.append((point, normal, point - carried))
    return tuple(np.reshape(part, (-1, 2)) for part in zip(*found, strict=True)) if found else (np.zeros((0, 2)),) * 3  # pyright: ignore[reportReturnType]


def _touching(body: Shape, pose: np.ndarray, points: np.ndarray, reach: float, sign: int) -> list:
    """Return the closest points of an outline, and the directions into it times `sign`, for points within reach."""
    local = to_body(pose, points).astype(np.asarray(body.area).dtype)
    distance, closest, outward = (np.asarray(part, float) for part in jax.vmap(body.closest)(local))
    near = np.abs(distance) < reach
    turned = to_world(np.array([0.0, 0.0, pose[2]]), outward[near])
    return list(zip(to_world(pose, closest[near]), -sign * turned, strict=True))


def _balanced(point: np.ndarray, normal: np.ndarray, motion: np.ndarray, friction: float) -> np.ndarray | None:
    """Return the weights (contacts, 2) of the edges of the friction cones, or None if no forces cancel."""
    if len(point) < 2:
        return None
    across = friction * _tangent(normal)
    edges = np.stack([normal + across, normal - across], axis=1).reshape(-1, 2)
    arms = np.repeat(point - point.mean(axis=0), 2, axis=0) / np.ptp(point, axis=0).max()
    torque = arms[:, 0] * edges[:, 1] - arms[:, 1] * edges[:, 0]
    work = np.sum(edges * np.repeat(motion, 2, axis=0), axis=1)
    work = work / max(float(np.abs(work).max()), np.finfo(float).tiny)
    balance, total = np.vstack([edges.T, torque]), np.ones(len(edges))
    within = {"A_ub": np.vstack([balance, -balance]), "b_ub": np.full(6, BALANCE)}
    best = linprog(-work, A_eq=total[None], b_eq=[1.0], **within)
    if best.status != 0:
        return None
    rows = np.vstack([STIFF * balance, STIFF * total, STIFF * work, np.eye(len(edges))])
    wanted = np.concatenate([np.zeros(3), [STIFF, -STIFF * best.fun], np.zeros(len(edges))])
    return nnls(rows, wanted)[0].reshape(-1, 2)
