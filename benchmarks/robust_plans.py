"""A box to a random pose by at most three open-loop pushes, planned with and without regard to random friction.

Each plan is judged under friction that no search has seen, in steps a quarter as long as those of the search. It
succeeds if the box ends within 5 mm and 5 degrees of its goal.

- `nominal` plans reach the goal best under the mean friction.
- `robust` plans miss it least often under sampled friction. Their search starts from the same plans.
"""

import time
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.planning import FinalPose, Goal, PushPlan, PushSequence, plan_pushes, push_outcomes
from pushjax.plot.files import save

BOX, RADIUS, STEPS, FINER = (0.09, 0.06), 0.005, 12, 4
REACH, LONGEST = 0.05, 0.08  # half of the width of the goals' square, and the longest push, m
DRAWN = 30  # samples of a picture


def run(
    goals: int = 100,
    samples: int = 200,
    dof: float = 100.0,
    friction: tuple[float, float] = (0.2, 0.3),
    pushes: int = 3,
    degree: int = 2,
    out: Path | None = None,
    seed: int = 0,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Plan pushes to random goals, and judge the plans under friction that they have not seen.

    Args:
        goals: Number of goals: positions in a square of 100 mm around the box, at any angle.
        samples: Number of samples of friction that judge a plan.
        dof: Degrees of freedom of the limit surface.
        friction: Lowest and highest coefficient of friction of the finger.
        pushes: Largest number of pushes.
        degree: Degree of the limit surface.
        out: Folder for the picture; None for no picture.
        seed: Seed of the goals and of everything random.
        progress: Called with the number of goals done and their total.

    Returns:
        The record, with a row for each way to plan: how often its plans succeed, with the standard error over goals.
    """
    slider, hand = pj.Slider.uniform(pj.Polygon.rectangle(*BOX), degree=degree), pj.Hand.finger(RADIUS)
    model, sequence = pj.FrictionModel(dof, friction), PushSequence(pushes, length=LONGEST, steps=STEPS)
    poses = np.random.default_rng(seed).uniform(-1, 1, (goals, 3)) * [REACH, REACH, np.pi / 2]
    success: dict[str, list[float]] = {"nominal": [], "robust": []}
    predicted: dict[str, list[float]] = {"nominal": [], "robust": []}
    seconds: dict[str, list[float]] = {"nominal": [], "robust": []}
    drawn, most = {}, -np.inf  # the goal for which the robust plan gains most
    for k, pose in enumerate(poses):
        goal, found = Goal(pose, symmetry=2, length=slider.surface.length), {}
        for name, settings in (("nominal", {"cost": FinalPose(goal), "search": ()}), ("robust", {})):
            start = time.perf_counter()
            plan = plan_pushes(
                jax.random.key(seed + k), slider, hand, np.zeros(3), goal, model=model, pushes=sequence, **settings
            )
            seconds[name].append(time.perf_counter() - start)
            unseen = jax.random.key(10**6 + seed + k)
            paths = _finer(plan)
            done = push_outcomes(unseen, slider, hand, np.zeros(3), paths, model=model, samples=samples)
            success[name].append(done.success(goal))
            predicted[name].append(plan.success)
            found[name] = (goal, plan, np.asarray(done.pose), success[name][-1])
        gain = success["robust"][-1] - success["nominal"][-1]
        if gain > most:
            drawn, most = found, gain
        progress(k + 1, goals)
    rows = [_row(name, success[name], predicted[name], seconds[name]) for name in success]
    gained = np.subtract(success["robust"], success["nominal"])
    settings = {"goals": goals, "samples": samples, "dof": dof, "friction": friction, "pushes": pushes}
    figures = {"rows": rows, "gain": float(gained.mean()), "gain_error": _error(gained)}
    figures |= {"better": int(np.sum(gained > 0)), "worse": int(np.sum(gained < 0)), "pictures": []}
    if out is not None:
        figures["pictures"] = [str(save(_picture(slider, success, drawn), out / "robust_plans.png"))]
    return result_record("robust_plans", settings | {"degree": degree, "seed": seed}, **figures)


def _finer(plan: PushPlan) -> np.ndarray:
    """Return the paths of a plan, which are straight, in more steps."""
    return np.stack([pj.resample(path, FINER * STEPS) for path in plan.path])


def _error(values: Any) -> float:
    """Return the standard error of a mean."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def _row(name: str, success: list[float], predicted: list[float], seconds: list[float]) -> dict[str, Any]:
    figures = {"success": float(np.mean(success)), "success_error": _error(success)}
    figures |= {"predicted": float(np.mean(predicted)), "sure": float(np.mean(np.array(success) >= 0.9))}
    return {"plan": name} | figures | {"first_s": seconds[0], "median_s": float(np.median(seconds[1:] or seconds))}


def _picture(slider: pj.Slider, success: dict[str, list[float]], drawn: dict[str, Any]) -> Any:
    """Draw where the box ends with the two plans for one goal, and the probabilities of success of all goals."""
    with plt.rc_context(plot.STYLE):
        figure, panels = plt.subplots(1, 3, figsize=(11.5, 3.8), layout="constrained")
        for axes, name in zip(panels, ("nominal", "robust"), strict=False):
            goal, plan, poses, probability = drawn[name]
            for pose in poses[:DRAWN]:
                plot.outline(axes, slider.shape, pose, plot.RED, 0.5, alpha=0.5)
            plot.outline(axes, slider.shape, np.zeros(3), plot.GRAY, 1.2, label="start")
            plot.outline(axes, slider.shape, np.asarray(goal.pose), plot.BLACK, 1.5, label="goal")
            for number, path in enumerate(np.asarray(plan.path)):
                label = "finger" if number == 0 else None
                axes.plot(*(1e3 * path[:, :2]).T, color=plot.BLUE, lw=1.5, label=label)
                axes.annotate(str(number + 1), 1e3 * path[0, :2], color=plot.BLUE, fontsize=8)
            title = f"{name}: {100 * probability:.0f} % succeed"
            axes.set(title=title, xlim=(-130, 130), ylim=(-130, 130), xlabel="x / mm", ylabel="y / mm", aspect="equal")
        panels[0].legend(fontsize=8)
        axes = panels[2]
        axes.plot([0, 100], [0, 100], color=plot.GRAY, lw=1)
        axes.plot(100 * np.array(success["nominal"]), 100 * np.array(success["robust"]), ".", color=plot.BLUE)
        axes.set(xlabel="nominal plan succeeds / %", ylabel="robust plan succeeds / %", aspect="equal")
        axes.set(title="one point a goal")
    return figure


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints."""
    settings = record["settings"]
    lines = [f"{settings['goals']} goals, {settings['samples']} samples of friction each"]
    lines.append(f"{'plan':10}{'succeeds':>18}{'predicted':>11}{'>= 90 %':>9}{'first / s':>11}{'median / s':>12}")
    for row in record["rows"]:
        rate = f"{100 * row['success']:.1f} ± {100 * row['success_error']:.1f} %"
        lines.append(
            f"{row['plan']:10}{rate:>18}{100 * row['predicted']:9.1f} %{100 * row['sure']:7.0f} %"
            f"{row['first_s']:11.1f}{row['median_s']:12.2f}"
        )
    lines.append(
        f"robust minus nominal: {100 * record['gain']:+.1f} ± {100 * record['gain_error']:.1f} points; "
        f"better for {record['better']} goals, worse for {record['worse']}"
    )
    return "\n".join(lines + [f"drew {path}" for path in record["pictures"]])
