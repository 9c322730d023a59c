"""Table 1 of the paper: eleven objects pushed along straight lines on two surfaces, predicted against measured.

The limit surface and the friction of the finger are learned from about eighty whole pushes of each object. The other
pushes are predicted, from 10 to 90 % of their time. The result is the mean deviation of the final poses (Zhou et al.
2017, section VI.B, table 1).

There are two methods. `wrench_twist`, the paper's, fits the surface to measured forces and motions and finds the
friction on a grid. `identified` finds friction, surface, center of pressure, and the true positions of tip and object
from the final poses of the training pushes, starting from the surface of `wrench_twist`.

Deviations from the paper: there is one split, where the paper has ten. Pushes that the tracker lost are tested too, as
in the paper. The paper's third surface, delrin, is left out unless it is asked for.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets import Recordings
from pushjax.experiments import tables
from pushjax.experiments._cell_cache import find_or_compute, saved_cells_file
from pushjax.experiments._mit_pushes import group, load, noise_floor_mm, outline, training_pushes
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, saved
from pushjax.experiments._slider_options import MODELS

SURFACES = ("abs", "plywood")
ALL_SURFACES = ("delrin", *SURFACES)
OBJECTS = ("rect1", "rect2", "rect3", "tri1", "tri3", "ellip1", "ellip2", "ellip3", "hex", "butter", "tri2")
NOT_IN_PAPER = ("tri2",)  # not in the paper, because the tracker lost it; excluded from every mean
FRICTIONS = np.linspace(0.0, 0.6, 31)
# Largest number of steps per push in the identification, which takes derivatives. More steps give the same answer.
IDENTIFY_STEPS = 25
# Largest numbers of pushes to learn from and to test with; arrays are padded to them.
TRAINING_SIZE, TEST_SIZE = 128, 304
# Priors, as in `pj.Unknowns`: degrees of freedom of the surface, and standard deviations in m. All values were chosen
# on the surface abs.
UNKNOWNS: dict[str, Any] = {
    "surface_dof": 10.0,
    "pressure_center": 0.015,
    "inset": 0.001,
    "hand_offset": 0.002,
    "frame_offset": 0.001,
}

# Zhou et al. 2017, table 1: mean deviation in mm; mean deviation in mm if nothing moved; and the mean over conditions
# of the ratio of the two in percent, delrin included.
PAPER_MM = {
    ("delrin", "quartic"): (8.28, 5.37, 6.10, 9.71, 7.54, 7.68, 8.90, 7.35, 6.38, 4.83),
    ("delrin", "ellipsoid"): (8.60, 5.92, 8.20, 9.90, 8.18, 6.85, 6.29, 8.08, 6.42, 5.97),
    ("abs", "quartic"): (5.86, 7.48, 3.59, 7.13, 5.17, 8.45, 9.18, 5.93, 7.56, 3.94),
    ("abs", "ellipsoid"): (6.07, 6.74, 6.19, 8.00, 7.17, 6.66, 7.69, 5.78, 8.19, 5.39),
    ("plywood", "quartic"): (6.86, 6.86, 5.93, 4.61, 7.21, 4.39, 4.99, 5.72, 8.41, 4.72),
    ("plywood", "ellipsoid"): (6.20, 7.22, 6.88, 5.96, 9.43, 4.42, 5.84, 6.46, 8.85, 6.05),
}
PAPER_NO_MOTION_MM = {
    "delrin": (35.48, 40.53, 35.98, 36.91, 34.66, 32.18, 38.05, 33.37, 33.55, 34.09),
    "abs": (34.14, 39.74, 33.98, 35.43, 32.37, 32.68, 33.53, 32.45, 33.23, 33.53),
    "plywood": (31.86, 33.22, 32.94, 32.81, 33.78, 27.24, 28.23, 33.29, 32.77, 34.10),
}
PAPER_PERCENT = {"quartic": 20.05, "ellipsoid": 21.39}


def run(
    folder: Path,
    seed: int = 0,
    out: Path | None = None,
    steps: int = 100,
    method: Sequence[str] = ("wrench_twist", "identified"),
    surface: Sequence[str] = SURFACES,
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
        surface: Names of surfaces: "abs", "plywood" and "delrin".
        object: Names of objects.
        progress: Called with the number of cells done and their total.

    Returns:
        The record, with the cells, and the means by method, model and surface.

    Raises:
        LogError: If data are missing or damaged.
        ValueError: If a method, surface or object is unknown.
    """
    for name, given, allowed in (
        ("method", method, METHODS),
        ("surface", surface, ALL_SURFACES),
        ("object", object, OBJECTS),
    ):
        tables.check_chosen(name, given, allowed)
    logs = [load(folder, surface_name, object_name, seed) for surface_name in surface for object_name in object]
    settings = {"seed": seed, "steps": steps, "version": pj.__version__}
    todo = []
    for log in logs:
        for model in MODELS:
            condition = cache(partial(ConditionData.of, log, model, steps))  # made only if a cell is missing
            for name in method:
                labels = {"surface": log.surface, "object": log.object, "model": model, "method": name}
                todo.append((labels, partial(_cell, log, model, METHODS[name], condition, seed)))
    cells = find_or_compute(None if out is None else saved_cells_file("table1", out), settings, todo, progress)
    settings |= {"method": list(method), "surfaces": list(surface), "objects": list(object)}
    title = "Straight pushes: final pose, predicted against measured"
    return result_record(
        "table1",
        settings,
        cells=cells,
        means=tables.mean_rows(cells, PAPER_PERCENT, NOT_IN_PAPER),
        pictures=saved(out, lambda: tables.table_pictures("table1", cells, title)),
    )


