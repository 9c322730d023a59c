"""Panels of the motions of many pushes, drawn into given axes so that an experiment can lay them out."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from pushjax.plot.style import BLUE, MM, ORANGE

TICK = 1.6  # mm, length of a pose's tick


def traces(axes: Axes, trajectories: np.ndarray, color: str = BLUE, alpha: float = 0.06) -> None:
    """Draw the paths of the slider's body origin, or of another point of it, in mm.

    Args:
        axes: Axes to draw into.
        trajectories: (n, steps + 1, 3), poses, m and rad, one trajectory per row; or positions (n, steps + 1, 2), m.
        color: Color of the lines.
        alpha: Opacity of the lines.
    """
    axes.add_collection(LineCollection(list(MM * trajectories[..., :2]), colors=color, linewidths=0.6, alpha=alpha))
    axes.autoscale_view()


def pose_panel(axes: Axes, poses: np.ndarray, color: str, label: str | None = None, alpha: float = 0.6) -> None:
    """Draw poses as dots with a tick along their x axis, in mm.

    Args:
        axes: Axes to draw into.
        poses: (n, 3), m and rad.
        color: Color of dots and ticks.
        label: Label in the legend.
        alpha: Opacity.
    """
    centers = MM * poses[:, :2]
    tick = TICK * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    axes.add_collection(
        LineCollection(list(np.stack([centers, centers + tick], axis=1)), colors=color, lw=0.5, alpha=alpha)
    )
    axes.plot(*centers.T, ".", color=color, ms=2.2, alpha=alpha, label=label, lw=0)
    axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")


def histogram_panel(
    axes: Axes,
    values: np.ndarray | dict[str, Any],
    label: str,
    *,
    bins: int = 40,
    gaussian: tuple[float, float] | None = None,
) -> None:
    """Draw a histogram.

    Args:
        axes: Axes to draw into.
        values: Numbers of any shape, of which those that are not finite are left out. Or a histogram that is counted
            already, with `edges` (bins + 1,) and `counts` (bins,), as `MonteCarlo.histogram` gives it.
        label: Label of the horizontal axis.
        bins: Number of bins for numbers.
        gaussian: Mean and standard deviation of a Gaussian to draw over the bars. None: no Gaussian.
    """
    if isinstance(values, dict):
        edges, counts = np.asarray(values["edges"]), np.asarray(values["counts"])
    else:
        numbers = np.asarray(values, float).ravel()
        counts, edges = np.histogram(numbers[np.isfinite(numbers)], bins=bins)
    axes.stairs(counts, edges, fill=True, color=BLUE, alpha=0.75)
    if gaussian is not None and gaussian[1] > 0:
        mean, std = gaussian
        x = np.linspace(edges[0], edges[-1], 300)
        height = np.diff(edges).mean() * counts.sum() / (std * np.sqrt(2 * np.pi))
        axes.plot(x, height * np.exp(-0.5 * ((x - mean) / std) ** 2), color=ORANGE, lw=1.4, label="Gaussian")
    axes.set(xlabel=label, ylabel="count", ylim=(0, None))
