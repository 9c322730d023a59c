"""Predicted distributions of the pushes that nothing was learned from, beside what one would take else.

noise     what `identify_noise` finds: of each part of the pushes to learn from, about what the rest tells; then about
          what all of them tell.
calibrated  the same, but regions of the levels that held their share of the pushes to learn from, each predicted from
          nearly all others: what happens is nearer to the middle than the noise says, at the same tails, and most so
          where a push goes far. How far those tested go, by prediction, is not how far those learned from do; each of
          these counts for as many as there are of its kind.
normal    the same point prediction, with a normal distribution of its errors on those parts.
process   a Gaussian process of the same pushes. It knows nothing of how far a push goes, so it is asked for whole
          pushes only, as it has learned from.

How many pushes each needs: `curve`, of point predictions and of one normal distribution about them.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.stats import multivariate_normal

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._kept import Kept
from pushjax.experiments._predicted import (
    LEVELS,
    Scored,
    density_ratio,
    effective,
    errors,
    normal_draws,
    reach,
    scored,
)
from pushjax.experiments.table1 import gaussian_process
from pushjax.experiments.table1.conditions import APART, OBJECTS, chosen, load, straight
from pushjax.experiments.table1.methods import LEARNED, TESTED, UNKNOWNS, Setting, fitted, own
from pushjax.report import envelope

STEPS = 25
FOLDS, FOLD = 3, 48  # parts, and pushes in each at most
# For the levels: predicted from fewer pushes, what happens looks rarer than it is.
FINE_FOLDS, FINE_FOLD = 12, 12
DRAWS = 200
# Cells of which compiled programs are kept. A process may hold 65 530 pieces of memory (Linux, as it comes), a program
# has thousands; beyond, LLVM ends the process.
TOGETHER = 6
COUNTS = (10, 20, 40, 80, 128)  # pushes to learn from
CURVE_TESTS = 0.3  # share of all whole pushes
FORMAT = 2  # of cells: those kept by another are of another method


def run(
    folder: Path,
    seed: int = 0,
    out: Path | None = None,
    steps: int = STEPS,
    surface: Sequence[str] | None = None,
    object: Sequence[str] = OBJECTS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """A cell for each surface and object: of each method and push the energy score (mm), the logarithm of the density
    (per cubic metre of x, y, length * theta), and whether the regions of 50 and 90 % hold what happened; for `middle`,
    the pushes that table 1 tests, and for `whole`, the same pushes from beginning to end.

    folder, surface, object: as of table 1. Raises as it does, and ValueError without scikit-learn.
    """
    surface = chosen(folder, surface, object)
    settings = {"seed": seed, "steps": steps, "version": pj.__version__, "format": FORMAT}
    kept = Kept(None if out is None else out / "table1-spread-cells.json", settings)
    cells, total, computed = [], len(surface) * len(object), 0
    for log in (load(folder, on, target, seed) for on in surface for target in object):
        labels = {"surface": log.surface, "object": log.shape}
        cell = kept.find(labels)
        if cell is None:
            begin = time.perf_counter()
            found = _cell(log, Setting.of(log, "quartic", steps), steps, seed)
            cell = kept.add(labels | found | {"run_s": time.perf_counter() - begin})
            computed += 1
            if computed % TOGETHER == 0:
                jax.clear_caches()
        cells.append(cell)
        progress(len(cells), total)
    paper = [cell for cell in cells if cell["object"] not in APART]
    pooled = {
        group: _pooled([cell[group] for cell in paper], [cell["levels_of"][group] for cell in paper])
        for group in ("middle", "whole")
        if paper
    }
    curve = _mean_curve([cell["curve"] for cell in paper])
    pictures = [] if out is None or not paper else [_draw(pooled, curve, out)]
    kept.forget()
    settings |= {"surfaces": list(surface), "objects": list(object)}
    return envelope("table1-spread", settings, cells=cells, pooled=pooled, curve=curve, pictures=pictures)


def _cell(log: MitPushes, setting: Setting, steps: int, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    slider, hand, length = setting.slider, setting.hand, setting.length
    rows = rng.permutation(np.flatnonzero(log.learned & log.whole.valid))
    of_rest, held = _crossed(log, setting, rows, steps, FOLDS, FOLD)
    first, *keys = jax.random.split(jax.random.key(seed), 6)
    noise = pj.identify_noise(first, of_rest, held, slider, hand, score="density")
    every = pj.Unknowns((0.0, 1.0), **UNKNOWNS)
    found = fitted(setting.coarse, setting, every)
    off = own(errors(_ends(of_rest, held, setting), np.asarray(held.end), np.asarray(held.start)), held)
    predicted = noise.about(found)
    process = gaussian_process.learn(log.whole, rows, length)
    first, *keys = keys
    levels, far = _held(first, log, setting, noise, rows, steps)
    groups = {"middle": setting.tested, "whole": straight(log, log.whole, log.middle_of, steps, TESTED)}
    cell: dict[str, Any] = {"learned": len(rows), "tested": len(log.middle)}
    numbers: dict[str, Any] = {name: float(getattr(noise, name)) for name in ("dof", "offset", "sigma", "tails")}
    spread = float(predicted.friction[1] - found.friction)
    cell["noise"] = numbers | {"relative": np.asarray(noise.relative), "spread": spread}
    cell |= {"held_level": levels, "levels_of": {}}
    for k, (group, pushes) in enumerate(groups.items()):
        ends, start = own(pushes.end, pushes), own(pushes.start, pushes)
        draws = own(predicted.predict(keys[k], pushes, slider, hand, DRAWS), pushes)
        density = own(predicted.log_density(keys[2 + k], pushes, slider, hand, DRAWS), pushes)
        methods = {"noise": scored(draws, ends, length)._replace(density=density)}
        weights = density_ratio(far, reach(draws, start, length))
        methods["calibrated"] = methods["noise"].calibrated(levels, weights)
        cell["levels_of"][group] = effective(weights[0])
        point = own(_ends(found, pushes, setting), pushes)
        seen = errors(point, ends, start)
        scale = np.array([1, 1, length])
        normal: Any = multivariate_normal  # its types want a number
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
    cell["curve"] = _curve(log, setting, steps, rng)
    return cell


def _held(
    key: PRNGKeyArray, log: MitPushes, setting: Setting, noise: pj.Noise, rows: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of the pushes to learn from, each predicted from nearly all others: levels, and the reach predicted."""
    of_rest, held = _crossed(log, setting, rows, steps, FINE_FOLDS, FINE_FOLD)
    draws = own(noise.about(of_rest).predict(key, held, setting.slider, setting.hand, DRAWS), held)
    there = scored(draws, own(held.end, held), setting.length)
    return there.level, reach(draws, own(held.start, held), setting.length)


