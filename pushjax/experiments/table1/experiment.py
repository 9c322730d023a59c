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
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets import Recordings
from pushjax.experiments._cell_cache import CellCache
from pushjax.experiments._record import result_record
from pushjax.experiments._tables import MODELS, Prediction, bootstrapped_ci95, deviation_mm
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
    pictures = [] if out is None else _draw(cells, out)
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
    """Return the means over cells of one method and model."""
    toolbox = [cell["toolbox_mm"] for cell in cells]
    return {
        "mean_mm": float(np.mean([cell["mean_mm"] for cell in cells])),
        "paper_mm": float(np.mean([cell["paper_mm"] for cell in cells])),
        "toolbox_mm": None if None in toolbox else float(np.mean(toolbox)),
        "percent": float(100 * np.mean([cell["mean_mm"] / cell["no_motion_mm"] for cell in cells])),
        "paper_percent": PAPER_PERCENT[model],  # not of these cells: the paper has only the mean over all surfaces
    }


def _draw(cells: list[dict], out: Path) -> list[str]:
    """Draw one picture per method into the folder `out` and return their paths."""
    from pushjax import plot

    title, drawn = "Straight pushes: final pose, predicted against measured", []
    for name in dict.fromkeys(cell["method"] for cell in cells):
        of_method = [cell for cell in cells if cell["method"] == name]
        figure = plot.table_figure(of_method, f"{title} ({name.replace('_', '-')})", width=13.0)
        drawn.append(str(plot.save(figure, out / f"table1_{name}.png")))
    return drawn


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints: the paper's table with the computed one beside it."""
    objects, surfaces = record["settings"]["objects"], record["settings"]["surfaces"]
    lines = ["Mean deviation in mm, test pushes; the paper's in brackets."]
    for name, means in record["means"].items():
        cells = [cell for cell in record["cells"] if cell["method"] == name]
        lines += ["", f"{name:20}" + "".join(f"{object_name:>13}" for object_name in objects)]
        for surface in surfaces:
            for model in MODELS:
                row = [c for c in cells if (c["surface"], c["model"]) == (surface, model)]
                lines.append(f"{surface:9} {model:10}" + "".join(f"{_entry(c):>13}" for c in row))
            row = [c for c in cells if (c["surface"], c["model"]) == (surface, "quartic")]
            lines.append(f"{surface:9} {'no motion':10}" + "".join(f"{c['no_motion_mm']:13.2f}" for c in row))
            floors = ("-" if c["noise_floor_mm"] is None else f"{c['noise_floor_mm']:.2f}" for c in row)
            lines.append(f"{surface:9} {'noise':10}" + "".join(f"{floor:>13}" for floor in floors))
        for model, mean in means.items():
            for surface in surfaces if mean else ():
                there = mean[surface]
                toolbox = there["toolbox_mm"]
                by_toolbox = "" if toolbox is None else f", the authors' toolbox on these pushes {toolbox:.2f}"
                lines.append(
                    f"{model:10}{surface:9} mean {there['mean_mm']:.2f} mm (paper {there['paper_mm']:.2f}"
                    f"{by_toolbox}), {there['percent']:.2f} % of the motion"
                )
            if mean:
                lines.append(
                    f"{model:10}{'all':9} {mean['percent']:.2f} % of the motion (paper {mean['paper_percent']:.2f} %, "
                    "of all three surfaces)"
                )
    lines.append("")
    failed = sum(cell["failed_steps"] for cell in record["cells"])
    if failed:
        lines.append(f"{failed} steps failed; there the object was left where it was (see the JSON).")
    lines.append("noise: a push against the mean of its repetitions. tri2 is in no mean: the tracker lost it.")
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)


def _entry(cell: dict[str, Any]) -> str:
    """Format a cell: the computed mean, and the paper's in brackets."""
    paper = "" if cell["paper_mm"] is None else f" ({cell['paper_mm']:.2f})"
    return f"{cell['mean_mm']:.2f}{paper}"
