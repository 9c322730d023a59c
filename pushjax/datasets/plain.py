"""Read pushes from plain files: a `.csv` table, or an `.npz` archive of pushes with equally many samples.

Units are SI, and the frame is the world frame. The constants at the top of this file list names and shapes.
"""

import csv
import math
from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pushjax.datasets._archive import Arrays, floats, read_archive
from pushjax.datasets.push_log import Floats, LogError
from pushjax.datasets.recordings import FORCE, HAND, OBJECT, Recording, Recordings, checked_recording, collect
from pushjax.datasets.records import ParseError, quoted

# Columns of a table: all of _REQUIRED, and any groups of _OPTIONAL_GROUPS, each as a whole.
_PUSH = "push"
_REQUIRED = (_PUSH, *HAND[:2], *OBJECT)
_OPTIONAL_GROUPS = (("hand_theta",), ("hand_theta", "hand_distance"), ("time",), FORCE)
COLUMNS = (_PUSH, *HAND, *OBJECT, "time", *FORCE)
# A row may lack all numbers of the object's pose, if the object was not seen, or of the force, if none was measured.
_MAY_BE_BLANK = (*OBJECT, *FORCE)

# Arrays of an archive with n pushes of k samples: `path`, and either `start` and `end` or `pose`.
_POSES_AT_ENDS, _POSES_ALL_ALONG = ("start", "end"), ("pose",)
_OPTIONAL_ARRAYS = ("force", "time")
ARRAYS = ("path", *_POSES_AT_ENDS, *_POSES_ALL_ALONG, *_OPTIONAL_ARRAYS)
LAYOUT = "path (n, k, dof) with start and end (n, 3) or pose (n, k, 3), if known force (n, k, 2) and time (n, k)"


class _Row(NamedTuple):
    """One row of a table."""

    line: int  # line of the file on which the row ends, from 1
    cells: list[str]


def load_csv(path: Path) -> Recordings:
    """Read a table in UTF-8 text, with a header, columns in any order, and consecutive rows for each push."""
    rows = _nonblank_rows(path)
    header = next(rows, None)
    if header is None:
        raise LogError(path, f"expected a header of columns ({', '.join(COLUMNS)}), found an empty file")
    names = _check_header(path, header)
    label_column = names.index(_PUSH)
    # Rows that are too short to have a label form a push of their own, which becomes a problem.
    pushes = groupby(rows, key=lambda row: row.cells[label_column].strip() if label_column < len(row.cells) else "")
    # A push becomes a problem if a cell is bad, or if the object is not seen in its first or last row.
    return collect(path, (_read_push(path, index, names, list(group)) for index, (_, group) in enumerate(pushes)))