class ConditionData(NamedTuple):
    """One object on one surface as both methods take it, with pushes as padded arrays."""

    training: pj.Pushes
    coarse: pj.Pushes  # training pushes in at most `IDENTIFY_STEPS` steps
    test: pj.Pushes
    slider: pj.Slider  # the object with a surface that is fitted to measured forces and motions
    hand: pj.Hand
    length: float  # characteristic length of the deviations, m

    @staticmethod
    def of(log: Recordings, model: str, steps: int) -> "ConditionData":
        """Prepare the data of one object for a model, with `steps` steps of each push."""
        assert log.length is not None  # known for every object of the data set
        assert log.tip_radius is not None
        training, test = training_pushes(log), group(log, "middle")
        return ConditionData(
            tables.padded(pj.Pushes.of(training, steps), TRAINING_SIZE),
            tables.padded(pj.Pushes.of(training, min(steps, IDENTIFY_STEPS)), TRAINING_SIZE),
            tables.padded(pj.Pushes.of(test, steps), TEST_SIZE),
            pj.Slider(outline(log), tables.measured_surface(training, model, log.length)),
            pj.Hand.finger(log.tip_radius),
            log.length,
        )


def wrench_twist(condition: ConditionData) -> tables.Prediction:
    """Predict with the fitted surface and the friction that is best for the training pushes, on a grid."""
    _, _, test, slider, hand, length = condition
    dtype = test.path.dtype
    on_grid, *_ = tables.final_poses(slider, hand, condition.training, jnp.asarray(FRICTIONS, dtype))
    errors = tables.deviation_mm(on_grid, condition.training.end[None], length)
    best = FRICTIONS[tables.best_setting(errors, np.asarray(condition.training.weight) > 0)]
    final, failed, _ = tables.final_poses(slider, hand, test, jnp.asarray([best], dtype))
    return _prediction(condition, final, best, failed, None)


def identified(condition: ConditionData) -> tables.Prediction:
    """Predict with everything that is identified from the final poses of the training pushes."""
    _, coarse, test, slider, hand, length = condition
    unknowns = pj.Unknowns((0.0, 1.0), **UNKNOWNS)
    # The finger is assumed to touch the object at the end of most training pushes. Tip and object may overlap at the
    # start of a push to predict. This is assumed to be a measurement error. The training pushes are whole, from the
    # touch on, so they carry no information about it.
    found = pj.identify(coarse, slider, hand, unknowns, length=length, contact_at_end=True).with_known(overlap=1.0)
    predicted = found.predict(test, slider, hand)
    return _prediction(condition, predicted.pose[None, :, -1], found.friction, predicted.failed[None], found)


METHODS = {"wrench_twist": wrench_twist, "identified": identified}


def _prediction(condition: ConditionData, final, friction, failed, found: pj.Identified | None) -> tables.Prediction:
    """Return the prediction of the test pushes, of one split, from arrays that are padded to `TEST_SIZE`."""
    is_push = np.asarray(condition.test.weight) > 0
    errors = tables.deviation_mm(final, condition.test.end[None], condition.length)[:, is_push]
    return tables.Prediction(errors, np.asarray(friction, float), int(np.asarray(failed)[:, is_push].sum()), found)


def _cell(
    log: Recordings,
    model: str,
    method: Callable[[ConditionData], tables.Prediction],
    condition: Callable[[], ConditionData],
    seed: int,
) -> dict[str, Any]:
    """Compute the figures of one cell, apart from its labels and run time."""
    predicted, test, by_toolbox = method(condition()), group(log, "middle"), f"toolbox_{model}"
    toolbox = test.about(by_toolbox) if by_toolbox in test.pushes[0].about else None
    tested, rng = np.ones_like(predicted.errors, bool), np.random.default_rng(seed)
    return tables.split_figures(predicted, tested, tables.no_motion_mm(test), rng) | {
        "valid_mm": float(predicted.errors[0, test.about("valid")].mean()),  # without pushes that the tracker lost
        "paper_mm": paper(PAPER_MM[str(log.surface), model], log.object),
        "paper_no_motion_mm": paper(PAPER_NO_MOTION_MM[str(log.surface)], log.object),
        "toolbox_mm": None if toolbox is None else float(tables.deviation_mm(toolbox, test.end, log.length).mean()),
        "learned": len(training_pushes(log)),  # number of pushes
        **_calibration(predicted),
        "noise_floor_mm": noise_floor_mm(log),
    }


def paper(figures: Sequence[float], name: str | None) -> float | None:
    """Return the paper's figure for an object, or None for an object that is not in the paper."""
    return None if name in NOT_IN_PAPER else figures[OBJECTS.index(str(name))]


def _calibration(predicted: tables.Prediction) -> dict[str, Any]:
    """Return the other identified unknowns and the noise: lengths in mm, angles in degrees; {} if there are none."""
    if predicted.found is None:
        return {}
    parameters = predicted.found.parameters
    offset = parameters.frame_offset
    assert offset is not None  # `UNKNOWNS` has it
    lengths = {name: getattr(parameters, name) for name in ("pressure_center", "hand_offset", "inset")}
    lengths |= {"frame_offset": offset[:2]}
    lengths |= {name: getattr(predicted.found, name) for name in ("sigma", "gap_sigma")}
    found = {f"{name}_mm": 1e3 * np.asarray(value, float) for name, value in lengths.items()}
    return found | {"frame_offset_deg": float(np.degrees(offset[2]))}


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report: the table, with the paper's figures beside it."""
    notes = "repeats differ: a push from the mean of its repetitions. tri2 is in no mean: the tracker lost it."
    return [*tables.summary(record), notes]
