"""Read logs of the MIT pushing data set and other logs in its layout: one push per file, three streams.

The streams have separate rates. Each row has a time (s) and three numbers in the world frame:

- Tip: x, y (m) and angle. The tip is round, so its angle carries no information.
- Object: x, y (m) and theta (rad).
- Wrench: fx, fy (N) and torque. It is the reaction on the tip, so the force on the object is its negative.

The object's time stamps sometimes go back, by up to 7 ms. The stamps of tip and wrench never go back. The poses are
sorted by their stamps, as in the curated archives. At 0.1 m/s, this moves a sample by less than a millimeter.

Reference: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pushjax.datasets._archive import Arrays, check_shapes, floats, read_archive
from pushjax.datasets.push_log import Floats, LogError
from pushjax.datasets.recordings import FORCE, HAND, OBJECT, Recordings, collect
from pushjax.datasets.resampling import Stream, align_streams

STREAMS = ("tip_pose", "object_pose", "ft_wrench")
COLUMNS = 4
# Arrays of the curated archives, for each stream: its times, its values, and the number of columns of the values.
ARCHIVE_ARRAYS = {"tip_t": ("tip_xy", 2), "object_t": ("object_pose", 3), "ft_t": ("ft_wrench", 3)}
_OBJECT_ARRAYS = ("vertices_body", "rho", "tip_radius")


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
    return _recording_of_streams(path, _stream_tables(path, record, _rows_to_array))


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
            return _recording_of_streams(
                path, _stream_tables(path, record, lambda rows: np.asarray(rows[()], dtype=np.float64))
            )
    except LogError:
        raise
    except (OSError, RuntimeError, KeyError) as error:
        raise LogError(path, f"expected an HDF5 log of a push, but cannot read the file: {error}") from error


def load_mit_npz(path: Path, names: frozenset[str]) -> Recordings:
    """Read a curated archive from the folder `mit_push_full`, including what it says about the object."""
    values = [name for name, _ in ARCHIVE_ARRAYS.values()]
    data = read_archive(path, [*ARCHIVE_ARRAYS, *values, *(name for name in _OBJECT_ARRAYS if name in names)], "a push")
    _check_arrays(path, data)
    numbers = {name: floats(array) for name, array in data.items()}
    tables = [np.column_stack([numbers[time], numbers[name]]) for time, (name, _) in ARCHIVE_ARRAYS.items()]
    vertices, length, radius = (numbers.get(name) for name in _OBJECT_ARRAYS)
    return replace(
        _recording_of_streams(path, tables),
        vertices=vertices,
        length=None if length is None else float(length),
        tip_radius=None if radius is None else float(radius),
    )


def _check_arrays(path: Path, data: Arrays) -> None:
    """Check types and shapes, and that the numbers about the object are finite."""
    shapes: dict[str, tuple[int, ...]] = {}
    for time, (values, columns) in ARCHIVE_ARRAYS.items():
        count = data[time].size
        shapes |= {time: (count,), values: (count, columns)}
    vertex_count = len(data["vertices_body"]) if "vertices_body" in data and data["vertices_body"].ndim else 0
    object_shapes: dict[str, tuple[int, ...]] = {"vertices_body": (vertex_count, 2), "rho": (), "tip_radius": ()}
    check_shapes(path, data, shapes | {name: shape for name, shape in object_shapes.items() if name in data})
    for name, array in data.items():
        if array.dtype.kind not in "fiu":
            raise LogError(path, f"expected numbers in {name}, found {array.dtype}")
        if name in object_shapes and not np.isfinite(array).all():
            raise LogError(path, f"expected finite numbers in {name}, found NaN or infinity")


def _rows_to_array(rows: Any) -> Floats:
    """Convert the rows of a JSON stream to an array (n, 4), or raise ValueError with the first bad row."""
    if not isinstance(rows, list):
        raise ValueError(f"a {type(rows).__name__}")
    for index, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != COLUMNS:
            raise ValueError(f"row {index} is {str(row)[:60]}")
    return np.array(rows, dtype=np.float64).reshape(-1, COLUMNS)


def _stream_tables(path: Path, record: Mapping[str, Any], to_array: Callable[[Any], Floats]) -> list[Floats]:
    """Return the streams of a record in the order of STREAMS, each (n, 4)."""
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
    return tables


def _recording_of_streams(path: Path, tables: list[Floats]) -> Recordings:
    """Return the one recording of the streams tip, object and wrench (n, 4), with times in the first column."""
    tip, body, wrench = tables
    hand = Stream(STREAMS[0], HAND[:2], tip[:, 0], tip[:, 1:3])
    pose = Stream(STREAMS[1], OBJECT, body[:, 0], body[:, 1:])
    force = Stream(STREAMS[2], FORCE, wrench[:, 0], -wrench[:, 1:3])
    return collect(path, [align_streams(path, hand, pose, force)])
