"""Table 1 of the paper: eleven objects pushed along straight lines on two surfaces, predicted against measured.

The limit surface and the friction of the finger are learned from about eighty whole pushes of each object. The other
pushes are predicted, from 10 to 90 % of their time. The result is the mean deviation of the final poses (Zhou et al.
2017, section VI.B, table 1).

Deviations from the paper: there is one split, where the paper has ten. Pushes that the tracker lost are tested too, as
in the paper. The paper's third surface, delrin, is left out unless it is asked for.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets import Recordings
from pushjax.experiments._cell_cache import CellCache
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, saved, table
from pushjax.experiments._tables import (
    MODELS,
    Prediction,
    bootstrapped_ci95,
    by_object,
    deviation_mm,
    failures,
    mean_figures,
)
from pushjax.experiments.table1.conditions import (
    NOT_IN_PAPER,
    OBJECTS,
    PAPER_PERCENT,
    checked_surfaces,
    load,
    paper_mm,
)
from pushjax.experiments.table1.groups import group, noise_floor_mm, training_pushes
from pushjax.experiments.table1.methods import METHODS, ConditionData


def run(
    folder: Path,
    seed: int = 0,
    out: Path | None = None,
    steps: int = 100,
    method: Sequence[str] = tuple(METHODS),
    surface: Sequence[str] | None = None,
    object: Sequence[str] = OBJECTS,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Compute one cell of the table for each surface, object, method and model.

    With `out`, every cell is saved there as soon as it is known. An interrupted run continues with the saved cells.

    Args:
        folder: Folder of the published data set, or one with files `mit_push/SURFACE_OBJECT.npz` of grouped pushes.
        seed: Seed of the bootstrap, and of the choice of training pushes where the data do not have one.
        out: Folder for the pictures and the saved cells. None: neither.
        steps: Steps of each push.
        method: One or both of "wrench_twist" and "identified".
        surface: Names of surfaces. None: abs and plywood.
        object: Names of objects.
        progress: Called with the number of cells done and their total.

    Returns:
        The record, with the cells, and the means by method and model.

    Raises:
        LogError: If data are missing or damaged.
        ValueError: If a method, surface or object is unknown.
    """
    surface = checked_surfaces(surface, object)
    unknown = [one for one in method if one not in METHODS]
    if unknown or not method:
        raise ValueError(f"method must be one or more of {', '.join(METHODS)}; got {unknown or 'none'}")
    logs = [load(folder, surface_name, object_name, seed) for surface_name in surface for object_name in object]
    settings = {"seed": seed, "steps": steps, "version": pj.__version__}
    todo = []
    for log in logs:
        for model in MODELS:
            condition = cache(partial(ConditionData.of, log, model, steps))  # made only if a cell is missing
            for name in method:
                labels = {"surface": log.surface, "object": log.object, "model": model, "method": name}
                todo.append((labels, partial(_cell, log, model, METHODS[name], condition, seed)))
    cells = CellCache("table1", out, settings).find_or_compute(todo, progress)
    means = {name: {model: _means_by_surface(cells, name, model) for model in MODELS} for name in method}
    title = "Straight pushes: final pose, predicted against measured"
    pictures = saved(
        out,
        lambda: {
            f"table1_{name}.png": plot.table_figure(
                [cell for cell in cells if cell["method"] == name], f"{title} ({name.replace('_', '-')})", width=13.0
            )
            for name in method
        },
    )
    settings |= {"method": list(method), "surfaces": list(surface), "objects": list(object)}
    return result_record("table1", settings, cells=cells, means=means, pictures=pictures)


def _cell(
    log: Recordings,
    model: str,
    method: Callable[[ConditionData], Prediction],
    condition: Callable[[], ConditionData],
    seed: int,
) -> dict[str, Any]:
    """Compute the figures of one cell, apart from its labels and run time."""
    predicted, test = method(condition()), group(log, "middle")
    deviations, by_toolbox = predicted.errors, f"toolbox_{model}"
    toolbox = test.about(by_toolbox) if by_toolbox in test.pushes[0].about else None
    return {
        "mean_mm": float(deviations.mean()),
        "ci95_bootstrap_mm": bootstrapped_ci95(deviations, np.random.default_rng(seed)),
        "median_mm": float(np.median(deviations)),
        "worst_mm": float(deviations.max()),
        "valid_mm": float(deviations[test.about("valid")].mean()),  # without the pushes that the tracker lost
        "no_motion_mm": float(deviation_mm(test.start, test.end, log.length).mean()),
        "paper_mm": paper_mm(str(log.surface), str(log.object), model),
        "toolbox_mm": None if toolbox is None else float(deviation_mm(toolbox, test.end, log.length).mean()),
        "friction": float(predicted.friction),
        "learned": len(training_pushes(log)),  # number of pushes, as "tested" is
        "tested": len(deviations),
        "failed_steps": predicted.failed,
        **_calibration(predicted),
        "noise_floor_mm": noise_floor_mm(log),
    }


