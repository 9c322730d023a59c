"""What a first call takes: a rollout, its gradient, a grasp by two fingers and by a parallel jaw (four contacts).

    python benchmarks/first_calls.py [CASE …] [--rounds 3] [--batch 2000] [--x64] [--option NAME=VALUE …]

Each call is in a process of its own, without a cache of compiled programs, the cases in turns. Prints the seconds of
tracing, lowering and compiling, the kernels and instructions of the compiled program, and the median of nine runs after
the first; then the medians of all rounds. `--option` is one of XLA's, as in `jax.jit(compiler_options=...)`. Leave the
machine alone meanwhile: compiling uses all cores.
"""

import argparse
import re
import subprocess
import sys
from statistics import median
from time import perf_counter

STEPS, RUNS = 8, 9
CASES = ("push", "gradient", "two_fingers", "jaw")
COLUMNS = ("trace_s", "lower_s", "compile_s", "first_call_s", "kernels", "instructions", "run_ms")

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
    from _measure import header

    print(header())
    row = "{:>12}" + " {:>12}" * len(COLUMNS)
    print(row.format("", *COLUMNS))
    found = {case: [] for case in arguments.cases}
    for _ in range(arguments.rounds):
        for case in arguments.cases:
            found[case].append(in_process_of_its_own(case))
            print(row.format(case, *(f"{x:g}" for x in found[case][-1])), flush=True)
    print("medians")
    for case, rows in found.items():
        print(row.format(case, *(f"{median(column):g}" for column in zip(*rows, strict=True))))


def in_process_of_its_own(case: str) -> list[float]:
    given = [f"--option={option}" for option in arguments.option] + ["--x64"] * arguments.x64
    command = [sys.executable, __file__, case, "--alone", "--batch", str(arguments.batch), *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return [float(word) for word in done.stdout.split()]


def measured(case: str) -> list[float]:
    """`COLUMNS` of one case."""
    import jax

    from pushjax.bench.traffic import traffic

    jax.config.update("jax_enable_x64", arguments.x64)
    jax.config.update("jax_enable_compilation_cache", False)
    function, args = work(case, "float64" if arguments.x64 else "float32")
    jax.block_until_ready(args)
    options = dict(option.split("=", 1) for option in arguments.option)
    program = jax.jit(function, compiler_options=options)

    begin = perf_counter()
    traced = program.trace(*args)
    then = perf_counter()
    lowered = traced.lower()
    later = perf_counter()
    compiled = lowered.compile()
    end = perf_counter()
    jax.block_until_ready(compiled(*args))
    first = perf_counter() - begin

    text = compiled.as_text() or ""
    instructions = len(re.findall(r"^ +(?:ROOT )?%?[\w.-]+ = ", text, re.MULTILINE))
    runs = []
    for _ in range(RUNS):
        begin_run = perf_counter()
        jax.block_until_ready(compiled(*args))
        runs.append(1e3 * (perf_counter() - begin_run))
    seconds = [round(x, 2) for x in (then - begin, later - then, end - later, first)]
    return [*seconds, traffic(text).kernels, instructions, round(median(runs), 2)]


def work(case: str, dtype: str) -> tuple:
    """The function of the case, and its arguments."""
    import jax
    import jax.numpy as jnp

    import pushjax as pj
    from pushjax.bench import cases, grasps, tasks

    if case in ("push", "gradient"):
        one, args = cases.each_push("quartic", dtype, arguments.batch, STEPS)
    else:
        hand = grasps.hand(dtype) if case == "two_fingers" else tasks.cast(pj.Hand.parallel_jaw(0.05, 0.01), dtype)
        one, args = cases.each_grasp(hand, dtype, arguments.batch, STEPS)
    final = jax.vmap(lambda *each: one(*each).pose[-1])
    if case == "gradient":
        return jax.grad(lambda *args: jnp.sum(final(*args)), argnums=(0, 1, 2)), args
    return final, args


if __name__ == "__main__":
    main()
