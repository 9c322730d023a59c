"""Study of predicted distributions: the identified noise on the test pushes of table 1, compared with three others.

- `noise`: the noise found by `identify_noise`. It is fitted by cross-validation on the training pushes: each part is
  predicted with the physics identified from the other parts. For the test pushes it is put about the physics identified
  from all training pushes.
- `calibrated`: the same distribution, with regions whose levels are calibrated by cross-validation on the training
  pushes, each predicted from nearly all others. This is needed because observations are nearer to the center than the
  noise says, with the same tails, and most so where a push goes far. The predicted motions of the test pushes have
  another distribution than those of the training pushes. Each training push is therefore weighted by how frequent its
  kind is among the test pushes.
- `normal`: the same point prediction, with a normal distribution of its errors in the cross-validation.
- `process`: a Gaussian process fitted to the same pushes. It does not know how far a push goes, so it predicts whole
  pushes only, which are what it is trained on.

`curve` shows how many pushes are needed, for point predictions and for one normal distribution about them.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.stats import multivariate_normal

import pushjax as pj
from benchmarks.robot import DataFolder, Objects, Surfaces, gaussian_process
from benchmarks.robot.predicted import (
    LEVELS,
    Scored,
    density_ratio,
    effective,
    errors,
    normal_draws,
    reach,
    scored,
)
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.cli.main import data_folder
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._cell_cache import CellCache
from pushjax.experiments._record import result_record
from pushjax.experiments.table1.conditions import NOT_IN_PAPER, OBJECTS, checked_surfaces, load, padded_pushes
from pushjax.experiments.table1.methods import (
    TEST_SIZE,
    TRAINING_SIZE,
    UNKNOWNS,
    ConditionData,
    fitted,
    without_padding,
)

STEPS = 25
FOLDS, FOLD = 3, 48  # number of parts, and largest number of pushes in each
# The same for the calibrated levels. Predicted from fewer pushes, an observation looks rarer than it is.
FINE_FOLDS, FINE_FOLD = 12, 12
DRAWS = 200
# Number of cells after which compiled programs are dropped. A process may have 65 530 memory mappings (the default of
# Linux) and a program has thousands of them. Beyond the limit, LLVM ends the process.
TOGETHER = 6
COUNTS = (10, 20, 40, 80, 128)  # numbers of training pushes
CURVE_TESTS = 0.3  # fraction of all whole pushes that are test pushes of the curve
FORMAT = 2  # format of kept cells; those of another format come from another method


def run(
    data: DataFolder = None,
    seed: int = 0,
    out: Path | None = None,
    steps: int = STEPS,
    surface: Surfaces = None,
    object: Objects = OBJECTS,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Run the study: one cell for each surface and object, and results pooled over the paper's objects.

    Each cell has, for each method and push, the energy score (mm), the log density (per cubic meter of x, y,
    length * theta), and whether the regions of 50 and 90 % contain the observation. `middle` are the test pushes of
    table 1; `whole` are the same pushes from beginning to end.

    Args:
        data: Folder of the recorded pushes, as for table 1. Default: the environment variable PUSHJAX_DATA.
        seed: Seed of all sampling, and of the choice of training pushes where the data do not have one.
        out: Folder for the picture. Each cell is also kept there as soon as it is computed.
        steps: Number of steps of a push.
        surface: Names of the surfaces, as for table 1. Default: abs, plywood.
        object: Names of the objects, as for table 1. Default: all.
        progress: Function called with the number of cells done and their total number.

    Returns:
        The record of the study.

    Raises:
        ValueError: As table 1 does, and if scikit-learn is not installed.
    """
    folder = data_folder(data)
    surface = checked_surfaces(folder, surface, object)
    settings = {"seed": seed, "steps": steps, "version": pj.__version__, "format": FORMAT}
    kept = CellCache("table1-spread", out, settings)

    def cell_of(log: MitPushes) -> dict[str, Any]:
        if len(kept.cells) % TOGETHER == 0:
            jax.clear_caches()
        return _cell(log, ConditionData.of(log, "quartic", steps), steps, seed)

    logs = [load(folder, on, target, seed) for on in surface for target in object]
    todo = [({"surface": log.surface, "object": log.shape}, partial(cell_of, log)) for log in logs]
    cells = kept.find_or_compute(todo, progress)
    paper = [cell for cell in cells if cell["object"] not in NOT_IN_PAPER]
    pooled = {
        group: _pooled([cell[group] for cell in paper], [cell["levels_of"][group] for cell in paper])
        for group in ("middle", "whole")
        if paper
    }
    curve = _mean_curve([cell["curve"] for cell in paper])
    pictures = [] if out is None or not paper else [_draw(pooled, curve, out)]
    settings |= {"surfaces": list(surface), "objects": list(object)}
    return result_record("table1-spread", settings, cells=cells, pooled=pooled, curve=curve, pictures=pictures)


