"""Does the predicted spread of a push rank how much its repetitions on the MIT robot differ.

The robot made each push of nine objects on abs twice, at 10 and at 20 mm/s. Half of the squared distance between the
two final poses, seen from the starts, is an estimate of the variance of the pose. The prediction knows nothing of it:
friction and limit surface are identified from the training pushes as in table 1, and are then sampled around that, with
the same degrees of freedom and range of friction for all objects.

Rank correlations are Spearman's. Two repetitions say little about one action, so no prediction can rank them perfectly.
`attainable` is the correlation if the predicted distributions were true: for pairs of draws in place of the robot.

- `spread`: root mean square distance of sampled final poses from their mean.
- `motion`: how far the push is predicted to move the object. Pushes that go far scatter more, whatever the reason.
- `spread at equal motion`: partial rank correlation of the spread, with the motion held fixed.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import rankdata

import pushjax as pj
from benchmarks.robot import DataFolder, Objects
from pushjax._internal.checks import check_count
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.cli.main import data_folder
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._record import result_record
from pushjax.experiments.table1.conditions import NOT_IN_PAPER, OBJECTS, load, padded_pushes
from pushjax.experiments.table1.methods import TEST_SIZE, UNKNOWNS, ConditionData, fitted, without_padding
from pushjax.experiments.table1.repeats import relative_motions
from pushjax.identification.predictive import NoiseParameters, PredictiveModel, predict

SURFACE, STEPS = "abs", 25  # only on abs pushes were repeated
PAIRS = 16  # pairs of draws for `attainable`
RESAMPLED = 2000
FIGURES = ("spread", "motion", "spread at equal motion", "attainable")


def run(
    data: DataFolder = None,
    seed: int = 0,
    draws: int = 64,
    dof: float = 20.0,
    half_width: float = 0.1,
    object: Objects = OBJECTS,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Compare the predicted spread of repeated pushes with the measured one.

    Args:
        data: Folder of the recorded pushes, as for table 1. Default: the environment variable PUSHJAX_DATA.
        seed: Seed of all sampling.
        draws: Number of samples of friction for each push.
        dof: Degrees of freedom of the limit surface.
        half_width: Half of the width of the range of friction, around the identified one.
        object: Names of the objects, as for table 1. Default: all. Those without repetitions are left out.
        progress: Called with the number of objects done and their total.

    Returns:
        The record, with a row for each object and one for all but tri2: the rank correlations with their 95 %
        intervals, and the root mean squares of the measured and the predicted spread.

    Raises:
        ValueError: As table 1 does, and if no object has repetitions.
    """
    check_count("draws", draws)
    if draws < 2 * PAIRS:
        raise ValueError(f"draws must be at least {2 * PAIRS}; got {draws}")
    folder, rng, rows, pooled = data_folder(data), np.random.default_rng(seed), [], []
    for k, name in enumerate(object):
        log = load(folder, SURFACE, name, seed)
        if len(log.repeats):
            found = _repetitions(jax.random.key(seed + k), log, draws, dof, half_width)
            rows.append({"object": name} | _figures([found], rng))
            pooled += [] if name in NOT_IN_PAPER else [found]
        progress(k + 1, len(object))
    if not rows:
        raise ValueError(f"object: none of {', '.join(object)} has repetitions on {SURFACE}")
    if len(pooled) > 1:
        rows.append({"object": "all"} | _figures(pooled, rng))
    settings = {"surface": SURFACE, "draws": draws, "dof": dof, "half_width": half_width, "seed": seed, "steps": STEPS}
    return result_record("mit-repetitions", settings, rows=rows)


