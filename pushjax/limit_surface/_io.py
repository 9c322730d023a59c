"""Limit surfaces in files."""

from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp

from pushjax._files import numbers, read_record, write_record
from pushjax.limit_surface._base import LimitSurface
from pushjax.limit_surface.ellipsoid import Ellipsoid
from pushjax.limit_surface.quartic import Quartic

FORMAT = "pushjax limit surface"
VERSION = 1
S = TypeVar("S", bound=LimitSurface)


def save_surface(surface: LimitSurface, path: str | Path) -> None:
    record: dict[str, Any] = {"length": numbers(surface.length)}
    if isinstance(surface, Ellipsoid):
        record |= {"kind": "ellipsoid", "A": numbers(surface.A)}
    elif isinstance(surface, Quartic):
        record |= {"kind": "quartic", "coefficients": numbers(surface.coefficients)}
    else:
        raise TypeError(f"surface: cannot save a {type(surface).__name__}; an Ellipsoid or a Quartic can be saved")
    write_record(path, FORMAT, VERSION, surface.length.dtype, record)


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
