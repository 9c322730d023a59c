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
import numpy as np
import scipy.stats

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.simulation.monte_carlo_result import COORDINATES
from pushjax.testing.convexity import least_curvatures

SIDE, RADIUS = 0.09, 0.00475  # m
ALONG, TRAVEL = 0.018, 0.05  # m: distance of the tip from the middle of the side, and its travel
SUPPORT_POINTS, PAIRS = 64, 400
N, STEPS, DOF, FRICTION = 2000, 200, 20.0, (0.15, 0.35)
HISTOGRAM_BINS, MAX_PLOTTED, MIN_PUSHES = 40, 2000, 20
SURFACES_AT_ONCE = 2000  # surfaces that are sampled together
# A surface counts as convex if its least curvature, relative to its largest coefficient, is at least this. It is not
# zero because the coefficients are rounded to float32.
MIN_CURVATURE = -3e-7
# Of each coordinate: the factor from m or rad to the unit in which it is shown, and the label of its axis.
LABELS = {"x": (1e3, "Δx / mm"), "y": (1e3, "Δy / mm"), "theta": (180 / np.pi, "Δθ / °")}


def push_setup(seed: int, steps: int) -> tuple[pj.Slider, pj.Hand, jax.Array]:
    """Return the square with its quartic, the finger, and the path (steps + 1, 2) of its center, m."""
    block = pj.Polygon.rectangle(SIDE, SIDE)
    pairs = pj.Support.uniform(block, points=SUPPORT_POINTS).wrench_twist_pairs(jax.random.key(seed), PAIRS)
    slider = pj.Slider(block, pj.fit_limit_surface(*pairs, degree=4))
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
        The record, which holds:

            - for each coordinate of the displacement (m, rad): its moments, histogram and test of normality
            - the correlations of the coordinates
            - the number of sampled surfaces that are not convex
            - the share of sampled surfaces that were repaired, and the mean shrinkage of these (see `SurfaceSample`)
            - the outcomes
            - the time of the run and that of compiling, in s

    Raises:
        ValueError: If there are too few pushes for a test of normality.
    """
    if n < MIN_PUSHES:
        raise ValueError(f"n must be at least {MIN_PUSHES}, for a test of normality; got {n}")
    slider, hand, path = push_setup(seed, steps)
    model = pj.FrictionModel(dof=dof, friction=friction)
    key = jax.random.key(seed + 1)
    arguments = (key, n, slider, hand, path)
    all_plotted = n <= MAX_PLOTTED
    options: dict[str, Any] = {"pose": jnp.zeros(3), "model": model, "trajectories": all_plotted}
    first_run = pj.monte_carlo(*arguments, **options, progress=progress)  # includes compiling
    pushes = pj.monte_carlo(*arguments, **options)
    delta = np.asarray(pushes.delta, np.float64)
    pictures = []
    if out is not None:
        options["trajectories"] = True
        # with the same key, fewer pushes are the first ones
        drawn = pushes if all_plotted else pj.monte_carlo(key, MAX_PLOTTED, slider, hand, path, **options)
        pictures = _draw(out, slider, hand, path, pushes, drawn.trajectory)
    settings = {"seed": seed, "steps": steps, "dof": dof, "friction": friction, "side_m": SIDE, "radius_m": RADIUS}
    settings |= {"along_m": ALONG, "travel_m": TRAVEL, "support_points": SUPPORT_POINTS, "pairs": PAIRS}
    return result_record(
        "stochastic-push",
        settings,
        n=n,
        delta={name: _describe_coordinate(delta[:, k]) for k, name in enumerate(COORDINATES)},
        correlation=np.corrcoef(delta.T),
        nonconvex=int(np.sum(~(_curvatures(key, model, slider.surface, n) >= MIN_CURVATURE))),
        repaired=float(np.mean(pushes.shrinkage > 0)),
        mean_shrinkage=pushes.summary()["repaired"]["mean_shrinkage"],
        outcomes=pushes.outcomes(),
        run_s=pushes.seconds,
        compile_s=first_run.seconds - pushes.seconds,
        pictures=pictures,
    )


def _describe_coordinate(values: np.ndarray) -> dict[str, Any]:
    """Return the moments, the histogram and a test of normality of one coordinate (n,) of the displacement."""
    counts, edges = np.histogram(values, bins=HISTOGRAM_BINS)
    description: dict[str, Any] = {"mean": values.mean(), "std": values.std(ddof=1), "edges": edges, "counts": counts}
    test = scipy.stats.normaltest(values)
    normality = {"skewness": scipy.stats.skew(values), "excess_kurtosis": scipy.stats.kurtosis(values)}
    description["normality"] = normality | {"statistic": test.statistic, "p_value": test.pvalue}
    return {name: float(v) if np.ndim(v) == 0 and not isinstance(v, dict) else v for name, v in description.items()}


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


def _draw(out: Path, slider: pj.Slider, hand: pj.Hand, path: jax.Array, pushes: pj.MonteCarlo, trajectory) -> list[str]:
    """Draw the pushes and the histograms into the folder `out` and return the paths of the pictures."""
    import matplotlib.pyplot as plt

    from pushjax import plot

    title = f"{len(pushes)} pushes" + (f", {len(trajectory)} drawn" if len(trajectory) < len(pushes) else "")
    cloud = plot.cloud_figure(slider.shape, hand, np.asarray(path), trajectory, title)
    with plt.rc_context(plot.STYLE):
        histograms, panels = plt.subplots(1, 3, figsize=(10.5, 3.0), layout="constrained")
        for k, (axes, name) in enumerate(zip(panels, COORDINATES, strict=True)):
            scale, label = LABELS[name]
            values = scale * np.asarray(pushes.delta[:, k], np.float64)
            test = scipy.stats.normaltest(values)
            gaussian = values.mean(), values.std(ddof=1)
            plot.histogram_panel(axes, pushes.histogram(values, HISTOGRAM_BINS), label, gaussian=gaussian)
            unit = label.split(" / ")[1]
            axes.set_title(f"{gaussian[0]:.2f} ± {gaussian[1]:.2f} {unit}; normal: p = {test.pvalue:.1g}")
        panels[0].legend()
        pictures = (cloud, "stochastic_push.png"), (histograms, "stochastic_push_histograms.png")
        return [str(plot.save(figure, out / name)) for figure, name in pictures]


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints for a record of `run`."""
    settings, delta = record["settings"], record["delta"]
    lines = [
        f"{record['n']} pushes of a 90 mm square over {1e3 * TRAVEL:.0f} mm, dof {settings['dof']:g}, friction "
        f"{settings['friction'][0]:g} to {settings['friction'][1]:g}:"
    ]
    for name, (scale, label) in LABELS.items():
        row = delta[name]
        test = row["normality"]
        lines.append(
            f"  {label:9} {scale * row['mean']:8.2f} ± {scale * row['std']:.2f}   skewness {test['skewness']:5.2f},"
            f" excess kurtosis {test['excess_kurtosis']:5.2f}, normal: p = {test['p_value']:.2g}"
        )
    failed = record["outcomes"]["failed"]
    lines.append(
        f"  surfaces: {record['nonconvex']} not convex by an independent sweep, {record['repaired']:.1%} had been "
        f"repaired{f'; {failed} pushes failed' if failed else ''}"
    )
    lines.append(f"  ran in {record['run_s']:.2f} s, after {record['compile_s']:.1f} s of compiling")
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
