"""What tables of predicted against measured pushes share: splits, floor, the figures of a cell, report and picture."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import pushjax as pj
from pushjax.datasets import Recordings
from pushjax.experiments._report import Table, table
from pushjax.experiments._slider_options import MODELS, fitted_surface
from pushjax.geometry.se2_numpy import compose, inverse
from pushjax.plot.style import BLUE, ORANGE, STYLE

SUPPORT_POINTS = 150  # that stand for uniform pressure
SPLITS, BOOTSTRAP_SAMPLES = 10, 2000
# The hatch distinguishes the models in grayscale.
BARS: dict[str, dict[str, Any]] = {"quartic": {"color": BLUE}, "ellipsoid": {"color": ORANGE, "hatch": "////"}}
Cell = dict[str, Any]  # labels and figures of one condition, model and method


class Prediction(NamedTuple):
    """Predictions of the pushes of one condition in each split."""

    errors: np.ndarray  # (splits, pushes), deviations of the final poses, mm
    friction: np.ndarray  # (splits,), coefficient of friction that was learned
    failed: int  # number of failed steps
    found: pj.Identified | None = None  # None if the method identifies nothing else


def check_chosen(name: str, given: Sequence[str], allowed: Iterable[str]) -> None:
    """Raise ValueError unless one or more of the allowed words are given."""
    unknown = [one for one in given if one not in allowed]
    if unknown or not given:
        raise ValueError(f"{name} must be one or more of {', '.join(allowed)}; got {unknown or 'none'}")


def polygon(log: Recordings) -> pj.Polygon:
    """Return the outline of the object."""
    assert log.vertices is not None  # known for the objects of all tables
    return pj.Polygon(log.vertices)


def ideal_surface(log: Recordings, model: str, seed: int) -> pj.LimitSurface:
    """Fit a limit surface to pairs of the known support, whose points have the loads that statics gives them.

    Args:
        log: The pushes of a condition. Without support points the pressure is uniform.
        model: "quartic" or "ellipsoid".
        seed: Seed of the wrench-twist pairs.
    """
    points, force = log.support_points, log.support_force
    if points is None or force is None or len(points) == 0:
        support = pj.Support.uniform(polygon(log), SUPPORT_POINTS)
    else:
        support = pj.Support.points(points, force / np.sum(force))
    return fitted_surface(support, model, seed)


def measured_surface(log: Recordings, model: str, length: Any) -> pj.LimitSurface:
    """Fit a limit surface to the wrenches and twists that were measured during pushes."""
    wrench, twist = (
        jnp.asarray(np.concatenate([getattr(push, name) for push in log.pushes]), jnp.result_type(float))
        for name in ("wrench", "twist")
    )
    return pj.fit_limit_surface(wrench, twist, length, degree=MODELS[model])


@jax.jit
def final_poses(slider: pj.Slider, hand: pj.Hand, pushes: pj.Pushes, frictions: jax.Array):
    """Simulate pushes at every friction: poses (frictions, pushes, 3), failed steps and whether the hand stopped."""

    def final_pose(path, start, friction):
        push = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return push.pose[-1], jnp.sum(push.failed), push.stopped >= 0

    over_pushes = jax.vmap(final_pose, in_axes=(0, 0, None))
    return jax.vmap(over_pushes, in_axes=(None, None, 0))(pushes.path, pushes.start, frictions)


def padded(pushes: pj.Pushes, batch: int) -> pj.Pushes:
    """Return pushes with the first one repeated, at weight zero, up to the number `batch`."""
    # One compiled program serves all logs that are padded to the same number.
    count = len(pushes.start)
    if batch < count:
        raise ValueError(f"batch must be at least {count}; got {batch}")
    rows = np.arange(batch)
    repeated = jax.tree.map(lambda leaf: leaf[np.where(rows < count, rows, 0)], pushes)
    return repeated.weighted((rows < count).astype(float))


def deviation_mm(final, end, length: float | None) -> np.ndarray:
    """Return the deviations (...,), mm, of final poses (..., 3) from the measured ones."""
    assert length is not None  # known for the objects of all tables
    return 1e3 * np.asarray(pj.deviation(final, end, length), np.float64)


def no_motion_mm(log: Recordings) -> np.ndarray:
    """Return the deviations (n,), mm, if nothing moves."""
    return deviation_mm(log.start, log.end, log.length)


def relative_motions(log: Recordings) -> np.ndarray:
    """Return the end poses (n, 3) in the frames of the starts, in which repetitions are the same push."""
    return compose(inverse(log.start), log.end)


def repetitions(action: np.ndarray) -> np.ndarray:
    """Return a mask (n, n) of the pairs of different pushes of the same action."""
    return (action[:, None] == action) & ~np.eye(len(action), dtype=bool)


def repetition_floor_mm(moved: np.ndarray, same: np.ndarray, length: float | None) -> np.ndarray:
    """Estimate how far pushes are from the mean of their action; those without a repetition (`same`) are left out."""
    count = same.sum(axis=1)
    others = same @ moved / np.maximum(count, 1)[:, None]
    # The mean of all k repetitions is estimated from the other k - 1, which makes the deviation too large by
    # sqrt(k / (k - 1)).
    return (deviation_mm(moved, others, length) * np.sqrt(count / (count + 1)))[count > 0]


def training_masks(group: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return masks (splits, pushes) of the training pushes of random splits; a group (n,) is never divided."""
    # with a share between one and three quarters, two or more groups are never all on one side
    groups = np.unique(group)
    count = round(share * len(groups))
    return np.stack([np.isin(group, rng.permutation(groups)[:count]) for _ in range(SPLITS)])


