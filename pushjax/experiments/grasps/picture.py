"""The pictures of the grasps: where the slider lay, where it is left, and histograms of both."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax.experiments.grasps.sliders import Setting
from pushjax.plot.style import BLACK, BLUE, GRAY, MM, ORANGE, PURPLE, RED, STYLE

COLORS = {"grasped": RED, "jammed": ORANGE, "free": GRAY, "failed": PURPLE}
COORDINATES = ((MM, "x / mm"), (MM, "y / mm"), (180 / np.pi, "θ / °"))
BINS = 60  # of each histogram in the picture; the record has fewer


def draw(
    out: Path,
    name: str,
    setting: Setting,
    hand: pj.Hand,
    path: Any,  # (steps + 1, dof), configurations of the jaw
    starts: np.ndarray,  # (n, 3), m and rad
    shown: dict[str, tuple[pj.MonteCarlo, np.ndarray]],
) -> list[str]:
    """Draw start poses and, for each pressure in `shown`, the final poses by outcome, with histograms."""
    with plt.rc_context(STYLE):
        rows = len(shown) + 1
        figure, axes = plt.subplots(rows, 4, figsize=(14.0, 3.4 * rows), layout="constrained")
        first = axes[0]
        plot.pose_panel(first[0], starts, BLACK)
        plot.outline(first[0], setting.shape, np.zeros(3), BLUE, 1.0)
        plot.hand_at(first[0], hand, np.asarray(hand.poses(path[0])), BLUE, 1.0)
        first[0].set_title(f"{len(starts)} start poses")
        _histograms(first[1:], starts)
        for row, (pressure, (grasps, outcomes)) in zip(axes[1:], shown.items(), strict=True):
            for word, color in COLORS.items():
                which = outcomes == word
                if which.any():
                    plot.pose_panel(row[0], grasps.pose[which], color, f"{word}: {which.sum()}")
            ends = MM * np.abs(grasps.pose[:, :2]).max(axis=0) + 4
            row[0].set(xlim=(-ends[0], ends[0]), ylim=(-ends[1], ends[1]))
            row[0].set(title=f"where they end, pressure: {pressure}", aspect="equal")
            row[0].legend(loc="upper right", markerscale=3, fontsize=7)
            held = np.array(grasps.pose[grasps.stopped >= 0], np.float64)
            # shifted so that a spike at a right angle is not cut into two halves
            held[:, 2] = np.mod(held[:, 2] + setting.symmetry / 4, setting.symmetry) - setting.symmetry / 4
            _histograms(row[1:], held)
            row[2].set_title("of those held (θ modulo its symmetry)")
        return [str(plot.save(figure, out / f"{name}.png"))]


def _histograms(panels, poses: np.ndarray) -> None:
    """Draw histograms of x, y (mm) and theta (degrees) of poses (n, 3)."""
    for k, (axes, (scale, label)) in enumerate(zip(panels, COORDINATES, strict=True)):
        values = scale * np.asarray(poses[:, k], np.float64)
        if len(values):
            counts, edges = np.histogram(values, BINS)
            plot.histogram_panel(axes, {"edges": edges, "counts": counts}, label)
