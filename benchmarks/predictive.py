"""How good predicted distributions are, on real pushes that nothing was learned from.

Of every split, friction, limit surface and calibration are identified from one part of the pushes, the noise from a
second, and the final poses of the third are predicted. Beside it: the best point prediction, with a normal distribution
of its errors on the second part, in the slider's own directions. Scores of the same pushes are compared in pairs; a
push may be in the third part of several splits, and counts once in standard errors.

    python benchmarks/predictive.py three-point --splits 5
    python benchmarks/predictive.py two-finger --splits 2 --pushes 60
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _measure import header

import pushjax as pj
from pushjax.datasets.two_finger import load_two_finger_npz
from pushjax.experiments._predicted import LEVELS, errors, normal_draws, scored
from pushjax.experiments.table2 import conditions, methods
from pushjax.experiments.two_finger import predictions

PARTS = (0.4, 0.7)  # where the second and the third begin
DRAWS = 500


class Case(NamedTuple):
    """pushes: of every condition. group: whose pushes must not be torn apart, one number each."""

    pushes: list[pj.Pushes]
    group: list[np.ndarray]
    slider: pj.Slider
    hand: pj.Hand
    unknowns: pj.Unknowns
    length: float


def three_point(folder: Path, steps: int, limit: int) -> Case:
    logs = [conditions.load(folder / "three_point_push", *condition) for condition in conditions.CONDITIONS]
    where = conditions.GEOMETRIES["nominal"]
    each = [conditions.ideal_surface(log, "quartic", jax.random.key(k)) for k, log in enumerate(logs)]
    surface = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    pushes = [conditions.recorded(log, where, steps) for log in logs]
    unknowns = pj.Unknowns((0.0, 1.0), dof=methods.DOF, inset=methods.INSET, end=methods.END)
    slider, hand = pj.Slider(conditions.outline(logs[0], where), surface), pj.Hand.finger(where.radius)
    return Case(pushes, [np.arange(len(p.weight)) for p in pushes], slider, hand, unknowns, logs[0].length)


def two_finger(folder: Path, steps: int, limit: int) -> Case:
    logs = [load_two_finger_npz(folder / "two_finger_push" / f"{name}.npz") for name in ("3pts1", "3pts3", "patch")]
    rng = np.random.default_rng(0)
    pushes, groups, each = [], [], []
    for k, log in enumerate(logs):
        actions = rng.permutation(np.unique(log.group))
        rows = np.flatnonzero(np.isin(log.group, actions[: np.searchsorted(_sizes(log.group, actions), limit) + 1]))
        pushes.append(pj.Pushes(log.pose_start[rows], log.paths(steps)[rows], log.pose_end[rows]))
        groups.append(log.group[rows])
        pairs = predictions.support(log).wrench_twist_pairs(jax.random.key(k), predictions.PAIRS)
        each.append(pj.fit_limit_surface(*pairs, degree=4))
    surface = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    unknowns = pj.Unknowns((0.0, 1.0), dof=methods.DOF, inset=0.002)
    slider = pj.Slider(pj.Polygon(logs[0].vertices), surface)
    return Case(pushes, groups, slider, pj.Hand.two_fingers(0.001), unknowns, logs[0].length)


def _sizes(group: np.ndarray, actions: np.ndarray) -> np.ndarray:
    return np.cumsum([np.sum(group == action) for action in actions])


def split(case: Case, rng: np.random.Generator) -> list[list[np.ndarray]]:
    """Rows of each condition, for each of the three parts."""
    parts: list[list[np.ndarray]] = [[], [], []]
    for group in case.group:
        actions = rng.permutation(np.unique(group))
        ends = [round(share * len(actions)) for share in PARTS]
        for part, mine in zip(parts, np.split(actions, ends), strict=True):
            part.append(np.flatnonzero(np.isin(group, mine)))
    return parts


def chosen(case: Case, rows: list[np.ndarray]) -> pj.Pushes:
    """Filled up to a multiple of eight, so that splits of about one size share a compiled program."""
    most = 8 * -(-max(len(mine) for mine in rows) // 8)
    filled = []
    for pushes, mine in zip(case.pushes, rows, strict=True):
        places = np.concatenate([mine, np.repeat(mine[:1], most - len(mine))])
        weight = np.arange(most) < len(mine)
        filled.append(jax.tree.map(lambda leaf, places=places: leaf[places], pushes).weighted(1.0 * weight))
    return pj.Pushes.conditions(filled)


def normal_errors(found: pj.Identified, case: Case, learned: pj.Pushes, tested: pj.Pushes, rng) -> np.ndarray:
    """Draws from the best point prediction, with its errors' normal distribution: (conditions, pushes, n, 3)."""

    def point(pushes):
        return np.asarray(found.predict(pushes, case.slider, case.hand).pose[..., -1, :], float)

    off = errors(point(learned), np.asarray(learned.end, float), np.asarray(learned.start, float))
    off = off[np.asarray(learned.weight) > 0]
    return normal_draws(rng, point(tested), np.asarray(tested.start, float), off, DRAWS)