def _repetitions(key: Any, log: MitPushes, draws: int, dof: float, half_width: float) -> np.ndarray:
    """Return measured and predicted spread, predicted motion, and spreads of pairs of draws, (actions, columns), m."""
    pairs = log.repeats[log.fast.valid[log.repeats[:, 0]] & log.whole.valid[log.repeats[:, 1]]]
    fast, slow = relative_motions(log.fast)[pairs[:, 0]], relative_motions(log.whole)[pairs[:, 1]]
    scale = np.array([1, 1, log.length])
    measured = np.linalg.norm((fast - slow) * scale, axis=1) / np.sqrt(2)
    condition = ConditionData.of(log, "quartic", STEPS)
    found = fitted(condition.coarse, condition, pj.Unknowns((0.0, 1.0), **UNKNOWNS))
    pushes = padded_pushes(log, log.whole, pairs[:, 1], STEPS, TEST_SIZE)
    dtype = pushes.path.dtype
    mu = jnp.maximum(found.friction + half_width * jnp.array([[-1.0, 1.0]], dtype), 0)
    none, many = jnp.zeros((), dtype), jnp.asarray(1e3, dtype)
    friction_only = NoiseParameters(jnp.asarray(dof, dtype), mu, none, none, jnp.zeros(2, dtype), many)
    model = PredictiveModel.of(found, pushes, condition.slider, condition.hand, "sum_of_squares")
    ends = without_padding(predict(key, model, friction_only, draws)[0], pushes) * scale
    spread = np.sqrt(np.sum(np.var(ends, axis=1, ddof=1), axis=-1))
    motion = np.linalg.norm(ends.mean(axis=1) - without_padding(pushes.start, pushes) * scale, axis=1)
    one, other = ends[:, :PAIRS], ends[:, PAIRS : 2 * PAIRS]
    simulated = np.linalg.norm(one - other, axis=-1) / np.sqrt(2)
    return np.concatenate([np.stack([measured, spread, motion], axis=1), simulated], axis=1)


def _figures(objects: list[np.ndarray], rng: np.random.Generator) -> dict[str, Any]:
    """Return the correlations over the actions of some objects; intervals are by resampling the actions of each."""
    every = np.concatenate(objects)
    resampled = [
        _correlations(np.concatenate([each[rng.integers(len(each), size=len(each))] for each in objects]))
        for _ in range(RESAMPLED)
    ]
    low, high = np.percentile(resampled, [2.5, 97.5], axis=0)
    values = _correlations(every)
    simulated = [_spearman(every[:, 1], every[:, 3 + k]) for k in range(PAIRS)]
    correlations = {
        name: {"value": float(value), "interval": [float(a), float(b)]}
        for name, value, a, b in zip(FIGURES[:3], values, low, high, strict=True)
    }
    correlations["attainable"] = {"value": float(np.mean(simulated)), "interval": None}
    # pushes whose spread the prediction calls small, and those it calls large
    order = np.argsort(every[:, 1])
    thirds = [1e3 * float(np.median(every[part, 0])) for part in np.array_split(order, 3)]
    rms = 1e3 * np.sqrt(np.mean(every[:, :2] ** 2, axis=0))
    spreads = {"measured_mm": float(rms[0]), "predicted_mm": float(rms[1]), "medians_of_thirds_mm": thirds}
    return {"actions": len(every), "correlations": correlations} | spreads


def _correlations(rows: np.ndarray) -> tuple[float, float, float]:
    """Return the rank correlations of the measured spread with the first three of `FIGURES`."""
    measured, spread, motion = rows[:, 0], rows[:, 1], rows[:, 2]
    with_spread, with_motion, between = (
        _spearman(a, b) for a, b in ((measured, spread), (measured, motion), (spread, motion))
    )
    rest = np.sqrt((1 - with_motion**2) * (1 - between**2))
    return with_spread, with_motion, (with_spread - with_motion * between) / rest if rest > 0 else 0.0


def _spearman(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints."""
    titles = "".join(f"{name:>24}" for name in FIGURES)
    lines = ["rank correlation with the measured spread of two repetitions, and its 95 % interval"]
    lines.append(f"{'object':8}{'actions':>8}{titles}{'spread (measured, predicted) / mm':>36}")
    for row in record["rows"]:
        cells = ""
        for name in FIGURES:
            each = row["correlations"][name]
            interval = each["interval"]
            text = f"{each['value']:.2f}" + (f" ({interval[0]:.2f} to {interval[1]:.2f})" if interval else "")
            cells += f"{text:>24}"
        spreads = f"{row['measured_mm']:.2f}, {row['predicted_mm']:.2f}"
        lines.append(f"{row['object']:8}{row['actions']:8}{cells}{spreads:>36}")
    return "\n".join(lines)
