"""The record of a run (results, settings, versions, machine), and its JSON file."""

import json
import math
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import pushjax
from pushjax._internal.checks import warn

PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpy", "matplotlib")


def result_record(experiment: str, settings: dict[str, Any], **figures: Any) -> dict[str, Any]:
    """Return the record of one run: where, when and with which settings it ran, followed by its figures."""
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
    """Return the name of the processor's model, or its architecture where the system does not name it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def write_json(record: dict[str, Any], path: Path) -> None:
    """Write a record to a JSON file, and warn of numbers that are not finite."""
    missing: list[str] = []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(as_plain(record, "", missing), indent=2, allow_nan=False) + "\n")
    if missing:
        others = f", and {len(missing) - 1} more" if len(missing) > 1 else ""
        warn(f"{path}: {missing[0]}{others} is not a finite number; it is null there")


def as_plain(value: Any, name: str = "", missing: list[str] | None = None) -> Any:
    """Return a value as JSON has it; the names of numbers that are not finite, which are None, go to `missing`."""
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        value = np.asarray(value).tolist()
    if isinstance(value, dict):
        return {key: as_plain(entry, f"{name}.{key}" if name else key, missing) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(entry, f"{name}[{k}]", missing) for k, entry in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        if missing is not None:
            missing.append(name)
        return None
    return str(value) if isinstance(value, Path) else value
