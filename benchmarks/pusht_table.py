"""PushT with real friction that the planner does not know: nominal, robust and adapting controllers.

The plant is `pushjax.tasks.PushT` with the physics "table": in each episode the limit surface is another quartic around
that of even pressure, and the friction of the finger is another too. An episode succeeds by the rule of gym-pusht: the
T covers more than 95 % of the goal within 300 control steps. All controllers see exact poses, play the same episodes,
and correct pushes while they run, unless `--no-feedback` is given.

- `nominal`: plans and corrects with the mean friction.
- `robust`: plans with the mean outcomes of pushes under samples of friction, and prefers last pushes that reach the
  goal under many of them.
- `adapting`: the same, and a filter weights the samples by the motions that are seen.
- `known`: plans and corrects with the true friction, for which it simulates all pushes again in each episode.
"""

import time
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import numpy as np
from scipy.stats import binomtest

import pushjax as pj
from pushjax._internal.checks import check_count
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.experiments.pusht_mpc import setting
from pushjax.experiments.pusht_mpc.player import cache_folder, library, planner
from pushjax.planning import PushController, PushLibrary
from pushjax.planning.feedback.controller import Observation
from pushjax.planning.feedback.friction_filter import FrictionFilter
from pushjax.tasks import PushT

Controller = Literal["nominal", "robust", "adapting", "known"]
CONTROLLERS: tuple[Controller, ...] = ("nominal", "robust", "adapting")
SUBSTEPS = 10  # of the plant
HAND = pj.Hand.finger(setting.FINGER_RADIUS)
ERROR, RELATIVE_ERROR = 5e-4, 0.1  # of a motion, for the filter, m; the plant has no noise, but the model is coarser


@dataclass
class Episode:
    """One episode: whether it succeeded, its number of control steps and of pushes, and processor times, s."""

    success: bool = False
    steps: int = 0
    pushes: int = 0
    coverage: float = 0.0
    seconds: list[float] = field(default_factory=list)