def best_setting(errors: np.ndarray, trains: np.ndarray) -> int:
    """Return the setting whose deviations (settings, pushes) of the training pushes are least in the mean."""
    return int(np.argmin(errors[:, trains].mean(axis=1)))


def per_push(errors: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Average deviations (splits, n) over the splits that tested each push; NaN if none did."""
    return np.ma.array(errors, mask=~test).mean(axis=0).filled(np.nan)


def split_figures(
    found: Prediction,
    test: np.ndarray,  # (splits, pushes), which pushes are tested
    no_motion: np.ndarray,  # (pushes,), deviations if nothing moves, mm
    rng: np.random.Generator,
    group: np.ndarray | None = None,  # (pushes,), of pushes that are sampled together; None: each alone
) -> dict[str, Any]:
    """Return the figures of one cell: those of the tested pushes, over all splits."""
    means = [error[tested].mean() for error, tested in zip(found.errors, test, strict=True)]
    error = per_push(found.errors, test)
    seen = np.isfinite(error)
    spread = float(1.96 * np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else None
    return {
        "mean_mm": float(np.mean(means)),
        "ci95_mm": spread,  # over splits alone
        "ci95_bootstrap_mm": bootstrapped_ci95(error[seen], rng, None if group is None else group[seen]),
        "median_mm": float(np.median(error[seen])),
        "worst_mm": float(error[seen].max()),
        "no_motion_mm": float(np.mean([no_motion[tested].mean() for tested in test])),
        "friction": float(np.mean(found.friction)),
        "pushes": test.shape[1],
        "splits": len(test),
        "failed_steps": found.failed,
    }


def bootstrapped_ci95(values: np.ndarray, rng: np.random.Generator, group: np.ndarray | None = None) -> float:
    """Return half the bootstrapped 95 % interval of the mean of values (n,), sampled one by one or by group."""
    place = np.arange(len(values)) if group is None else np.unique(group, return_inverse=True)[1]
    total, count = np.bincount(place, values), np.bincount(place)
    resampled = rng.integers(len(total), size=(BOOTSTRAP_SAMPLES, len(total)))
    means = total[resampled].sum(axis=1) / count[resampled].sum(axis=1)
    return float(np.diff(np.quantile(means, [0.025, 0.975]))[0] / 2)


def mean_rows(cells: Sequence[Cell], paper_percent: dict[str, float], left_out: Sequence[str] = ()) -> list[Cell]:
    """Return the means over cells by method and model, for each surface and all; the paper's percentage is over all."""
    counted = [cell for cell in cells if cell["mean_mm"] is not None and cell["object"] not in left_out]
    rows = []
    for method, model in dict.fromkeys((cell["method"], cell["model"]) for cell in counted):
        mine = [cell for cell in counted if (cell["method"], cell["model"]) == (method, model)]
        for surface in (*dict.fromkeys(cell["surface"] for cell in mine), "all"):
            some = [cell for cell in mine if surface in (cell["surface"], "all")]
            values: dict[str, list[Any]] = {
                key: [cell.get(key) for cell in some] for key in ("mean_mm", "paper_mm", "toolbox_mm")
            }
            figures = {key: None if None in each else float(np.mean(each)) for key, each in values.items()}
            figures["percent"] = float(100 * np.mean([cell["mean_mm"] / cell["no_motion_mm"] for cell in some]))
            labels = {"method": method, "model": model, "surface": surface, "conditions": len(some)}
            rows.append(labels | figures | {"paper_percent": paper_percent[model]})
    return rows


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a table of the paper: its cells and their means, beside the paper's."""
    parts: list[str | Table] = [
        "Mean deviation of the test pushes:",
        table(
            record["cells"],
            ("method", "method"),
            ("model", "model"),
            ("surface", "surface"),
            ("object", "object"),
            ("mean / mm", mean_with_interval),
            ("paper / mm", "paper_mm", ".2f"),
            ("no motion / mm", "no_motion_mm", ".2f"),
            ("paper, no motion / mm", "paper_no_motion_mm", ".2f"),
            ("repeats differ / mm", "noise_floor_mm", ".2f"),
        ),
        table(
            record["means"],
            ("means", "method"),
            ("model", "model"),
            ("surface", "surface"),
            ("conditions", "conditions"),
            ("mean / mm", "mean_mm", ".2f"),
            ("paper / mm", "paper_mm", ".2f"),
            ("authors' toolbox / mm", "toolbox_mm", ".2f"),
            ("part of the motion / %", "percent", ".2f"),
            ("paper, all surfaces / %", "paper_percent", ".2f"),
        ),
    ]
    if any(cell["mean_mm"] is None for cell in record["cells"]):
        parts.append("A cell with words could not be computed, for the reason that it gives; the means leave it out.")
    return [*parts, *failures(record["cells"]), "The interval is of the mean over pushes, by bootstrap."]


def mean_with_interval(cell: Cell) -> str:
    """Return the mean deviation of a cell with its interval, or why it has none."""
    if cell["mean_mm"] is None:
        return cell["missing"]
    return f"{cell['mean_mm']:.2f} ± {cell['ci95_bootstrap_mm']:.2f}"


def failures(cells: Sequence[Cell]) -> list[str]:
    """Return a note on the steps that failed, if there are any."""
    failed = sum(cell.get("failed_steps", 0) for cell in cells)
    return [f"{failed} steps failed; there the object was left where it was (see the JSON)."] if failed else []


def table_pictures(name: str, cells: Sequence[Cell], title: str) -> dict[str, Figure]:
    """Draw the cells of each method, by the names of the files."""
    methods = dict.fromkeys(cell["method"] for cell in cells)
    return {
        f"{name}_{method}.png": table_figure(
            [cell for cell in cells if cell["method"] == method], f"{title} ({method.replace('_', '-')})"
        )
        for method in methods
    }


def table_figure(cells: Sequence[Cell], title: str) -> Figure:
    """Draw mean deviations by condition, with their intervals and the paper's, one group of bars per condition."""
    with plt.rc_context(STYLE):
        conditions = list(dict.fromkeys((cell["surface"], cell["object"]) for cell in cells))
        size = max(8.6, 0.6 * len(conditions)), 3.8
        figure, axes = plt.subplots(figsize=size, layout="constrained")
        above = axes.get_xaxis_transform()  # x in data, y as a share of the height
        for k, (model, style) in enumerate(BARS.items()):
            of_model = [cell for cell in cells if cell["model"] == model]
            if not of_model:
                continue
            x = np.arange(len(conditions)) + (k - 0.5) * 0.36
            for place, cell in zip(x, of_model, strict=True):
                if cell["mean_mm"] is None:
                    up = {"rotation": 90, "ha": "center", "va": "bottom", "size": 7}
                    axes.text(place, 0.02, cell["missing"], transform=above, **up)
            height, error, paper = (
                np.array([cell.get(key) for cell in of_model], float)
                for key in ("mean_mm", "ci95_bootstrap_mm", "paper_mm")
            )
            edge: dict[str, Any] = {"edgecolor": "white", "linewidth": 0, "ecolor": "0.25", "capsize": 2}
            axes.bar(x, height, 0.34, yerr=error, label=f"{model}, this run", **style, **edge)
            axes.plot(x, paper, "_", color="black", ms=13, mew=1.8, label="the paper" if k == 0 else None)
        axes.set_xticks(np.arange(len(conditions)), [name for _, name in conditions])
        surfaces = np.array([surface for surface, _ in conditions])
        for surface in dict.fromkeys(surfaces.tolist()):
            middle = float(np.mean(np.flatnonzero(surfaces == surface)))
            axes.text(middle, -0.15, surface, transform=above, ha="center", va="center")
        axes.set(ylabel="mean deviation / mm", title=title)
        axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))
        return figure
