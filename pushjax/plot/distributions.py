"""Pictures of where many pushes end. Panels are drawn into given axes, so that an experiment lays them out."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from pushjax.plot.style import BLUE, END, GREEN, MM, ORANGE, PURPLE, START, STYLE

TICK = 1.6  # mm, half the length of a pose's tick


def traces(axes: Axes, trajectory: np.ndarray, color: str = BLUE, alpha: float = 0.06) -> None:
    """The ways (n, steps + 1, 3) of the slider's origin, in mm."""
    axes.add_collection(LineCollection(list(MM * trajectory[..., :2]), colors=color, linewidths=0.6, alpha=alpha))
    axes.autoscale_view()


def pose_panel(axes: Axes, poses: np.ndarray, color: str, label: str | None = None, alpha: float = 0.6) -> None:
    """Poses (n, 3): a dot at each position with a tick along its x axis, in mm."""
    at = MM * poses[:, :2]
    along = TICK * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    axes.add_collection(LineCollection(list(np.stack([at, at + along], axis=1)), colors=color, lw=0.5, alpha=alpha))
    axes.plot(*at.T, ".", color=color, ms=2.2, alpha=alpha, label=label, lw=0)
    axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")


def histogram_panel(axes: Axes, counted: dict[str, Any], label: str, *, gaussian: tuple[float, float] | None = None):
    """Bars of a histogram with `edges` and `counts`, `label` on its axis; gaussian: mean and deviation of one to draw
    over it."""
    edges, counts = np.asarray(counted["edges"]), np.asarray(counted["counts"])
    axes.stairs(counts, edges, fill=True, color=BLUE, alpha=0.75)
    if gaussian is not None and gaussian[1] > 0:
        mean, std = gaussian
        x = np.linspace(edges[0], edges[-1], 300)
        height = np.diff(edges).mean() * counts.sum() / (std * np.sqrt(2 * np.pi))
        axes.plot(x, height * np.exp(-0.5 * ((x - mean) / std) ** 2), color=ORANGE, lw=1.4, label="Gaussian")
    axes.set(xlabel=label, ylabel="count", ylim=(0, None))


def density_panel(axes: Axes, grid: tuple[np.ndarray, np.ndarray], density: np.ndarray, inside, outside) -> Any:
    """A density over (x, y) in mm, with the points (n, 2) m that made it in red and the others in black."""
    drawn = axes.contourf(*(MM * g for g in grid), density, levels=12, cmap="Blues")
    axes.plot(*(MM * np.asarray(outside)).T, ".", color=START, ms=2.5)
    axes.plot(*(MM * np.asarray(inside)).T, ".", color=END, ms=2.5)
    axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
    return plt.colorbar(drawn, ax=axes, label="density / (1/mm²)", shrink=0.8)


def spread_figure(pooled: dict[str, dict[str, dict[str, Any]]], curve: list[dict[str, Any]]) -> Figure:
    """Left: how often regions of predicted distributions hold what happened, against how often they should. Right: the
    mean deviation by how many pushes were learned from. pooled: by kind of push and method, with the shares `inside_50`
    and `inside_90`; curve: rows of `count`, `physics_mm`, `process_mm`."""
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.8), layout="constrained")
        methods = {"noise": ("identified noise", BLUE), "normal": ("normal errors", ORANGE)}
        methods |= {"process": ("Gaussian process", GREEN), "calibrated": ("calibrated levels", PURPLE)}
        left.plot([0, 100], [0, 100], color="0.7", lw=0.9, label="as it should be")
        for group, dash in (("middle", "-"), ("whole", "--")):
            for (name, (label, color)), marker in zip(methods.items(), "os^D", strict=True):
                row = pooled.get(group, {}).get(name)
                if row is not None:
                    shares = [0, 100 * row["inside_50"], 100 * row["inside_90"], 100]
                    look = {"color": color, "ls": dash, "marker": marker, "ms": 4, "lw": 1.1}
                    left.plot([0, 50, 90, 100], shares, label=f"{label}, {group}", **look)
        left.set(xlabel="predicted share / %", ylabel="share of the pushes / %", title="Pushes inside a region")
        left.legend(loc="lower right", fontsize=7.5)
        counts = [row["count"] for row in curve]
        for name, label, color, style in (
            ("physics", "physics", BLUE, "o-"),
            ("process", "Gaussian process", GREEN, "^--"),
        ):
            right.plot(counts, [row[f"{name}_mm"] for row in curve], style, color=color, ms=4, label=label)
        right.set(xlabel="pushes learned from", ylabel="mean deviation / mm", ylim=(0, None))
        right.set_title("Few pushes, and many")
        if counts:
            right.set_xscale("log", base=2)
            right.set_xticks(counts, [str(count) for count in counts])
        right.legend(loc="upper right")
        return figure
