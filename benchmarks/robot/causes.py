"""Study of the causes of the prediction error in table 1: how much of the error each cause explains.

Friction, limit surface and center of pressure are identified from the training pushes, together with one cause at a
time. The measure is how much better the test pushes are then predicted. The same is repeated with each cause in
addition to the calibration, which is the true positions of tip, object and outline. Table 1 keeps the calibration and
the overlap.

All runs use one compiled program: a cause that is switched off has a prior of almost zero width (`NO_ROOM`).
"""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import pushjax as pj
from benchmarks.robot import DataFolder, Objects, Surfaces
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.cli.main import data_folder
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._cell_cache import CellCache
from pushjax.experiments._record import result_record
from pushjax.experiments.table1.conditions import NOT_IN_PAPER, OBJECTS, SIDES, checked_surfaces, load
from pushjax.experiments.table1.experiment import deviation_mm
from pushjax.experiments.table1.methods import (
    FRAME_OFFSET,
    HAND_OFFSET,
    INSET,
    PRESSURE_CENTER,
    SURFACE_DOF,
    ConditionData,
    fitted,
    without_padding,
)
from pushjax.experiments.table1.repeats import noise_floor_mm

STEPS = 50
NO_ROOM = 1e-6  # prior standard deviation of a cause that is switched off
# Unknowns of each cause, with their prior standard deviations as in `Unknowns`.
CAUSES: dict[str, dict[str, float]] = {
    "tip offset": {"hand_offset": HAND_OFFSET},
    "object frame": {"frame_offset": FRAME_OFFSET},
    "outline": {"inset": INSET},
    "stream lag": {"lag_distance": 0.001},
    "initial overlap": {"overlap": 1.0},
    "anisotropic friction": {"anisotropy": 0.1},
    "friction over the table": {"log_gradient": 1.0, "log_hessian": 10.0},
    "drift": {"friction_drift": 0.3},
    "friction by side": {"friction_by_side": 0.3},
}
CALIBRATION = ("tip offset", "object frame", "outline")
NOTHING, CALIBRATED = "nothing", "calibration"


def runs() -> dict[str, tuple[str, ...]]:
    """Return the causes that each run identifies, by the name of the run."""
    rest = [name for name in CAUSES if name not in CALIBRATION]
    alone = {name: (name,) for name in CAUSES}
    beside = {f"{CALIBRATED} + {name}": (*CALIBRATION, name) for name in rest}
    return {NOTHING: (), CALIBRATED: CALIBRATION} | alone | beside


