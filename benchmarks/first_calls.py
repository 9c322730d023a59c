"""Time of first calls including tracing and compiling.

    python -m benchmarks first_calls [CASE …] [--rounds 3] [--batch 2000] [--x64] [--option NAME=VALUE …]

The programs are pushes of a square, their gradient, pushes of a T, and grasps by two fingers and by a parallel jaw
(four contacts). The sessions are the README's example and 1000 random pushes of an L, both timed from after the import
to the end, and the whole command `pushjax identify` on the log of "Getting started".

Each call runs in a process of its own, without a cache of compiled programs, with the cases in turns. Prints the
seconds of tracing, lowering and compiling, the equations traced, the kernels and instructions of the compiled program,
the memory maps that it added to the process (Linux allows 65 530), and the median time of nine runs after the first;
then the medians of all rounds. `--option` sets an option of XLA, as in `jax.jit(compiler_options=...)`. Run nothing
else on the machine meanwhile, because compiling uses all cores.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

STEPS, RUNS, RANDOM_PUSHES = 8, 9, 1000
PROGRAMS = ("push", "gradient", "t", "two_fingers", "jaw")
SESSIONS = ("example", "random_l", "identify")
CASES = PROGRAMS + SESSIONS
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
LAYOUT = "{:>12}" + " {:>12}" * len(COLUMNS)
ROOT = Path(__file__).resolve().parent.parent

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES), default=CASES)
parser.add_argument("--rounds", type=int, default=3)
parser.add_argument("--batch", type=int, default=2000)
parser.add_argument("--x64", action="store_true", help="with float64 enabled, and used")
parser.add_argument("--option", action="append", default=[])
parser.add_argument("--alone", action="store_true", help="one case, in this process")
arguments = parser.parse_args()
if wrong := sorted(set(arguments.cases) - set(CASES)):
    parser.error(f"unknown {', '.join(wrong)}; there are {', '.join(CASES)}")


def main() -> None:
    if arguments.alone:
        print(*measured(arguments.cases[0]))
        return
    from benchmarks._measure import header

    print(header())
    print(LAYOUT.format("", *COLUMNS))
    found = {case: [] for case in arguments.cases}
    for _ in range(arguments.rounds):
        for case in arguments.cases:
            found[case].append(in_process_of_its_own(case))
            print(LAYOUT.format(case, *(f"{x:g}" for x in found[case][-1])), flush=True)
    print("medians")
    for case, rows in found.items():
        print(LAYOUT.format(case, *(f"{median(column):g}" for column in zip(*rows, strict=True))))


def in_process_of_its_own(case: str) -> list[float]:
    """Return `COLUMNS` of one case, measured in a new process."""
    given = [f"--option={option}" for option in arguments.option] + ["--x64"] * arguments.x64
    command = [sys.executable, "-m", "benchmarks.first_calls", case, "--alone", "--batch", str(arguments.batch), *given]
    with tempfile.TemporaryDirectory() as folder:
        if case == "identify":  # writing its log is not timed
            _checked([sys.executable, "-c", log_script()], folder)
            command = [sys.executable, "-m", "pushjax", *identify_arguments(), "--no-cache"]
            begin = perf_counter()
            processor = _checked(command, folder)[1]
            return session(perf_counter() - begin, processor)
        return [float(word) for word in _checked(command, folder)[0].split()]


def _checked(command: list[str], folder: str) -> tuple[str, float]:
    """Run a command, and stop this process with its error output if it fails.

    Args:
        command: The command.
        folder: Folder in which it runs.

    Returns:
        What the command prints, and the processor time that it took, in s.
    """
    before = os.times()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    after = os.times()
    if done.returncode:
        raise SystemExit(done.stderr)
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, used


def session(seconds: float, processor: float) -> list[float]:
    """Return `COLUMNS` of a whole session, with NaN for all but its two times.

    Args:
        seconds: Wall time, in s.
        processor: Processor time, in s.
    """
    known = {"first_call_s": round(seconds, 2), "processor_s": round(processor, 2)}
    return [known.get(column, float("nan")) for column in COLUMNS]


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


def measured(case: str) -> list[float]:
    """Return `COLUMNS` of one case, measured in this process."""
    if case in SESSIONS:
        return in_session(case)
    import jax

    from benchmarks.hlo import traffic

    jax.config.update("jax_enable_x64", arguments.x64)
    jax.config.update("jax_enable_compilation_cache", False)
    function, args = work(case, "float64" if arguments.x64 else "float32")
    jax.block_until_ready(args)
    options = dict(option.split("=", 1) for option in arguments.option)
    program = jax.jit(function, compiler_options=options)

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
    return [*seconds, *counts, round(median(runs), 2)]


def memory_maps() -> int:
    """Return the number of memory maps of this process, or zero where the system does not list them."""
    listed = Path("/proc/self/maps")
    return len(listed.read_text().splitlines()) if listed.exists() else 0


def equations(jaxpr) -> int:
    """Return the number of equations of a traced program, with those of its loops and inner calls."""
    from jax.extend.core import jaxprs_in_params

    return sum(1 + sum(map(equations, jaxprs_in_params(each.params))) for each in jaxpr.eqns)


def in_session(case: str) -> list[float]:
    """Return `COLUMNS` of a session that runs in this process, timed from after the import."""
    import jax
    import jax.numpy as jnp

    import pushjax as pj

    jax.config.update("jax_enable_x64", arguments.x64)
    jax.config.update("jax_enable_compilation_cache", False)
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
    return session(perf_counter() - begin, process_time() - busy)


def work(case: str, dtype: str) -> tuple:
    """Return the function of a program and its arguments.

    Args:
        case: One of `PROGRAMS`.
        dtype: Floating type.
    """
    import jax
    import jax.numpy as jnp

    import pushjax as pj
    from benchmarks import cases, grasps, tasks

    if case in ("push", "gradient"):
        one, args = cases.each_push("quartic", dtype, arguments.batch, STEPS)
    elif case == "t":
        one, (_, path, friction) = cases.each_push("quartic", dtype, arguments.batch, STEPS)
        one, args = push_of_t(dtype), (path, friction)
    else:
        hand = grasps.hand(dtype) if case == "two_fingers" else tasks.cast(pj.Hand.parallel_jaw(0.05, 0.01), dtype)
        one, args = cases.each_grasp(hand, dtype, arguments.batch, STEPS)
    final = jax.vmap(lambda *each: one(*each).pose[-1])
    if case == "gradient":
        return jax.grad(lambda *args: jnp.sum(final(*args)), argnums=(0, 1, 2)), args
    return final, args


def push_of_t(dtype: str):
    """Return the function of one push of a T, which is as large as the square, against its bar."""
    import pushjax as pj
    from benchmarks import tasks

    task = tasks.task("quartic", dtype)
    task = task._replace(slider=pj.Slider(tasks.cast(tasks.t_block(), dtype), task.slider.surface))
    return lambda path, friction: task.push(path, friction)


if __name__ == "__main__":
    main()
