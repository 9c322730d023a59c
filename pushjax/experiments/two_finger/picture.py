"""The picture of the two-finger pushes: for each object the distribution of deviations, and three test pushes."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from pushjax import plot
from pushjax.datasets import Recordings
from pushjax.experiments._tables import deviation_mm, polygon
from pushjax.experiments.two_finger.predictions import Tested, per_push
from pushjax.plot.style import BLACK, BLUE, GRAY, ORANGE, STYLE, legend_below

# name, log, predicted final poses (radii, frictions, n, 3), their deviations (radii, frictions, n), mm, and the splits
Shown = tuple[str, Recordings, np.ndarray, np.ndarray, Tested]


def figure(shown: list[Shown]) -> Figure:
    """Draw for each object the distribution of deviations, and three test pushes of the first random split."""
    with plt.rc_context(STYLE):
        drawn, axes = plt.subplots(len(shown), 4, figsize=(14.0, 3.5 * len(shown)), layout="constrained")
        for row, (name, log, final, errors, tested) in zip(axes, shown, strict=True):
            each, no_motion = per_push(errors, tested), deviation_mm(log.start, log.end, log.length or 0.0)
            _distribution(row[0], name, each[np.isfinite(each)], no_motion)
            at, pushes = tested.chosen[0], tested.test[0]
            order = pushes[np.argsort(errors[at][pushes])]
            for panel, (word, share) in zip(
                row[1:], (("median", 0.5), ("90th percentile", 0.9), ("worst", 1.0)), strict=True
            ):
                push = order[round(share * (len(order) - 1))]
                _one_push(panel, log, push, final[at][push])
                panel.set_title(f"{name}, {word}: {errors[at][push]:.1f} mm")
        legend_below(drawn, axes[0, 1], columns=5)
        return drawn


def _distribution(axes, name: str, predicted: np.ndarray, no_motion: np.ndarray) -> None:
    """Draw the cumulative distributions of the deviations, mm, of the predictions and of the start poses."""
    for values, color, dash, label in (
        (predicted, BLUE, "-", "predicted"),
        (no_motion, GRAY, "--", "no motion"),
    ):
        axes.ecdf(values, ls=dash, color=color, label=label)
    axes.set(xscale="log", xlim=(0.4, 200), ylim=(0, 1), title=f"{name}, test pushes")
    axes.set(xlabel="deviation of the final pose / mm", ylabel="share of pushes below")
    axes.legend(loc="upper left")


def _one_push(axes, log: Recordings, push: int, final: np.ndarray) -> None:
    """Draw the start, the measured end and the predicted end of one push, with the fingers."""
    shape = polygon(log)
    drawn = (
        (log.start[push], GRAY, "-", "start"),
        (log.end[push], BLACK, "-", "measured end"),
        (final, BLUE, "--", "predicted end"),
    )
    for pose, color, dash, label in drawn:
        plot.outline(axes, shape, pose, color, 1.5, linestyle=dash, label=label)
    for hand, color, label in (
        (log.pushes[push].hand[0], GRAY, "fingers, start"),
        (log.pushes[push].hand[-1], ORANGE, "fingers, end"),
    ):
        aside = hand[3] / 2 * np.array([-np.sin(hand[2]), np.cos(hand[2])])
        fingers = 1e3 * np.stack([hand[:2] + aside, hand[:2] - aside])
        axes.plot(*fingers.T, "o", color=color, ms=5, label=label)
    axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
    axes.set_aspect("equal", adjustable="datalim")
