"""The planner for `gym-pusht`, built once and kept in the user's cache folder, and episodes that it plays."""

import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
import platformdirs

import pushjax as pj
from pushjax.experiments.pusht_mpc import setting
from pushjax.planning.controller import Observation, PushController
from pushjax.planning.cost_to_go import CostToGo
from pushjax.planning.coverage_table import CoverageTable
from pushjax.planning.push_library import PushLibrary, digest, fan
from pushjax.planning.push_planner import PushPlanner
from pushjax.tasks.push_t import SIZE

INSTALL = "gym-pusht is not installed; `pip install gym-pusht` gets it"


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


def make_plant() -> Any:
    """Return the environment, or raise ValueError if its package is not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import gym_pusht  # noqa: F401  # registers the environment
        import gymnasium
    except ImportError:
        raise ValueError(INSTALL) from None
    return gymnasium.make("gym_pusht/PushT-v0", obs_type="state", disable_env_checker=True)


def cache_folder() -> Path:
    """Return the folder in which libraries of pushes and tables of costs are kept."""
    return platformdirs.user_cache_path("pushjax", appauthor=False) / "planning"


def library(slider: pj.Slider, folder: Path, **friction: Any) -> tuple[PushLibrary, bool]:
    """Return the library of the finger's pushes, and whether it was read from a file rather than simulated."""
    hand = pj.Hand.finger(setting.FINGER_RADIUS)
    starts, directions = fan(slider, setting.FINGER_RADIUS)
    wanted = digest(slider, hand, starts, directions, **friction)
    path = folder / f"pushes-{wanted[:16]}.npz"
    with suppress(FileNotFoundError, ValueError):  # there is none, or it is damaged
        return PushLibrary.load(path, wanted), True
    built = PushLibrary.simulate(slider, hand, starts, directions, **friction)
    folder.mkdir(parents=True, exist_ok=True)
    built.save(path)
    return built, False


def planner(
    slider: pj.Slider, pushes: PushLibrary, *, look_ahead: bool = True, value: CostToGo | bool | None = None
) -> PushPlanner:
    """Return a planner of PushT for a library of pushes. The other arguments are those of `PushPlanner`."""
    vertices = np.asarray(slider.shape.vertices, float)  # pyright: ignore[reportAttributeAccessIssue]
    measure = CoverageTable(vertices, pushes.center, pushes.length, setting.ENOUGH)
    given = slider, setting.FINGER_RADIUS, pushes, setting.goal(), setting.workspace(), setting.pace()
    return PushPlanner(*given, measure=measure, look_ahead=look_ahead, value=value)


def controller(
    folder: Path | None = None,  # of the tables' files; None: `cache_folder`
    *,
    lookahead: bool = True,  # consider plans of two pushes
    cost_to_go: bool = True,  # choose pushes far from the goal by the cost to go, else by the distance to the goal
    feedback: bool = True,  # correct pushes while they run
    friction_in_model: float = 0.0,  # at the contact; the plant has none
    observation_noise: float = 0.0,  # standard deviation, m
) -> tuple[PushController, dict[str, Any]]:
    """Build the controller, and return it with the setup times of its parts, s."""
    folder, began = folder or cache_folder(), time.perf_counter()
    slider = setting.slider()
    pushes, loaded = library(slider, folder, friction=friction_in_model)
    times: dict[str, Any] = {"library": time.perf_counter() - began, "library_from_file": loaded}
    began = time.perf_counter()
    planning = planner(slider, pushes, look_ahead=lookahead, value=None if cost_to_go else False)
    if cost_to_go:
        file = folder / f"cost-{planning.value_digest()[:16]}.npz"
        try:
            planning.value = CostToGo.load(file)
        except (FileNotFoundError, ValueError):  # there is none, or it is damaged
            value = planning.value
            assert value is not None
            value.save(file)
    planning.prepare()
    times["tables"] = time.perf_counter() - began
    began = time.perf_counter()
    push_controller = PushController(planning, setting.finger_control(), feedback=feedback, noise=observation_noise)
    push_controller.prepare()
    return push_controller, times | {"feedback": time.perf_counter() - began}


def play(
    plant: Any,
    push_controller: PushController,
    seed: int,
    *,
    actuation_noise: float = 0.0,
    observation_noise: float = 0.0,
) -> Episode:
    """Play one episode; noise is in px, and on the observed angle px over the surface's length."""
    rng = np.random.default_rng([seed, 1])
    turn = observation_noise * setting.PIXEL / push_controller.length
    scale = np.array([observation_noise] * 4 + [turn])
    seen, _ = plant.reset(seed=seed)
    memory, episode, key = push_controller.initial_memory(), Episode(seed), jax.random.key(seed)
    while True:
        noisy = seen + scale * rng.standard_normal(5)
        began, began_processor = time.perf_counter(), time.process_time()
        observation = Observation(setting.PIXEL * noisy[:2], setting.from_gym(noisy[2:4], noisy[4]))
        action, memory = push_controller(key, observation, memory)
        episode.seconds.append(time.perf_counter() - began)
        episode.processor_seconds.append(time.process_time() - began_processor)
        action = action / setting.PIXEL + actuation_noise * rng.standard_normal(2)
        seen, _, terminated, truncated, info = plant.step(np.clip(action, 0, SIZE))
        episode.steps += 1
        episode.final_coverage = float(info["coverage"])
        episode.largest_coverage = max(episode.largest_coverage, episode.final_coverage)
        if terminated or truncated or episode.steps == setting.STEPS:
            episode.success, episode.pushes = bool(terminated), memory.pushes
            return episode
