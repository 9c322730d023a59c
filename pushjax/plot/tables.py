"""Pictures of tables."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from pushjax.plot.style import BLUE, ORANGE, STYLE

# The hatch distinguishes the models in grayscale.
MODELS: dict[str, dict[str, Any]] = {"quartic": {"color": BLUE}, "ellipsoid": {"color": ORANGE, "hatch": "////"}}
BARS: dict[str, Any] = {"edgecolor": "white", "linewidth": 0, "ecolor": "0.25", "capsize": 2}


def table_figure(cells: list[dict], title: str, width: float = 8.6) -> Figure:
    """Draw mean deviations by condition, with their intervals and the paper's, one group of bars per condition.

    Args:
        cells: Each with `surface`, `object`, `model` ("quartic" or "ellipsoid"), `mean_mm`, `ci95_bootstrap_mm` and
            `paper_mm` (or None). A cell with `mean_mm` None has the reason as `missing`, which is written in its place.
        title: Title of the picture.
        width: Width of the figure, inches.
    """
    with plt.rc_context(STYLE):
        conditions = list(dict.fromkeys((cell["surface"], cell["object"]) for cell in cells))
        figure, axes = plt.subplots(figsize=(width, 3.8), layout="constrained")
        above = axes.get_xaxis_transform()  # x in data, y as a share of the height
        for k, (model, style) in enumerate(MODELS.items()):
            of_model = [cell for cell in cells if cell["model"] == model]
            if not of_model:
                continue
            x = np.arange(len(conditions)) + (k - 0.5) * 0.36
            height, error = (
                [np.nan if cell["mean_mm"] is None else cell[key] for cell in of_model]
                for key in ("mean_mm", "ci95_bootstrap_mm")
            )
            for place, cell in zip(x, of_model, strict=True):
                if cell["mean_mm"] is None:
                    axes.text(
                        place, 0.02, cell["missing"], rotation=90, ha="center", transform=above, va="bottom", size=7
                    )
            axes.bar(x, height, 0.34, yerr=error, label=f"{model}, this run", **style, **BARS)
            paper = [np.nan if cell["paper_mm"] is None else cell["paper_mm"] for cell in of_model]
            axes.plot(x, paper, "_", color="black", ms=13, mew=1.8, label="the paper" if k == 0 else None)
        axes.set_xticks(np.arange(len(conditions)), [name for _, name in conditions])
        surfaces = np.array([surface for surface, _ in conditions])
        for surface in dict.fromkeys(surfaces.tolist()):
            middle = float(np.mean(np.flatnonzero(surfaces == surface)))
            axes.text(middle, -0.15, surface, transform=above, ha="center", va="center")
        axes.set(ylabel="mean deviation / mm", title=title)
        axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))
        return figure
