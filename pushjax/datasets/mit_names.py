"""Parse the file names of the MIT pushing data set: what was pushed, where, how fast, and at which angle.

An example is `motion_surface=plywood_shape=hex_a=0_v=150_i=1.000_s=0.000_t=-0.349_rep=0003.h5`.

The fields are:

- `surface` and `shape`: names of the surface and of the object.
- `a` and `v`: acceleration in mm/s^2 and speed in mm/s.
- `i`, `s` and `t`: side, fraction and angle in rad; see `PushParameters`.
- `rep`: number of the repetition, present only for repeated pushes.

Reference: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016.
"""

import math
import re
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from pushjax.datasets.push_log import LogError

SUFFIXES = (".json", ".h5", ".hdf5")  # the first is preferred, because it needs no other package
PREFIX = "motion_surface="
_TEXT_KEYS = ("surface", "shape")
_NUMBER_KEYS = ("a", "v", "i", "s", "t")
# A value ends at the next "_key=" or at the end of the name, so it may contain underscores.
_FIELD = re.compile(r"_([a-z]+)=(.*?)(?=_[a-z]+=|$)")


class PushParameters(NamedTuple):
    """The parameters of a push, as given in its file name.

    Attributes:
        surface: Name of the surface in the data set.
        shape: Name of the object in the data set.
        acceleration: Acceleration of the tip, in m/s^2; 0 if its speed is constant.
        speed: Speed of the tip, in m/s. Negative if the tip accelerates, because it then has no constant speed.
        side: Side of the outline that is pushed, from 0. A round outline has only side 0.
        fraction: Position along that side at which the tip aims, in [0, 1].
        angle: Angle of the push from the normal of the side, in rad.
        repetition: Number of the repetition, from 0; None if the push has no such number.
    """

    surface: str
    shape: str
    acceleration: float
    speed: float
    side: int
    fraction: float
    angle: float
    repetition: int | None


def parse_push_name(path: str | PathLike[str]) -> PushParameters:
    """Parse the name of a file, which need not exist.

    Fields may be in any order. Unknown fields are ignored.

    Args:
        path: The file, in any folder, with or without its suffix.

    Returns:
        The parameters of the push, in SI units.

    Raises:
        LogError: If a field is missing, or if one of `a`, `v`, `i`, `s`, `t` and `rep` is not a valid number.
    """
    name = Path(path).name
    stem = Path(name).stem if Path(name).suffix.lower() in SUFFIXES else name
    fields = dict(_FIELD.findall(stem))
    missing = [key for key in (*_TEXT_KEYS, *_NUMBER_KEYS) if not fields.get(key)]
    if missing:
        wanted = f"expected a name like {PREFIX}abs_shape=rect1_a=0_v=10_i=0.000_s=0.500_t=0.000"
        raise LogError(path, f"{wanted}; found none of {', '.join(missing)}")
    acceleration, speed, side, fraction, angle = (_number(path, fields, key) for key in _NUMBER_KEYS)
    return PushParameters(
        surface=fields["surface"],
        shape=fields["shape"],
        acceleration=acceleration / 1e3,
        speed=speed / 1e3,
        side=_nonnegative_int(path, "i", side),
        fraction=fraction,
        angle=angle,
        repetition=_nonnegative_int(path, "rep", _number(path, fields, "rep")) if "rep" in fields else None,
    )


def _number(path: str | PathLike[str], fields: dict[str, str], key: str) -> float:
    """Return a field as a finite number."""
    try:
        value = float(fields[key])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LogError(path, f"expected a number for {key} in the name, found {fields[key]!r}")
    return value


def _nonnegative_int(path: str | PathLike[str], key: str, value: float) -> int:
    """Return a value as a nonnegative integer."""
    if value != int(value) or value < 0:
        raise LogError(path, f"expected a number from 0 without a fraction for {key} in the name, found {value:g}")
    return int(value)
