"""Check of the motion of several sliders in contact, in random scenes: wrong answers, missing answers, and time.

The scenes are piles of disks with one or two fingers, and squares of a grid, face to face, with pads, fingers and
walls; the latter also with the same surface everywhere, so that much is symmetric and degenerate, and between pads that
may close, so that many jam.

- MOVING and FREE are checked against every condition of the contact problem, by code that is not the solver's.
- JAMMED is right if a linear program finds contact forces that balance on every slider, within their friction, and do
  work on the motion of the pushers.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linprog

import pushjax as pj
from benchmarks.scenes_of_sliders import Scenes, grid, pile, scenes, violations
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.contact.near_contacts import solve_sliders
from pushjax.contact.several_sliders import SlidersMotion
from pushjax.contact.sliders_problem import SlidersProblem
from pushjax.experiments._record import result_record
from pushjax.friction.polynomial import Polynomial

ALLOWED = {"float64": 1e-8, "float32": 1e-3}  # largest relative violation that an answer may have
LEAST_POWER = 1e-9  # of the forces of a jam, of sum one
CHUNK, TILE, SCENES = 500, 20, 10_000  # scenes drawn together, solved together, and of each row
KINDS: dict[str, Any] = {"pile": pile, "grid": grid, "alike": grid, "closing": partial(grid, closes=True)}
# kind, sliders, contacts at most, degree of the limit surfaces
ROWS = [
    ("pile", 2, 3, 2),
    ("pile", 3, 5, 4),
    ("pile", 5, 9, 2),
    ("pile", 8, 16, 4),
    ("grid", 2, 8, 4),
    ("grid", 3, 12, 2),
    ("grid", 5, 24, 2),
    ("alike", 2, 8, 2),
    ("alike", 3, 12, 4),
    ("alike", 4, 16, 2),
    ("closing", 2, 10, 4),
    ("closing", 3, 14, 2),
    ("closing", 5, 24, 2),
]


def run(
    seed: int = 0,
    scale: float = 1.0,
    dtype: Literal["float32", "float64"] = "float64",
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Check the motion of several sliders in random scenes, one row for each kind and number of sliders.

    Args:
        seed: Seed of the scenes.
        scale: Factor of the number of scenes, 10 000 in each row.
        dtype: Floating type.
        progress: Called after every row with the number of rows done and their total.
        keep: Called after every row with the record so far.

    Returns:
        The record, with the counts of each outcome, the largest violation and the time per scene in each row.
    """
    jax.config.update("jax_enable_x64", dtype == "float64")
    rows: list[dict[str, Any]] = []
    record = result_record("sliders", {"seed": seed, "scale": scale, "allowed": ALLOWED[dtype]}, rows=rows)
    for done, row in enumerate(ROWS):
        rows.append(_row(*row, dtype, max(1, round(scale * SCENES / CHUNK)), seed))
        keep(record)
        progress(done + 1, len(ROWS))
    return record


def _row(kind: str, sliders: int, contacts: int, degree: int, dtype: str, chunks: int, seed: int) -> dict[str, Any]:
    solve, elapsed, worst = jax.jit(solve_in_tiles), [], 0.0
    counts = dict.fromkeys(("moving", "free", "jammed", "wrong", "not_converged"), 0)
    for chunk in range(chunks):
        own_seed, alike = seed + 1000 * chunk, kind == "alike"
        given = scenes(KINDS[kind], sliders, contacts, CHUNK, degree=degree, seed=own_seed, alike=alike)
        of_dtype = problem_of(given, dtype)
        if not chunk:
            jax.block_until_ready(solve(of_dtype))  # compiles
        begin = time.perf_counter()
        motion = jax.block_until_ready(solve(of_dtype))
        elapsed.append(time.perf_counter() - begin)
        status, twist, force = (np.asarray(x) for x in (motion.status, motion.twist, motion.force))
        answered = (status == pj.Status.MOVING) | (status == pj.Status.FREE)
        error = np.where(answered, violations(given, twist, force), 0.0)
        worst = max(worst, float(error.max()))
        wrong = (error > ALLOWED[dtype]) | (status == pj.Status.INVALID)  # all scenes are valid
        jams = np.flatnonzero(status == pj.Status.JAMMED)
        wrong[jams] = [jam_power(given, int(k)) <= LEAST_POWER for k in jams]
        for name in ("moving", "free", "jammed", "not_converged"):
            counts[name] += int(np.sum(status == pj.Status[name.upper()]))
        counts["wrong"] += int(wrong.sum())
    return {
        "kind": kind,
        "sliders": sliders,
        "contacts": contacts,
        "degree": degree,
        "dtype": dtype,
        "scenes": chunks * CHUNK,
        **counts,
        "worst_violation": worst,
        "us_per_scene": 1e6 * float(np.median(elapsed)) / CHUNK,
    }


def solve_in_tiles(problem: SlidersProblem) -> SlidersMotion:
    """Solve the problems of a chunk, a few at once, as they are in a rollout."""
    tiles = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], -1, TILE), -2, 0), problem)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1), jax.lax.map(solve_sliders, tiles))


def problem_of(given: Scenes, dtype: Any = jnp.float64) -> SlidersProblem:
    """Return the contact problem of scenes."""
    numbers = (jnp.asarray(x, dtype) for x in (given.surfaces(), given.rows, given.goal, given.friction))
    table, rows, goal, friction = numbers
    return SlidersProblem(Polynomial(table), rows, goal, friction, jnp.asarray(given.active))


def jam_power(given: Scenes, scene: int) -> float:
    """Return the largest power of forces of sum one that balance on every slider, or -1 if there are none."""
    active = given.active[:, scene]
    normal, tangent = given.rows[:, :, :, active, scene].reshape(2, -1, active.sum())
    friction, goal = np.diag(given.friction[active, scene]), given.goal[:, active, scene]
    eye = np.eye(len(friction))
    found = linprog(
        -goal.ravel(),
        A_ub=np.block([[-friction, eye], [-friction, -eye]]),
        b_ub=np.zeros(2 * len(eye)),
        A_eq=np.block([[normal, tangent], [np.ones((1, len(eye))), np.zeros((1, len(eye)))]]),
        b_eq=np.append(np.zeros(len(normal)), 1.0),
        bounds=[(0, None)] * len(eye) + [(None, None)] * len(eye),
    )
    return -found.fun if found.status == 0 else -1.0


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    names = list(record["rows"][0])
    return "\n".join(
        ["".join(f"{name:>16}" for name in names)]
        + [
            "".join(f"{row[name]:>16.3g}" if isinstance(row[name], float) else f"{row[name]!s:>16}" for name in names)
            for row in record["rows"]
        ]
    )
