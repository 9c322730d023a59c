"""Grasping under uncertainty: final poses of a rectangle or a butterfly that a parallel jaw closes on.

The pads of the jaw are 27 x 10 mm. The jaw closes from 85 mm until it is stopped or shut. The limit surface is an
ellipsoid, sampled with 250 degrees of freedom around the one that the pressure gives. The pressure acts along the rim;
the rectangle is also simulated on six points. The friction of the pads is uniform in [0.015, 0.02].

The paper leaves two things open, which are chosen here. One is how far the jaw is open at first. The other is that
start poses that overlap the open jaw are sampled again. Of the butterfly the paper gives two diameters: 39 mm across
its convex ends and 28.6 mm across its concave waist. The outline here is r(angle) = a + b cos(2 angle) + c cos(4 angle)
with these two diameters and c = -1 mm, which makes the waist a hollow of 17 mm radius.

Reference: Zhou et al. 2017, section VI.C, figures on grasping under uncertainty.
"""

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import pushjax as pj
from pushjax import plot
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._cli_option import cli_option
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, saved, table, uniform_in_circle
from pushjax.experiments._slider_options import PAIRS, fitted_surface
from pushjax.experiments.tables import check_chosen
from pushjax.geometry.se2_numpy import to_world
from pushjax.plot.style import BLACK, BLUE, GRAY, MM, ORANGE, PURPLE, RED, STYLE
from pushjax.simulation.slider import overlaps

PAD_WIDTH, PAD_THICKNESS = 0.027, 0.010  # m
OPENING = (0.085, 0.001)  # first and last opening of the jaw, m
HOLD = 5  # steps for which the closed jaw waits, so that a slider that has slipped out is free at the end
BINS = 45  # of each histogram in the record
PICTURE_BINS = 60
COLORS = {"grasped": RED, "jammed": ORANGE, "free": GRAY, "failed": PURPLE}  # by outcome
COORDINATES = ((MM, "x / mm"), (MM, "y / mm"), (180 / np.pi, "θ / °"))
ENDS_DIAMETER, WAIST_DIAMETER = 0.039, 0.0286  # m, diameters of the butterfly
HOLLOW_TERM = -0.001  # c, m
CURVE_POINTS = 24
PERTURBATION = np.radians(1.0)  # turn either way by which a grasp is tested for stability
OUTLINE_POINTS = 500  # on a curve
BIN_WIDTH = np.radians(1.0)  # width of a bin of angles in which spikes are looked for
MIN_SPIKE_SHARE = 0.02  # smallest share of all angles that makes a spike
SYMMETRY = np.pi  # rotation after which either outline is the same, rad


class Setting(NamedTuple):
    """What is grasped, and how often."""

    shape: pj.Shape
    supports: dict[str, pj.Support]  # by the name of the pressure distribution
    n: int  # number of grasps
    circle: float  # radius of the circle of start centers, m


def rectangle() -> Setting:
    """Return the setting of the rectangle, on its rim or on six points."""
    block = pj.Polygon.rectangle(0.050, 0.035)
    x, y = 0.025, 0.0175
    six = np.array([(-x, -y), (0, -y), (x, -y), (x, y), (0, y), (-x, y)])
    return Setting(block, {"rim": pj.Support.rim(block, points=200), "six points": pj.Support.points(six)}, 600, 0.020)


def butterfly() -> Setting:
    """Return the setting of the butterfly, on its rim."""
    angle = 2 * np.pi * np.arange(CURVE_POINTS) / CURVE_POINTS
    b = (ENDS_DIAMETER - WAIST_DIAMETER) / 4
    r = ENDS_DIAMETER / 2 - b - HOLLOW_TERM + b * np.cos(2 * angle) + HOLLOW_TERM * np.cos(4 * angle)
    points = jnp.asarray(np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1), jnp.result_type(float))
    curve = pj.Curve.through(points)
    return Setting(curve, {"rim": pj.Support.rim(curve, points=200)}, 900, 0.030)


SLIDERS = {"rectangle": rectangle, "butterfly": butterfly}


