"""The picture of a plan: the finger's pushes and transits, where the block is on the way, and where it may end."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

import pushjax as pj
from pushjax import plot
from pushjax.experiments.plan.options import Options
from pushjax.planning import Goal, PushPlan
from pushjax.plot.parts import draw_fixtures
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, MM, ORANGE, RED, STYLE
from pushjax.simulation.fixtures import Fixtures

DRAWN = 40  # largest number of predicted ends that are drawn


def draw(slider: pj.Slider, goal: Goal, fixtures: Fixtures, plan: PushPlan, options: Options, path: Path) -> Path:
    """Draw a plan and the errors of its predicted final poses, and return the path of the picture."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, 3, figsize=(12.5, 4.6), layout="constrained", gridspec_kw={"width_ratios": [2, 1, 1]}
        )
        draw_fixtures(panels[0], fixtures)
        _draw_plan(panels[0], slider, goal, plan, options)
        errors = np.asarray(goal.offset(np.asarray(plan.outcomes.pose)), float)
        _draw_positions(panels[1], errors, options.tolerance[0])
        plot.histogram_panel(panels[2], np.degrees(errors[:, 2]), "error of the angle / °", bins=30)
        for side, label in ((-1, "tolerance"), (1, None)):
            angle = side * np.degrees(options.tolerance[1])
            panels[2].axvline(angle, color=BLACK, lw=1, ls="--", label=label)
        panels[2].legend(fontsize=7, loc="upper left")
        panels[0].set_title(f"{plan.status.name.replace('_', ' ').lower()}: {plan.success:.0%} succeed")
        panels[2].set_title("angle at the end")
        return plot.save(figure, path)


def _draw_plan(axes: Axes, slider: pj.Slider, goal: Goal, plan: PushPlan, options: Options) -> None:
    for pose in np.asarray(plan.outcomes.pose)[:DRAWN]:
        plot.outline(axes, slider.shape, pose, RED, 0.4, alpha=0.5)
    axes.plot([], [], color=RED, lw=0.8, label="predicted ends")
    for number, pose in enumerate(np.asarray(plan.pose)):
        color, label = (BLACK, "start") if number == 0 else (GRAY, "after each push" if number == 1 else None)
        plot.outline(axes, slider.shape, pose, color, 1.2, label=label)
    plot.outline(axes, slider.shape, np.asarray(goal.pose), GREEN, 1.6, linestyle="--", label="goal")
    for number, transit in enumerate(plan.transits):
        label = "between pushes" if number == 0 else None
        axes.plot(*(MM * transit.points.T), color=ORANGE, lw=0.9, ls="--", label=label)
    for number, path in enumerate(np.asarray(plan.path)):
        points = MM * path
        axes.plot(*points.T, color=BLUE, lw=1.8, label="pushes of the finger" if number == 0 else None)
        axes.annotate(
            "", points[-1], points[-2], arrowprops={"arrowstyle": "-|>", "color": BLUE, "shrinkA": 0, "shrinkB": 0}
        )
        axes.add_patch(Circle(tuple(points[0]), MM * options.radius, color=BLUE, fill=False, lw=0.9))
        axes.annotate(
            str(number + 1),
            points[0],
            xytext=(7, 7),
            textcoords="offset points",
            color=BLUE,
            weight="bold",
            bbox={"boxstyle": "circle,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
            zorder=6,
        )
    axes.set(xlabel="x / mm", ylabel="y / mm")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=7, loc="best")


def _draw_positions(axes: Axes, errors: np.ndarray, tolerance: float) -> None:
    points = MM * errors[:, :2]
    reach = max(1.3 * MM * tolerance, float(np.quantile(np.abs(points), 0.995)) * 1.05)
    axes.plot(*points[np.all(np.abs(points) <= reach, axis=1)].T, ".", color=RED, ms=3)
    axes.add_patch(Circle((0, 0), MM * tolerance, color=BLACK, fill=False, ls="--", lw=1))
    axes.update_datalim([(-reach, -reach), (reach, reach)])
    axes.set(xlabel="error of x / mm", ylabel="error of y / mm")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("position at the end")
