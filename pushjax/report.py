"""What a command prints, in one envelope: settings, versions, machine, figures."""

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


def envelope(experiment: str, settings: dict[str, Any], **figures: Any) -> dict[str, Any]:
    """The record of one run. `figures` are the experiment's own ("cells" or "rows", and whatever else it found)."""
    import pushjax

    return {
        "experiment": experiment,
        "versions": {"python": platform.python_version(), "pushjax": pushjax.__version__}
        | {name: version(name) for name in PACKAGES},
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "devices": [str(device) for device in jax.devices()],
            "x64": bool(jax.config.jax_enable_x64),  # pyright: ignore[reportAttributeAccessIssue]
        },
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "settings": settings,
    } | figures


def write_json(record: dict[str, Any], path: Path) -> None:
    """Write a record; numpy and JAX numbers and arrays become plain ones. NaN is refused."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=2, default=plain, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """What `json` cannot write by itself."""
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        return np.asarray(value).tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write a {type(value).__name__} to JSON")
