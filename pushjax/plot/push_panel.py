"""One panel of an animation of pushes: its data at each point of the push, and what it shows at one of them."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from pushjax.contact.status import ContactMode, Status
from pushjax.datasets.recordings import Recording
from pushjax.geometry.se2_numpy import to_world
from pushjax.geometry.shape import Shape
from pushjax.plot.forces import contact_forces, squeeze_forces
from pushjax.plot.parts import SMOOTH_OUTLINE_POINTS, centroids, finger_poses, placed_outline, vertices
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, MM, ORANGE, PURPLE, RED
from pushjax.simulation.hand import Hand, Pad
from pushjax.simulation.trajectory import Trajectory

MAX_ARROW_LENGTH = 0.4  # length of the arrow of the largest force, in units of the slider's size
SQUEEZE_LENGTH = 0.45  # length of the arrow of a unit of squeeze, in units of the slider's size
MIN_FORCE = 1e-3  # weaker forces are not drawn, in units of the largest
# Arrows at their true angles, in mm.
ARROWS: dict[str, Any] = {
    "angles": "xy",
    "scale_units": "xy",
    "scale": 1.0,
    "units": "dots",
    "width": 2.2,
    "headlength": 4,
    "headaxislength": 4,
    "zorder": 5,
}


class PushPanel:
    """The outlines, contacts, forces and words of a push, in mm and N, and the artists that show one point of it."""

    def __init__(
        self,
        shapes: tuple[Shape, ...],  # of each slider; the pose of one has no axis for them
        hand: Hand,
        push: Trajectory | Recording,
        measured: np.ndarray | None,  # (points, 3), poses to draw over it, world, m and rad
        forces: bool,  # whether to draw contacts and forces
        friction: float | None,  # at the contacts, to draw the squeeze that holds the slider
    ):
        pose = np.asarray(push.pose, float)
        poses = pose.reshape(len(pose), -1, 3).swapaxes(0, 1)
        # of each slider, by point
        self.outlines = [placed_outline(vertices(one), own) for one, own in zip(shapes, poses, strict=True)]
        self.centers = [centroids(one, own) for one, own in zip(shapes, poses, strict=True)]
        self.fingers = fingers_along(hand, push.hand if isinstance(push, Recording) else push.configuration)
        if len(self.fingers[0]) != len(pose):
            raise ValueError(f"push has {len(pose)} poses, but {len(self.fingers[0])} configurations")
        self.measured = None if measured is None else placed_outline(vertices(shapes[0]), np.asarray(measured, float))
        # Contacts and forces (points, contacts, 2) of the step that led to each point, and that step in words.
        self.contact = self.force = np.zeros((len(pose), 0, 2))
        self.words = [""] * len(pose)
        self.failed = self.stopped = -1  # the first failed step, and the step at which the hand stops
        self.squeeze = None
        if isinstance(push, Recording):
            return
        self.failed, self.stopped, self.words = int(push.first_failure), int(push.stopped), _words(push)
        if forces:
            self.contact, self.force = _in_world(pose, push)
        if forces and friction is not None and len(shapes) == 1:
            self.squeeze = squeeze_forces(shapes[0], hand, push, friction)

    @property
    def largest_force(self) -> float:
        """The largest force, N."""
        return float(np.max(np.linalg.norm(self.force, axis=-1), initial=0.0))

    def add_artists(self, axes: Axes, largest_force: float) -> None:
        """Add the artists, with arrows to the scale of the largest force of all panels, N."""
        size = float(np.ptp(self.outlines[0][0], axis=0).max())
        self.scale = MAX_ARROW_LENGTH * size / largest_force if largest_force > 0 else 0.0
        self.weakest = MIN_FORCE * largest_force
        for points in self.outlines:
            axes.plot(*points[0].T, color=GRAY, lw=1.0, label="start" if points is self.outlines[0] else None)
        labels = [("slider", "its centroid"), *[(None, None)] * (len(self.outlines) - 1)]
        self.slider_lines = [axes.plot([], [], color=BLACK, lw=1.5, label=label)[0] for label, _ in labels]
        self.traces = [axes.plot([], [], color=BLUE, lw=1.2, label=label)[0] for _, label in labels]
        self.finger_lines = [axes.plot([], [], color=GREEN, lw=1.8, label="hand")[0] for _ in self.fingers]
        label = None if self.measured is None else "measured"
        (self.measured_line,) = axes.plot([], [], "--", color=RED, lw=1.3, label=label)
        (self.contact_dots,) = axes.plot([], [], "o", color=ORANGE, ms=3.5, zorder=5)
        zero = np.zeros(self.force.shape[1])
        self.arrows = axes.quiver(zero, zero, zero, zero, color=ORANGE, **ARROWS) if len(zero) else None
        if self.squeeze is not None:
            tips, force = MM * self.squeeze.point, SQUEEZE_LENGTH * size * self.squeeze.force
            self.squeeze_arrows = axes.quiver(*tips.T, *force.T, color=PURPLE, pivot="tip", **ARROWS)
        above_axes: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "ha": "center"}
        self.text = axes.annotate("", (0.5, 1), (0, 4), color="0.3", **above_axes)

    def draw(self, fraction: float) -> None:
        """Show the push at a share of its steps, from 0 to 1."""
        k = round(fraction * (len(self.outlines[0]) - 1))
        for line, trace, points, center in zip(
            self.slider_lines, self.traces, self.outlines, self.centers, strict=True
        ):
            line.set_data(*points[k].T)
            trace.set_data(*center[: k + 1].T)
        for line, finger in zip(self.finger_lines, self.fingers, strict=True):
            line.set_data(*finger[k].T)
        if self.measured is not None:
            self.measured_line.set_data(*self.measured[round(fraction * (len(self.measured) - 1))].T)
        self.text.set_text(self.words[k])
        self.text.set_color(RED if 0 <= self.failed < k else "0.3")
        is_acting = np.linalg.norm(self.force[k], axis=1) > self.weakest
        self.contact_dots.set_data(*self.contact[k][is_acting].T)
        if self.arrows is not None:
            # an arrow of length zero would leave a dot
            tails, force = (np.where(is_acting[:, None], part, np.nan) for part in (self.contact[k], self.force[k]))
            self.arrows.set_offsets(tails)
            self.arrows.set_UVC(*(self.scale * force).T)
        if self.squeeze is not None:
            self.squeeze_arrows.set_visible(k > self.stopped)


def fingers_along(hand: Hand, configurations: Any) -> list[np.ndarray]:
    """Return for each finger its outlines along the configurations (points, dof): (points, vertices, 2), mm."""
    angle = np.linspace(0, 2 * np.pi, SMOOTH_OUTLINE_POINTS // 4, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    outlines = [vertices(f.shape) if isinstance(f, Pad) else float(f.radius) * circle for f in hand.fingers]
    poses = np.moveaxis(finger_poses(hand, configurations), 1, 0)
    return [placed_outline(points, along) for points, along in zip(outlines, poses, strict=True)]


def _in_world(pose: np.ndarray, push: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return for each pose the contacts (mm) and forces (N) of the step that led there, world; zero for the first."""
    point, force = contact_forces(push)
    here = pose[1:, None]
    if pose.ndim == 3:  # each contact is in the frame of a slider
        here = pose[1:, [int(first.removeprefix("slider ")) for first, _ in push.contacts]]
    in_world = MM * to_world(here, point), to_world(here * [0, 0, 1], force)
    contact, force = (np.concatenate([np.zeros_like(part[:1]), part]) for part in in_world)
    return contact, force


