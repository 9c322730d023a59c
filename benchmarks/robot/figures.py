"""Figures of the studies."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from pushjax.plot.style import BLUE, GRAY, GREEN, ORANGE, PURPLE, STYLE, bars

Change = Mapping[str, float]


def causes_figure(
    alone: Mapping[str, Change],
    beside: Mapping[str, Change],
    surfaces: Mapping[str, Mapping[str, float | None]],
) -> Figure:
    """Draw the change of the mean deviation by each cause (left), and the deviation on each surface (right).

    Args:
        alone: Change by each cause alone: `change_mm`, and `ci95_mm` for its interval.
        beside: The same for each cause in addition to the calibration.
        surfaces: Mean deviations on each surface, mm: `nothing`, `calibration` and `noise`. `noise` is None where no
            push was repeated.

    Returns:
        The figure.
    """
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.2), layout="constrained", width_ratios=(1.7, 1))
        names = list(alone)
        place = np.arange(len(names))[::-1]
        both = (alone, 0.19, bars(BLUE), "alone"), (beside, -0.19, bars(ORANGE, True), "beside the calibration")
        for rows, shift, look, label in both:
            there = [(y, rows[name]) for y, name in zip(place, names, strict=True) if name in rows]
            if not there:
                continue
            y = np.array([at for at, _ in there]) + shift
            change, interval = (np.array([each[key] for _, each in there]) for key in ("change_mm", "ci95_mm"))
            left.barh(y, change, 0.36, xerr=interval, label=label, **look)
        left.axvline(0, color="0.2", lw=0.8)
        left.set_yticks(place, names)
        left.set(xlabel="change of the mean deviation / mm (left is better)", title="What each cause explains")
        left.legend(loc="upper center", bbox_to_anchor=(0.4, -0.16), ncols=2)
        kinds = (
            ("nothing", "no cause", bars(GRAY)),
            ("calibration", "calibrated", bars(BLUE)),
            ("noise", "repetitions", bars(ORANGE, True)),
        )
        for k, (kind, label, look) in enumerate(kinds):
            heights = [float("nan") if (mean := each[kind]) is None else mean for each in surfaces.values()]
            x = np.arange(len(surfaces)) + 0.27 * (k - 1)
            right.bar(x, heights, 0.25, label=label, **look)
            for at, height in zip(x, heights, strict=True):
                if np.isfinite(height):
                    right.annotate(f"{height:.2f}", (at, height), ha="center", va="bottom", fontsize=8)
        right.set_xticks(np.arange(len(surfaces)), list(surfaces))
        right.set(ylabel="mean deviation / mm", title="What is left")
        right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
        return figure


def spread_figure(pooled: dict[str, dict[str, dict[str, Any]]], curve: list[dict[str, Any]]) -> Figure:
    """Draw the coverage of predicted regions (left), and the mean deviation by the number of training pushes (right).

    Coverage is the fraction of the observations that lie inside a region, against the fraction that should.

    Args:
        pooled: Results by kind of push and method, with the fractions `inside_50` and `inside_90`.
        curve: Rows with `count`, `physics_mm` and `process_mm`.

    Returns:
        The figure.
    """
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
