"""What a push looks like at each of its points: outlines in mm, contacts, forces, words."""

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np

from pushjax.hands import Hand, Pad
from pushjax.plot.forces import contact_forces
from pushjax.plot.parts import FINE, placed, vertices
from pushjax.plot.style import MM
from pushjax.rollout import Trajectory
from pushjax.shapes import Shape
from pushjax.status import ContactMode, Status


class Recorded(NamedTuple):
    """A push that was measured: pose (points, 3) of the slider and configuration (points, dof) of the hand, at the same
    times; world, m and rad."""

    pose: np.ndarray
    configuration: np.ndarray


class Moved(Protocol):
    """What can be shown in motion: a `Trajectory` or a `Recorded`."""

    @property
    def pose(self) -> Any: ...

    @property
    def configuration(self) -> Any: ...


class Track(NamedTuple):
    """A push as it is drawn, mm: outlines (points, vertices, 2), of each finger (points, vertices, 2), centres (points,
    2); over it measured outlines; of each point the contacts and forces of the step that led there, N, and words.
    failed: the first step that did, or -1."""

    outline: np.ndarray
    fingers: list[np.ndarray]
    center: np.ndarray
    measured: np.ndarray | None
    contact: np.ndarray
    force: np.ndarray
    words: list[str]
    failed: int

    @property
    def largest(self) -> float:
        return float(np.max(np.linalg.norm(self.force, axis=-1), initial=0.0))


def track_of(shape: Shape, hand: Hand, push: Moved, measured: np.ndarray | None, forces: bool) -> Track:
    pose, body = np.asarray(push.pose, float), vertices(shape)
    fingers = fingers_along(hand, push.configuration)
    if len(fingers[0]) != len(pose):
        raise ValueError(f"push has {len(pose)} poses, but {len(fingers[0])} configurations")
    contact, force, words = np.zeros((len(pose), 0, 2)), np.zeros((len(pose), 0, 2)), [""] * len(pose)
    failed = -1
    if isinstance(push, Trajectory):
        words = ["", *(_words(int(s), m) for s, m in zip(push.status, np.asarray(push.mode), strict=True))]
        if forces:
            contact, force = _in_world(pose, *contact_forces(shape, hand, push))
        failed = int(push.first_failure)
        if failed >= 0:  # what is drawn from here on is no answer
            name = _plain(Status(int(push.status[failed])))
            words = [*words[: failed + 1], *[f"{name} at step {failed}"] * (len(pose) - failed - 1)]
    over = None if measured is None else placed(body, np.asarray(measured, float))
    return Track(placed(body, pose), fingers, MM * pose[:, :2], over, contact, force, words, failed)


def _in_world(pose: np.ndarray, point: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each pose the contacts, mm, and forces of the step that led there; of the first, nothing."""
    c, s = np.cos(pose[1:, None, 2]), np.sin(pose[1:, None, 2])

    def turned(v):
        return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)

    both = MM * (turned(point) + pose[1:, None, :2]), turned(force)
    contact, force = (np.concatenate([np.zeros_like(part[:1]), part]) for part in both)
    return contact, force


def _words(status: int, modes: np.ndarray) -> str:
    """A step in words: its status, and how many contacts stick and slide."""
    kinds, counts = np.unique(modes[modes != ContactMode.SEPARATED], return_counts=True)
    each = [f"{n} {_plain(ContactMode(int(kind)))}" for kind, n in zip(kinds, counts, strict=True)]
    one = len(modes) == 1
    return ": ".join([_plain(Status(status)), *([", ".join(each).removeprefix("1 " if one else "")] if each else [])])


def _plain(name: ContactMode | Status) -> str:
    return name.name.lower().replace("_", " ")


def fingers_along(hand: Hand, configurations: Any) -> list[np.ndarray]:
    """Of each finger its outline along the configurations (points, dof): (points, vertices, 2), mm."""
    poses = np.asarray(hand.poses(jnp.asarray(configurations)), float)
    angle = np.linspace(0, 2 * np.pi, FINE // 4, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    drawn = []
    for finger, where in zip(hand.fingers, np.moveaxis(poses, 1, 0), strict=True):
        if where.shape[1] == 2:  # a hand that never turns
            where = np.column_stack([where, np.zeros(len(where))])
        body = vertices(finger.shape) if isinstance(finger, Pad) else float(finger.radius) * circle
        drawn.append(placed(body, where))
    return drawn
