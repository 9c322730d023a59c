"""Success of the planner in the task PushT of `gym-pusht`, by the package's own rule.

An episode succeeds if the T covers more than 95 % of the goal at the end of a control step, within 300 steps. The plant
is `gym-pusht`, which simulates with pymunk. The controller sees the observation "state" and nothing else: positions of
the finger and of the T, and the angle. Policies that see pixels solve a harder task.
"""

import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import jax
import numpy as np
from scipy.stats import binomtest

from pushjax._internal.checks import check_count, check_finite, check_non_negative
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, table
from pushjax.planning import PushController, pusht_controller, pusht_observation
from pushjax.planning.pusht import PIXEL
from pushjax.tasks.push_t import SIZE

INSTALL = "gym-pusht is not installed; `pip install gym-pusht` gets it"
STEPS = 300  # usual limit of an episode
PUBLISHED = (
    {"policy": "diffusion policy (LeRobot)", "success": 0.638, "episodes": 500, "sees": "pixels"},
    {"policy": "diffusion policy (LeRobot, later card)", "success": 0.654, "episodes": 500, "sees": "pixels"},
    {"policy": "VQ-BeT (LeRobot)", "success": 0.638, "episodes": 500, "sees": "pixels"},
)
# The same rule: coverage above 0.95 within 300 steps. The first is on its model card (huggingface.co/lerobot).


@dataclass
class Episode:
    """Result of one episode."""

    seed: int  # of the start
    success: bool = False  # whether the coverage was above 0.95 at the end of a control step
    steps: int = 0  # control steps
    largest_coverage: float = 0.0  # at the end of a control step
    final_coverage: float = 0.0
    pushes: int = 0  # planned pushes
    seconds: list[float] = field(default_factory=list)  # time of the controller in each control step
    # processor time of the same; other programs on the machine change it less than `seconds`
    processor_seconds: list[float] = field(default_factory=list)


