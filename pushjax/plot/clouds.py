"""Pictures of many pushes at once: their ways and ends, and which starts end as wanted."""

from collections.abc import Mapping

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pushjax.hands import Hand
from pushjax.plot.distributions import density_panel, traces
from pushjax.plot.parts import hand_at, outline
from pushjax.plot.style import BETWEEN, BLUE, END, MM, START, STYLE, legend_below
from pushjax.shapes import Shape

QUANTILES = (0.025, 0.5, 0.975)
Density = tuple[tuple[np.ndarray, np.ndarray], np.ndarray]


def cloud_figure(shape: Shape, hand: Hand, path: np.ndarray, trajectory: np.ndarray, title: str = "") -> Figure:
    """The ways of the centre in many pushes that begin alike; the start, and the ends with the median angle and those
    that 2.5 and 97.5 % of the pushes fall short of; the hand at both ends of its path.

    path: (steps + 1, dof), the hand's configurations. trajectory: (pushes, steps + 1, 3), poses; both world, m and rad.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(6.0, 5.0), layout="constrained")
        trajectory = np.asarray(trajectory)
        traces(axes, trajectory, alpha=_faint(len(trajectory)))
        outline(axes, shape, trajectory[0, 0], START, 1.4, label="start")
        order = np.argsort(trajectory[:, -1, 2])
        for share in QUANTILES:
            style, label = ("-", "median end") if share == 0.5 else (":", "end, 2.5 and 97.5 % of θ")
            end = trajectory[order[round(share * (len(order) - 1))], -1]
            outline(axes, shape, end, END, 1.2, linestyle=style, label=label)
        fingers = np.asarray(hand.poses(jnp.asarray(path)))
        hand_at(axes, hand, fingers[0], START, 1.0)
        hand_at(axes, hand, fingers[-1], END, 1.0)
        axes.plot([], [], color=BLUE, lw=0.8, label="ways of the centre")
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal", title=title)
        handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))  # each label once
        axes.legend(handles.values(), handles.keys(), loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return figure


def capture_figure(
    shape: Shape,
    hand: Hand,
    path: np.ndarray,
    runs: Mapping[str, tuple[np.ndarray, np.ndarray]],
    density: Density | None = None,
    ways: int = 100,
) -> Figure:
    """Many starts, and which of them end as wanted (red, the others black): the ways of the centre, a panel a run; the
    hand at its start grey, at its end blue with one slider that it caught.

    path: (steps + 1, dof). runs: by name, the poses (pushes, steps + 1, 3) and which are wanted (pushes,). ways: how
    many are drawn at most in each panel, the first. density: of the wanted starts of the last run, 1/mm², over a grid
    ((n, n) of x, (n, n) of y, m), for one more panel with the start centres of that run. World, m and rad.
    """
    with plt.rc_context(STYLE):
        ratios = [1.0] * len(runs) + ([] if density is None else [1.45])
        size = 3.6 * sum(ratios), 5.6
        figure, panels = plt.subplots(
            1, len(ratios), figsize=size, layout="constrained", width_ratios=ratios, squeeze=False
        )
        fingers = np.asarray(hand.poses(jnp.asarray(path)))
        for axes, (name, (trajectory, wanted)) in zip(panels[0], runs.items(), strict=False):
            _ways(axes, trajectory[:ways], wanted[:ways])
            hand_at(axes, hand, fingers[0], BETWEEN, 2.0)
            hand_at(axes, hand, fingers[-1], BLUE, 2.0)
            if np.any(wanted):
                outline(axes, shape, trajectory[np.argmax(wanted), -1], BLUE, 1.0)
            axes.set(title=name, xlabel="x / mm", aspect="equal")
        panels[0, 0].set_ylabel("y / mm")
        if density is not None:
            name, (trajectory, wanted) = list(runs.items())[-1]
            starts = trajectory[:, 0, :2]
            density_panel(panels[0, -1], *density, starts[wanted], starts[~wanted])
            panels[0, -1].set_title(f"start centres, {name}")
        for color, label in ((END, "end as wanted"), (START, "do not")):
            panels[0, 0].plot([], [], color=color, label=label)
        legend_below(figure, panels[0, 0], columns=2)
        return figure


def _ways(axes: Axes, trajectory: np.ndarray, wanted: np.ndarray) -> None:
    for which, color in ((wanted, END), (~wanted, START)):
        traces(axes, trajectory[which], color, alpha=0.5)
        axes.plot(*(MM * trajectory[which, 0, :2].T), ".", color=color, ms=3)


def _faint(lines: int) -> float:
    """The opacity at which so many lines on top of each other still show where they are dense."""
    return float(np.clip(30 / max(lines, 1), 0.06, 0.6))
