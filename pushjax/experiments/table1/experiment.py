"""Table 1 of the paper: eleven objects pushed along straight lines on two surfaces; predicted against measured.

Surface and friction are learned from about eighty whole pushes of each object; the other pushes, from 10 to 90 % of
their time, are predicted: the mean deviation of the final poses (Zhou et al. 2017, section VI.B, table 1).

Deviations from the paper: one split, where the paper has ten; pushes are tested that the tracker lost, as there. The
curated archives have no pushes on delrin, the paper's third surface; the published folders do.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._kept import Kept
from pushjax.experiments._tables import bootstrapped_ci95
from pushjax.experiments.table1.conditions import APART, MODELS, OBJECTS, PAPER_PERCENT, chosen, load, paper_mm
from pushjax.experiments.table1.methods import METHODS, Predicted, Setting
from pushjax.experiments.table1.repeats import noise_floor_mm
from pushjax.report import envelope


def run(
    folder: Path,
    seed: int = 0,
    out: Path | None = None,
    steps: int = 100,
    method: Sequence[str] = tuple(METHODS),
    surface: Sequence[str] | None = None,
    object: Sequence[str] = OBJECTS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """A cell for each surface, object, method and model. folder: the data's, with `mit_push/`, or that of the published
    data set. method: one or more of "wrench_twist" and "identified". surface: by default those of the archives.

    With `out`, every cell is kept there as soon as it is known, and taken from there if the run was interrupted.
    Raises LogError for data that lack or are damaged, ValueError for an unknown method, surface or object.
    """
    surface = chosen(folder, surface, object)
    unknown = [one for one in method if one not in METHODS]
    if unknown or not method:
        raise ValueError(f"method must be one or more of {', '.join(METHODS)}; got {unknown or 'none'}")
    logs = [load(folder, on, target, seed) for on in surface for target in object]
    settings = {"seed": seed, "steps": steps, "version": pj.__version__}
    kept = Kept(None if out is None else out / "table1-cells.json", settings)
    cells, total = [], len(logs) * len(MODELS) * len(method)
    for log in logs:
        floor = noise_floor_mm(log)
        for model in MODELS:
            setting = None  # for all methods, but made only if a cell lacks
            for name in method:
                labels = {"surface": log.surface, "object": log.shape, "model": model, "method": name}
                cell = kept.find(labels)
                if cell is None:
                    begin = time.perf_counter()
                    setting = Setting.of(log, model, steps) if setting is None else setting
                    found = _cell(log, model, METHODS[name](setting), seed)
                    taken = {"noise_floor_mm": floor, "run_s": time.perf_counter() - begin}
                    cell = kept.add(labels | found | taken)
                cells.append(cell)
                progress(len(cells), total)
    means = {name: {model: _means(cells, name, model) for model in MODELS} for name in method}
    pictures = [] if out is None else _draw(cells, out)
    kept.forget()
    settings |= {"method": list(method), "surfaces": list(surface), "objects": list(object)}
    return envelope("table1", settings, cells=cells, means=means, pictures=pictures)


def _cell(log: MitPushes, model: str, predicted: Predicted, seed: int) -> dict[str, Any]:
    off = deviation_mm(log, predicted.final)
    toolbox = log.middle.toolbox.get(model)
    return {
        "mean_mm": float(off.mean()),
        "ci95_bootstrap_mm": bootstrapped_ci95(off, np.random.default_rng(seed)),
        "median_mm": float(np.median(off)),
        "worst_mm": float(off.max()),
        "valid_mm": float(off[log.middle.valid].mean()),
        "no_motion_mm": float(deviation_mm(log, log.middle.start).mean()),
        "paper_mm": paper_mm(log.surface, log.shape, model),
        "toolbox_mm": None if toolbox is None else float(deviation_mm(log, toolbox).mean()),
        "friction": predicted.friction,
        "learned": int(np.sum(log.learned & log.whole.valid)),
        "tested": len(off),
        "failed_steps": predicted.failed,
        **_calibration(predicted),
    }


def _calibration(predicted: Predicted) -> dict[str, Any]:
    """What else was found, mm."""
    if predicted.found is None:
        return {}
    own = predicted.found.physical
    found = {f"{name}_mm": 1e3 * np.asarray(getattr(own, name), float) for name in ("center", "offset", "inset")}
    if own.marker is not None:
        found |= {"marker_mm": 1e3 * np.asarray(own.marker[:2], float), "marker_deg": float(np.degrees(own.marker[2]))}
    return found | {"sigma_mm": 1e3 * float(predicted.found.sigma), "gap_mm": 1e3 * float(predicted.found.gap)}


def deviation_mm(log: MitPushes, final: np.ndarray) -> np.ndarray:
    """(pushes,), of those that are tested."""
    return 1e3 * np.asarray(pj.deviation(final, log.middle.end, log.length), np.float64)


def _means(cells: list[dict], method: str, model: str) -> dict[str, Any]:
    """Over the paper's ten objects, and of each surface alone."""
    mine = [c for c in cells if (c["method"], c["model"]) == (method, model) and c["object"] not in APART]
    if not mine:
        return {}
    surfaces = dict.fromkeys(cell["surface"] for cell in mine)
    return _mean(mine, model) | {name: _mean([c for c in mine if c["surface"] == name], model) for name in surfaces}


def _mean(cells: list[dict], model: str) -> dict[str, float | None]:
    toolbox = [cell["toolbox_mm"] for cell in cells]
    return {
        "mean_mm": float(np.mean([cell["mean_mm"] for cell in cells])),
        "paper_mm": float(np.mean([cell["paper_mm"] for cell in cells])),
        "toolbox_mm": None if None in toolbox else float(np.mean(toolbox)),
        "percent": float(100 * np.mean([cell["mean_mm"] / cell["no_motion_mm"] for cell in cells])),
        "paper_percent": PAPER_PERCENT[model],
    }


def _draw(cells: list[dict], out: Path) -> list[str]:
    from pushjax import plot

    title, drawn = "Straight pushes: final pose, predicted against measured", []
    for name in dict.fromkeys(cell["method"] for cell in cells):
        mine = [cell for cell in cells if cell["method"] == name]
        figure = plot.table_figure(mine, f"{title} ({name.replace('_', '-')})", width=13.0)
        drawn.append(str(plot.save(figure, out / f"table1_{name}.png")))
    return drawn


def summary(record: dict[str, Any]) -> str:
    """What the command prints: the paper's table with ours beside it."""
    objects, surfaces = record["settings"]["objects"], record["settings"]["surfaces"]
    lines = ["Mean deviation in mm, test pushes; the paper's in brackets."]
    for name, means in record["means"].items():
        cells = [cell for cell in record["cells"] if cell["method"] == name]
        lines += ["", f"{name:20}" + "".join(f"{target:>13}" for target in objects)]
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
                own = mean[surface]
                toolbox = own["toolbox_mm"]
                theirs = "" if toolbox is None else f", its program on these pushes {toolbox:.2f}"
                lines.append(
                    f"{model:10}{surface:9} mean {own['mean_mm']:.2f} mm (paper {own['paper_mm']:.2f}{theirs}), "
                    f"{own['percent']:.2f} % of the motion"
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
    paper = "" if cell["paper_mm"] is None else f" ({cell['paper_mm']:.2f})"
    return f"{cell['mean_mm']:.2f}{paper}"
