"""Pictures of single pushes and grasps, side by side; simulated, and real beside predicted."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from pushjax.hands import Hand
from pushjax.plot.parts import hand_at, outline, placed, vertices
from pushjax.plot.style import BETWEEN, BLUE, END, MM, ORANGE, START, STYLE, legend_below, legend_of_moments, row
from pushjax.rollout import Trajectory
from pushjax.shapes import Shape
from pushjax.status import Status


def push_figure(
    shape: Shape, pushes: Mapping[str, tuple[Trajectory, np.ndarray]], radius: float, frames: int = 5
) -> Figure:
    """Pushes by one round finger, side by side: outline and finger at the start black, at the end red, between grey;
    the centre's trace.

    pushes: by name, a trajectory and the path (steps + 1, 2) of the finger's centre, m. radius: m, the finger's.
    frames: how many moments between start and end. A push with a step that failed says so in its title.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = row(len(pushes), 4.0, 4.2, shared=True)
        for axes, (name, (push, path)) in zip(all_axes, pushes.items(), strict=True):
            pose, path = np.asarray(push.pose), np.asarray(path)
            shown = np.unique(np.linspace(0, len(pose) - 1, frames + 2).round().astype(int))
            for k in [*shown[1:-1], shown[0], shown[-1]]:
                color = START if k == 0 else END if k == shown[-1] else BETWEEN
                outline(axes, shape, pose[k], color, 1.4 if color != BETWEEN else 0.8)
                axes.add_patch(Circle(MM * path[k], MM * radius, color=color, fill=color != BETWEEN, lw=0.8))
            axes.plot(*(MM * pose[:, :2]).T, color=BLUE, lw=1.2, label="centre of the slider")
            axes.set(title=_titled(name, push), xlabel="x / mm", ylabel="y / mm", aspect="equal")
        legend_of_moments(figure, all_axes[0])
        return figure


def grasp_figure(shape: Shape, hand: Hand, grasps: Mapping[str, Trajectory], frames: int = 4) -> Figure:
    """Grasps side by side: slider and fingers at the start black, at the end red, between grey; the centre's trace.

    Pushes by any hand can be drawn so, too. frames: how many moments between start and end, of those in which the
    slider moves. A grasp with a step that failed says so in its title.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = row(len(grasps), 3.1, 3.9, shared=True)
        for axes, (name, grasp) in zip(all_axes, grasps.items(), strict=True):
            pose = np.asarray(grasp.pose)
            fingers = np.asarray(hand.poses(grasp.configuration))
            # only where the slider moves is there something to see
            moves = np.flatnonzero(np.any(np.diff(pose, axis=0) != 0, axis=1))
            last = len(pose) - 1 if moves.size == 0 else min(moves[-1] + 1, len(pose) - 1)
            first = 0 if moves.size == 0 else moves[0]
            between = np.linspace(first, last, frames + 2).round().astype(int)[1:-1]
            for k, color in [*((k, BETWEEN) for k in between), (0, START), (last, END)]:
                width = 0.8 if color == BETWEEN else 1.4
                outline(axes, shape, pose[k], color, width)
                hand_at(axes, hand, fingers[k], color, width)
            axes.plot(*(MM * pose[:, :2]).T, color=BLUE, lw=1.4, label="centre of the slider", zorder=4)
            axes.set(title=_titled(name.replace(": ", ":\n"), grasp), xlabel="x / mm", aspect="equal")
        all_axes[0].set_ylabel("y / mm")
        legend_of_moments(figure, all_axes[0])
        return figure


def _titled(name: str, push: Trajectory) -> str:
    """The title of a push; if a step failed, with its status, since what is drawn after it is no answer."""
    first = int(push.first_failure)
    return name if first < 0 else f"{name}\n{Status(int(push.status[first])).name} from step {first}"


class RealPush(NamedTuple):
    """A push that was measured, and what was predicted of it; world, m and rad.

    start, end: (3,), the slider's measured poses. predicted: its end (3,), or draws of it (draws, 3). path: the hand's
    configurations (points, dof), or None.
    """

    start: np.ndarray
    end: np.ndarray
    predicted: np.ndarray
    path: np.ndarray | None = None


def real_figure(shape: Shape, pushes: Mapping[str, RealPush], hand: Hand | None = None) -> Figure:
    """Real pushes side by side: the measured start (grey) and end (black), the predicted end or ends (blue, dashed),
    and the fingers' paths with the fingers at their end, where a hand is given."""
    with plt.rc_context(STYLE):
        figure, all_axes = row(len(pushes), 3.6, 3.8)
        for axes, (name, push) in zip(all_axes, pushes.items(), strict=True):
            outline(axes, shape, push.start, BETWEEN, 1.5, label="start")
            outline(axes, shape, push.end, START, 1.5, label="measured end")
            _predicted(axes, shape, np.asarray(push.predicted))
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


def _predicted(axes: Axes, shape: Shape, poses: np.ndarray) -> None:
    if poses.ndim == 1:
        outline(axes, shape, poses, BLUE, 1.5, linestyle="--", label="predicted end")
        return
    lines = list(placed(vertices(shape), poses))
    axes.add_collection(LineCollection(lines, colors=BLUE, linewidths=0.6, alpha=min(0.6, 8 / len(lines))))
    axes.plot([], [], color=BLUE, lw=0.8, label="predicted ends")
