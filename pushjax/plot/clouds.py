"""Pictures of many pushes at once: their paths and ends."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from pushjax.geometry.shape import Shape
from pushjax.plot.distributions import traces
from pushjax.plot.parts import centroids, finger_poses, hand_at, outline
from pushjax.plot.style import BLACK, BLUE, MM, RED, STYLE, legend_below
from pushjax.simulation.hand import Hand

QUANTILES = (0.025, 0.5, 0.975)
MOST_LINES = 200  # largest number of paths that are drawn as lines
CELL = 1.0  # mm, side of the cells in which paths are counted


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


def _draw_counts(figure: Figure, axes: Axes, paths: np.ndarray) -> None:
    """Draw how many of the paths (pushes, steps + 1, 2), mm, pass each cell of `CELL` mm, with a color bar."""
    cells = np.floor(paths / CELL).astype(int)
    push = np.broadcast_to(np.arange(len(paths))[:, None, None], (*cells.shape[:2], 1))
    passed = np.unique(np.concatenate([push, cells], axis=2).reshape(-1, 3), axis=0)[:, 1:]
    counts, x, y = np.histogram2d(*passed.T, bins=[np.arange(each.min(), each.max() + 2) for each in passed.T])
    shown = np.where(counts > 0, counts, np.nan).T
    drawn = axes.pcolormesh(CELL * x, CELL * y, shown, norm=LogNorm(1, len(paths)), cmap="Blues")
    figure.colorbar(drawn, ax=axes, label="paths of the centroid / (1/mm²)", shrink=0.6)
