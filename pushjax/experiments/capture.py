"""Two fingers push a disk: which starts end with the disk between the fingers, and how does noise change that?

A disk of radius 52.5 mm lies under uniform pressure. Two point fingers, 100 mm apart, move 262.5 mm straight ahead. The
500 start centers are uniform in a circle of radius 78.8 mm ahead of the fingers. A push converges if the center of the
disk ends within 1 mm of the place where the disk rests on both fingers. Whether it does is the verdict on its start.
The same starts are pushed with every noise and every friction.

The paper leaves the following open, and it is chosen here: where the circle lies, how far the fingers go into it, the
radius of the fingers, the friction, and the criterion of convergence.

Reference: Zhou et al. 2017, section VI.B, figure on two point fingers pushing a circle.
"""

from collections.abc import Sequence
from itertools import product
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
from pushjax.experiments._report import Table, saved, table, uniform_in_circle
from pushjax.experiments._slider_options import fitted_surface
from pushjax.plot.parts import finger_poses
from pushjax.plot.style import BLACK, BLUE, GRAY, MM, RED, STYLE, legend_below

DISK_RADIUS, FINGER_RADIUS, FINGER_SPACING, TRAVEL = 0.0525, 0.001, 0.1, 0.2625  # m
START_RADIUS = 0.0788  # m, of the circle of start centers
START_DISTANCE = 0.135  # m, of that circle's center from the middle between the fingers at the start, ahead of it
N, STEPS = 500, 525
MAX_DRAWN = 100  # paths in each panel of the picture
DOFS, FRICTIONS = (200.0, 10.0), (0.25, 0.1, 0.5)  # the picture and the record's own figures are of the first friction
CONVERGED_DISTANCE = 1e-3  # m
SUPPORT_POINTS = 150
GRID_POINTS = 80  # on each axis, for the density of start centers in the picture
SETUP = {"disk_m": DISK_RADIUS, "finger_m": FINGER_RADIUS, "apart_m": FINGER_SPACING, "travel_m": TRAVEL}
SETUP |= {"circle_m": START_RADIUS, "ahead_m": START_DISTANCE, "near_m": CONVERGED_DISTANCE}