def run(
    episodes: int = 100,
    samples: int = 32,
    dof: float = 20.0,
    friction: tuple[float, float] = (0.15, 0.45),
    feedback: bool = True,
    controller: tuple[Controller, ...] = CONTROLLERS,
    seed: int = 0,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Play episodes of PushT whose friction is not known.

    Args:
        episodes: Number of episodes of each controller.
        samples: Number of samples of friction of the library and of the filter.
        dof: Degrees of freedom of the limit surface.
        friction: Lowest and highest coefficient of friction of the finger.
        feedback: Whether pushes are corrected while they run.
        controller: Which controllers.
        seed: Seed of the first episode.
        progress: Called with the number of episodes done and their total.

    Returns:
        The record, with a row for each controller.
    """
    check_count("episodes", episodes)
    model = pj.FrictionModel(dof, friction, "sum_of_squares")
    env = PushT(substeps=SUBSTEPS)
    params = env.params("table", model=model)
    step, played, rows = jax.jit(env.step_env), {}, []
    for name in controller:
        began = time.process_time()
        made = _controller(name, params.slider, model, samples, feedback)
        setup = time.process_time() - began
        each = []
        for k in range(episodes):
            key = jax.random.key(seed + k)
            _, state = env.reset(key, params)
            plays = _knowing(made, state) if name == "known" else made
            each.append(_play(key, state, step, params, plays))
            progress(len(played) * episodes + k + 1, len(controller) * episodes)
        played[name] = each
        rows.append(_row(name, each, played.get("nominal"), setup))
    settings = {"episodes": episodes, "samples": samples, "dof": dof, "friction": friction}
    return result_record("pusht-table", settings | {"feedback": feedback, "seed": seed}, rows=rows)


def _controller(
    name: Controller, slider: pj.Slider, model: pj.FrictionModel, samples: int, feedback: bool
) -> PushController:
    """Build a controller. Libraries of pushes are kept in the user's cache folder."""
    key, mean = jax.random.key(10**6), float(np.mean(np.asarray(model.friction)))
    drawn: dict[str, Any] = {"friction": mean}
    if name in ("robust", "adapting"):
        drawn = {"model": model, "samples": samples, "key": key}
    pushes, _ = library(slider, cache_folder(), **drawn)
    learning = {}
    if name == "adapting":
        settings = FrictionFilter(slider, HAND, model, samples=samples, error=ERROR, relative_error=RELATIVE_ERROR)
        learning = {"friction_filter": settings, "prior": settings.init(key)}
    planning = planner(slider, pushes)
    planning.prepare()
    made = PushController(planning, setting.finger_control(), feedback=feedback, **learning)
    made.prepare()
    return made


def _knowing(nominal: PushController, state: Any) -> PushController:
    """Return a controller that knows the friction of an episode; it keeps the nominal cost to go."""
    slider = pj.Slider(nominal.planner.slider.shape, state.surface)
    pushes, friction = nominal.planner.library, float(state.friction)
    true = PushLibrary.simulate(slider, HAND, pushes.starts, pushes.directions, friction=friction)
    planning = planner(slider, true, value=nominal.planner.value)
    planning.prepare()
    return PushController(planning, setting.finger_control(), feedback=nominal.feedback)


def _play(key: Any, state: Any, step: Any, params: Any, made: PushController) -> Episode:
    """Play one episode from a state."""
    memory, episode = made.initial_memory(), Episode()
    while episode.steps < setting.STEPS:
        pose = np.asarray(state.pose, float) * [setting.PIXEL, setting.PIXEL, 1]
        began = time.process_time()
        seen = Observation(setting.PIXEL * np.asarray(state.hand, float), pose)
        action, memory = made(key, seen, memory)
        episode.seconds.append(time.process_time() - began)
        _, state, _, done, info = step(key, state, np.asarray(action / setting.PIXEL, np.float32), params)
        episode.steps += 1
        episode.coverage = float(info["coverage"])
        if bool(done):
            episode.success = episode.coverage > setting.ENOUGH
            break
    episode.pushes = memory.pushes
    return episode


def _row(name: str, played: list[Episode], nominal: list[Episode] | None, setup: float) -> dict[str, Any]:
    """Return the figures of a controller, with Wilson's interval. Failures count with the steps that they took."""
    steps, successes = np.array([each.steps for each in played], float), sum(each.success for each in played)
    times = np.concatenate([each.seconds for each in played])
    interval = binomtest(successes, len(played)).proportion_ci(0.95, method="wilson")
    row: dict[str, Any] = {"controller": name, "episodes": len(played), "successes": successes}
    row |= {"success_ci95": [float(interval.low), float(interval.high)], "steps_mean": float(steps.mean())}
    row |= {"steps_median": float(np.median(steps)), "steps_95": float(np.percentile(steps, 95))}
    row |= {"pushes_mean": float(np.mean([each.pushes for each in played])), "setup_processor_s": setup}
    row |= {"step_ms": 1e3 * float(times.mean()), "step_95_ms": 1e3 * float(np.percentile(times, 95))}
    row["step_largest_ms"] = 1e3 * float(times.max())
    row["steps"] = steps.tolist()
    if nominal is not None and name != "nominal":
        less = np.array([each.steps for each in nominal]) - steps
        row |= {"fewer_steps": float(less.mean()), "fewer_steps_error": float(less.std(ddof=1) / np.sqrt(len(less)))}
    return row


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints."""
    lines = [
        f"{'controller':12}{'success':>28}{'steps (median, mean, 95 %)':>28}{'pushes':>8}{'fewer steps':>16}"
        f"{'ms (mean, 95 %, largest)':>26}"
    ]
    for row in record["rows"]:
        low, high = row["success_ci95"]
        success = f"{row['successes']} of {row['episodes']} ({low:.3f} to {high:.3f})"
        steps = f"{row['steps_median']:g}, {row['steps_mean']:.1f}, {row['steps_95']:.0f}"
        fewer = f"{row['fewer_steps']:.1f} ± {row['fewer_steps_error']:.1f}" if "fewer_steps" in row else ""
        times = ", ".join(f"{row[name]:.0f}" for name in ("step_ms", "step_95_ms", "step_largest_ms"))
        lines.append(f"{row['controller']:12}{success:>28}{steps:>28}{row['pushes_mean']:8.1f}{fewer:>16}{times:>26}")
    return "\n".join(lines)
