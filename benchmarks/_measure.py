"""Timing of functions for the scripts, on top of `benchmarks.timing`, and a line on the machine."""

import os
import platform
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax

from benchmarks import timing


def header() -> str:
    """Return one line on the machine and the versions, to print above any figure."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as info:
            cpu = next((line.split(":")[1].strip() for line in info if line.startswith("model name")), cpu)
    except OSError:
        pass
    devices = ", ".join(str(device) for device in jax.devices())
    return f"{cpu}, {os.cpu_count()} cores; devices {devices}; jax {jax.__version__}, jaxlib {version('jaxlib')}"


def compiled(function: Callable, *args: Any) -> tuple[Callable, float]:
    """Return the jitted function, compiled for `args`, and the seconds that tracing and compiling took."""
    program = timing.compiled(function, *args)
    return program.call, program.compile_s


def alternate(programs: dict[str, tuple[Callable, tuple]], repeats: int = timing.REPEATS) -> dict[str, float]:
    """Return the median run time of each program, with the programs run in turns (`timing.alternate`).

    Args:
        programs: Programs by name, each with its arguments.
        repeats: Number of turns.

    Returns:
        Median times by name, in s.
    """

    def run(program: Callable, args: tuple) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(program(*args))

    timings = timing.alternate({name: run(*each) for name, each in programs.items()}, repeats)
    return {name: timing.median for name, timing in timings.items()}
