"""Read logs of the MIT pushing data set and other logs in its layout: one push per file, three streams.

The streams have separate rates. Each row has a time (s) and three numbers in the world frame:

- Tip: x, y (m) and angle. The tip is round, so its angle carries no information.
- Object: x, y (m) and theta (rad).
- Wrench: fx, fy (N) and torque. It is the reaction on the tip, so the force on the object is its negative.

The object's time stamps sometimes go back, by up to 7 ms. The stamps of tip and wrench never go back. The poses are
sorted by their stamps. At 0.1 m/s, this moves a sample by less than a millimeter.

The name of a file says what was pushed, where, how fast, and at which angle. An example is
`motion_surface=plywood_shape=hex_a=0_v=150_i=1.000_s=0.000_t=-0.349_rep=0003.h5`, with acceleration in mm/s^2 and speed
in mm/s; for the other fields see `PushName`.

Reference: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016.
"""

import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pushjax.datasets.checks import FORCE, HAND, OBJECT, collect_checked
from pushjax.datasets.mit_shapes import MIT_SHAPES, mit_shape
from pushjax.datasets.recordings import Floats, LogError, Recordings
from pushjax.datasets.streams import Stream, align_streams

SUFFIXES = (".json", ".h5", ".hdf5")  # the first is preferred, because it needs no other package
PREFIX = "motion_surface="
STREAMS = ("tip_pose", "object_pose", "ft_wrench")
COLUMNS = 4
# A value ends at the next "_key=" or at the end of the name, so it may contain underscores.
_FIELD = re.compile(r"_([a-z]+)=(.*?)(?=_[a-z]+=|$)")


class PushName(NamedTuple):
    """The parameters of a push, as given in its file name."""

    surface: str
    shape: str
    acceleration: float  # of the tip, m/s^2; 0 if its speed is constant
    speed: float  # of the tip, m/s; negative if it accelerates, because it then has no constant speed
    side: int  # of the outline, from 0; a round outline has only side 0
    fraction: float  # position along that side at which the tip aims, in [0, 1]
    angle: float  # of the push from the normal of the side, rad
    repetition: int  # from 0; 0 if the name has none

    @property
    def action(self) -> str:
        """What is equal in repetitions of a push, whatever their speed."""
        return f"side {self.side}, fraction {self.fraction:g}, angle {self.angle:g}"


def parse_name(path: Path) -> PushName:
    """Parse the name of a file; LogError if a field is missing or no number. Unknown fields are ignored."""
    stem = path.stem if path.suffix.lower() in SUFFIXES else path.name
    fields = dict(_FIELD.findall(stem))
    missing = [key for key in ("surface", "shape", "a", "v", "i", "s", "t") if not fields.get(key)]
    if missing:
        wanted = f"expected a name like {PREFIX}abs_shape=rect1_a=0_v=10_i=0.000_s=0.500_t=0.000"
        raise LogError(path, f"{wanted}; found none of {', '.join(missing)}")

    def number(key: str) -> float:
        try:
            value = float(fields.get(key, 0))
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key in ("i", "rep") and (value < 0 or value % 1)):
            kind = "a whole number" if key in ("i", "rep") else "a number"
            raise LogError(path, f"expected {kind} for {key} in the name, found {fields[key]!r}")
        return value

    return PushName(
        surface=fields["surface"],
        shape=fields["shape"],
        acceleration=number("a") / 1e3,
        speed=number("v") / 1e3,
        side=int(number("i")),
        fraction=number("s"),
        angle=number("t"),
        repetition=int(number("rep")),
    )


def load_mit_log(path: Path) -> Recordings:
    """Read the one push of a `.json`, `.h5` or `.hdf5` file."""
    return (load_mit_json if path.suffix.lower() == ".json" else load_mit_hdf5)(path)


def load_mit_json(path: Path) -> Recordings:
    """Read a `.json` file of the data set, which maps `tip_pose`, `object_pose` and `ft_wrench` to lists of rows."""
    try:
        record = json.loads(path.read_bytes())
    except OSError as error:
        raise LogError(path, f"expected a JSON log, but cannot read the file: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise LogError(path, f"expected a JSON log of a push, found something else: {error}") from error
    if not isinstance(record, dict):
        raise LogError(path, f"expected a JSON object with {', '.join(STREAMS)}, found a {type(record).__name__}")
    return _recording_of_streams(path, record, _rows_to_array)


def load_mit_hdf5(path: Path) -> Recordings:
    """Read an HDF5 file with the datasets `tip_pose`, `object_pose` and `ft_wrench`, each (n, 4)."""
    try:
        import h5py
    except ImportError as error:
        message = "expected the package h5py, which reads HDF5, found none: pip install '.[hdf5]'"
        raise LogError(path, message) from error
    library: Any = h5py  # h5py has no type annotations
    try:
        with library.File(path, "r") as file:
            # Nothing is read here, because a file may hold much else, camera images for instance.
            record = {name: file[name] for name in file if isinstance(file[name], library.Dataset)}
            return _recording_of_streams(path, record, lambda rows: np.asarray(rows[()], dtype=np.float64))
    except LogError:
        raise
    except (OSError, RuntimeError, KeyError) as error:
        raise LogError(path, f"expected an HDF5 log of a push, but cannot read the file: {error}") from error


def _rows_to_array(rows: Any) -> Floats:
    """Convert the rows of a JSON stream to an array (n, 4), or raise ValueError with the first bad row."""
    if not isinstance(rows, list):
        raise ValueError(f"a {type(rows).__name__}")
    for index, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != COLUMNS:
            raise ValueError(f"row {index} is {str(row)[:60]}")
    return np.array(rows, dtype=np.float64).reshape(-1, COLUMNS)


def _recording_of_streams(path: Path, record: Mapping[str, Any], to_array: Callable[[Any], Floats]) -> Recordings:
    """Return the one recording of the streams of a record, with what the name of the file says about the object."""
    missing = [name for name in STREAMS if name not in record]
    if missing:
        found = ", ".join(list(record)[:10]) or "nothing"
        raise LogError(path, f"expected {', '.join(STREAMS)}; found no {', '.join(missing)}, but {found}")
    tables = []
    for name in STREAMS:
        wanted = f"expected {name} to have rows of {COLUMNS} numbers, a time and three values"
        try:
            table = to_array(record[name])
        except (ValueError, TypeError, OverflowError) as error:
            raise LogError(path, f"{wanted}; found something else: {error}") from error
        if table.ndim != 2 or table.shape[1] != COLUMNS:
            raise LogError(path, f"{wanted}; found shape {table.shape}")
        tables.append(table)
    tip, body, wrench = tables
    hand = Stream(STREAMS[0], HAND[:2], tip[:, 0], tip[:, 1:3])
    pose = Stream(STREAMS[1], OBJECT, body[:, 0], body[:, 1:])
    force = Stream(STREAMS[2], FORCE, wrench[:, 0], -wrench[:, 1:3])
    return collect_checked(path, [align_streams(path, hand, pose, force)], **_facts_from_name(path))


def _facts_from_name(path: Path) -> dict[str, Any]:
    """Return what the name of a file says about the object, as fields of `Recordings`; {} if nothing."""
    try:
        name = parse_name(path)
    except LogError:
        return {}
    outline = mit_shape(name.shape)._asdict() if name.shape in MIT_SHAPES else {}
    return {"surface": name.surface, "object": name.shape, **outline}
