"""Control steps per second of the tasks, in batches on any device, and the time of their first calls.

The actions are either steered at random points around the block all the time, or drawn from the whole space of actions.
Episodes reset by themselves. Observation, coverage, reward and resets are included. On a CPU, times are processor times
of all threads of the process; on an accelerator they are wall times.
"""

import time
from collections.abc import Callable
from itertools import product
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

import pushjax as pj
from benchmarks.timing import on_cpu
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.tasks import PushAlongWall, PushBox, PushT, PushTwoFingers, Squeeze, TaskState
from pushjax.tasks.environment import Environment

TASKS: dict[str, Environment] = {
    "PushT": PushT(),
    "PushT_without_walls": PushT(walls=False),
    "PushBox": PushBox(),
    "PushAlongWall": PushAlongWall(),
    "PushTwoFingers": PushTwoFingers(),
    "Squeeze": Squeeze(),
}
CONTROL_STEPS = 20  # of a timed program
WARM_UP, RUNS = 2, 6  # programs that run before those that are timed, and those
SCATTER = 60.0  # px, standard deviation of where the agent of PushT is steered to, around the T's center of gravity
AHEAD = 20.0  # px, how far ahead of the agent the action is: in the end the agent moves by half of it in a control step
TABLE_SCATTER = 0.03  # m, the same as SCATTER for the tasks on a table


def run(
    task: tuple[str, ...] = tuple(TASKS),
    batch: tuple[int, ...] = (1024,),
    actions: tuple[Literal["steered", "uniform"], ...] = ("steered",),
    seed: int = 0,
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Time batches of environments.

    Args:
        task: Names of the tasks.
        batch: Numbers of environments that step together.
        actions: How actions are chosen.
        seed: Seed of everything random.
        progress: Called with the number of rows done and their total.
        keep: Called with the record so far.

    Returns:
        The record, with a row for each task and batch.

    Raises:
        ValueError: If there is no such task.
    """
    unknown = [name for name in task if name not in TASKS]
    if unknown:
        raise ValueError(f"task: one or more of {', '.join(TASKS)}; got {', '.join(unknown)}")
    rows: list[dict[str, Any]] = []
    settings = {"task": task, "batch": batch, "actions": actions, "seed": seed}
    record = result_record("environments", settings, rows=rows)
    cases = list(product(task, batch, actions))
    for name, count, kind in cases:
        rows.append({"task": name} | throughput(TASKS[name], count, kind, seed))
        keep(record)
        progress(len(rows), len(cases))
    return record


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = [
        f"{'task':20}{'actions':9}{'batch':>9}{'first call':>12}{'steps/s':>13}{'µs each':>9}  statuses of substeps"
    ]
    for row in record["rows"]:
        shares = ", ".join(f"{name} {100 * share:.2g} %" for name, share in row["statuses"].items() if share > 0)
        lines.append(
            f"{row['task']:20}{row['actions']:9}{row['batch']:9}{row['first_call_s']:10.1f} s"
            f"{row['steps_per_second']:13,.0f}{1e6 / row['steps_per_second']:9.2f}  {shares}"
        )
    return "\n".join(lines)


def throughput(env: Environment, batch: int, actions: str = "steered", seed: int = 0) -> dict[str, Any]:
    """Return the control steps per second of a batch in the median of several runs, its first call and its statuses."""
    clock = time.process_time if on_cpu() else time.perf_counter
    params = env.default_params
    advance = control_steps(env, batch, actions, params)
    states = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(jax.random.key(seed), batch), params)[1]
    seconds, counts = [], np.zeros(len(pj.Status))
    for k in range(WARM_UP + RUNS):
        begin = clock()
        states, sums = jax.block_until_ready(advance(jax.random.fold_in(jax.random.key(seed), k), states))
        seconds.append(clock() - begin)
        counts = np.asarray(sums[-1], float).sum(0)
    shares = counts / counts.sum()
    return {
        "batch": batch,
        "actions": actions,
        "dtype": str(states.pose.dtype),
        "first_call_s": seconds[0],
        "steps_per_second": batch * CONTROL_STEPS / float(np.median(seconds[WARM_UP:])),
        # shares among the substeps of the last run
        "statuses": {status.name: float(share) for status, share in zip(pj.Status, shares, strict=True)},
    }


def control_steps(env: Environment, batch: int, actions: str, params: Any) -> Callable[[PRNGKeyArray, TaskState], Any]:
    """Compile `CONTROL_STEPS` control steps of a batch, from a key and states to states and sums of all results."""

    @jax.jit
    def program(key: PRNGKeyArray, states: TaskState):
        def one_step(states: TaskState, key: PRNGKeyArray):
            action_key, step_key = jax.random.split(key)
            keys = jax.random.split(step_key, batch)
            if actions == "steered":
                chosen = steered(env, action_key, states)
            else:
                chosen = jax.vmap(env.action_space(params).sample)(jax.random.split(action_key, batch))
            out = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, states, chosen, params)
            observation, states, reward, terminated, truncated, info = out
            sums = jnp.sum(observation), jnp.sum(reward), jnp.sum(terminated | truncated)
            return states, (*sums, jnp.sum(info["status"], axis=0))

        return jax.lax.scan(one_step, states, jax.random.split(key, CONTROL_STEPS))

    return program


def steered(env: Environment, key: PRNGKeyArray, states: TaskState) -> Array:
    """Return actions toward random points around the block; where a hand also turns and opens, it does so at random."""
    scatter_key, rest_key = jax.random.split(key)
    position, on_pixels = states.hand[:, :2], isinstance(env, PushT)
    scatter = (SCATTER if on_pixels else TABLE_SCATTER) * jax.random.normal(scatter_key, position.shape)
    way = states.pose[:, :2] + scatter - position
    way = way / jnp.linalg.norm(way, axis=1, keepdims=True)
    if on_pixels:
        return jnp.clip(position + AHEAD * way, 0, 512)
    rest = jax.random.uniform(rest_key, (len(way), env.num_actions - 2), way.dtype, -1.0, 1.0)
    return jnp.concatenate([way, rest], axis=1)
