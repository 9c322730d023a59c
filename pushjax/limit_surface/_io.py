"""Limit surfaces in files."""

import json
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from pushjax._files import read_record
from pushjax.limit_surface._base import LimitSurface
from pushjax.limit_surface.ellipsoid import Ellipsoid
from pushjax.limit_surface.quartic import Quartic

FORMAT = "pushjax limit surface"
VERSION = 1
S = TypeVar("S", bound=LimitSurface)


def save_surface(surface: LimitSurface, path: str | Path) -> None:
    record: dict = {"format": FORMAT, "version": VERSION, "dtype": str(surface.length.dtype)}
    # repr of a float64 is exact, and a float32 is a float64
    record["length"] = float(surface.length)
    if isinstance(surface, Ellipsoid):
        record |= {"kind": "ellipsoid", "A": np.asarray(surface.A, np.float64).tolist()}
    elif isinstance(surface, Quartic):
        record |= {"kind": "quartic", "coefficients": np.asarray(surface.coefficients, np.float64).tolist()}
    else:
        raise TypeError(f"surface: cannot save a {type(surface).__name__}; an Ellipsoid or a Quartic can be saved")
    Path(path).write_text(json.dumps(record, indent=2) + "\n")


def load_surface(path: str | Path, kind: type[S]) -> S:
    surface = read_record(path, "a limit surface saved by pushjax", FORMAT, VERSION, _surface)
    if not isinstance(surface, kind):
        raise ValueError(f"{path} holds a {type(surface).__name__}, not a {kind.__name__}")
    return surface


def _surface(record: dict[str, Any], dtype: Any) -> LimitSurface:
    length = jnp.asarray(record["length"], dtype)
    if record["kind"] == "ellipsoid":
        return Ellipsoid(jnp.asarray(record["A"], dtype), length)
    if record["kind"] == "quartic":
        return Quartic(jnp.asarray(record["coefficients"], dtype), length)
    raise ValueError(f"{record['kind']!r} is no kind of surface")
