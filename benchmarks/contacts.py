"""Check of every answer to thousands of random contact problems: wrong answers, missing answers, and time.

The problems are those of `pushjax.testing.problems`: rigid hands, closing and independent fingers, with and without
gaps, flat faces, opposite pairs, wedges at the border of a jam, pushers that drag the slider along, well and badly
conditioned surfaces. The answers are checked by `pushjax.testing`, which shares no code with the solvers.

- MOVING and FREE are checked against every condition of the contact problem.
- JAMMED is right if the squeeze power is positive and a different solver finds no valid solution from many starts. The
  squeeze power is found by enumeration; for some of the jams, a linear program has to confirm it.
- In float32 a jam may depend on the rounding of the problem's numbers. A jam is counted as borderline, not as wrong, if
  its squeeze power is not positive for the given numbers, but is positive with 1e-5 more friction.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import jax
import numpy as np

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.contact.problem import Motion
from pushjax.experiments._record import result_record
from pushjax.testing import ProblemBatch, search, squeeze_power, squeeze_power_enumerated, violations
from pushjax.testing.problems import random_contacts_problem

# Largest relative violation that an answer may have.
ALLOWED = {"float64": 1e-8, "float32": 1e-4}
# Increase of friction with which a borderline jam has a positive squeeze power.
SLACK = {"float64": 0.0, "float32": 1e-5}
COUNTS = {m: 100_000 if m <= 4 else 10_000 for m in range(1, 9)}
CHUNK = 2000
PROGRAMMED = 50  # jams of each chunk whose squeeze power a linear program has to confirm
MODELS = {"quartic": 4, "ellipsoid": 2}


def run(
    seed: int = 0,
    scale: float = 1.0,
    starts: int = 50,
    contacts: tuple[int, ...] = tuple(COUNTS),
    fixtures: int = 0,
    dtype: Literal["float32", "float64"] = "float64",
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Check the answers to random problems, one row for each number of contacts and each model.

    All rows take a quarter of an hour of one core.

    Args:
        seed: Seed of the problems and of the search for other solutions.
        scale: Factor of the number of problems: 100 000, or 10 000 for more than four contacts. Each row has at least
            2000 problems.
        starts: Starts of the different solver on each problem that was called jammed.
        contacts: Numbers of contacts, each from one to eight.
        fixtures: Number of contacts of each problem that do not move; less than each of `contacts`.
        dtype: Floating type.
        progress: Called after every row with the number of rows done and their total.
        keep: Called after every row with the record so far.

    Returns:
        The record, with the counts of `judge`, the largest violation and the time per problem in each row.

    Raises:
        ValueError: If a number of contacts is not from one to eight, or not greater than `fixtures`.
    """
    wrong = [m for m in contacts if m not in COUNTS]
    if wrong:
        raise ValueError(f"contacts must be from 1 to {max(COUNTS)}; got {wrong[0]}")
    if fixtures < 0 or fixtures >= min(contacts):
        raise ValueError(f"fixtures must be from 0 to {min(contacts) - 1}, one less than contacts; got {fixtures}")
    jax.config.update("jax_enable_x64", dtype == "float64")
    cases = [(m, model) for m in contacts for model in MODELS]
    rows: list[dict[str, Any]] = []
    settings = {"seed": seed, "scale": scale, "starts": starts, "fixtures": fixtures}
    settings |= {"allowed": ALLOWED[dtype], "chunk": CHUNK}
    record = result_record("contacts", settings, rows=rows)
    for done, (m, model) in enumerate(cases):
        rows.append(_row(m, model, dtype, max(CHUNK, int(scale * COUNTS[m])), starts, seed, fixtures))
        keep(record)
        progress(done + 1, len(cases))
    return record