def _words(push: Trajectory) -> list[str]:
    """Describe for each point the step that led there; what comes after a failed step is no answer."""
    words = ["", *(_describe_step(int(s), m) for s, m in zip(push.status, np.asarray(push.mode), strict=True))]
    failed = int(push.first_failure)
    if failed < 0:
        return words
    name = _plain_name(Status(int(push.status[failed])))
    return [*words[: failed + 1], *[f"{name} at step {failed}"] * (len(words) - failed - 1)]


def _describe_step(status: int, modes: np.ndarray) -> str:
    """Describe a step in words: its status, and how many contacts stick and slide."""
    modes_seen, counts = np.unique(modes[modes != ContactMode.SEPARATED], return_counts=True)
    contacts = [f"{n} {_plain_name(ContactMode(int(kind)))}" for kind, n in zip(modes_seen, counts, strict=True)]
    listed = ", ".join(contacts)
    if len(modes) == 1:
        listed = listed.removeprefix("1 ")
    return ": ".join([_plain_name(Status(status)), *([listed] if listed else [])])


def _plain_name(member: ContactMode | Status) -> str:
    """Return the name of a mode or status in lower case, with spaces."""
    if member is Status.GRASPED:  # the slider may be held flat or wedged
        return "held by every finger"
    return member.name.lower().replace("_", " ")
