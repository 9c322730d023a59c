"""Timing for the benchmarks: compile time apart, medians after warm-up, alternating between what is compared."""

import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import numpy as np


def header() -> str:
    """One line on the machine and the versions, to print above any figure."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as info:
            cpu = next((line.split(":")[1].strip() for line in info if line.startswith("model name")), cpu)
    except OSError:
        pass
    devices = ", ".join(str(device) for device in jax.devices())
    return f"{cpu}, {os.cpu_count()} cores; devices {devices}; jax {jax.__version__}, jaxlib {version('jaxlib')}"


def compiled(function: Callable, *args: Any) -> tuple[Callable, float]:
    """The jitted function, compiled for `args`, and the seconds that tracing and compiling took."""
    begin = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    return program, time.perf_counter() - begin


def alternate(programs: dict[str, tuple[Callable, tuple]], repeats: int = 7) -> dict[str, float]:
    """Median run time in s of each program, run in turn so that a slow spell of the machine meets all of them."""
    times: dict[str, list[float]] = {name: [] for name in programs}
    for k in range(repeats + 1):
        for name, (program, args) in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(program(*args))
            if k:  # the first round warms up
                times[name].append(time.perf_counter() - begin)
    return {name: float(np.median(t)) for name, t in times.items()}
