"""Timing: compile time apart, medians after warm-up, in turns with what is compared; and the machine's own ceilings.

Machines are shared and their clocks change: only ratios of what ran in turns in one process mean anything. So every
timing goes with a reference kernel, a chain of fused multiply-adds (FMA), run in the same turns.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pushjax.bench.traffic import Traffic, traffic

REPEATS = 7
LEAST_S = 0.03  # of a turn
CHAINS, LINKS, ROUNDS = 8, 16, 200  # the FMA kernel, compute-bound
LANES, MANY_LANES = 4096, 1 << 22  # of a CPU, in the first-level cache; of an accelerator, which has many threads
COPIED, PASSES = 1 << 24, 4  # numbers beyond any cache of a CPU, and how often
NEAR, NEAR_PASSES = 1 << 16, 1000  # what the second-level cache holds, as it does what a tile of pushes works on


class Program(NamedTuple):
    """A compiled program with its arguments. traffic: of one run, where there is one program and its text."""

    call: Callable
    args: tuple
    compile_s: float
    traffic: Traffic | None

    def run(self) -> Any:
        return jax.block_until_ready(self.call(*self.args))


class Timing(NamedTuple):
    """Seconds of one run: median, and the range of the middle half. processor: the median of what all threads of the
    process took of processors, which a machine's other programs change least; where something else computes, of time
    as such."""

    median: float
    low: float
    high: float
    processor: float


def compiled(function: Callable, *args: Any) -> Program:
    """`jit(function)` for these arguments, traced and compiled (or, if the process has a cache of compiled programs,
    loaded: the command turns it off)."""
    begin = time.perf_counter()
    call = jax.jit(function).lower(*args).compile()
    compile_s = time.perf_counter() - begin
    text = call.as_text()
    return Program(call, args, compile_s, None if text is None else traffic(text))


def called(function: Callable, *args: Any) -> Program:
    """A function that compiles by itself, as far as it does. compile_s: the first call less the second."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*args))
    middle = time.perf_counter()
    jax.block_until_ready(function(*args))
    compile_s = max(0.0, 2 * middle - begin - time.perf_counter())
    return Program(function, args, compile_s, None)


def alternate(
    programs: dict[str, Callable[[], Any]], repeats: int = REPEATS, most_s: float = math.inf
) -> dict[str, Timing]:
    """Time each, run in turns, so that a slow spell of the machine meets all of them; in a turn once without a clock,
    since the one before has left its own numbers in the caches, and a short one several times. most_s: of all turns
    together, which leaves out some if need be."""
    once = {name: max(_seconds(run)[0], 1e-9) for name, run in programs.items()}
    counts = {name: max(1, round(LEAST_S / seconds)) for name, seconds in once.items()}
    turn = sum(seconds * (counts[name] + 1) for name, seconds in once.items())
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in programs}
    for _ in range(max(1, int(min(repeats, most_s / turn)))):
        for name, run in programs.items():
            times[name].append(_seconds(run, counts[name]))
    found = {}
    for name, both in times.items():
        wall, processor = np.array(both).T
        low, median, high = (float(q) for q in np.quantile(wall, (0.25, 0.5, 0.75)))
        found[name] = Timing(median, low, high, float(np.median(processor)))
    return found


def _seconds(run: Callable[[], Any], count: int = 1) -> tuple[float, float]:
    """Wall and processor time of a run; the first of all runs is not counted."""
    clock = time.process_time if on_cpu() else time.perf_counter
    run()
    begin, busy = time.perf_counter(), clock()
    for _ in range(count):
        run()
    return (time.perf_counter() - begin) / count, (clock() - busy) / count


def on_cpu() -> bool:
    return jax.default_backend() == "cpu"


@contextmanager
def both_dtypes() -> Iterator[None]:
    """float64 is allowed, whatever the process had set; the library computes in what it is given."""
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


class Ceiling(NamedTuple):
    """The machine's own kernels: FMA as fast as it computes, `copied` as fast as it moves what fits no cache, `near`
    what fits the second one."""

    multiply_add: Program
    flops: float
    copied: Program
    near: Program

    def runs(self) -> dict[str, Callable[[], Any]]:
        return {"multiply_add": self.multiply_add.run, "copied": self.copied.run, "near": self.near.run}


@cache
def ceiling(dtype: str) -> Ceiling:
    """The kernels, in `dtype`, written as the library is: JAX on batches, compiled by XLA."""
    kind = jnp.dtype(dtype)

    def multiply_add(x):
        def round_(_, chains):
            for _ in range(LINKS):
                chains = [chain * 0.999 + 0.001 for chain in chains]
            # each round one array: several would be several loops over the lanes
            total = chains[0]
            for chain in chains[1:]:
                total = total + chain
            return [total * (0.1 + 0.01 * k) for k in range(CHAINS)]

        return jax.lax.fori_loop(0, ROUNDS, lambda k, x: round_(k, [x * (1 + 0.01 * j) for j in range(CHAINS)])[0], x)

    def moved(count: int, passes: int) -> Program:
        # in place, again and again: memory that is new to the process would be waited for
        return compiled(lambda x: jax.lax.fori_loop(0, passes, lambda _, x: x * 1.000001, x), jnp.ones(count, kind))

    many = LANES if on_cpu() else MANY_LANES
    lanes = jnp.linspace(0.5, 1.5, many, dtype=kind)
    flops = many * ROUNDS * CHAINS * (2.0 * LINKS + 2)
    return Ceiling(compiled(multiply_add, lanes), flops, moved(COPIED, PASSES), moved(NEAR, NEAR_PASSES))


def rates(top: Ceiling, dtype: str, timings: dict[str, Timing]) -> dict[str, float]:
    """Ceilings in GFLOP/s and GB/s (read and written) of one processor, from timings of `Ceiling.runs`."""
    each = 2e-9 * jnp.dtype(dtype).itemsize
    return {
        "multiply_add_gflops": top.flops / timings["multiply_add"].processor / 1e9,
        "copy_gbytes": each * COPIED * PASSES / timings["copied"].processor,
        "near_copy_gbytes": each * NEAR * NEAR_PASSES / timings["near"].processor,
    }
