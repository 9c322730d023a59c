"""PushT beside gym-pusht: the same episodes in both, and control steps per second of CPU time.

Needs gym-pusht: pip install 'gym-pusht==0.1.8' 'pymunk<7'. The episodes start at its own resets, and both get the same
actions: positions 20 px ahead of the agent, toward a random point of the T. Speeds are of gym-pusht, of pymunk alone
(no observation and no coverage) and of `pushjax.tasks.PushT` (observation, coverage, reward and automatic resets
included), in one process.
"""

import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks.environments import AHEAD, SCATTER, throughput
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.tasks import PushT, TaskState

AT_ONCE = 64  # episodes in one program
REACH = 2.5  # px, from the faces of the walls, where pymunk's margin still holds the T
ACTIONS = "steered", "uniform"
LIMITS = {"free": (1.5, 1.0), "walls": (3.0, np.inf)}  # px and degrees


class Recorded(NamedTuple):
    """Episodes of gym-pusht."""

    start: np.ndarray  # rows as in its "state" observations, (episodes, 5)
    actions: np.ndarray  # (steps, episodes, 2)
    rows: np.ndarray  # after each control step, (steps, episodes, 5)
    coverage: np.ndarray  # after each control step, (steps, episodes)
    at_wall: np.ndarray  # whether the T has been within `REACH` of a wall, (episodes,)


