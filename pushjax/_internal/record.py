"""Records of a command's results, with its settings, the versions and the machine, and their JSON files."""

import json
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpy", "matplotlib")


def result_record(experiment: str, settings: dict[str, Any], **figures: Any) -> dict[str, Any]:
    """Return the record of one run.

    Args:
        experiment: Name of the experiment.
        settings: Settings of the run.
        **figures: The experiment's results: "cells" or "rows", and further results of its own.

    Returns:
        A dictionary with the entries "experiment", "versions", "machine", "date" (UTC) and "settings", followed by the
        figures.
    """
    import pushjax

    return {
        "experiment": experiment,
        "versions": {"python": platform.python_version(), "pushjax": pushjax.__version__}
        | {name: version(name) for name in PACKAGES},
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "devices": [str(device) for device in jax.devices()],
            "x64": bool(jax.config.jax_enable_x64),  # pyright: ignore[reportAttributeAccessIssue]
        },
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "settings": settings,
    } | figures


def _processor() -> str:
    """Return the name of the processor's model, or its architecture where the system does not tell."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def write_json(record: dict[str, Any], path: Path) -> None:
    """Write a record as JSON, with NumPy and JAX arrays and numbers as lists and Python numbers.

    Args:
        record: The record.
        path: The file. Its folder is created.

    Raises:
        ValueError: If a number is NaN or infinite.
        TypeError: If a value cannot be written to JSON.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=2, default=to_builtin, allow_nan=False) + "\n")


def to_builtin(value: Any) -> Any:
    """Convert a value that `json` cannot write by itself: an array, a NumPy or JAX number, or a path."""
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        return np.asarray(value).tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write a {type(value).__name__} to JSON")