def _calibration(predicted: Prediction) -> dict[str, Any]:
    """Return the other identified unknowns and the noise: lengths in mm, angles in degrees; {} if there are none."""
    if predicted.found is None:
        return {}
    parameters = predicted.found.parameters
    names = ("pressure_center", "hand_offset", "inset")
    found = {f"{name}_mm": 1e3 * np.asarray(getattr(parameters, name), float) for name in names}
    offset = parameters.frame_offset
    if offset is not None:
        found |= {"frame_offset_mm": 1e3 * np.asarray(offset[:2], float)}
        found |= {"frame_offset_deg": float(np.degrees(offset[2]))}
    sigma, gap_sigma = predicted.found.sigma, predicted.found.gap_sigma
    return found | {"sigma_mm": 1e3 * float(sigma), "gap_sigma_mm": 1e3 * float(gap_sigma)}


def _means_by_surface(cells: list[dict], method: str, model: str) -> dict[str, Any]:
    """Return the means over the paper's ten objects, over all surfaces and for each surface alone."""
    selected = [c for c in cells if (c["method"], c["model"]) == (method, model) and c["object"] not in NOT_IN_PAPER]
    if not selected:
        return {}
    surfaces = dict.fromkeys(cell["surface"] for cell in selected)
    return _mean_cell(selected, model) | {
        name: _mean_cell([c for c in selected if c["surface"] == name], model) for name in surfaces
    }


def _mean_cell(cells: list[dict], model: str) -> dict[str, float | None]:
    """Return the means over cells of one method and model; the paper's percentage is over all its surfaces."""
    toolbox = [cell["toolbox_mm"] for cell in cells]
    by_toolbox = None if None in toolbox else float(np.mean(toolbox))
    return mean_figures(cells, PAPER_PERCENT[model]) | {"toolbox_mm": by_toolbox}


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report: the paper's table with the computed one beside it."""
    either = next(iter(MODELS))  # the motion and the noise are those of every model
    parts: list[str | Table] = ["Mean deviation in mm, test pushes; the paper's in brackets."]
    for name, means in record["means"].items():
        parts.append(
            by_object(
                [cell for cell in record["cells"] if cell["method"] == name],
                name,
                *((model, model, _entry) for model in MODELS),
                ("no motion", either, lambda cell: f"{cell['no_motion_mm']:.2f}"),
                ("noise", either, lambda cell: _or_dash(cell["noise_floor_mm"])),
            )
        )
        rows = [
            {"model": model, "surface": surface} | (mean if surface == "all" else mean[surface])
            for model, mean in means.items()
            for surface in ((*record["settings"]["surfaces"], "all") if mean else ())
        ]
        parts.append(
            table(
                rows,
                (f"{name}, means", "model"),
                ("surface", "surface"),
                ("mean / mm", "mean_mm", ".2f"),
                ("paper / mm", "paper_mm", ".2f"),
                ("authors' toolbox / mm", "toolbox_mm", ".2f"),
                ("part of the motion / %", "percent", ".2f"),
            )
        )
    percents = " and ".join(f"{percent:.2f} % ({model})" for model, percent in PAPER_PERCENT.items())
    return [
        *parts,
        f"The paper's means over all three surfaces are {percents} of the motion.",
        *failures(record["cells"]),
        "noise: a push against the mean of its repetitions. tri2 is in no mean: the tracker lost it.",
    ]


def _entry(cell: dict[str, Any]) -> str:
    """Format a cell: the computed mean, and the paper's in brackets."""
    paper = "" if cell["paper_mm"] is None else f" ({cell['paper_mm']:.2f})"
    return f"{cell['mean_mm']:.2f}{paper}"


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
