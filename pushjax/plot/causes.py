"""Pictures of where an error comes from."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from pushjax.plot.style import BETWEEN, BLUE, ORANGE, STYLE, bars

Change = Mapping[str, float]


def causes_figure(
    alone: Mapping[str, Change],
    beside: Mapping[str, Change],
    surfaces: Mapping[str, Mapping[str, float | None]],
) -> Figure:
    """Left: the mean change of the deviation by each cause, with its interval, alone and beside the calibration. Right:
    what is left on each surface. Changes have `change_mm` and `ci95_mm`; surfaces the means `nothing`, `calibration`
    and `noise`, mm, the last None where no push was repeated."""
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
            ("nothing", "no cause", bars(BETWEEN)),
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