def _crossed(
    log: MitPushes, setting: Setting, rows: np.ndarray, steps: int, count: int, most: int
) -> tuple[pj.Identified, pj.Pushes]:
    """What the rest of the pushes tells about each of `count` parts, and the parts, of `most` pushes at most."""
    parts = np.array_split(rows, count)
    rest = [straight(log, log.whole, np.setdiff1d(rows, part), steps, LEARNED) for part in parts]
    held = pj.Pushes.conditions([straight(log, log.whole, part, steps, most) for part in parts])
    # each part's own, as if they were of different objects
    apart = pj.Unknowns((0.0, 1.0), **UNKNOWNS, shared=())
    return fitted(pj.Pushes.conditions(rest), setting, apart), held


def _ends(found: pj.Identified, pushes: pj.Pushes, setting: Setting) -> np.ndarray:
    return np.asarray(found.predict(pushes, setting.slider, setting.hand).pose[..., -1, :], np.float64)


def _deviation_mm(predicted: np.ndarray, ends: np.ndarray, length: float) -> float:
    return float(1e3 * np.mean(np.asarray(pj.deviation(predicted, ends, length), np.float64)))


def _per_push(each: Scored) -> dict[str, Any]:
    inside = {f"inside_{100 * level:g}": each.inside[:, k] for k, level in enumerate(LEVELS)}
    return {"energy_mm": 1e3 * each.energy, "log_density": each.density, "level": each.level} | inside


def _curve(log: MitPushes, setting: Setting, steps: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Physics and Gaussian process from few pushes and from many, of the same: whole ones, in any order."""
    rows = rng.permutation(np.flatnonzero(log.whole.valid))
    tests = np.sort(rows[: min(round(CURVE_TESTS * len(rows)), TESTED)])
    rest, length, found = rows[len(tests) :], setting.length, []
    tested = straight(log, log.whole, tests, steps, TESTED)
    ends = log.whole.end[tests]
    for count in (count for count in COUNTS if count <= len(rest)):
        learned = straight(log, log.whole, rest[:count], steps, LEARNED)
        physics = fitted(learned, setting, pj.Unknowns((0.0, 1.0), **UNKNOWNS))
        point = own(_ends(physics, tested, setting), tested)
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
    """Of all pushes: means; standard errors of the shares; and against `noise`, pairs of the same push. seen: of how
    many pushes, were their weights equal, each cell's calibrated levels are, which have an error of their own."""
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
    """Over objects, for counts that all have."""
    rows = []
    for count in COUNTS:
        mine = [row for curve in curves for row in curve if row["count"] == count]
        if mine and len(mine) == len(curves):
            rows.append({name: float(np.mean([row[name] for row in mine])) for name in mine[0]} | {"count": count})
    return rows


def _draw(pooled: dict[str, dict[str, dict[str, Any]]], curve: list[dict[str, Any]], out: Path) -> str:
    from pushjax import plot

    return str(plot.save(plot.spread_figure(pooled, curve), out / "table1_spread.png"))


def summary(record: dict[str, Any]) -> str:
    """What the command prints."""
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
