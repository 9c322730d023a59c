"""Distribution of the displacement of one square in many pushes under random friction.

The 90 mm square of the MIT data set is pushed 2000 times by the data set's round tip. The pushes differ only in
friction. The limit surface is a quartic whose Gram matrix has a Wishart distribution with 20 degrees of freedom. The
coefficient of friction at the contact is uniform in [0.15, 0.35]. Zhou et al. leave open where the tip touches and in
how many steps it moves. Here it touches 70 % along the side and moves in `STEPS` steps.

Reference: Zhou et al. 2017, section VI.B, figures on pushing with stochasticity; the setting of Yu et al. 2016, figures
9 and 10.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.stats
from matplotlib.figure import Figure

import pushjax as pj
from pushjax import plot
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, saved, table
from pushjax.experiments._slider_options import PAIRS, fitted_surface
from pushjax.plot.style import STYLE
from pushjax.simulation.monte_carlo_result import COORDINATES
from pushjax.testing.convexity import least_curvatures

SIDE, RADIUS = 0.09, 0.00475  # m
ALONG, TRAVEL = 0.018, 0.05  # m: distance of the tip from the middle of the side, and its travel
SUPPORT_POINTS = 64
N, STEPS, DOF, FRICTION = 2000, 200, 20.0, (0.15, 0.35)
HISTOGRAM_BINS, MAX_PLOTTED, MIN_PUSHES = 40, 2000, 20
SETUP = {"side_m": SIDE, "radius_m": RADIUS, "along_m": ALONG, "travel_m": TRAVEL}
SETUP |= {"support_points": SUPPORT_POINTS, "pairs": PAIRS}
SURFACES_AT_ONCE = 2000  # surfaces that are sampled together
# A surface counts as convex if its least curvature, relative to its largest coefficient, is at least this. It is not
# zero because the coefficients are rounded to float32.
MIN_CURVATURE = -3e-7
# Of each coordinate: the factor from m or rad to the unit in which it is shown, and the label of its axis.
LABELS = {"x": (1e3, "Δx / mm"), "y": (1e3, "Δy / mm"), "theta": (180 / np.pi, "Δθ / °")}


def push_setup(seed: int, steps: int) -> tuple[pj.Slider, pj.Hand, jax.Array]:
    """Return the square with its quartic, the finger, and the path (steps + 1, 2) of its center, m."""
    block = pj.Polygon.rectangle(SIDE, SIDE)
    slider = pj.Slider(block, fitted_surface(pj.Support.uniform(block, points=SUPPORT_POINTS), "quartic", seed))
    start = -SIDE / 2 - RADIUS
    return slider, pj.Hand.finger(RADIUS), pj.line((start, ALONG), (start + TRAVEL, ALONG), steps)


def run(
    seed: int = 0,
    out: Path | None = None,
    n: int = N,
    steps: int = STEPS,
    dof: float = DOF,
    friction: tuple[float, float] = FRICTION,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Sample the pushes and describe the distribution of the square's displacement.

    Args:
        seed: Seed of the wrench-twist pairs; the pushes use `seed + 1`.
        out: Folder for the pictures. None: no pictures.
        n: Number of pushes, at least 20.
        steps: Steps of each push.
        dof: Degrees of freedom of the quartic's Gram matrix.
        friction: Lowest and highest coefficient of friction at the contact.
        progress: Called with the number of pushes done and their total.

    Returns:
        The record: moments, histogram and test of normality of each coordinate of the displacement (m, rad), and their
        correlations; how many sampled surfaces are not convex, the share of them that was repaired, and the mean
        shrinkage of these (see `SurfaceSample`); the outcomes; and the times of the run and of compiling, s.

    Raises:
        ValueError: If there are too few pushes for a test of normality.
    """
    if n < MIN_PUSHES:
        raise ValueError(f"n must be at least {MIN_PUSHES}, for a test of normality; got {n}")
    slider, hand, path = push_setup(seed, steps)
    model, key, all_plotted = pj.FrictionModel(dof=dof, friction=friction), jax.random.key(seed + 1), n <= MAX_PLOTTED
    arguments = (key, n, slider, hand, path)
    options: dict[str, Any] = {"pose": jnp.zeros(3), "model": model, "trajectories": all_plotted}
    first_run = pj.monte_carlo(*arguments, **options, progress=progress)  # includes compiling
    pushes = pj.monte_carlo(*arguments, **options)
    delta = np.asarray(pushes.delta, np.float64)
    described = {name: _describe_coordinate(delta[:, k]) for k, name in enumerate(COORDINATES)}

    def figures() -> dict[str, Figure]:
        # with the same key, fewer pushes are the first ones
        shown = {**options, "trajectories": True}
        drawn: Any = pushes if all_plotted else pj.monte_carlo(key, MAX_PLOTTED, slider, hand, path, **shown)
        title = f"{n} pushes" + ("" if all_plotted else f", {MAX_PLOTTED} drawn")
        cloud = plot.cloud_figure(slider.shape, hand, np.asarray(path), drawn.trajectory, title)
        return {"stochastic_push.png": cloud, "stochastic_push_histograms.png": _histograms(described)}

    return result_record(
        "stochastic-push",
        {"seed": seed, "steps": steps, "dof": dof, "friction": friction} | SETUP,
        n=n,
        delta=described,
        correlation=np.corrcoef(delta.T),
        nonconvex=int(np.sum(~(_curvatures(key, model, slider.surface, n) >= MIN_CURVATURE))),
        repaired=float(np.mean(pushes.shrinkage > 0)),
        mean_shrinkage=pushes.summary()["repaired"]["mean_shrinkage"],
        outcomes=pushes.outcomes(),
        run_s=pushes.seconds,
        compile_s=first_run.seconds - pushes.seconds,
        pictures=saved(out, figures),
    )