def _nonblank_rows(path: Path) -> Iterator[_Row]:
    """Iterate over the rows that are not blank."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            try:
                for cells in reader:
                    if any(cell.strip() for cell in cells):
                        yield _Row(reader.line_num, cells)
            except (csv.Error, UnicodeDecodeError) as error:
                message = f"expected a table in UTF-8 text, found something else: {error}"
                raise LogError(path, message, line=reader.line_num + 1) from error
    except OSError as error:
        raise LogError(path, f"expected a table, but cannot read the file: {error.strerror or error}") from error


def _check_header(path: Path, header: _Row) -> list[str]:
    """Return the names of the columns; LogError if one is unknown, missing or duplicated."""
    names = [cell.strip() for cell in header.cells]
    missing = [name for name in _REQUIRED if name not in names]
    for group in _OPTIONAL_GROUPS:
        if group[-1] in names or (group == FORCE and group[0] in names):
            missing += [name for name in group if name not in names and name not in missing]
    unknown = [name for name in names if name not in COLUMNS]
    duplicated = sorted({name for name in names if names.count(name) > 1})
    kinds = (("no", missing), ("unknown", [quoted(name) for name in unknown]), ("more than one", duplicated))
    faults = [f"{what} {', '.join(found)}" for what, found in kinds if found]
    if faults:
        allowed = f"expected columns out of {', '.join(COLUMNS)}, separated by commas"
        raise LogError(path, f"{allowed}; found {'; '.join(faults)}", line=header.line)
    return names


def _read_push(path: Path, index: int, names: list[str], rows: list[_Row]) -> Recording | LogError:
    """Read the rows of one push, or return the error that describes its first fault."""
    try:
        numbers = [_read_row(names, row) for row in rows]
    except ParseError as fault:
        return LogError(path, str(fault), push=index, line=fault.line)

    def columns(wanted: tuple[str, ...]) -> Floats:
        return np.array([[row[name] for name in wanted] for row in numbers], dtype=np.float64)

    return checked_recording(
        path,
        index,
        columns(tuple(name for name in HAND if name in names)),
        columns(OBJECT),
        force=columns(FORCE) if FORCE[0] in names else None,
        time=columns(("time",))[:, 0] if "time" in names else None,
        lines=[row.line for row in rows],
    )


def _read_row(names: list[str], row: _Row) -> Mapping[str, float]:
    """Read the numbers of a row, by column, or raise ParseError; NaN for a blank cell where it is allowed."""
    if len(row.cells) != len(names):
        raise ParseError(f"expected {len(names)} cells, as in the header, found {len(row.cells)}", row.line)
    cells = dict(zip(names, (cell.strip() for cell in row.cells), strict=True))
    if not cells.pop(_PUSH):
        raise ParseError(f"expected the number of the push in column {_PUSH}, found a blank", row.line)
    return {name: _read_cell(name, cell, row.line) for name, cell in cells.items()}


def _read_cell(name: str, cell: str, line: int) -> float:
    """Read the number in a cell, or raise ParseError; NaN for a blank cell where it is allowed."""
    if not cell and name in _MAY_BE_BLANK:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        found = quoted(cell) if cell else "a blank"
        raise ParseError(f"expected a number in column {name}, found {found}", line) from None
    if not math.isfinite(value) and not (math.isnan(value) and name in _MAY_BE_BLANK):
        raise ParseError(f"expected a finite number in column {name}, found {cell}", line)
    return value


def load_plain_npz(path: Path, names: frozenset[str]) -> Recordings:
    """Read an `.npz` archive of pushes with equally many samples and with the arrays `names`."""
    wanted = _arrays_to_read(path, names)
    data = read_archive(path, wanted, "pushes")
    _check_arrays(path, data)
    numbers = {name: floats(array) for name, array in data.items()}
    if "pose" in numbers:
        pose = numbers["pose"]
    else:
        pose = np.full((*numbers["path"].shape[:2], 3), np.nan)
        pose[:, 0], pose[:, -1] = numbers["start"], numbers["end"]

    def optional_row(name: str, index: int) -> Floats | None:
        return numbers[name][index] if name in numbers else None

    # A push becomes a problem if it has numbers that are not finite, other than NaN for an unseen pose or no force.
    return collect(
        path,
        (
            checked_recording(
                path, index, hand, pose[index], force=optional_row("force", index), time=optional_row("time", index)
            )
            for index, hand in enumerate(numbers["path"])
        ),
    )


def _arrays_to_read(path: Path, names: frozenset[str]) -> list[str]:
    """Return the names of the arrays to read, or raise LogError for unknown or conflicting arrays."""
    unknown = sorted(names - set(ARRAYS))
    if unknown:
        raise LogError(path, f"expected {LAYOUT}; found unknown arrays {', '.join(unknown)}")
    if set(_POSES_ALL_ALONG) & names and set(_POSES_AT_ENDS) & names:
        raise LogError(path, "expected either start and end or pose, found both")
    poses = _POSES_ALL_ALONG if set(_POSES_ALL_ALONG) & names else _POSES_AT_ENDS
    # Required arrays are listed even if they are absent, because `read_archive` reports them as missing.
    return ["path", *poses, *(name for name in _OPTIONAL_ARRAYS if name in names)]


def _check_arrays(path: Path, data: Arrays) -> None:
    """Raise LogError unless the arrays have numbers and shapes that fit the shape of `path`."""
    for name, array in data.items():
        if array.dtype.kind not in "fiu":
            raise LogError(path, f"expected numbers in {name}, found {array.dtype}")
    path_shape = data["path"].shape
    if len(path_shape) != 3 or path_shape[0] < 1 or path_shape[1] < 2 or path_shape[2] < 2:
        message = "expected path of shape (n, k, dof) for n pushes of k samples, dof and k at least 2"
        raise LogError(path, f"{message}; found {path_shape}")
    row_shapes = {
        "start": (3,),
        "end": (3,),
        "pose": (path_shape[1], 3),
        "force": (path_shape[1], 2),
        "time": (path_shape[1],),
    }
    for name in data.keys() - {"path"}:
        shape = (path_shape[0], *row_shapes[name])
        if data[name].shape != shape:
            expected = f"expected {name} of shape {shape} to go with path {path_shape}"
            raise LogError(path, f"{expected}; found {data[name].shape}")
