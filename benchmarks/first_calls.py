"""Time of first calls including tracing and compiling.

The programs are pushes of a square, their gradient, pushes of a T, and grasps by two fingers and by a parallel jaw
(four contacts). The sessions are the README's example and 1000 random pushes of an L, both timed from after the import
to the end, and the whole command `pushjax identify` on the log of "Getting started".

Each call runs in a process of its own, without a cache of compiled programs, with the cases in turns. The figures are
the seconds of tracing, lowering and compiling, the equations traced, the kernels and instructions of the compiled
program, the memory maps that it added to the process (Linux allows 65 530), and the median time of nine runs after the
first; then the medians of all rounds. Run nothing else on the machine meanwhile, because compiling uses all cores.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Annotated, Any, Literal, get_args

import tyro

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record

RUNS, RANDOM_PUSHES = 9, 1000
Program = Literal["push", "gradient", "t", "two_fingers", "jaw"]
Session = Literal["example", "random_l", "identify"]
COLUMNS = (
    "trace_s",
    "lower_s",
    "compile_s",
    "first_call_s",
    "processor_s",
    "equations",
    "kernels",
    "instructions",
    "maps",
    "run_ms",
)
ROOT = Path(__file__).resolve().parent.parent
Figures = dict[str, float]


def run(
    cases: Annotated[tuple[Program | Session, ...], tyro.conf.Positional] = (*get_args(Program), *get_args(Session)),
    rounds: int = 3,
    batch: int = 2000,
    x64: bool = False,
    option: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")] = (),
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Measure first calls, each in a process of its own.

    Args:
        cases: Names of programs and sessions.
        rounds: Number of times that each is measured, in turns.
        batch: Number of pushes or grasps of a program.
        x64: Whether to compute in float64.
        option: Options of XLA, as in `jax.jit(compiler_options=...)`.
        progress: Called with the number of calls done and their total.
        keep: Called with the record so far.

    Returns:
        The record, with one row for each call in the order of the calls, and the `medians` of each case. A session has
        two times only.
    """
    settings = {"rounds": rounds, "batch": batch, "x64": x64, "option": list(option)}
    rows: list[dict[str, Any]] = []
    record = result_record("first_calls", settings, rows=rows, medians=[])
    for _ in range(rounds):
        for case in cases:
            rows.append({"case": case} | _in_process_of_its_own(case, settings))
            keep(record)
            progress(len(rows), rounds * len(cases))
    for case in cases:
        mine = [row for row in rows if row["case"] == case]
        medians = {name: median(row[name] for row in mine) for name in COLUMNS if name in mine[0]}
        record["medians"].append({"case": case} | medians)
    return record


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""

    def line(row: dict[str, Any]) -> str:
        return f"{row['case']:>12}" + "".join(f" {row[x]:>12g}" if x in row else f" {'':>12}" for x in COLUMNS)

    heads = " " * 12 + "".join(f" {name:>12}" for name in COLUMNS)
    return "\n".join([heads, *map(line, record["rows"]), "medians", *map(line, record["medians"])])


def _in_process_of_its_own(case: str, settings: dict[str, Any]) -> Figures:
    """Return the figures of one case, measured in a new process."""
    command = [sys.executable, "-m", "benchmarks.first_calls", case, json.dumps(settings)]
    with tempfile.TemporaryDirectory() as folder:
        if case == "identify":  # writing its log is not timed
            _checked([sys.executable, "-c", log_script()], folder)
            command = [sys.executable, "-m", "pushjax", *identify_arguments(), "--no-cache"]
            begin = perf_counter()
            processor = _checked(command, folder)[1]
            return _session(perf_counter() - begin, processor)
        return json.loads(_checked(command, folder)[0])


def _checked(command: list[str], folder: str) -> tuple[str, float]:
    """Run a command in `folder`; return what it prints and its processor time, s, or exit with its error output."""
    before = os.times()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    after = os.times()
    if done.returncode:
        raise SystemExit(done.stderr)
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, used


def _session(seconds: float, processor: float) -> Figures:
    """Return the figures of a whole session: its wall time and its processor time, in s."""
    return {"first_call_s": round(seconds, 2), "processor_s": round(processor, 2)}


