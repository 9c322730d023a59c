"""Pictures of single pushes and grasps, side by side: simulated ones, and real ones beside predictions."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from pushjax.contact.status import Status
from pushjax.geometry.shape import Shape
from pushjax.plot.parts import arrow, centroids, draw_fixtures, hand_at, outline, placed_outline, vertices
from pushjax.plot.squeezing import SQUEEZE_LABEL, SqueezeForces, squeeze_forces
from pushjax.plot.style import BLACK, BLUE, GRAY, MM, ORANGE, RED, STYLE, legend_below, panel_row, start_to_end_legend
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.trajectory import Trajectory

ARROW_LENGTH = 0.7  # length of the arrow of a unit force, in units of the slider's size


def push_figure(
    shape: Shape,
    pushes: Mapping[str, tuple[Trajectory, np.ndarray]],
    radius: float,
    frames: int = 5,
    *,
    fixtures: Sequence[Wall | Fixture] = (),
) -> Figure:
    """Draw pushes by one round finger, side by side.

    Outline and finger are black at the start, red at the end, and gray between. The trace of the slider's centroid is
    drawn too. The title of a push with a failed step says so.

    Args:
        shape: Outline of the slider.
        pushes: By name, a trajectory and the path (steps + 1, 2) of the finger's center, m. After a jam the finger is
            drawn where it stopped.
        radius: Radius of the finger, m.
        frames: Number of moments between start and end.
        fixtures: Walls and bodies that do not move, in every panel.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(pushes), 4.0, 4.2, shared=True)
        for axes, (name, (push, path)) in zip(all_axes, pushes.items(), strict=True):
            pose, stopped = np.asarray(push.pose), int(push.stopped)
            path = np.asarray(path)[: stopped + 1] if stopped >= 0 else np.asarray(path)
            shown = np.unique(np.linspace(0, len(pose) - 1, frames + 2).round().astype(int))
            for k in [*shown[1:-1], shown[0], shown[-1]]:
                color = BLACK if k == 0 else RED if k == shown[-1] else GRAY
                outline(axes, shape, pose[k], color, 1.4 if color != GRAY else 0.8)
                axes.add_patch(
                    Circle(MM * path[min(k, len(path) - 1)], MM * radius, color=color, fill=color != GRAY, lw=0.8)
                )
            axes.plot(*centroids(shape, pose).T, color=BLUE, lw=1.2, label="centroid of the slider")
            draw_fixtures(axes, fixtures)
            axes.set(title=_title_with_failure(name, push), xlabel="x / mm", ylabel="y / mm", aspect="equal")
        start_to_end_legend(figure, all_axes[0])
        return figure


def grasp_figure(
    shape: Shape,
    hand: Hand,
    grasps: Mapping[str, Trajectory],
    frames: int = 4,
    *,
    friction: float | None = None,
) -> Figure:
    """Draw grasps side by side.

    Slider and fingers are black at the start, red at the end, and gray between. The trace of the slider's centroid is
    drawn too. The title of a grasp with a failed step says so. Pushes by any hand can also be drawn with it.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        grasps: Trajectories by name.
        frames: Number of moments between start and end, among those in which the slider moves.
        friction: Coefficient of friction at the contacts. With it, the forces by which the hand holds the slider at the
            end are drawn, where it does, per unit of squeeze (`squeeze_forces`).
    """
    held = False
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(grasps), 3.1, 3.9, shared=True)
        for axes, (name, grasp) in zip(all_axes, grasps.items(), strict=True):
            pose = np.asarray(grasp.pose)
            fingers = np.asarray(hand.poses(grasp.configuration))
            # there is something to see only where the slider moves
            moving_steps = np.flatnonzero(np.any(np.diff(pose, axis=0) != 0, axis=1))
            last = len(pose) - 1 if moving_steps.size == 0 else min(moving_steps[-1] + 1, len(pose) - 1)
            first = 0 if moving_steps.size == 0 else moving_steps[0]
            between = np.linspace(first, last, frames + 2).round().astype(int)[1:-1]
            for k, color in [*((k, GRAY) for k in between), (0, BLACK), (last, RED)]:
                width = 0.8 if color == GRAY else 1.4
                outline(axes, shape, pose[k], color, width)
                hand_at(axes, hand, fingers[k], color, width)
            axes.plot(*centroids(shape, pose).T, color=BLUE, lw=1.4, label="centroid of the slider", zorder=4)
            squeeze = None if friction is None else squeeze_forces(shape, hand, grasp, friction)
            if squeeze is not None:
                _draw_squeeze(axes, squeeze, ARROW_LENGTH * float(np.ptp(vertices(shape), axis=0).max()))
                held = True
            axes.set(title=_title_with_failure(name.replace(": ", ":\n"), grasp), xlabel="x / mm", aspect="equal")
        all_axes[0].set_ylabel("y / mm")
        if held:
            all_axes[0].plot([], [], color=ORANGE, lw=2.2, label=SQUEEZE_LABEL)
        start_to_end_legend(figure, all_axes[0])
        return figure


def _draw_squeeze(axes: Axes, squeeze: SqueezeForces, length: float) -> None:
    """Draw the forces of a squeeze as arrows that end at the contacts, `length` m long per unit force."""
    for tip, tail in zip(MM * squeeze.point, MM * (squeeze.point - length * squeeze.force), strict=True):
        arrow(axes, tail, tip, ORANGE, 2.0)


def _title_with_failure(name: str, push: Trajectory) -> str:
    """Return the title of a push, with the status if a step failed: what is drawn after it is no answer."""
    failed_step = int(push.first_failure)
    return name if failed_step < 0 else f"{name}\n{Status(int(push.status[failed_step])).name} from step {failed_step}"


class RealPush(NamedTuple):
    """A push that was measured, and its prediction; world, m and rad.

    Attributes:
        start: (3,), measured pose of the slider at the start.
        end: (3,), measured pose at the end.
        predicted: (3,), predicted pose at the end, or samples of it (draws, 3).
        path: (points, dof), configurations of the hand, or None.
    """

    start: np.ndarray
    end: np.ndarray
    predicted: np.ndarray
    path: np.ndarray | None = None


def real_figure(shape: Shape, pushes: Mapping[str, RealPush], hand: Hand | None = None) -> Figure:
    """Draw real pushes side by side.

    The measured start is gray, the measured end is black. The predicted end is blue and dashed; several predicted ends
    are blue and faint. With a hand, the paths of the fingers are drawn, and the fingers at the end of their paths.

    Args:
        shape: Outline of the slider.
        pushes: Pushes by name.
        hand: The hand. None: it is not drawn.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(pushes), 3.6, 3.8)
        for axes, (name, push) in zip(all_axes, pushes.items(), strict=True):
            outline(axes, shape, push.start, GRAY, 1.5, label="start")
            outline(axes, shape, push.end, BLACK, 1.5, label="measured end")
            _draw_predicted(axes, shape, np.asarray(push.predicted))
            if hand is not None and push.path is not None:
                fingers = np.asarray(hand.poses(jnp.asarray(push.path)))
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
