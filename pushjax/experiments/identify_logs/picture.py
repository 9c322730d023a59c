"""The report's pictures: predicted over measured pushes, residuals, and profiles."""

from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import PchipInterpolator

from pushjax import plot
from pushjax.experiments.identify_logs.findings import Findings, unit
from pushjax.identification.uncertainty import DROP_AT_90
from pushjax.plot.style import BLACK, BLUE, GRAY, ORANGE, STYLE, legend_below

SHOWN = (("best", 0.0), ("median", 0.5), ("90th percentile", 0.9), ("worst", 1.0))


def draw(findings: Findings, out: Path) -> list[str]:
    """Draw the three pictures into the folder `out` and return their paths."""
    with plt.rc_context(STYLE):
        return [str(picture(findings, out)) for picture in (_pushes, _residuals, _profiles)]


def _pushes(findings: Findings, out: Path) -> Path:
    """Draw the best, the median, the 90th percentile and the worst push, predicted over measured."""
    final = findings.final
    off = findings.deviation_mm(final)
    order = np.argsort(off)
    start, end, path = (findings.rows(getattr(findings.pushes, name)) for name in ("start", "end", "path"))
    figure, axes = plt.subplots(1, len(SHOWN), figsize=(3.6 * len(SHOWN), 3.8), layout="constrained")
    for panel, (word, share) in zip(axes, SHOWN, strict=True):
        push = order[round(share * (len(order) - 1))]
        shape, hand = findings.slider.shape, findings.hand
        for pose, color, dash, label in (
            (start[push], GRAY, "-", "start"),
            (end[push], BLACK, "-", "measured end"),
            (final[push], BLUE, "--", "predicted end"),
        ):
            plot.outline(panel, shape, pose, color, 1.5, linestyle=dash, label=label)
        fingers = np.asarray(hand.poses(jnp.asarray(path[push])))
        for k in range(fingers.shape[1]):
            label = "fingers' paths, as logged" if k == 0 else None
            panel.plot(*(1e3 * fingers[:, k, :2]).T, color=ORANGE, lw=1.2, label=label)
        plot.hand_at(panel, hand, fingers[-1], ORANGE, 1.2)
        panel.set(title=f"{word}: {off[push]:.2f} mm", xlabel="x / mm", ylabel="y / mm")
        panel.set_aspect("equal", adjustable="datalim")
    legend_below(figure, axes[0], columns=4)
    return plot.save(figure, out / "identify_pushes.png")


def _residuals(findings: Findings, out: Path) -> Path:
    """Draw the residuals with rings of one and two sigma, and the distribution of deviations."""
    residual = 1e3 * findings.rows(findings.found.residual)
    sigma = 1e3 * float(findings.found.sigma)
    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.8), layout="constrained")
    for panel, (a, b), names in (
        (axes[0], (0, 1), ("x / mm", "y / mm")),
        (axes[1], (0, 2), ("x / mm", "length · angle / mm")),
    ):
        panel.plot(residual[:, a], residual[:, b], "o", color=BLUE, ms=4, alpha=0.7)
        angle = np.linspace(0, 2 * np.pi, 100)
        for radius, dash in ((sigma, "-"), (2 * sigma, "--")):
            panel.plot(radius * np.cos(angle), radius * np.sin(angle), dash, color=GRAY, zorder=0)
        panel.set(xlabel=f"predicted less measured {names[0]}", ylabel=f"predicted less measured {names[1]}")
        panel.set_aspect("equal", adjustable="datalim")
    axes[0].set_title(f"rings: one and two sigma, {sigma:.2g} mm")
    still = findings.deviation_mm(findings.rows(findings.pushes.start))
    for values, color, dash, label in (
        (findings.deviation_mm(findings.final), BLUE, "-", "predicted"),
        (still, GRAY, "--", "no motion"),
    ):
        axes[2].ecdf(values, ls=dash, color=color, label=label)
    axes[2].set(xscale="log", ylim=(0, 1), xlabel="deviation of the final pose / mm", ylabel="share of pushes below")
    axes[2].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)  # above the panel, off the curves
    return plot.save(figure, out / "identify_residuals.png")


def _profiles(findings: Findings, out: Path) -> Path:
    """Draw the profile of each number beside its normal approximation."""
    profiles = findings.profiles
    columns = min(len(profiles), 4)
    rows = -(-len(profiles) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.4 * columns, 3.0 * rows), layout="constrained", squeeze=False)
    for panel in axes.flat[len(profiles) :]:
        panel.set_visible(False)
    for panel, each in zip(axes.flat, profiles, strict=False):
        name, scale = unit(each.label)
        # Signed distances of the values from the estimate, in standard deviations of z.
        distance = np.sign(np.arange(len(each.normal)) - np.argmin(each.normal)) * np.sqrt(2 * each.normal)
        dense = np.linspace(distance[0], distance[-1], 200)
        value, drop = (PchipInterpolator(distance, y)(dense) for y in (scale * each.value, each.log_posterior_drop))
        panel.plot(value, drop, "-", color=BLUE, label="all else at its best")
        panel.plot(scale * each.value, each.log_posterior_drop, "o", color=BLUE, ms=3)
        panel.plot(value, dense**2 / 2, "--", color=ORANGE, label="normal")
        panel.axhline(DROP_AT_90, color=GRAY, lw=0.8, label="where a 90 % interval ends")
        panel.set(xlabel=each.label + (f" / {name}" if name else ""), ylim=(0, 5))
    axes[0, 0].set_ylabel("drop of the log posterior density")
    legend_below(figure, axes[0, 0], columns=3)
    return plot.save(figure, out / "identify_profiles.png")