def run(
    seeds: int = 200,
    steps: int = 30,
    substeps: tuple[int, ...] = (2,),
    batch: int = 4096,
    seed: int = 0,
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Compare PushT with gym-pusht.

    Args:
        seeds: Number of episodes.
        steps: Control steps of an episode.
        substeps: Steps of the simulator in a control step; several are compared.
        batch: Number of environments that are timed together; 0 to time nothing.
        seed: Seed of the first episode.
        progress: Called with the number of parts done and their total.
        keep: Called with the record so far.

    Returns:
        The record: a row for each number of substeps, and the speeds.
    """
    rows: list[dict[str, Any]] = []
    speeds: dict[str, dict[str, float]] = {}
    settings = {"seeds": seeds, "steps": steps, "substeps": substeps, "batch": batch, "seed": seed}
    record = result_record("pusht", settings, rows=rows, control_steps_per_second=speeds)
    parts = 1 + len(substeps) * (1 + len(ACTIONS) * bool(batch))
    episodes = recorded(seeds, steps, seed)
    progress(1, parts)
    for count in substeps:
        env = PushT(substeps=count)
        rows.append({"substeps": count} | compared(env, episodes))
        keep(record)
        progress(1 + len(rows), parts)
    done = 1 + len(rows)
    for kind in ACTIONS if batch else ():
        speeds[kind] = {"gym-pusht": _gym_speed(True, kind), "pymunk alone": _gym_speed(False, kind)}
        for count in substeps:
            row = throughput(PushT(substeps=count), batch, kind)
            speeds[kind][f"pushjax, {count} substeps"] = row["steps_per_second"]
            keep(record)
            done += 1
            progress(done, parts)
    return record


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = []
    for row in record["rows"]:
        for kind in LIMITS:
            part = row[kind]
            lines.append(
                f"{row['substeps']} substeps, {kind:6}{part['episodes']:4} episodes: position off by "
                f"{part['position_px'][0]:.2f} px (median), {part['position_px'][1]:.2f} (90 %), angle "
                f"{part['angle_deg'][0]:.2f}, {part['angle_deg'][1]:.2f}°, coverage {part['coverage'][1]:.3f} (90 %); "
                f"{100 * part['within']:.1f} % within {LIMITS[kind][0]} px"
            )
    for kind, speeds in record["control_steps_per_second"].items():
        lines += [f"{name:24}{speed:12,.0f} control steps/s, {kind} actions" for name, speed in speeds.items()]
    return "\n".join(lines)


def recorded(seeds: int, steps: int, seed: int = 0) -> Recorded:
    """Record episodes of gym-pusht, with actions at random around the T."""
    env = make_gym()
    starts, actions, rows, coverage, at_wall = [], [], [], [], []
    for k in range(seeds):
        rng = np.random.default_rng(seed + k)
        starts.append(env.reset(seed=seed + k)[0])
        near = _near_wall(env)
        taken, seen, covered = [], [], []
        for _ in range(steps):
            taken.append(random_action(env, rng))
            row, _, _, _, info = env.step(taken[-1])
            seen.append(row)
            covered.append(info["coverage"])
            near |= _near_wall(env)
        for kept, each in zip((actions, rows, coverage, at_wall), (taken, seen, covered, near), strict=True):
            kept.append(each)
    taken, seen, covered = (np.swapaxes(np.array(each), 0, 1) for each in (actions, rows, coverage))
    return Recorded(np.array(starts), taken, seen, covered, np.array(at_wall))


def make_gym() -> Any:
    """Return gym-pusht's environment, without Gymnasium's wrappers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gym_pusht.envs

        return gym_pusht.envs.PushTEnv(obs_type="state")


def random_action(env: Any, rng: np.random.Generator) -> np.ndarray:
    """Return a position ahead of the agent, toward a random point around the T's center of gravity."""
    center, agent = np.array(env.block.local_to_world(env.block.center_of_gravity)), np.array(env.agent.position)
    way = center + SCATTER * rng.standard_normal(2) - agent
    return np.clip(agent + AHEAD * way / np.linalg.norm(way), 0, 512)


def _near_wall(env: Any) -> bool:
    """Whether the T is within `REACH` of a wall."""
    corners = env.get_keypoints(env._block_shapes)
    return bool(corners.min() < 7 + REACH or corners.max() > 504 - REACH)


@partial(jax.jit, static_argnums=0)
def replayed(env: PushT, states: TaskState, actions: Array, params: Any) -> tuple[TaskState, Any]:
    """Take control steps of a batch with automatic resets; return each step's state and all that `step` returned."""
    keys = jax.random.split(jax.random.key(0), actions.shape[:2])  # of actions (steps, batch, 2)

    def one_step(states: TaskState, at: tuple[Array, Array]):
        out = jax.vmap(env.step, in_axes=(0, 0, 0, None))(at[0], states, at[1], params)
        return out[1], (out[1], out)

    return jax.lax.scan(one_step, states, (keys, actions))[1]


def states_at(env: PushT, params: Any, rows: np.ndarray) -> TaskState:
    """Return the states whose observations are the given rows, (batch, 5)."""
    return jax.vmap(lambda row: env.state_of(row, params))(jnp.asarray(rows))


def compared(env: PushT, episodes: Recorded) -> dict[str, Any]:
    """Return how far the T ends from where it does in gym-pusht."""
    count, params = len(episodes.start), env.default_params
    padded = np.arange(-(-count // AT_ONCE) * AT_ONCE) % count
    ends, coverages = [], []
    for part in padded.reshape(-1, AT_ONCE):
        states = states_at(env, params, episodes.start[part])
        _, (_, _, _, _, _, info) = replayed(env, states, jnp.asarray(episodes.actions[:, part]), params)
        ends.append(np.asarray(info["final_observation"])[-1])
        coverages.append(np.asarray(info["coverage"])[-1])
    end, wanted = np.concatenate(ends)[:count], episodes.rows[-1]
    kept = episodes.coverage.max(0) <= 0.95  # the others were reset on the way
    covered = np.abs(np.concatenate(coverages)[:count] - episodes.coverage[-1])
    position = np.linalg.norm(end[:, 2:4] - wanted[:, 2:4], axis=1)
    turn = np.degrees(np.abs((end[:, 4] - wanted[:, 4] + np.pi) % (2 * np.pi) - np.pi))
    kinds = np.where(episodes.at_wall, "walls", "free")
    found = {}
    for kind, (pixels, degrees) in LIMITS.items():
        chosen = kept & (kinds == kind)
        within = (position <= pixels) & (turn <= degrees)
        found[kind] = {
            "episodes": int(chosen.sum()),
            "within": float(within[chosen].mean()),
            "position_px": np.quantile(position[chosen], [0.5, 0.9]).tolist(),
            "angle_deg": np.quantile(turn[chosen], [0.5, 0.9]).tolist(),
            "coverage": np.quantile(covered[chosen], [0.5, 0.9]).tolist(),
        }
    return found


def _gym_speed(whole: bool, kind: str, seconds: float = 3.0) -> float:
    """Return control steps per second of CPU time of gym-pusht, or of its physics alone."""
    env, rng, done = make_gym(), np.random.default_rng(0), 0
    env.reset(seed=0)
    start = time.process_time()
    while time.process_time() - start < seconds:
        if done % 300 == 299:
            env.reset(seed=done)
        action = random_action(env, rng) if kind == "steered" else rng.uniform(0, 512, 2)
        if whole:
            env.step(action)
        else:
            a, b = action.tolist()
            for _ in range(10):  # with plain floats, twice as fast as gym-pusht's own arrays
                (x, y), (u, v) = env.agent.position, env.agent.velocity
                u += (env.k_p * (a - x) - env.k_v * u) * env.dt
                v += (env.k_p * (b - y) - env.k_v * v) * env.dt
                env.agent.velocity = u, v
                env.space.step(env.dt)
        done += 1
    return done / (time.process_time() - start)
