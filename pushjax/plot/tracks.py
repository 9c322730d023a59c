"""A push as an animation draws it: for each of its points the outlines in mm, the contacts, the forces and a text."""

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np

from pushjax.contact.status import ContactMode, Status
from pushjax.geometry.shape import Shape
from pushjax.plot.forces import contact_forces
from pushjax.plot.parts import SMOOTH_OUTLINE_POINTS, centroids, placed_outline, vertices
from pushjax.plot.squeezing import squeeze_forces
from pushjax.plot.style import MM
from pushjax.simulation.hand import Hand, Pad
from pushjax.simulation.trajectory import Trajectory


class RecordedPush(NamedTuple):
    """A push that was measured, with slider and hand at the same times; world, m and rad.

    Attributes:
        pose: (points, 3), poses of the slider.
        configuration: (points, dof), configurations of the hand.
    """

    pose: np.ndarray
    configuration: np.ndarray


class Animatable(Protocol):
    """What can be animated: a `Trajectory` or a `RecordedPush`."""

    @property
    def pose(self) -> Any: ...

    @property
    def configuration(self) -> Any: ...


class DrawnPush(NamedTuple):
    """A push as it is drawn, in mm and N, world frame."""

    outline: np.ndarray  # (points, vertices, 2), of the slider
    fingers: list[np.ndarray]  # of each finger the outlines, (points, vertices, 2)
    center: np.ndarray  # (points, 2), centroids of the slider
    measured: np.ndarray | None  # outlines to draw over it, or None
    contact: np.ndarray  # (points, contacts, 2), of the step that led to each point
    force: np.ndarray  # (points, contacts, 2), of that step, N
    words: list[str]  # for each point the text that describes that step
    failed: int  # the first failed step, or -1
    # Forces that hold the slider once the hand stops: points (contacts, 2), mm, and forces (contacts, 2) per unit of
    # squeeze. None if it is not held, or if they are not asked for.
    squeeze: tuple[np.ndarray, np.ndarray] | None
    stopped: int  # the step at which the hand stops, or -1

    @property
    def largest_force(self) -> float:
        """The largest force, N."""
        return float(np.max(np.linalg.norm(self.force, axis=-1), initial=0.0))


def drawn_push(
    shape: Shape,
    hand: Hand,
    push: Animatable,
    measured: np.ndarray | None,  # (points, 3), poses to draw over it, world, m and rad
    forces: bool,  # whether to draw contacts and forces
    friction: float | None = None,  # at the contacts, to draw the squeeze that holds the slider
) -> DrawnPush:
    """Convert a push to its outlines, contacts, forces and texts."""
    pose, outline_points = np.asarray(push.pose, float), vertices(shape)
    fingers = fingers_along(hand, push.configuration)
    if len(fingers[0]) != len(pose):
        raise ValueError(f"push has {len(pose)} poses, but {len(fingers[0])} configurations")
    contact, force, words = np.zeros((len(pose), 0, 2)), np.zeros((len(pose), 0, 2)), [""] * len(pose)
    failed = stopped = -1
    squeeze = None
    if isinstance(push, Trajectory):
        words = ["", *(_describe_step(int(s), m) for s, m in zip(push.status, np.asarray(push.mode), strict=True))]
        if forces:
            contact, force = _in_world(pose, *contact_forces(push))
        failed, stopped = int(push.first_failure), int(push.stopped)
        if forces and friction is not None:
            held = squeeze_forces(shape, hand, push, friction)
            squeeze = None if held is None else (MM * held.point, held.force)
        if failed >= 0:  # what is drawn from here on is no answer
            name = _plain_name(Status(int(push.status[failed])))
            words = [*words[: failed + 1], *[f"{name} at step {failed}"] * (len(pose) - failed - 1)]
    measured_outlines = None if measured is None else placed_outline(outline_points, np.asarray(measured, float))
    return DrawnPush(
        placed_outline(outline_points, pose),
        fingers,
        centroids(shape, pose),
        measured_outlines,
        contact,
        force,
        words,
        failed,
        squeeze,
        stopped,
    )


def _in_world(pose: np.ndarray, point: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each pose the contacts (mm) and forces (N) of the step that led there, world; zero for the first."""
    c, s = np.cos(pose[1:, None, 2]), np.sin(pose[1:, None, 2])

    def rotated(v):
        return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)

    in_world = MM * (rotated(point) + pose[1:, None, :2]), rotated(force)
    contact, force = (np.concatenate([np.zeros_like(part[:1]), part]) for part in in_world)
    return contact, force


def _describe_step(status: int, modes: np.ndarray) -> str:
    """Describe a step in words: its status, and how many contacts stick and slide."""
    modes_seen, counts = np.unique(modes[modes != ContactMode.SEPARATED], return_counts=True)
    descriptions = [f"{n} {_plain_name(ContactMode(int(kind)))}" for kind, n in zip(modes_seen, counts, strict=True)]
    only_one_contact = len(modes) == 1
    return ": ".join(
        [
            _plain_name(Status(status)),
            *([", ".join(descriptions).removeprefix("1 " if only_one_contact else "")] if descriptions else []),
        ]
    )


def _plain_name(member: ContactMode | Status) -> str:
    """Return the name of a mode or status in lower case, with spaces."""
    if member is Status.GRASPED:  # the slider may be held flat or wedged
        return "held by every finger"
    return member.name.lower().replace("_", " ")


def fingers_along(hand: Hand, configurations: Any) -> list[np.ndarray]:
    """Return for each finger its outlines along the configurations (points, dof): (points, vertices, 2), mm."""
    poses = np.asarray(hand.poses(jnp.asarray(configurations)), float)
    angle = np.linspace(0, 2 * np.pi, SMOOTH_OUTLINE_POINTS // 4, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    drawn = []
    for finger, finger_poses in zip(hand.fingers, np.moveaxis(poses, 1, 0), strict=True):
        if finger_poses.shape[1] == 2:  # a hand that never turns
            finger_poses = np.column_stack([finger_poses, np.zeros(len(finger_poses))])
        outline_points = vertices(finger.shape) if isinstance(finger, Pad) else float(finger.radius) * circle
        drawn.append(placed_outline(outline_points, finger_poses))
    return drawn
