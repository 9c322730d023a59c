"""Files of arrays in NumPy's format "npz", written as a whole or not at all."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np


def save_arrays(path: str | Path, version: int, arrays: dict[str, Any]) -> None:
    """Write arrays by name, with the version of their format, to exactly this path."""
    target = Path(path).expanduser()
    partial = target.with_name(f".{target.name}-{os.getpid()}")
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, format_version=version, **arrays)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def load_arrays(path: str | Path, content: str, version: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read what `save_arrays` wrote, where `content` is what the file should hold, in words."""
    try:
        with np.load(Path(path).expanduser()) as file:
            found = {name: file[name] for name in ("format_version", *names)}
        if (written := found.pop("format_version")) != version:
            raise ValueError(f"its format is {written}; this program reads {version}")
    except FileNotFoundError:
        raise
    except (KeyError, ValueError, TypeError, EOFError, OSError, BadZipFile) as error:
        raise ValueError(f"{path} does not hold {content}: {error}") from error
    return found


def check_arrays(path: str | Path, content: str, arrays: dict[str, np.ndarray], shapes: dict[str, tuple]) -> None:
    """Raise ValueError unless the arrays have these shapes and are finite."""
    # Equal words in shapes are equal sizes.
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        array = arrays[name]
        wanted = tuple(
            sizes.setdefault(each, found) if isinstance(each, str) else each
            for each, found in zip(shape, array.shape, strict=False)
        )
        if len(shape) != array.ndim or wanted != array.shape:
            raise ValueError(f"{path} does not hold {content}: {name} has shape {array.shape}; expected {shape}")
        if array.dtype.kind not in "bfiu" or not np.all(np.isfinite(array)):
            raise ValueError(f"{path} does not hold {content}: {name} must be finite numbers")