def _cell(log: MitPushes, condition: ConditionData, steps: int, seed: int) -> dict[str, Any]:
    """Identify, predict and score with every method, for one object on one surface."""
    rng = np.random.default_rng(seed)
    slider, hand, length = condition.slider, condition.hand, condition.length
    rows = rng.permutation(np.flatnonzero(log.is_training & log.whole.valid))
    of_rest, held = _crossed(log, condition, rows, steps, FOLDS, FOLD)
    first, *keys = jax.random.split(jax.random.key(seed), 6)
    noise = pj.identify_noise(first, of_rest, held, slider, hand, score="density")
    every = pj.Unknowns((0.0, 1.0), **UNKNOWNS)
    found = fitted(condition.coarse, condition, every)
    off = without_padding(errors(_ends(of_rest, held, condition), np.asarray(held.end), np.asarray(held.start)), held)
    predicted = noise.transferred_to(found)
    process = gaussian_process.learn(log.whole, rows, length)
    first, *keys = keys
    levels, far = _held(first, log, condition, noise, rows, steps)
    groups = {"middle": condition.test, "whole": padded_pushes(log, log.whole, log.middle_of, steps, TEST_SIZE)}
    cell: dict[str, Any] = {"learned": len(rows), "tested": len(log.middle)}
    scalars = ("surface_dof", "hand_offset", "sigma", "student_dof")
    numbers: dict[str, Any] = {name: float(getattr(noise, name)) for name in scalars}
    spread = float(predicted.friction[1] - found.friction)
    cell["noise"] = numbers | {"relative_error": np.asarray(noise.relative_error), "spread": spread}
    cell |= {"held_level": levels, "levels_of": {}}
    for k, (group, pushes) in enumerate(groups.items()):
        ends, start = without_padding(pushes.end, pushes), without_padding(pushes.start, pushes)
        draws = without_padding(predicted.predict(keys[k], pushes, slider, hand, DRAWS), pushes)
        density = without_padding(predicted.log_density(keys[2 + k], pushes, slider, hand, DRAWS), pushes)
        methods = {"noise": scored(draws, ends, length)._replace(density=density)}
        weights = density_ratio(far, reach(draws, start, length))
        methods["calibrated"] = methods["noise"].calibrated(levels, weights)
        cell["levels_of"][group] = effective(weights[0])
        point = without_padding(_ends(found, pushes, condition), pushes)
        seen = errors(point, ends, start)
        scale = np.array([1, 1, length])
        normal: Any = multivariate_normal  # its type annotations want a number
        density = normal((off * scale).mean(axis=0), np.cov((off * scale).T)).logpdf(seen * scale)
        about = normal_draws(rng, point, start, off, DRAWS)
        methods["normal"] = scored(about, ends, length)._replace(density=density)
        if group == "whole":
            theirs = gaussian_process.predict(process, log.whole, log.middle_of)
            about, density = theirs.draws(rng, DRAWS), theirs.log_density(log.whole.end[log.middle_of])
            methods["process"] = scored(about, ends, length)._replace(density=density)
            cell["process_mm"] = _deviation_mm(theirs.poses(), ends, length)
        cell[group] = {name: _per_push(each) for name, each in methods.items()}
        cell[f"{group}_mm"] = _deviation_mm(point, ends, length)
    cell["curve"] = _curve(log, condition, steps, rng)
    return cell


