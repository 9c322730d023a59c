"""What the files of the MIT pushing data set are called: what was pushed, where, how fast, and at which angle.

As in `motion_surface=plywood_shape=hex_a=0_v=150_i=1.000_s=0.000_t=-0.349_rep=0003.h5`, where `rep` is there only for
pushes that were repeated. Source: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016.
"""

import math
import re
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from pushjax.datasets.pushes import LogError

SUFFIXES = (".json", ".h5", ".hdf5")  # the first is preferred, as it needs no other package
PREFIX = "motion_surface="
_WORDS = ("surface", "shape")
_NUMBERS = ("a", "v", "i", "s", "t")
_FIELD = re.compile(r"_([a-z]+)=(.*?)(?=_[a-z]+=|$)")


class PushName(NamedTuple):
    """surface, shape: as the data set calls them. acceleration: m/s^2, of the tip; 0 where its speed is constant.
    speed: m/s, of the tip; below 0, which is none, where it accelerates. side: of the outline, from 0, which is all of
    a round one. fraction: in [0, 1], along that side, where the tip aims. angle: rad, of the push against the side's
    normal. repetition: from 0; None where the push has no number."""

    surface: str
    shape: str
    acceleration: float
    speed: float
    side: int
    fraction: float
    angle: float
    repetition: int | None


def parse_push_name(path: str | PathLike[str]) -> PushName:
    """Reads the name of a file, whatever its folder and with or without its suffix; it need not exist.

    Fields may come in any order, and others are passed over. Raises LogError for one that lacks or is no number.
    """
    name = Path(path).name
    stem = Path(name).stem if Path(name).suffix.lower() in SUFFIXES else name
    fields = dict(_FIELD.findall(stem))
    missing = [key for key in (*_WORDS, *_NUMBERS) if not fields.get(key)]
    if missing:
        wanted = f"expected a name like {PREFIX}abs_shape=rect1_a=0_v=10_i=0.000_s=0.500_t=0.000"
        raise LogError(path, f"{wanted}; found none of {', '.join(missing)}")
    acceleration, speed, side, fraction, angle = (_number(path, fields, key) for key in _NUMBERS)
    return PushName(
        surface=fields["surface"],
        shape=fields["shape"],
        acceleration=acceleration / 1e3,
        speed=speed / 1e3,
        side=_whole(path, "i", side),
        fraction=fraction,
        angle=angle,
        repetition=_whole(path, "rep", _number(path, fields, "rep")) if "rep" in fields else None,
    )


def _number(path: str | PathLike[str], fields: dict[str, str], key: str) -> float:
    try:
        value = float(fields[key])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LogError(path, f"expected a number for {key} in the name, found {fields[key]!r}")
    return value


def _whole(path: str | PathLike[str], key: str, value: float) -> int:
    if value != int(value) or value < 0:
        raise LogError(path, f"expected a number from 0 without a fraction for {key} in the name, found {value:g}")
    return int(value)