def run(case: Case, seed: int, say) -> list[dict]:
    rng = np.random.default_rng(seed)
    first, second, third = split(case, rng)
    begun = time.perf_counter()
    found = pj.identify(chosen(case, first), case.slider, case.hand, case.unknowns, length=case.length)
    say(f"  split {seed}: identified in {time.perf_counter() - begun:.0f} s, sigma {1e3 * float(found.sigma):.2f} mm")
    begun = time.perf_counter()
    learned = chosen(case, second)
    noise = pj.identify_noise(jax.random.key(seed), found, learned, case.slider, case.hand)
    way, turn = 100 * np.asarray(noise.relative)
    values = f"dof {float(noise.dof):.1f}, spread {float(noise.friction[0, 1] - found.friction[0]):.2f}, hand "
    values += f"{1e3 * float(noise.offset):.2f} mm, pose {1e3 * float(noise.sigma):.2f} mm, {way:.1f} % of its way, "
    values += f"{turn:.1f} % of its turn, tails {float(noise.tails):.1f}"
    say(f"    noise in {time.perf_counter() - begun:.0f} s: {values}")
    tested = chosen(case, third)
    ours = np.asarray(noise.predict(jax.random.key(1000 + seed), tested, case.slider, case.hand, DRAWS))
    normal = normal_errors(found, case, learned, tested, rng)
    rows = []
    there = np.asarray(tested.weight) > 0
    each = [scored(draws[there], np.asarray(tested.end)[there], case.length) for draws in (ours, normal)]
    names = [(c, int(row)) for c, mine in enumerate(third) for row in mine]
    for k, name in enumerate(names):
        row = {"condition": name[0], "push": name[1], "seed": seed}
        for label, score in zip(("noise", "normal"), each, strict=True):
            row |= {f"{label}_energy_mm": 1e3 * float(score.energy[k]), f"{label}_log_density": float(score.density[k])}
            row |= {f"{label}_{level}": float(score.inside[k, i]) for i, level in enumerate(LEVELS)}
        rows.append(row)
    return rows


def by_push(rows: list[dict], name: str) -> np.ndarray:
    """The mean over splits, of each push."""
    pushes: dict[tuple, list[float]] = {}
    for row in rows:
        pushes.setdefault((row["condition"], row["push"]), []).append(row[name])
    return np.array([np.mean(values) for values in pushes.values()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=("three-point", "two-finger"))
    parser.add_argument("--splits", type=int, default=5)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--pushes", type=int, default=60, help="of each object, two-finger only")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("PUSHJAX_DATA", "../shared/data")))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    print(header())
    make = {"three-point": three_point, "two-finger": two_finger}[given.case]
    case = make(given.data, given.steps, given.pushes)
    rows = []
    for seed in range(given.splits):
        rows += run(case, seed, lambda line: print(line, flush=True))
        report(rows)
        if given.json is not None:
            given.json.write_text(json.dumps(rows, indent=1))


def report(rows: list[dict]) -> None:
    count = len(by_push(rows, "noise_0.5"))
    print(f"  {count} pushes, predicted {len(rows)} times")
    for label in ("noise", "normal"):
        parts = []
        for level in LEVELS:
            error = np.sqrt(level * (1 - level) / count)
            parts.append(f"{np.mean([row[f'{label}_{level}'] for row in rows]):.3f} (nominal {level}, +- {error:.3f})")
        energy, density = by_push(rows, f"{label}_energy_mm"), by_push(rows, f"{label}_log_density")
        print(f"  {label:7} holds {', '.join(parts)}; energy {energy.mean():.3f} mm; log density {density.mean():.2f}")
    for name, unit in (("energy_mm", "mm"), ("log_density", "")):
        apart = by_push(rows, f"noise_{name}") - by_push(rows, f"normal_{name}")
        error = apart.std(ddof=1) / np.sqrt(len(apart))
        print(f"  noise less normal, {name}: {apart.mean():.3f} +- {error:.3f} {unit}", flush=True)


if __name__ == "__main__":
    main()
