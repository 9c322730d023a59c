"""The style that all pictures share: colors, line styles, units, panels and legends."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

MM = 1e3  # lengths are drawn in mm
# The colors of Okabe & Ito, which color-blind readers can tell apart.
BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
# Where a picture shows the start, the middle and the end of a push, they are black, gray and red. These colors differ
# in lightness, so that a grayscale print keeps them apart.
BLACK, GRAY, RED = "black", "0.72", "#C1121F"
# Color and dash of the curves of one panel. Most of the colors have nearly one lightness, so in grayscale only the dash
# distinguishes the curves.
SERIES = (
    (BLUE, "-"),
    (ORANGE, "--"),
    (GREEN, "-."),
    (PURPLE, ":"),
    ("#56B4E9", (0, (5, 1, 1, 1, 1, 1))),
    ("black", (0, (1, 3))),
)
MODEL_ROWS = {"quartic": 0, "ellipsoid": 1}  # index into `SERIES`, the same in every picture

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=[color for color, _ in SERIES]),
    "lines.linewidth": 1.4,
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.dpi": 160,
    "pdf.fonttype": 42,  # keeps text as text
    "svg.fonttype": "none",
}


def panel_row(
    panels: int,
    width: float,  # of each panel, inches
    height: float,  # of each panel, inches
    shared: bool = False,  # whether the panels show the same range
) -> tuple[Figure, list[Axes]]:
    """Make a figure with panels side by side, and return it with the axes of the panels."""
    figure, axes = plt.subplots(
        1, panels, figsize=(width * panels, height), sharex=shared, sharey=shared, layout="constrained", squeeze=False
    )
    return figure, list(axes[0])


def curve_styles(curves: Mapping[str, Any]) -> list[tuple[str, Any, dict[str, Any]]]:
    """Return for each curve its name, the curve, and its color and dash as arguments of `Axes.plot`."""
    if len(curves) > len(SERIES):
        raise ValueError(f"at most {len(SERIES)} curves can be distinguished; got {len(curves)}: {', '.join(curves)}")
    order = [MODEL_ROWS[name] for name in curves] if MODEL_ROWS.keys() >= curves.keys() else range(len(curves))
    looks = [{"color": color, "linestyle": dash} for color, dash in (SERIES[k] for k in order)]
    return list(zip(curves.keys(), curves.values(), looks, strict=True))


def legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """Draw one legend for all panels below them, with each label of `axes` once, in `columns` columns."""
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)