def _describe_coordinate(values: np.ndarray) -> dict[str, Any]:
    """Return the moments, the histogram and a test of normality of one coordinate (n,) of the displacement."""
    counts, edges = np.histogram(values, bins=HISTOGRAM_BINS)
    test = scipy.stats.normaltest(values)
    normality = {"skewness": scipy.stats.skew(values), "excess_kurtosis": scipy.stats.kurtosis(values)}
    normality |= {"statistic": test.statistic, "p_value": test.pvalue}
    moments = {"mean": values.mean(), "std": values.std(ddof=1)}
    return moments | {"edges": edges, "counts": counts, "normality": normality}


def _curvatures(key: jax.Array, model: pj.FrictionModel, surface: Any, n: int) -> np.ndarray:
    """Return the least curvatures (n,) of the sampled surfaces, sampled again with `monte_carlo`'s keys."""
    distribution: Any = model.around(surface)

    def sampled_coefficients(index):
        return distribution.sample(jax.random.split(jax.random.fold_in(key, index))[0]).surface.coefficients

    chunk, program, curvatures = min(n, SURFACES_AT_ONCE), jax.jit(jax.vmap(sampled_coefficients)), []
    for begin in range(0, n, chunk):
        indices = np.minimum(np.arange(begin, begin + chunk), n - 1).astype(np.uint32)
        curvatures.append(least_curvatures(np.asarray(program(indices)))[: n - begin])
    return np.concatenate(curvatures)


def _histograms(delta: dict[str, dict[str, Any]]) -> Figure:
    """Draw the histogram of each coordinate of the displacement, with the Gaussian of the same moments."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 3, figsize=(10.5, 3.0), layout="constrained")
        for axes, (name, (scale, label)) in zip(panels, LABELS.items(), strict=True):
            found = delta[name]
            counted = {"edges": scale * found["edges"], "counts": found["counts"]}
            mean, deviation = scale * found["mean"], scale * found["std"]
            plot.histogram_panel(axes, counted, label, gaussian=(mean, deviation))
            unit, p = label.split(" / ")[1], found["normality"]["p_value"]
            axes.set_title(f"{mean:.2f} ± {deviation:.2f} {unit}; normal: p = {p:.1g}")
        panels[0].legend()
        return figure


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    settings, failed = record["settings"], record["outcomes"]["failed"]
    rows = [record["delta"][name] | {"scale": scale, "label": label} for name, (scale, label) in LABELS.items()]
    return [
        f"{record['n']} pushes of a 90 mm square over {1e3 * TRAVEL:.0f} mm, dof {settings['dof']:g}, friction "
        f"{settings['friction'][0]:g} to {settings['friction'][1]:g}:",
        table(
            rows,
            ("motion", "label"),
            ("mean", lambda row: row["scale"] * row["mean"], ".2f"),
            ("deviation", lambda row: row["scale"] * row["std"], ".2f"),
            ("skewness", lambda row: row["normality"]["skewness"], ".2f"),
            ("excess kurtosis", lambda row: row["normality"]["excess_kurtosis"], ".2f"),
            ("normal: p", lambda row: row["normality"]["p_value"], ".2g"),
        ),
        f"Surfaces: {record['nonconvex']} not convex by an independent sweep, {record['repaired']:.1%} had been "
        f"repaired{f'; {failed} pushes failed' if failed else ''}.",
        f"Ran in {record['run_s']:.2f} s, after {record['compile_s']:.1f} s of compiling.",
    ]