def _held(
    key: PRNGKeyArray, log: MitPushes, condition: ConditionData, noise: pj.Noise, rows: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Predict each training push from nearly all others; return the levels and the predicted `reach`."""
    of_rest, held = _crossed(log, condition, rows, steps, FINE_FOLDS, FINE_FOLD)
    draws = without_padding(
        noise.transferred_to(of_rest).predict(key, held, condition.slider, condition.hand, DRAWS), held
    )
    there = scored(draws, without_padding(held.end, held), condition.length)
    return there.level, reach(draws, without_padding(held.start, held), condition.length)


def _crossed(
    log: MitPushes, condition: ConditionData, rows: np.ndarray, steps: int, count: int, most: int
) -> tuple[pj.Identified, pj.Pushes]:
    """Split the training pushes into `count` parts, and identify from the rest for each part.

    Returns:
        The identifications, and the parts, each of at most `most` pushes.
    """
    parts = np.array_split(rows, count)
    rest = [padded_pushes(log, log.whole, np.setdiff1d(rows, part), steps, TRAINING_SIZE) for part in parts]
    held = pj.Pushes.conditions([padded_pushes(log, log.whole, part, steps, most) for part in parts])
    # nothing is shared: each part has its own unknowns, as if the parts were different objects
    apart = pj.Unknowns((0.0, 1.0), **UNKNOWNS, shared=())
    return fitted(pj.Pushes.conditions(rest), condition, apart), held


def _ends(found: pj.Identified, pushes: pj.Pushes, condition: ConditionData) -> np.ndarray:
    return np.asarray(found.predict(pushes, condition.slider, condition.hand).pose[..., -1, :], np.float64)


def _deviation_mm(predicted: np.ndarray, ends: np.ndarray, length: float) -> float:
    return float(1e3 * np.mean(np.asarray(pj.deviation(predicted, ends, length), np.float64)))


def _per_push(each: Scored) -> dict[str, Any]:
    inside = {f"inside_{100 * level:g}": each.inside[:, k] for k, level in enumerate(LEVELS)}
    return {"energy_mm": 1e3 * each.energy, "log_density": each.density, "level": each.level} | inside


def _curve(log: MitPushes, condition: ConditionData, steps: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Compare physics and Gaussian process by the number of training pushes.

    Both use the same whole pushes, in random order.
    """
    rows = rng.permutation(np.flatnonzero(log.whole.valid))
    tests = np.sort(rows[: min(round(CURVE_TESTS * len(rows)), TEST_SIZE)])
    rest, length, found = rows[len(tests) :], condition.length, []
    tested = padded_pushes(log, log.whole, tests, steps, TEST_SIZE)
    ends = log.whole.end[tests]
    for count in (count for count in COUNTS if count <= len(rest)):
        learned = padded_pushes(log, log.whole, rest[:count], steps, TRAINING_SIZE)
        physics = fitted(learned, condition, pj.Unknowns((0.0, 1.0), **UNKNOWNS))
        point = without_padding(_ends(physics, tested, condition), tested)
        sigma = float(physics.sigma) / np.array([1, 1, length])
        about = point[:, None] + rng.normal(size=(len(tests), DRAWS, 3)) * sigma
        process = gaussian_process.predict(gaussian_process.learn(log.whole, rest[:count], length), log.whole, tests)
        row: dict[str, Any] = {"count": count}
        for name, mean, draws in (("physics", point, about), ("process", process.poses(), process.draws(rng, DRAWS))):
            energy = 1e3 * float(scored(draws, ends, length).energy.mean())
            row |= {f"{name}_mm": _deviation_mm(mean, ends, length), f"{name}_energy_mm": energy}
        found.append(row)
    return found


def _pooled(cells: list[dict[str, Any]], seen: list[float]) -> dict[str, dict[str, Any]]:
    """Pool the scores of all pushes, for each method.

    The result has means, standard errors of the coverage, and paired differences of `noise` from each method.

    Args:
        cells: Scores of each push, by method.
        seen: Effective sample size behind each cell's calibrated levels, which have an error of their own.
    """
    found: dict[str, dict[str, Any]] = {}
    ours = {name: np.concatenate([cell["noise"][name] for cell in cells]) for name in ("energy_mm", "log_density")}
    for method in cells[0]:
        pool = {name: np.concatenate([cell[method][name] for cell in cells]) for name in cells[0][method]}
        count = len(pool["energy_mm"])
        row: dict[str, Any] = {name: float(values.mean()) for name, values in pool.items()} | {"pushes": count}
        variance = 1 / count
        if method == "calibrated":
            tested = [len(cell[method]["energy_mm"]) for cell in cells]
            variance += sum((mine / count) ** 2 / of for mine, of in zip(tested, seen, strict=True))
            row["levels_of"] = sum(seen)
        for level in LEVELS:
            row[f"error_{100 * level:g}"] = float(np.sqrt(level * (1 - level) * variance))
        for name, values in ours.items():
            less = values - pool[name]
            row[f"noise_less_{name}"] = [float(less.mean()), float(less.std(ddof=1) / np.sqrt(count))]
        found[method] = row
    return found


def _mean_curve(curves: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Average the curves over objects, for the counts that all of them have."""
    rows = []
    for count in COUNTS:
        mine = [row for curve in curves for row in curve if row["count"] == count]
        if mine and len(mine) == len(curves):
            rows.append({name: float(np.mean([row[name] for row in mine])) for name in mine[0]} | {"count": count})
    return rows


def _draw(pooled: dict[str, dict[str, dict[str, Any]]], curve: list[dict[str, Any]], out: Path) -> str:
    from benchmarks.robot.figures import spread_figure
    from pushjax import plot

    return str(plot.save(spread_figure(pooled, curve), out / "table1_spread.png"))


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints, for a record of `run`."""
    lines = []
    for group, methods in record["pooled"].items():
        title = {"middle": "The pushes of table 1", "whole": "The same pushes, whole"}[group]
        lines += [f"{title}: {methods['noise']['pushes']} that nothing was learned from.", ""]
        lines.append(f"{'':9}{'energy score':>14}{'log density':>13}{'in 50 %':>9}{'in 90 %':>9}")
        for name, row in methods.items():
            shares = "".join(f"{100 * row[f'inside_{level}']:7.1f} %" for level in ("50", "90"))
            lines.append(f"{name:9}{row['energy_mm']:11.3f} mm{row['log_density']:13.2f}{shares}")
        for name, row in methods.items():
            if name not in ("noise", "calibrated"):  # the same draws
                energy, density = row["noise_less_energy_mm"], row["noise_less_log_density"]
                lines.append(
                    f"noise less {name}: energy score {energy[0]:+.3f} +- {energy[1]:.3f} mm, log density "
                    f"{density[0]:+.2f} +- {density[1]:.2f}"
                )
        tested, calibrated = (
            f"{100 * row['error_50']:.1f} and {100 * row['error_90']:.1f} %"
            for row in (methods["noise"], methods["calibrated"])
        )
        of = f"of calibrated ones, with levels of {methods['calibrated']['levels_of']:.0f} pushes: {calibrated}"
        lines += [f"standard errors of the shares: {tested}; {of}", ""]
    if record["curve"]:
        lines.append(f"{'learned from':14}{'physics':>14}{'process':>14}   mean deviation (energy score), mm")
        for row in record["curve"]:
            each = (f"{row[f'{name}_mm']:6.2f} ({row[f'{name}_energy_mm']:.2f})" for name in ("physics", "process"))
            lines.append(f"{row['count']:6.0f} pushes {''.join(f'{entry:>14}' for entry in each)}")
    lines += ["", "tri2 is in no mean: the tracker lost it."]
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