def run(
    slider: str,
    seed: int = 0,
    out: Path | None = None,
    n: Annotated[int | None, cli_option("N")] = None,
    steps: int = 840,
    dof: float = 250.0,
    friction: tuple[float, float] = (0.015, 0.02),
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Simulate the grasps of one slider, once for each pressure distribution under it.

    Args:
        slider: "rectangle" or "butterfly".
        seed: Seed of the wrench-twist pairs and the start poses; the grasps use `seed + 1`.
        out: Folder for the pictures. None: no pictures.
        n: Number of grasps. Default: the paper's, 600 rectangles or 900 butterflies.
        steps: Steps in which the jaw closes.
        dof: Degrees of freedom of the sampled ellipsoids.
        friction: Lowest and highest coefficient of friction of the pads.
        progress: Called with the number of grasps done and their total.

    Returns:
        The record: `cells` has the results for each pressure distribution, `starts` the start poses, and `redrawn` the
        number of start poses that were sampled again because they overlapped the open jaw.

    Raises:
        ValueError: If the slider is unknown.
    """
    check_chosen("slider", [slider], SLIDERS)
    setting = SLIDERS[slider]()
    count = setting.n if n is None else n
    hand, path = pj.Hand.parallel_jaw(PAD_WIDTH, PAD_THICKNESS), closing(steps)
    model = pj.FrictionModel(dof=dof, friction=friction)
    slider_by_pressure = {
        name: pj.Slider(setting.shape, fitted_surface(support, "ellipsoid", seed))
        for name, support in setting.supports.items()
    }
    starts, resampled = start_poses(next(iter(slider_by_pressure.values())), hand, path[0], setting.circle, count, seed)
    cells, shown = [], {}

    def report_progress(done: int, _: int) -> None:
        progress(len(cells) * count + done, len(slider_by_pressure) * count)

    for name, grasped_slider in slider_by_pressure.items():
        arguments = jax.random.key(seed + 1), count, grasped_slider, hand, path
        grasps = pj.monte_carlo(*arguments, pose=starts, model=model, progress=report_progress)
        outcomes = classify(grasps, setting.shape, PAD_WIDTH)
        cells.append({"pressure": name} | _results(grasps, outcomes))
        shown[name] = grasps, outcomes
    settings = {"seed": seed, "steps": steps, "dof": dof, "friction": friction, "circle_m": setting.circle}
    return result_record(
        f"grasp-{slider}",
        settings | {"pad_m": (PAD_WIDTH, PAD_THICKNESS), "opening_m": OPENING, "pairs": PAIRS},
        n=count,
        outcomes=cells[0]["outcomes"],
        redrawn=resampled,
        starts=starts,
        cells=cells,
        pictures=saved(out, lambda: {f"grasp_{slider}.png": _figure(setting.shape, hand, path, starts, shown)}),
    )


def closing(steps: int) -> jax.Array:
    """Return the path (steps + 1 + HOLD, 4) of a jaw that closes, and then waits."""
    open_jaw, shut_jaw = ((0.0, 0.0, 0.0, opening) for opening in OPENING)
    return jnp.concatenate([pj.line(open_jaw, shut_jaw, steps), jnp.asarray([shut_jaw] * HOLD)])


def _results(grasps: pj.MonteCarlo, outcomes: np.ndarray) -> dict[str, Any]:
    """Return the results for one pressure distribution: outcomes, and the spikes and histograms of the held poses."""
    held = grasps.stopped >= 0
    pose = np.asarray(grasps.pose, np.float64)
    histograms = {
        name: grasps.histogram(pose[held, k], BINS) for k, name in enumerate(("x", "y", "theta")) if held.any()
    }
    return {
        "outcomes": {name: int(np.sum(outcomes == name)) for name in COLORS},
        "statuses": grasps.summary()["statuses"],
        "failed_steps": int(grasps.failed.sum()),
        "spikes": spikes(pose[held, 2]) if held.any() else [],
        "held": histograms,
        "pose": pose,
        "outcome_of_each": outcomes,
        "seconds": grasps.seconds,
    }


def openings(shape: pj.Shape, poses: np.ndarray, pad: float) -> np.ndarray:
    """Return the least pad distances (n,), m, with room for the slider at poses (n, 3) in the jaw's frame."""
    vertices = shape.vertices if isinstance(shape, pj.Polygon) else shape.boundary(OUTLINE_POINTS)
    x, y = np.moveaxis(to_world(poses[:, None], np.asarray(vertices, np.float64)), -1, 0)
    # heights of the outline between the pads, which are centered at the origin; NaN elsewhere
    heights = [np.where(np.abs(x) <= pad / 2, y, np.nan)]
    next_x, next_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    for side in (-pad / 2, pad / 2):  # where the outline crosses the lines through the pads' corners
        crosses = (x - side) * (next_x - side) < 0
        fraction = (side - x) / np.where(crosses, next_x - x, 1.0)
        heights.append(np.where(crosses, y + fraction * (next_y - y), np.nan))
    each = np.concatenate(heights, axis=1)
    # zero if the slider is not between the pads
    return np.nan_to_num(np.fmax.reduce(each, axis=1) - np.fmin.reduce(each, axis=1))


def classify(grasps: pj.MonteCarlo, shape: pj.Shape, pad: float) -> np.ndarray:
    """Classify every grasp: stable, kept by friction, or not held.

    A slider is held by both pads if the hand stopped. Unlike in `MonteCarlo.outcomes`, it counts as grasped if the
    grasp is stable: to turn the slider a little, either way, the jaw would have to open. It counts as jammed if
    friction alone keeps it: a turn would let the jaw close.

    Args:
        grasps: The n grasps.
        shape: Outline of the slider.
        pad: Width of the pads, m.

    Returns:
        (n,), each "grasped", "jammed", "free" or "failed".
    """
    pose = np.asarray(grasps.pose, np.float64)
    held, failed = grasps.stopped >= 0, grasps.failed > 0
    opening = openings(shape, pose, pad)
    turned_openings = [openings(shape, pose + np.array([0, 0, sign * PERTURBATION]), pad) for sign in (1, -1)]
    stable = (opening > 0) & (turned_openings[0] >= opening) & (turned_openings[1] >= opening)
    return np.select([failed, held & stable, held], ["failed", "grasped", "jammed"], "free")


def start_poses(
    slider: pj.Slider, hand: pj.Hand, configuration: Any, circle: float, n: int, seed: int
) -> tuple[np.ndarray, int]:
    """Sample poses (n, 3), m and rad, clear of the open jaw, and count those that had to be sampled again."""
    rng = np.random.default_rng(seed)
    kept, resampled = np.zeros((0, 3)), 0
    dtype = jnp.result_type(float)
    while len(kept) < n:
        centers = uniform_in_circle(rng, circle, n)
        poses = np.column_stack([centers, rng.uniform(-np.pi / 2, np.pi / 2, n)]).astype(dtype)
        is_free = np.asarray(overlaps(slider, hand, jnp.asarray(poses), jnp.asarray(configuration))) <= 0
        wanted = n - len(kept)
        chosen = np.flatnonzero(is_free)[:wanted]
        resampled += int(np.sum(~is_free[: chosen[-1] + 1])) if len(chosen) == wanted else int(np.sum(~is_free))
        kept = np.concatenate([kept, poses[chosen]])
    return kept.astype(dtype), resampled


def spikes(angles: np.ndarray) -> list[dict[str, float]]:
    """Find spikes in a distribution of angles, rad, modulo `SYMMETRY`, largest share first."""
    wrapped = np.mod(np.asarray(angles, np.float64) + SYMMETRY / 2, SYMMETRY) - SYMMETRY / 2
    bins = round(SYMMETRY / BIN_WIDTH)
    # bins are centered at multiples of a degree, so that a spike at a right angle is in one bin
    bin_index = np.mod(np.round(wrapped / BIN_WIDTH).astype(int), bins)
    counts = np.bincount(bin_index, minlength=bins)
    spike_bins = np.flatnonzero(counts >= MIN_SPIKE_SHARE * len(angles))
    signed_degrees = np.where(spike_bins > bins / 2, spike_bins - bins, spike_bins)
    order = np.argsort(-counts[spike_bins])
    return [{"degrees": float(signed_degrees[k]), "share": float(counts[spike_bins[k]] / len(angles))} for k in order]


def _figure(
    shape: pj.Shape, hand: pj.Hand, path: jax.Array, starts: np.ndarray, shown: dict[str, tuple[Any, np.ndarray]]
) -> Figure:
    """Draw start poses and, for each pressure in `shown`, the final poses by outcome, with histograms."""
    with plt.rc_context(STYLE):
        rows = len(shown) + 1
        figure, axes = plt.subplots(rows, 4, figsize=(14.0, 3.4 * rows), layout="constrained")
        first = axes[0]
        plot.pose_panel(first[0], starts, BLACK)
        plot.outline(first[0], shape, np.zeros(3), BLUE, 1.0)
        plot.hand_at(first[0], hand, np.asarray(hand.poses(path[0])), BLUE, 1.0)
        first[0].set_title(f"{len(starts)} start poses")
        _histograms(first[1:], starts)
        for row, (pressure, (grasps, outcomes)) in zip(axes[1:], shown.items(), strict=True):
            for word, color in COLORS.items():
                which = outcomes == word
                if which.any():
                    plot.pose_panel(row[0], grasps.pose[which], color, f"{word}: {which.sum()}")
            ends = MM * np.abs(grasps.pose[:, :2]).max(axis=0) + 4
            row[0].set(xlim=(-ends[0], ends[0]), ylim=(-ends[1], ends[1]))
            row[0].set(title=f"where they end, pressure: {pressure}", aspect="equal")
            row[0].legend(loc="upper right", markerscale=3, fontsize=7)
            held = np.array(grasps.pose[grasps.stopped >= 0], np.float64)
            # shifted so that a spike at a right angle is not cut into two halves
            held[:, 2] = np.mod(held[:, 2] + SYMMETRY / 4, SYMMETRY) - SYMMETRY / 4
            _histograms(row[1:], held)
            row[2].set_title("of those held (θ modulo its symmetry)")
        return figure


def _histograms(panels, poses: np.ndarray) -> None:
    """Draw histograms of x, y (mm) and theta (degrees) of poses (n, 3)."""
    for axes, values, (scale, label) in zip(panels, np.asarray(poses, np.float64).T, COORDINATES, strict=True):
        if len(values):
            plot.histogram_panel(axes, scale * values, label, bins=PICTURE_BINS)


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    name = record["experiment"].removeprefix("grasp-")
    return [
        f"A jaw closes on a {name} from {record['n']} poses ({record['redrawn']} sampled again, which overlapped it):",
        table(
            record["cells"],
            ("pressure", "pressure"),
            *((outcome, lambda cell, outcome=outcome: cell["outcomes"][outcome]) for outcome in COLORS),
            ("time / s", "seconds", ".0f"),
            ("angles that hold", _angles),
        ),
    ]


def _angles(cell: dict[str, Any]) -> str:
    found = ", ".join(f"{spike['degrees']:.0f}° {spike['share']:.0%}" for spike in cell["spikes"][:8])
    return found or "none above the others"