def run(
    seed: int = 0,
    episodes: int = 50,
    lookahead: bool = True,
    cost_to_go: bool = True,
    feedback: bool = True,
    friction_in_model: float = 0.0,
    actuation_noise: float = 0.0,
    observation_noise: float = 0.0,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Play episodes of PushT.

    Args:
        seed: Seed of the first episode; the others follow.
        episodes: Number of episodes.
        lookahead: Whether plans of two pushes are considered.
        cost_to_go: Whether pushes far from the goal are chosen by the cost to go, or else by the distance to the goal.
        feedback: Whether pushes are corrected while they run.
        friction_in_model: Coefficient of contact friction in the model; there is none in the plant.
        actuation_noise: Standard deviation of noise on the actions, px.
        observation_noise: Standard deviation of noise on the positions that the controller sees, px; the angle has the
            same, in units of the T's radius of gyration.
        progress: Called after each episode.

    Returns:
        The record, with one row per episode.

    Raises:
        ValueError: If `gym-pusht` is not installed, or a number is out of its range.
    """
    check_count("episodes", episodes)
    noise = {"actuation_noise": actuation_noise, "observation_noise": observation_noise}
    given = {"friction_in_model": friction_in_model} | noise
    for name, value in given.items():
        check_finite(name, value)
        check_non_negative(name, value)
    plant = make_plant()
    began = time.perf_counter()
    controller = pusht_controller(
        look_ahead=lookahead,
        use_cost_to_go=cost_to_go,
        feedback=feedback,
        friction=friction_in_model,
        noise=observation_noise * PIXEL,
    )
    setup = time.perf_counter() - began
    played = []
    for k in range(episodes):
        played.append(play(plant, controller, seed + k, **noise))
        progress(k + 1, episodes)
    switches = {"lookahead": lookahead, "cost_to_go": cost_to_go, "feedback": feedback}
    settings = {"seed": seed, "episodes": episodes} | switches | given
    settings |= {"speeds": controller.planner.speeds._asdict()}
    rows = [{name: value for name, value in asdict(each).items() if "seconds" not in name} for each in played]
    return result_record("pusht-mpc", settings, **_figures(played), setup_seconds=setup, published=PUBLISHED, rows=rows)


def make_plant() -> Any:
    """Return the environment, or raise ValueError if its package is not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import gym_pusht  # noqa: F401  # registers the environment
        import gymnasium
    except ImportError:
        raise ValueError(INSTALL) from None
    return gymnasium.make("gym_pusht/PushT-v0", obs_type="state", disable_env_checker=True)


def play(
    plant: Any, controller: PushController, seed: int, *, actuation_noise: float = 0.0, observation_noise: float = 0.0
) -> Episode:
    """Play one episode; noise is in px, and on the observed angle px over the surface's length."""
    rng = np.random.default_rng([seed, 1])
    turn = observation_noise * PIXEL / controller.length
    scale = np.array([observation_noise] * 4 + [turn])
    seen, _ = plant.reset(seed=seed)
    state, episode, key = controller.initial_state(), Episode(seed), jax.random.key(seed)
    while True:
        noisy = seen + scale * rng.standard_normal(5)
        began, began_processor = time.perf_counter(), time.process_time()
        action, state = controller(key, pusht_observation(noisy), state)
        episode.seconds.append(time.perf_counter() - began)
        episode.processor_seconds.append(time.process_time() - began_processor)
        action = action / PIXEL + actuation_noise * rng.standard_normal(2)
        seen, _, terminated, truncated, info = plant.step(np.clip(action, 0, SIZE))
        episode.steps += 1
        episode.final_coverage = float(info["coverage"])
        episode.largest_coverage = max(episode.largest_coverage, episode.final_coverage)
        if terminated or truncated or episode.steps == STEPS:
            episode.success, episode.pushes = bool(terminated), state.pushes
            return episode


def _figures(played: list[Episode]) -> dict[str, Any]:
    """Return the figures over all episodes."""
    successes, count = sum(each.success for each in played), len(played)
    low, high = binomtest(successes, count).proportion_ci()  # exact, by Clopper and Pearson
    steps = [each.steps for each in played if each.success]
    return {
        "success": successes / count,
        "success_ci95": (float(low), float(high)),
        "mean_largest_coverage": float(np.mean([each.largest_coverage for each in played])),
        "mean_final_coverage": float(np.mean([each.final_coverage for each in played])),
        "steps_of_successes": {
            "median": float(np.median(steps)),
            "percentile_95": float(np.percentile(steps, 95)),
            "largest": max(steps),
        }
        if steps
        else None,
        "seconds_per_step": _times(each.seconds for each in played),
        "processor_seconds_per_step": _times(each.processor_seconds for each in played),
    }


def _times(episodes: Iterable[list[float]]) -> dict[str, float]:
    """Return mean, 95th percentile and largest of times, s."""
    times = np.concatenate(list(episodes))
    return {"mean": times.mean(), "percentile_95": np.percentile(times, 95), "largest": times.max()}


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    (low, high), steps = record["success_ci95"], record["steps_of_successes"]
    successes = sum(row["success"] for row in record["rows"])
    kinds = {"wall": "seconds_per_step", "processor": "processor_seconds_per_step"}
    times = [{"of": name} | record[key] for name, key in kinds.items()]
    of_steps = (
        f"Control steps of successes: median {steps['median']:g}, 95 % within {steps['percentile_95']:.0f}, largest "
        f"{steps['largest']}."
        if steps
        else "No success."
    )
    return [
        f"PushT (gym-pusht): success in {successes} of {len(record['rows'])} episodes (95 % interval {low:.3f} to "
        f"{high:.3f}), set up in {record['setup_seconds']:.1f} s.",
        f"Mean coverage: largest {record['mean_largest_coverage']:.3f}, final {record['mean_final_coverage']:.3f}.",
        of_steps,
        table(
            times,
            ("time per control step", "of"),
            ("mean / s", "mean", ".3f"),
            ("95 % within / s", "percentile_95", ".3f"),
            ("largest / s", "largest", ".3f"),
        ),
        "The task's clock gives 0.1 s. The planner reads the exact positions. Published policies that see pixels, by "
        "the same rule:",
        table(record["published"], ("policy", "policy"), ("success", "success", ".1%"), ("episodes", "episodes")),
    ]