def run(
    seed: int = 0,
    out: Path | None = None,
    n: int = N,
    steps: int = STEPS,
    dof: Sequence[float] = DOFS,
    friction: Sequence[float] = FRICTIONS,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Find the share of convergent pushes for every noise and friction.

    Args:
        seed: Seed of the wrench-twist pairs, the start centers and the pushes.
        out: Folder for the pictures. None: no pictures.
        n: Number of start centers.
        steps: Steps of each push.
        dof: Two values of the degrees of freedom of the sampled limit surfaces, the one with less noise first.
        friction: Coefficients of friction of the fingers. The first one is drawn, and gives the record's own figures.
        progress: Called with the number of cells done and their total.

    Returns:
        The record. It has one row per friction and `dof`: the share of convergent pushes, the share of verdicts that
        another sample changes, and the difference between the two `dof`.

    Raises:
        ValueError: If `dof` is not two different numbers, or `friction` is empty or holds a number twice.
    """
    if len(dof) != 2 or dof[0] == dof[1]:
        raise ValueError(f"dof must be two different ones, to compare; got {', '.join(f'{d:g}' for d in dof)}")
    if not friction or len(set(friction)) != len(friction):
        raise ValueError(f"friction must be one or more, each once; got {', '.join(f'{mu:g}' for mu in friction)}")
    disk = pj.Disk(DISK_RADIUS)
    slider = pj.Slider(disk, fitted_surface(pj.Support.uniform(disk, points=SUPPORT_POINTS), "ellipsoid", seed))
    hand = pj.Hand.two_fingers(FINGER_RADIUS)
    path = pj.line((0, 0, np.pi / 2, FINGER_SPACING), (0, TRAVEL, np.pi / 2, FINGER_SPACING), steps)
    starts = start_poses(n, seed)
    rows, shown = [], {}
    for k, (mu, surface_dof) in enumerate(product(friction, dof)):
        setup = {"pose": starts, "model": pj.FrictionModel(dof=surface_dof, friction=mu), "trajectories": True}
        # run twice with different samples, to find how many verdicts the sampling alone changes
        keys = (jax.random.fold_in(jax.random.key(seed), 2 * k + again) for again in range(2))
        pushes, others = (pj.monte_carlo(key, n, slider, hand, path, **setup) for key in keys)
        verdicts = converged(pushes)
        row = {"friction": mu, "dof": surface_dof, "converged": float(verdicts.mean()), "outcomes": pushes.outcomes()}
        row |= {"changed_by_draw_percent": 100 * float(np.mean(verdicts != converged(others)))}
        rows.append(row | {"seconds": pushes.seconds, "settled": np.flatnonzero(verdicts)})
        if mu == friction[0]:
            shown[f"dof {surface_dof:g}: {verdicts.mean():.1%} of {n} converge"] = pushes.trajectory, verdicts
        progress(len(rows), len(friction) * len(dof))
    for pair in zip(rows[::2], rows[1::2], strict=True):  # the two dof of one friction
        _compare(*pair, n)
    return result_record(
        "capture",
        {"seed": seed, "steps": steps, "dof": dof, "friction": friction} | SETUP,
        n=n,
        dof={f"{row['dof']:g}": {"converged": row["converged"]} for row in rows[:2]},
        difference_percent=rows[0]["difference_percent"],
        starts=starts[:, :2],
        rows=rows,
        pictures=saved(out, lambda: {"capture.png": capture_figure(disk, hand, np.asarray(path), shown)}),
    )


def _compare(first: dict[str, Any], second: dict[str, Any], n: int) -> None:
    """Add to two rows how their shares of convergent pushes and their verdicts on `n` starts differ."""
    for row in (first, second):
        row["difference_percent"] = 100 * abs(first["converged"] - second["converged"])
        row["changed_by_noise_percent"] = 100 * (len(np.setxor1d(first["settled"], second["settled"])) / n)


def start_poses(n: int, seed: int) -> np.ndarray:
    """Sample start poses (n, 3) of the disk: centers uniform in the circle (m), angles zero."""
    centers = uniform_in_circle(np.random.default_rng(seed), START_RADIUS, n) + np.array([0, START_DISTANCE])
    return np.column_stack([centers, np.zeros(n)]).astype(jnp.result_type(float))


def converged(pushes: pj.MonteCarlo) -> np.ndarray:
    """Return which disks end between both fingers, (n,)."""
    resting_y = TRAVEL + np.sqrt((DISK_RADIUS + FINGER_RADIUS) ** 2 - (FINGER_SPACING / 2) ** 2)
    return np.hypot(pushes.pose[:, 0], pushes.pose[:, 1] - resting_y) < CONVERGED_DISTANCE


def capture_figure(
    shape: pj.Shape, hand: pj.Hand, path: np.ndarray, runs: dict[str, tuple[np.ndarray, np.ndarray]]
) -> Figure:
    """Draw the paths of each run, red if they converge, and the start positions of the last, with their density."""
    # a run has the poses (pushes, steps + 1, 3) and the verdicts (pushes,)
    name, (trajectories, verdicts) = list(runs.items())[-1]
    inside, outside = trajectories[verdicts, 0, :2], trajectories[~verdicts, 0, :2]
    with plt.rc_context(STYLE):
        ratios = [1.0] * len(runs) + [1.45] * (len(inside) > 2)  # fewer points have no density
        size = 3.6 * sum(ratios), 5.6
        figure, panels = plt.subplots(
            1, len(ratios), figsize=size, layout="constrained", width_ratios=ratios, squeeze=False
        )
        fingers = finger_poses(hand, path)
        for axes, (title, (poses, converge)) in zip(panels[0], runs.items(), strict=False):
            for which, color in ((converge[:MAX_DRAWN], RED), (~converge[:MAX_DRAWN], BLACK)):
                plot.traces(axes, poses[:MAX_DRAWN][which], color, alpha=0.5)
                axes.plot(*(MM * poses[:MAX_DRAWN][which, 0, :2].T), ".", color=color, ms=3)
            plot.hand_at(axes, hand, fingers[0], GRAY, 2.0)
            plot.hand_at(axes, hand, fingers[-1], BLUE, 2.0)
            if np.any(converge):
                plot.outline(axes, shape, poses[np.argmax(converge), -1], BLUE, 1.0)
            axes.set(title=title, xlabel="x / mm", aspect="equal")
        panels[0, 0].set_ylabel("y / mm")
        if len(inside) > 2:
            x, y = (c + np.linspace(-1.1, 1.1, GRID_POINTS) * START_RADIUS for c in (0.0, START_DISTANCE))
            grid = np.stack(np.meshgrid(x, y))
            density = scipy.stats.gaussian_kde(inside.T)(grid.reshape(2, -1)).reshape(grid.shape[1:]) / 1e6  # 1/mm²
            axes = panels[0, -1]
            drawn = axes.contourf(*(MM * grid), density, levels=12, cmap="Blues")
            axes.plot(*(MM * outside).T, ".", color=BLACK, ms=2.5)
            axes.plot(*(MM * inside).T, ".", color=RED, ms=2.5)
            axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal", title=f"start positions, {name}")
            plt.colorbar(drawn, ax=axes, label="density / (1/mm²)", shrink=0.8)
        for color, label in ((RED, "end as wanted"), (BLACK, "do not")):
            panels[0, 0].plot([], [], color=color, label=label)
        legend_below(figure, panels[0, 0], columns=2)
        return figure


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    return [
        f"Two fingers push a disk {1e3 * TRAVEL:.1f} mm, {record['n']} start centers. The last three columns: verdicts "
        "that another sample changes, difference between the two shares, and verdicts that differ between the two dof.",
        table(
            record["rows"],
            ("friction", "friction", "g"),
            ("dof", "dof", "g"),
            ("converge", "converged", ".1%"),
            ("failed", lambda row: row["outcomes"]["failed"]),
            ("by sample / %", "changed_by_draw_percent", ".1f"),
            ("difference / %", "difference_percent", ".1f"),
            ("by dof / %", "changed_by_noise_percent", ".1f"),
        ),
    ]
