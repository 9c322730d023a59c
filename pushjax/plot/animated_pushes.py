"""Animations of pushes and grasps.

The frames of each push are equally spaced over its steps, however many it has. So a recording and its simulation run
side by side from start to end, even if one has more steps. The animation ends when nothing moves any more in any push,
for example because the hand jammed, and the last frame stays on the screen for a moment.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from pushjax.datasets.recordings import Recording
from pushjax.geometry.shape import Shape
from pushjax.plot.animation import Animation
from pushjax.plot.forces import SQUEEZE_LABEL
from pushjax.plot.parts import centroids, draw_fixtures, placed_outline, vertices
from pushjax.plot.push_panel import PushPanel, fingers_along
from pushjax.plot.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, RED, STYLE, legend_below, panel_row
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.trajectory import Trajectory

PANEL_WIDTH, EXTRA_HEIGHT = 3.8, 1.2  # inches: width of a panel, and height of what is above and below it
LEGEND_ROW_HEIGHT = 0.2  # inches: height of the extra row in the legend below a single panel
MARGIN = 0.04  # width of the empty margin, in units of what is shown


def animate(
    shape: Shape | Sequence[Shape],
    hand: Hand,
    pushes: Trajectory | Recording | Mapping[str, Trajectory | Recording],
    *,
    measured: Mapping[str, np.ndarray] | None = None,
    forces: bool = True,
    friction: float | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
    frames: int = 60,
    seconds: float = 4.0,
) -> Animation:
    """Animate pushes or grasps side by side.

    Each panel shows the slider (its start in gray), the fingers, the trace of the slider's centroid, the contacts
    with the forces on the slider as arrows, and the status and contact modes of the step in words. From a failed step
    on, the words are its status and number, in red. Where the hand stops because it holds the slider, the forces of the
    squeeze are shown if `friction` is given.

    Args:
        shape: Outline of the slider, or of each of several.
        hand: The hand.
        pushes: One push, or several by name, all of that shape and hand: trajectories of `rollout`, or recordings
            (`pushjax.datasets.Recording`), which are shown without forces.
        measured: Poses (points, 3) by the name of a push, world, m and rad. They are drawn dashed over that push.
        forces: Whether contacts and forces are shown. The arrows of all panels have one scale, and the legend gives
            the largest force.
        friction: Coefficient of friction at the contacts, to show the forces that hold the slider at the end of a
            grasp, per unit of squeeze (`squeeze_forces`).
        fixtures: Walls and bodies that do not move, in every panel.
        frames: Number of frames, equally spaced over the steps.
        seconds: Time that the animation plays, s.

    Returns:
        The animation; `pushjax.plot.save` writes it to a file.

    Raises:
        ValueError: If there is no push, if there are fewer than two frames, if a name in `measured` is that of no push,
            or if a push has another number of configurations than of poses.
    """
    by_name = dict(pushes) if isinstance(pushes, Mapping) else {"": pushes}
    measured_by_name = dict(measured or {})
    if not by_name:
        raise ValueError("pushes: there is none to show")
    unknown = sorted(set(measured_by_name) - set(by_name))
    if unknown:
        raise ValueError(f"measured: no push is named {', '.join(map(repr, unknown))}")
    shapes = (shape,) if isinstance(shape, Shape) else tuple(shape)
    panels = [
        PushPanel(shapes, hand, push, measured_by_name.get(name), forces, friction) for name, push in by_name.items()
    ]
    fractions = _frame_fractions(panels, frames)
    largest_force = max(panel.largest_force for panel in panels)
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(panels), PANEL_WIDTH, PANEL_WIDTH + EXTRA_HEIGHT, shared=True)
        for axes, name, panel in zip(all_axes, by_name, panels, strict=True):
            panel.add_artists(axes, largest_force)
            draw_fixtures(axes, fixtures)
            # A name leaves room for the words below it. Without one, a space keeps the room of the words themselves.
            axes.set_title(name or " ", pad=18 if name else 4)
            axes.set(xlabel="x / mm", aspect="equal")
        all_axes[0].set_ylabel("y / mm")
        _share_limits(figure, all_axes, panels)
        if measured_by_name:
            all_axes[0].plot([], [], "--", color=RED, lw=1.3, label="measured")
        if largest_force > 0:
            label = f"force on the slider, up to {largest_force:.2g} N"
            all_axes[0].plot([], [], color=ORANGE, lw=2.2, label=label)
        if any(panel.squeeze is not None for panel in panels):
            all_axes[0].plot([], [], color=PURPLE, lw=2.2, label=SQUEEZE_LABEL)
        legend_below(figure, all_axes[0], columns=2 if len(panels) == 1 else 3)

    def draw(frame: int) -> None:
        for panel in panels:
            panel.draw(fractions[frame])

    draw(0)
    return Animation(figure, draw, frames, seconds)


def animate_cloud(
    shape: Shape,
    hand: Hand,
    path: Any,
    trajectories: np.ndarray,
    *,
    title: str = "",
    frames: int = 60,
    seconds: float = 4.0,
) -> Animation:
    """Animate many pushes along one path at once.

    The picture shows faint outlines of all pushes, the paths of their centroids, the start, and the hand.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        path: (steps + 1, dof), configurations of the hand.
        trajectories: (pushes, steps + 1, 3), poses as `monte_carlo(..., trajectories=True)` keeps them, world frame, m
            and rad.
        title: Title of the picture.
        frames: Number of frames, equally spaced over the steps.
        seconds: Time that the animation plays, s.

    Returns:
        The animation; `pushjax.plot.save` writes it to a file.

    Raises:
        ValueError: If there are fewer than two frames, or the path is of another length than the trajectories.
    """
    poses, fingers = np.asarray(trajectories, float), fingers_along(hand, path)
    if poses.ndim != 3 or len(fingers[0]) != poses.shape[1]:
        raise ValueError(
            f"trajectories have shape {poses.shape}; expected (pushes, {len(fingers[0])}, 3), as long as path"
        )
    outline_points, positions = placed_outline(vertices(shape), poses), centroids(shape, poses)
    steps = _equally_spaced(poses.shape[1] - 1, frames).round().astype(int)
    opacity = float(np.clip(12 / len(poses), 0.05, 0.6))
    with plt.rc_context(STYLE):
        figure, (axes,) = panel_row(1, 5.4, 5.0)
        outlines, paths = (LineCollection([], colors=BLUE, linewidths=w, alpha=opacity) for w in (0.8, 0.6))
        axes.add_collection(outlines)
        axes.add_collection(paths)
        (points,) = axes.plot([], [], ".", color=RED, ms=3, alpha=0.5, label="centroids")
        axes.plot(*outline_points[0, 0].T, color=BLACK, lw=1.4, label="start")
        axes.plot([], [], color=BLUE, lw=0.8, label=f"{len(poses)} pushes")
        tips = [axes.plot([], [], color=GREEN, lw=1.8)[0] for _ in fingers]
        axes.set(title=title, xlabel="x / mm", ylabel="y / mm", aspect="equal")
        _set_limits(axes, [outline_points.reshape(-1, 2), *(finger.reshape(-1, 2) for finger in fingers)])
        legend_below(figure, axes, columns=3)

    def draw(frame: int) -> None:
        k = steps[frame]
        outlines.set_segments(list(outline_points[:, k]))
        paths.set_segments(list(positions[:, : k + 1]))
        points.set_data(*positions[:, k].T)
        for tip, finger in zip(tips, fingers, strict=True):
            tip.set_data(*finger[k].T)

    draw(0)
    return Animation(figure, draw, frames, seconds)


def _frame_fractions(panels: list[PushPanel], frames: int) -> np.ndarray:
    """Return for each frame the fraction of the steps that is done, from 0 to where the last push stops moving."""
    last_fraction = 0.0
    for panel in panels:
        steps = len(panel.outlines[0]) - 1
        moving = [np.any(np.diff(points, axis=0) != 0, axis=(1, 2)) for points in (*panel.outlines, *panel.fingers)]
        moving_steps = np.flatnonzero(np.any(moving, axis=0))
        # includes the step whose status says why nothing moves any more
        stop_step = steps if moving_steps.size == 0 else min(moving_steps[-1] + 2, steps)
        last_fraction = max(last_fraction, stop_step / max(steps, 1))
    return _equally_spaced(1.0, frames) * last_fraction


def _equally_spaced(end: float, frames: int) -> np.ndarray:
    """Return equally spaced numbers from 0 to `end`, one per frame."""
    if frames < 2:
        raise ValueError(f"frames must be at least 2; got {frames}")
    return np.linspace(0, end, frames)


def _share_limits(figure: Figure, all_axes: list[Axes], panels: list[PushPanel]) -> None:
    """Give all panels one range that holds everything at all times, and the figure the proportions of that range."""
    parts = [part for panel in panels for part in (*panel.outlines, *panel.fingers)]
    parts += [panel.measured for panel in panels if panel.measured is not None]
    _set_limits(all_axes[0], [part.reshape(-1, 2) for part in parts])
    wide, high = np.ptp(all_axes[0].get_xlim()), np.ptp(all_axes[0].get_ylim())
    figure.set_layout_engine("compressed", h_pad=0.06)
    surrounding_height = EXTRA_HEIGHT + (LEGEND_ROW_HEIGHT if len(all_axes) == 1 else 0.0)
    figure.set_size_inches(
        PANEL_WIDTH * len(all_axes) + 0.5, float(np.clip(PANEL_WIDTH * high / wide, 1.5, 5.5)) + surrounding_height
    )


def _set_limits(axes: Axes, points: list[np.ndarray]) -> None:
    """Set the range of the axes to hold all points (..., 2), mm, with an empty margin."""
    low, high = (find(np.concatenate(points), axis=0) for find in (np.nanmin, np.nanmax))
    margin = MARGIN * (high - low).max()
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