def _row(m: int, model: str, dtype: str, problems: int, starts: int, seed: int, fixtures: int) -> dict[str, Any]:
    def problem_of(key):
        return random_contacts_problem(key, contacts=m, degree=MODELS[model], fixtures=fixtures)

    draw = jax.jit(jax.vmap(problem_of))
    solve = jax.jit(jax.vmap(pj.solve_contacts))
    names = ("solved", "jammed", "wrong", "borderline", "not_converged", "nonunique")
    counts: dict[str, int] = dict.fromkeys(names, 0)
    worst, elapsed, rounds = 0.0, [], -(-problems // CHUNK)
    key = jax.random.fold_in(jax.random.key(seed), 10 * m + MODELS[model])
    for chunk in range(rounds):
        problem = jax.block_until_ready(draw(jax.random.split(jax.random.fold_in(key, chunk), CHUNK)))
        if not chunk:
            jax.block_until_ready(solve(problem.surface, problem.contacts))  # compiles
        begin = time.perf_counter()
        motion = jax.block_until_ready(solve(problem.surface, problem.contacts))
        elapsed.append(time.perf_counter() - begin)
        found, violated = judge(ProblemBatch.of(problem.surface, problem.contacts), motion, dtype, starts, seed + chunk)
        worst = max(worst, violated)
        for name, number in found.items():
            counts[name] += number
    return {
        "contacts": m,
        "model": model,
        "dtype": dtype,
        "problems": rounds * CHUNK,
        **counts,
        "worst_violation": worst,
        "us_per_problem": 1e6 * float(np.median(elapsed)) / CHUNK,
    }


def judge(batch: ProblemBatch, motion: Motion, dtype: str, starts: int, seed: int = 0) -> tuple[dict[str, int], float]:
    """Check a batch of answers; return the number of each outcome and the largest violation by a MOVING or FREE one."""
    status = np.asarray(motion.status)
    answered = (status == pj.Status.MOVING) | (status == pj.Status.FREE)
    twist, force, wrench = (np.asarray(part) for part in (motion.twist, motion.force, motion.wrench))
    worst = violations(batch, twist, force, wrench).worst()
    wrong = (answered & (worst > ALLOWED[dtype])) | (status == pj.Status.INVALID)  # all problems are valid
    borderline = np.zeros(len(status), bool)
    jams = np.flatnonzero(status == pj.Status.JAMMED)
    if jams.size:
        jammed = batch.take(jams)
        tight = squeeze_power_enumerated(jammed) > 0
        few = np.flatnonzero(tight)[:PROGRAMMED]
        tight[few] &= squeeze_power(jammed.take(few)) > 0
        clean = search(jammed, starts=starts, seed=seed).found
        doubtful = np.flatnonzero(~tight)
        loose = ~tight
        if doubtful.size and SLACK[dtype] > 0:
            firmer = replace(jammed, friction=jammed.friction + SLACK[dtype]).take(doubtful)
            loose[doubtful] = squeeze_power_enumerated(firmer) <= 0
        wrong[jams] |= loose | (tight & clean)
        borderline[jams] = ~tight & ~loose
    counts = {
        "solved": int(answered.sum()),
        "jammed": int(jams.size),
        "wrong": int(wrong.sum()),
        "borderline": int(borderline.sum()),
        "not_converged": int(np.sum(status == pj.Status.NOT_CONVERGED)),
        "nonunique": int(np.sum(~np.asarray(motion.unique))),
    }
    return counts, float(worst[answered].max(initial=0.0))


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = [
        f"{'contacts':>8} {'model':10} {'dtype':8} {'problems':>8} {'solved':>8} {'jammed':>7} {'wrong':>6} "
        f"{'borderline':>10} "
        f"{'not conv.':>9} {'nonunique':>9} {'worst':>9} {'us each':>8}"
    ]
    for row in record["rows"]:
        lines.append(
            f"{row['contacts']:8} {row['model']:10} {row['dtype']:8} {row['problems']:8} {row['solved']:8} "
            f"{row['jammed']:7} {row['wrong']:6} {row['borderline']:10} {row['not_converged']:9} {row['nonunique']:9} "
            f"{row['worst_violation']:9.1e} {row['us_per_problem']:8.2f}"
        )
    return "\n".join(lines)
