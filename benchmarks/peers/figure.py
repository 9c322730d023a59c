"""Figure of computing time against error."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pushjax.plot.style import STYLE, curve_styles


def speed_figure(curves: Mapping[str, Sequence[tuple[float, float]]], allowed_mm: float) -> Figure:
    """Plot the time of a push (s) against the error of its final pose (mm), with a line at the allowed error."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(6.8, 3.8), layout="constrained")
        for name, points, look in curve_styles(curves):
            times, errors = zip(*sorted(points), strict=True)
            axes.loglog(errors, [1e6 * t for t in times], ms=4, lw=1.1, label=name, **look)
        axes.axvline(allowed_mm, color="0.6", lw=0.9, ls="--")
        axes.set(xlabel="worst error of a final pose / mm", ylabel="time of one core per push / µs")
        axes.set_title("What accuracy costs")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return figure
