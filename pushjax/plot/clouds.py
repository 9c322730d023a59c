"""Pictures of many pushes at once: their paths and ends, and which starts end as wanted."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from pushjax.geometry.shape import Shape
from pushjax.plot.distributions import density_panel, traces
from pushjax.plot.parts import centroids, finger_poses, hand_at, outline
from pushjax.plot.style import BLACK, BLUE, GRAY, MM, RED, STYLE, legend_below
from pushjax.simulation.hand import Hand

QUANTILES = (0.025, 0.5, 0.975)
MOST_LINES = 200  # largest number of paths that are drawn as lines
CELL = 1.0  # mm, side of the cells in which paths are counted
Density = tuple[tuple[np.ndarray, np.ndarray], np.ndarray]  # ((n, n) of x, (n, n) of y), m; density (n, n), 1/mm²


def cloud_figure(shape: Shape, hand: Hand, path: np.ndarray, trajectories: np.ndarray, title: str = "") -> Figure:
    """Draw many pushes that begin alike: the paths of the centroid, the start, and three of the ends.

    The three ends are those at the 2.5 %, 50 % and 97.5 % quantiles of the final angle. The hand is drawn at both ends
    of its path. Up to `MOST_LINES` paths are lines. Of more, lines would hide each other, so the color says how many
    pass each place.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        path: (steps + 1, dof), configurations of the hand.
        trajectories: (pushes, steps + 1, 3), poses of the slider, world, m and rad.
        title: Title of the picture.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(6.0, 5.6), layout="constrained")
        trajectories = np.asarray(trajectories)
        paths = centroids(shape, trajectories)
        if len(paths) > MOST_LINES:
            _draw_counts(figure, axes, paths)
        else:
            # Where paths are dense, many on top of each other still show.
            traces(axes, paths / MM, alpha=float(np.clip(30 / len(paths), 0.06, 0.6)))
            axes.plot([], [], color=BLUE, lw=0.8, label="paths of the centroid")
        outline(axes, shape, trajectories[0, 0], BLACK, 1.4, label="start")
        order = np.argsort(trajectories[:, -1, 2])
        for quantile in QUANTILES:
            style, label = ("-", "median end") if quantile == 0.5 else (":", "end, 2.5 and 97.5 % of θ")
            end = trajectories[order[round(quantile * (len(order) - 1))], -1]
            outline(axes, shape, end, RED, 1.2, linestyle=style, label=label)
        fingers = finger_poses(hand, path)
        hand_at(axes, hand, fingers[0], BLACK, 1.0)
        hand_at(axes, hand, fingers[-1], RED, 1.0)
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal", title=title)
        legend_below(figure, axes, columns=2)
        return figure


def capture_figure(
    shape: Shape,
    hand: Hand,
    path: np.ndarray,
    runs: Mapping[str, tuple[np.ndarray, np.ndarray]],
    density: Density | None = None,
    max_paths: int = 100,
) -> Figure:
    """Draw many starts and which of them end as wanted (red, the others black), one panel per run.

    Each panel shows the paths of the body origin. The hand is gray at its start, and blue at its end with one slider
    that it caught.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        path: (steps + 1, dof), configurations of the hand.
        runs: By name, the poses (pushes, steps + 1, 3), world, m and rad, and which pushes are wanted (pushes,).
        density: Density of the wanted starts of the last run, for one more panel with the start positions of that run:
            ((n, n) of x, (n, n) of y), m, and the density (n, n) there, 1/mm². None: no such panel.
        max_paths: Largest number of paths in each panel; the first ones are drawn.
    """
    with plt.rc_context(STYLE):
        ratios = [1.0] * len(runs) + ([] if density is None else [1.45])
        size = 3.6 * sum(ratios), 5.6
        figure, panels = plt.subplots(
            1, len(ratios), figsize=size, layout="constrained", width_ratios=ratios, squeeze=False
        )
        fingers = finger_poses(hand, path)
        for axes, (name, (trajectories, wanted)) in zip(panels[0], runs.items(), strict=False):
            _draw_paths(axes, trajectories[:max_paths], wanted[:max_paths])
            hand_at(axes, hand, fingers[0], GRAY, 2.0)
            hand_at(axes, hand, fingers[-1], BLUE, 2.0)
            if np.any(wanted):
                outline(axes, shape, trajectories[np.argmax(wanted), -1], BLUE, 1.0)
            axes.set(title=name, xlabel="x / mm", aspect="equal")
        panels[0, 0].set_ylabel("y / mm")
        if density is not None:
            name, (trajectories, wanted) = list(runs.items())[-1]
            starts = trajectories[:, 0, :2]
            density_panel(panels[0, -1], *density, starts[wanted], starts[~wanted])
            panels[0, -1].set_title(f"start positions, {name}")
        for color, label in ((RED, "end as wanted"), (BLACK, "do not")):
            panels[0, 0].plot([], [], color=color, label=label)
        legend_below(figure, panels[0, 0], columns=2)
        return figure


def _draw_paths(axes: Axes, trajectories: np.ndarray, wanted: np.ndarray) -> None:
    """Draw the paths and the start positions of the body origin, the wanted ones in red."""
    for which, color in ((wanted, RED), (~wanted, BLACK)):
        traces(axes, trajectories[which], color, alpha=0.5)
        axes.plot(*(MM * trajectories[which, 0, :2].T), ".", color=color, ms=3)


def _draw_counts(figure: Figure, axes: Axes, paths: np.ndarray) -> None:
    """Draw how many of the paths (pushes, steps + 1, 2), mm, pass each cell of `CELL` mm, with a color bar."""
    cells = np.floor(paths / CELL).astype(int)
    first = cells.min(axis=(0, 1))
    push = np.broadcast_to(np.arange(len(paths))[:, None, None], (*cells.shape[:2], 1))
    passed = np.unique(np.concatenate([push, cells - first], axis=2).reshape(-1, 3), axis=0)[:, 1:]
    counts = np.zeros(passed.max(axis=0) + 1)
    np.add.at(counts, tuple(passed.T), 1)
    edges = [CELL * (first[k] + np.arange(counts.shape[k] + 1)) for k in (0, 1)]
    drawn = axes.pcolormesh(*edges, np.where(counts > 0, counts, np.nan).T, norm=LogNorm(1, len(paths)), cmap="Blues")
    figure.colorbar(drawn, ax=axes, label="paths of the centroid / (1/mm²)", shrink=0.6)