def run(
    data: DataFolder = None,
    seed: int = 0,
    out: Path | None = None,
    steps: int = STEPS,
    surface: Surfaces = None,
    object: Objects = OBJECTS,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Run the study: one cell for each surface, object and run, and the change by each cause over all objects.

    Each cell has `mean_mm`, the mean deviation of the test pushes, and what was identified. The record's `shares` have,
    for each run, `change_mm`, the change of the mean against the run without any of its causes (for a run in addition
    to the calibration: against the calibration alone), and `ci95_mm`, half the width of its 95 % confidence interval.

    Args:
        data: Folder of the recorded pushes, as for table 1. Default: the environment variable PUSHJAX_DATA.
        seed: Seed of the choice of training pushes, where the data do not have one.
        out: Folder for the picture. Each cell is also kept there as soon as it is computed.
        steps: Number of steps of a push.
        surface: Names of the surfaces, as for table 1. Default: abs, plywood.
        object: Names of the objects, as for table 1. Default: all.
        progress: Function called with the number of cells done and their total number.

    Returns:
        The record of the study.

    Raises:
        ValueError: As table 1 does.
    """
    folder = data_folder(data)
    surface = checked_surfaces(folder, surface, object)
    settings = {"seed": seed, "steps": steps, "version": pj.__version__}
    todo = []
    for log in (load(folder, on, target, seed) for on in surface for target in object):
        condition = cache(partial(ConditionData.of, log, "quartic", steps))  # made only if a cell is missing
        for name, causes in runs().items():
            labels = {"surface": log.surface, "object": log.shape, "run": name}
            todo.append((labels, partial(_cell, log, condition, causes)))
    cells = CellCache("table1-causes", out, settings).find_or_compute(todo, progress)
    shares = {name: _share(cells, name) for name in runs()}
    surfaces = {name: _deviations([cell for cell in cells if cell["surface"] == name]) for name in surface}
    pictures = [] if out is None else [_draw(shares, surfaces, out)]
    settings |= {"surfaces": list(surface), "objects": list(object)}
    return result_record("table1-causes", settings, cells=cells, shares=shares, surfaces=surfaces, pictures=pictures)


def _cell(log: MitPushes, made: Callable[[], ConditionData], causes: tuple[str, ...]) -> dict[str, Any]:
    """Identify with these causes and predict the test pushes of one object on one surface."""
    condition = made()
    found = identified(condition, causes)
    predicted = found.predict(condition.test, condition.slider, condition.hand)
    off = deviation_mm(log, without_padding(predicted.pose[:, -1], condition.test))
    parameters = found.parameters._asdict()
    return {
        "mean_mm": float(off.mean()),
        "each_mm": off,
        "friction": float(found.friction),
        "sigma_mm": 1e3 * float(found.sigma),
        "found": {name: np.asarray(parameters[name], float) for cause in causes for name in CAUSES[cause]},
        "failed_steps": int(without_padding(predicted.failed, condition.test).sum()),
        "noise_floor_mm": noise_floor_mm(log),
    }


def identified(condition: ConditionData, causes: tuple[str, ...]) -> pj.Identified:
    """Identify friction, limit surface and center of pressure, together with some causes, from the training pushes.

    Args:
        condition: What the identification needs of one object.
        causes: Names in `CAUSES`.
    """
    spreads: dict[str, Any] = {name: NO_ROOM for each in CAUSES.values() for name in each}
    spreads |= {name: value for cause in causes for name, value in CAUSES[cause].items()}
    spreads["overlap"] = None  # known, not identified
    unknowns = pj.Unknowns((0.0, 1.0), surface_dof=SURFACE_DOF, pressure_center=PRESSURE_CENTER, sides=SIDES, **spreads)
    return fitted(condition.coarse, condition, unknowns, overlap=1.0 if "initial overlap" in causes else 0.0)


def _without(name: str) -> str:
    """Return the run that this run is compared with."""
    return CALIBRATED if name.startswith(f"{CALIBRATED} + ") else NOTHING


def _share(cells: list[dict], name: str) -> dict[str, float]:
    """Return a run's mean over the paper's objects, its change, and the change in percent of the error without it."""

    def each(run: str) -> dict[tuple[str, str], np.ndarray]:
        mine = (cell for cell in cells if cell["run"] == run and cell["object"] not in NOT_IN_PAPER)
        return {(cell["surface"], cell["object"]): np.asarray(cell["each_mm"]) for cell in mine}

    mine, without = each(name), each(_without(name))
    if not mine:
        return {}
    changes = [mine[key] - without[key] for key in mine]
    mean, change = (float(np.mean([values.mean() for values in several])) for several in (mine.values(), changes))
    interval = 1.96 * np.sqrt(np.sum([values.var(ddof=1) / len(values) for values in changes])) / len(changes)
    share = -change / (mean - change)
    return {"mean_mm": mean, "change_mm": change, "ci95_mm": float(interval), "percent": 100 * share}


def _deviations(cells: list[dict]) -> dict[str, float | None]:
    """Return mean deviations on one surface: without any cause (`nothing`) and with the calibration (`calibration`).

    For objects whose pushes were repeated, also those with the calibration (`twice`) and the noise floor (`noise`).
    """
    mine = [cell for cell in cells if cell["object"] not in NOT_IN_PAPER]
    floors = [cell["noise_floor_mm"] for cell in mine if cell["run"] == NOTHING and cell["noise_floor_mm"] is not None]
    found: dict[str, float | None] = {
        name: float(np.mean([cell["mean_mm"] for cell in mine if cell["run"] == name])) if mine else None
        for name in (NOTHING, CALIBRATED)
    }
    twice = [cell["mean_mm"] for cell in mine if cell["run"] == CALIBRATED and cell["noise_floor_mm"] is not None]
    found["twice"] = float(np.mean(twice)) if twice else None
    return found | {"noise": float(np.mean(floors)) if floors else None}


def _draw(shares: dict[str, dict[str, float]], surfaces: dict[str, dict[str, float | None]], out: Path) -> str:
    from benchmarks.robot.figures import causes_figure
    from pushjax import plot

    alone = {name: shares[name] for name in (*CAUSES, CALIBRATED) if shares[name]}
    beside = {name: shares.get(f"{CALIBRATED} + {name}", {}) for name in CAUSES}
    figure = causes_figure(alone, {name: each for name, each in beside.items() if each}, surfaces)
    return str(plot.save(figure, out / "table1_causes.png"))


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints, for a record of `run`."""
    shares = record["shares"]
    lines = ["Mean deviation of the tested pushes in mm; what it changes, and which share of the error that is.", ""]
    for name, each in shares.items():
        if not each:
            continue
        change = f"{each['change_mm']:+7.3f} +- {each['ci95_mm']:.3f}  {each['percent']:+5.1f} %"
        change = "" if name == NOTHING else change
        lines.append(f"{name:40}{each['mean_mm']:6.2f}  {change}")
    for name, each in record["surfaces"].items():
        if each["noise"] is not None:
            left = f"calibrated {each['twice']:.2f} mm, noise {each['noise']:.2f} mm"
            lines += ["", f"On {name}, of the objects that were pushed twice: {left}."]
    failed = sum(cell["failed_steps"] for cell in record["cells"])
    if failed:
        lines.append(f"{failed} steps failed; there the object was left where it was (see the JSON).")
    lines += ["", "Intervals (95 %) are of the pushes; objects are as they are. tri2 is in no mean."]
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