def blocks(page: str, language: str) -> list[str]:
    """Return the code blocks of one language on a page of the documentation."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


def log_script() -> str:
    """Return the code of "Getting started" up to the block that writes the log of pushes."""
    code = blocks("docs/getting-started.md", "python")
    return "\n".join(code[: next(k for k, block in enumerate(code) if "pushes.csv" in block) + 1])


def identify_arguments() -> list[str]:
    """Return the arguments of `pushjax identify` in "Getting started"."""
    (command,) = [line for line in blocks("docs/getting-started.md", "sh") if line.startswith("pushjax identify")]
    return command.split()[1:]


def measured(case: str, batch: int, x64: bool, option: list[str], rounds: int = 1) -> Figures:
    """Return the figures of one case, measured in this process, with the settings of `run`."""
    import jax

    from benchmarks.hlo import traffic

    jax.config.update("jax_enable_x64", x64)
    jax.config.update("jax_enable_compilation_cache", False)
    if case in get_args(Session):
        return _in_session(case)
    function, args = work(case, "float64" if x64 else "float32", batch)
    jax.block_until_ready(args)
    program = jax.jit(function, compiler_options=dict(each.split("=", 1) for each in option))

    maps, busy = memory_maps(), process_time()
    begin = perf_counter()
    traced = program.trace(*args)
    then = perf_counter()
    lowered = traced.lower()
    later = perf_counter()
    compiled = lowered.compile()
    end = perf_counter()
    jax.block_until_ready(compiled(*args))
    first = perf_counter() - begin
    busy, maps = process_time() - busy, memory_maps() - maps

    text = compiled.as_text() or ""
    instructions = len(re.findall(r"^ +(?:ROOT )?%?[\w.-]+ = ", text, re.MULTILINE))
    runs = []
    for _ in range(RUNS):
        begin_run = perf_counter()
        jax.block_until_ready(compiled(*args))
        runs.append(1e3 * (perf_counter() - begin_run))
    seconds = [round(x, 2) for x in (then - begin, later - then, end - later, first, busy)]
    counts = [equations(traced.jaxpr.jaxpr), traffic(text).kernels, instructions, maps]
    return dict(zip(COLUMNS, [*seconds, *counts, round(median(runs), 2)], strict=True))


def memory_maps() -> int:
    """Return the number of memory maps of this process, or zero where the system does not list them."""
    listed = Path("/proc/self/maps")
    return len(listed.read_text().splitlines()) if listed.exists() else 0


def equations(jaxpr) -> int:
    """Return the number of equations of a traced program, with those of its loops and inner calls."""
    from jax.extend.core import jaxprs_in_params

    return sum(1 + sum(map(equations, jaxprs_in_params(each.params))) for each in jaxpr.eqns)


def _in_session(case: str) -> Figures:
    """Return the figures of a session that runs in this process, timed from after the import."""
    import jax
    import jax.numpy as jnp

    import pushjax as pj

    begin, busy = perf_counter(), process_time()
    if case == "example":
        exec(blocks("README.md", "python")[0], {})
    else:
        corners = [(-0.05, -0.05), (0.05, -0.05), (0.05, 0.0), (0.0, 0.0), (0.0, 0.05), (-0.05, 0.05)]
        shape = pj.Polygon(corners)
        pairs = pj.Support.uniform(shape, points=64).wrench_twist_pairs(jax.random.key(0), 400)
        slider = pj.Slider(shape, pj.fit_limit_surface(*pairs, degree=4))
        path = pj.line((-0.06, 0.0), (-0.02, 0.01), 40)
        model = pj.FrictionModel(dof=20, friction=(0.15, 0.35))
        hand, key = pj.Hand.finger(0.005), jax.random.key(1)
        pj.monte_carlo(key, RANDOM_PUSHES, slider, hand, path, pose=jnp.zeros(3), model=model).summary()
    return _session(perf_counter() - begin, process_time() - busy)


def work(case: str, dtype: str, batch: int) -> tuple:
    """Return the function of a program and its arguments."""
    import jax
    import jax.numpy as jnp

    from benchmarks import cases

    makers = {"t": cases.push_t, "jaw": cases.grasp_jaw, "two_fingers": partial(cases.grasp, steps=cases.MANY_STEPS)}
    if case in makers:
        made = makers[case](dtype, batch)
        return made.function, made.args
    one, args = cases.each_push("quartic", dtype, batch, cases.MANY_STEPS)
    final = cases.final_poses(one, batch)
    if case == "gradient":
        return jax.grad(lambda *args: jnp.sum(final(*args)), argnums=(0, 1, 2)), args
    return final, args


if __name__ == "__main__":
    print(json.dumps(measured(sys.argv[1], **json.loads(sys.argv[2]))))
