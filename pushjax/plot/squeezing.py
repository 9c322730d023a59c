"""The squeeze that holds a slider at the end of a grasp: contact forces that cancel through it.

How hard the hand squeezes is not part of the model, so the forces are per unit of normal force: the normal forces of
all contacts sum to one. Of all such forces within the friction cones, these are the ones on which the closing hand does
the most work, as in the certificate of a jam (`pushjax.contact.jam_certificate`). Where several do as much, for example
along the whole edge of a flat grasp, these are the most evenly distributed ones.
"""

from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import linprog, nnls

from pushjax.geometry.shape import Shape
from pushjax.plot.parts import vertices
from pushjax.simulation.hand import Hand, Pad
from pushjax.simulation.trajectory import Trajectory

# Largest gap of a contact, in units of the slider's size. The motion of the hand in its last step is added to it.
TOUCH = 1e-3
BALANCE = 1e-3  # largest resultant of forces that count as balanced, relative to the normal forces
SQUEEZE_LABEL = "forces that hold it, per unit of squeeze"
STIFF = 1e4  # weight of the equations in the search for the most even forces


class SqueezeForces(NamedTuple):
    """Forces on the slider that cancel, world frame.

    Attributes:
        point: (contacts, 2), where they act, m.
        force: (contacts, 2), per unit of normal force of all contacts.
    """

    point: np.ndarray
    force: np.ndarray


def squeeze_forces(shape: Shape, hand: Hand, grasp: Trajectory, friction: float) -> SqueezeForces | None:
    """Return the squeeze by which a hand holds the slider where it stopped, or None where it does not.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        grasp: The grasp.
        friction: Coefficient of friction of all contacts.
    """
    stop, configurations = int(grasp.stopped), np.asarray(grasp.configuration)
    moved = np.flatnonzero(np.any(np.diff(configurations[: stop + 2], axis=0) != 0, axis=1))
    if stop < 0 or not len(moved):
        return None
    before, after = (_as_poses(hand.poses(grasp.configuration[k])) for k in (moved[-1], moved[-1] + 1))
    point, normal, motion = _contacts(shape, hand, np.asarray(grasp.pose[-1], float), before, after)
    edge_weights = _balanced(point, normal, motion, friction)
    if edge_weights is None:
        return None
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    left, right = edge_weights.T[..., None]
    return SqueezeForces(point, (left + right) * normal + friction * (left - right) * tangent)


def _as_poses(fingers) -> np.ndarray:
    """Return poses (fingers, 3) of fingers given by poses or by centers (fingers, 2)."""
    placed = np.asarray(fingers, float)
    return placed if placed.shape[1] == 3 else np.column_stack([placed, np.zeros(len(placed))])


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
            corners = _to_world(np.asarray(finger.shape.vertices, float), end)
            candidates = [
                *_touching(shape, pose, corners, slack, 1),
                *_touching(finger.shape, end, _to_world(outline, pose), slack, -1),
            ]
        else:
            candidates = _touching(shape, pose, end[None, :2], slack + float(finger.radius), 1)
        for point, normal in candidates:
            carried = _to_world(_to_body(point[None], end), start)[0]  # where this point of the finger was before
            if all(np.linalg.norm(point - other) > TOUCH * size for other, *_ in found):
                found.append((point, normal, point - carried))
    return tuple(np.reshape(part, (-1, 2)) for part in zip(*found, strict=True)) if found else (np.zeros((0, 2)),) * 3  # pyright: ignore[reportReturnType]


def _touching(body: Shape, pose: np.ndarray, points: np.ndarray, reach: float, sign: int) -> list:
    """Return the closest points of an outline, and the directions into it times `sign`, for points within reach."""
    local = _to_body(points, pose).astype(np.asarray(body.area).dtype)
    distance, closest, outward = (np.asarray(part, float) for part in jax.vmap(body.closest)(local))
    near = np.abs(distance) < reach
    turned = _to_world(outward[near], np.array([0.0, 0.0, pose[2]]))
    return list(zip(_to_world(closest[near], pose), -sign * turned, strict=True))


def _balanced(point: np.ndarray, normal: np.ndarray, motion: np.ndarray, friction: float) -> np.ndarray | None:
    """Return the weights (contacts, 2) of the edges of the friction cones, or None if no forces cancel."""
    if len(point) < 2:
        return None
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    edges = np.stack([normal + friction * tangent, normal - friction * tangent], axis=1).reshape(-1, 2)
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


def _to_world(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Move body points (points, 2) to the world."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def _to_body(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Move world points (points, 2) to the frame of a body."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (points - pose[:2]) @ np.array([[c, -s], [s, c]])
