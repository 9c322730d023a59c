"""Timing of programs in turns, with compile time apart and medians after warm-up, and the machine's own ceilings.

Machines are shared and their clocks change, so only ratios of times that were measured in turns in one process mean
anything. Every timing therefore comes with that of a reference kernel, a chain of fused multiply-adds (FMA), which is
run in the same turns.
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

from benchmarks.hlo import Traffic, traffic

REPEATS = 7
LEAST_S = 0.03  # shortest time of a program in one turn; a shorter program runs several times
CHAINS, LINKS, ROUNDS = 8, 16, 200  # size of the FMA kernel, which is compute-bound


class Sizes(NamedTuple):
    """Sizes of the kernels of `Ceiling`."""

    lanes: int  # of the FMA kernel
    copied: int  # count of numbers that exceeds every cache
    passes: int  # how often they are copied
    near: int  # count of numbers that fits the second-level cache
    near_passes: int  # how often these are copied


# On a CPU the lanes fit the first-level cache, and the second-level cache also holds the data of a tile of pushes.
CPU = Sizes(lanes=4096, copied=1 << 24, passes=4, near=1 << 16, near_passes=1000)
# An accelerator has many threads and larger caches. Copies of fewer numbers would take less time than their kernels
# take to start.
ACCELERATOR = Sizes(lanes=1 << 22, copied=1 << 28, passes=20, near=1 << 22, near_passes=1000)


class Program(NamedTuple):
    """A compiled program with its arguments."""

    call: Callable
    args: tuple
    compile_s: float  # time to trace and compile
    traffic: Traffic | None  # of one run, or None if there is not one program with a text

    def run(self) -> Any:
        """Run the program, and return its results when they are ready."""
        return jax.block_until_ready(self.call(*self.args))


class Timing(NamedTuple):
    """Times of one run, in s."""

    median: float  # wall time
    low: float  # lower quartile of the wall time
    high: float  # upper quartile of the wall time
    # Median of the processor time of all threads of the process, which other programs on the machine change least. On
    # an accelerator it is the median of the wall time.
    processor: float


def compiled(function: Callable, *args: Any) -> Program:
    """Trace and compile `jit(function)` for these arguments."""
    # If the process has a cache of compiled programs, the program may be loaded from there; the command turns the cache
    # off.
    begin = time.perf_counter()
    call = jax.jit(function).lower(*args).compile()
    compile_s = time.perf_counter() - begin
    text = call.as_text()
    return Program(call, args, compile_s, None if text is None else traffic(text))


def called(function: Callable, *args: Any) -> Program:
    """Call a function that compiles by itself; `compile_s` is the time of the first call less that of the second."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*args))
    middle = time.perf_counter()
    jax.block_until_ready(function(*args))
    compile_s = max(0.0, 2 * middle - begin - time.perf_counter())
    return Program(function, args, compile_s, None)


def alternate(
    programs: dict[str, Callable[[], Any]], repeats: int = REPEATS, most_s: float = math.inf
) -> dict[str, Timing]:
    """Time programs that are run in turns, so that a slow spell of the machine meets all of them."""
    # In each turn a program first runs once without being timed, because the program before it has left its own data in
    # the caches. A short program then runs several times. If `most_s` (s, of all turns together) requires it, there are
    # fewer turns, but at least one.
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
    """Return wall and processor time of a run, as the mean of `count` runs after one that is not timed."""
    clock = time.process_time if on_cpu() else time.perf_counter
    run()
    begin, busy = time.perf_counter(), clock()
    for _ in range(count):
        run()
    return (time.perf_counter() - begin) / count, (clock() - busy) / count


def on_cpu() -> bool:
    """Return whether JAX computes on a CPU."""
    return jax.default_backend() == "cpu"


@contextmanager
def both_dtypes() -> Iterator[None]:
    """Allow float64 within the context, whatever the process has set."""
    # The library computes in the dtype of its arguments, so float32 is still possible.
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def sizes() -> Sizes:
    """Return the sizes of the kernels for the device on which JAX computes."""
    return CPU if on_cpu() else ACCELERATOR


class Ceiling(NamedTuple):
    """Kernels that compute and move data as fast as the machine can."""

    multiply_add: Program  # FMA kernel
    flops: float  # floating-point operations in one run of it
    copied: Program  # copy of data that fits no cache
    near: Program  # copy of data that fits the second-level cache

    def runs(self) -> dict[str, Callable[[], Any]]:
        """Return the kernels by name, as `alternate` takes them."""
        return {"multiply_add": self.multiply_add.run, "copied": self.copied.run, "near": self.near.run}


@cache
def ceiling(dtype: str) -> Ceiling:
    """Return the kernels in `dtype`, written in the same way as the library: JAX on batches, compiled by XLA."""
    kind, size = jnp.dtype(dtype), sizes()

    def multiply_add(x):
        def round_(_, chains):
            for _ in range(LINKS):
                chains = [chain * 0.999 + 0.001 for chain in chains]
            # Each round ends in one array, because several arrays would become several loops over the lanes.
            total = chains[0]
            for chain in chains[1:]:
                total = total + chain
            return [total * (0.1 + 0.01 * k) for k in range(CHAINS)]

        return jax.lax.fori_loop(0, ROUNDS, lambda k, x: round_(k, [x * (1 + 0.01 * j) for j in range(CHAINS)])[0], x)

    def moved(count: int, passes: int) -> Program:
        # The copy is made in place again and again, because the process would have to wait for new memory.
        return compiled(lambda x: jax.lax.fori_loop(0, passes, lambda _, x: x * 1.000001, x), jnp.ones(count, kind))

    lanes = jnp.linspace(0.5, 1.5, size.lanes, dtype=kind)
    flops = size.lanes * ROUNDS * CHAINS * (2.0 * LINKS + 2)
    copies = moved(size.copied, size.passes), moved(size.near, size.near_passes)
    return Ceiling(compiled(multiply_add, lanes), flops, *copies)


def rates(top: Ceiling, dtype: str, timings: dict[str, Timing]) -> dict[str, float]:
    """Return the ceilings of one processor, in GFLOP/s and GB/s (read and written), from timings of `Ceiling.runs`."""
    each, size = 2e-9 * jnp.dtype(dtype).itemsize, sizes()
    return {
        "multiply_add_gflops": top.flops / timings["multiply_add"].processor / 1e9,
        "copy_gbytes": each * size.copied * size.passes / timings["copied"].processor,
        "near_copy_gbytes": each * size.near * size.near_passes / timings["near"].processor,
    }
