"""Pictures of single pushes and grasps, side by side: simulated ones, and real ones beside predictions."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from pushjax.contact.status import Status
from pushjax.datasets.recordings import Recording
from pushjax.geometry.shape import Shape
from pushjax.plot.forces import SQUEEZE_LABEL, squeeze_forces
from pushjax.plot.parts import (
    arrow,
    centroids,
    draw_fixtures,
    finger_poses,
    hand_at,
    outline,
    placed_outline,
    vertices,
)
from pushjax.plot.style import BLACK, BLUE, GRAY, MM, ORANGE, RED, STYLE, legend_below, panel_row
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.trajectory import Trajectory

ARROW_LENGTH = 0.7  # length of the arrow of a unit force, in units of the slider's size


def push_figure(
    shape: Shape | Sequence[Shape],
    hand: Hand,
    pushes: Mapping[str, Trajectory],
    frames: int = 4,
    *,
    friction: float | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
) -> Figure:
    """Draw pushes or grasps side by side.

    Slider and fingers are black at the start, red at the end, and gray between. The trace of the slider's centroid is
    drawn too. The title of a push with a failed step says so.

    Args:
        shape: Outline of the slider, or of each of several.
        hand: The hand.
        pushes: Trajectories by name.
        frames: Number of moments between start and end, among those in which the slider moves.
        friction: Coefficient of friction at the contacts. With it, the forces by which the hand holds the slider at the
            end are drawn, where it does, per unit of squeeze (`squeeze_forces`).
        fixtures: Walls and bodies that do not move, in every panel.
    """
    held, shapes = False, (shape,) if isinstance(shape, Shape) else tuple(shape)
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(pushes), 3.1, 3.9, shared=True)
        for axes, (name, push) in zip(all_axes, pushes.items(), strict=True):
            pose, fingers = np.asarray(push.pose), finger_poses(hand, push.configuration)
            poses = pose.reshape(len(pose), -1, 3)
            for k, color in _moments(pose.reshape(len(pose), -1), frames):
                width = 0.8 if color == GRAY else 1.4
                for one, own in zip(shapes, poses[k], strict=True):
                    outline(axes, one, own, color, width)
                hand_at(axes, hand, fingers[k], color, width)
            for k, one in enumerate(shapes):
                label = "centroid of the slider" if k == 0 else None
                axes.plot(*centroids(one, poses[:, k]).T, color=BLUE, lw=1.4, label=label, zorder=4)
            squeeze = None
            if friction is not None and len(shapes) == 1:
                squeeze = squeeze_forces(shapes[0], hand, push, friction)
            if squeeze is not None:
                length, held = ARROW_LENGTH * float(np.ptp(vertices(shapes[0]), axis=0).max()), True
                for tip, force in zip(*squeeze, strict=True):  # the arrows end at the contacts
                    arrow(axes, MM * (tip - length * force), MM * tip, ORANGE, 2.0)
            draw_fixtures(axes, fixtures)
            axes.set(title=_title_with_failure(name.replace(": ", ":\n"), push), xlabel="x / mm", aspect="equal")
        all_axes[0].set_ylabel("y / mm")
        if held:
            all_axes[0].plot([], [], color=ORANGE, lw=2.2, label=SQUEEZE_LABEL)
        for color, label in ((BLACK, "start"), (GRAY, "between"), (RED, "end")):
            all_axes[0].plot([], [], color=color, label=label)
        legend_below(figure, all_axes[0], columns=5 if len(all_axes) > 1 else 2)
        return figure


def _moments(pose: np.ndarray, frames: int) -> list[tuple[int, str]]:
    """Return the steps to draw and their colors: those between, evenly in the motion; the first; the last of it."""
    moving = np.flatnonzero(np.any(np.diff(pose, axis=0) != 0, axis=1))
    first, last = (0, len(pose) - 1) if moving.size == 0 else (moving[0], moving[-1] + 1)
    between = np.linspace(first, last, frames + 2).round().astype(int)[1:-1]
    return [*((k, GRAY) for k in between), (0, BLACK), (last, RED)]


def _title_with_failure(name: str, push: Trajectory) -> str:
    """Return the title of a push, with the status if a step failed: what is drawn after it is no answer."""
    failed_step = int(push.first_failure)
    return name if failed_step < 0 else f"{name}\n{Status(int(push.status[failed_step])).name} from step {failed_step}"


def real_figure(shape: Shape, pushes: Mapping[str, tuple[Recording, np.ndarray]], hand: Hand | None = None) -> Figure:
    """Draw real pushes side by side.

    The measured start is gray, the measured end is black. The predicted end is blue and dashed; several predicted ends
    are blue and faint. With a hand, the paths of the fingers are drawn, and the fingers at the end of their paths.

    Args:
        shape: Outline of the slider.
        pushes: By name, a recording, and its predicted pose at the end (3,) or samples of it (draws, 3), world, m and
            rad.
        hand: The hand. None: it is not drawn.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(pushes), 3.6, 3.8)
        for axes, (name, (push, predicted)) in zip(all_axes, pushes.items(), strict=True):
            outline(axes, shape, push.pose[0], GRAY, 1.5, label="start")
            outline(axes, shape, push.pose[-1], BLACK, 1.5, label="measured end")
            _draw_predicted(axes, shape, np.asarray(predicted))
            if hand is not None:
                fingers = finger_poses(hand, push.hand)
                for k in range(fingers.shape[1]):
                    label = "fingers' paths" if k == 0 else None
                    axes.plot(*(MM * fingers[:, k, :2]).T, "-.", color=ORANGE, lw=1.2, label=label)
                hand_at(axes, hand, fingers[-1], ORANGE, 1.2)
            axes.set(title=name, xlabel="x / mm", ylabel="y / mm")
            axes.set_aspect("equal", adjustable="datalim")
        legend_below(figure, all_axes[0], columns=4)
        return figure


def _draw_predicted(axes: Axes, shape: Shape, poses: np.ndarray) -> None:
    """Draw one predicted pose (3,) dashed, or several (draws, 3) faint."""
    if poses.ndim == 1:
        outline(axes, shape, poses, BLUE, 1.5, linestyle="--", label="predicted end")
        return
    lines = list(placed_outline(vertices(shape), poses))
    axes.add_collection(LineCollection(lines, colors=BLUE, linewidths=0.6, alpha=min(0.6, 8 / len(lines))))
    axes.plot([], [], color=BLUE, lw=0.8, label="predicted ends")
