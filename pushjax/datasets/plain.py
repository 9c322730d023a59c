"""Pushes in plain files of one's own: a `.csv` table, or an `.npz` archive of pushes with equally many samples.

Units are SI, the frame is the world's; names and shapes are those at the head of this file.
"""

import csv
import math
from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pushjax.datasets._archive import Arrays, floats, read_archive
from pushjax.datasets.pushes import Floats, LogError
from pushjax.datasets.recordings import FORCE, HAND, OBJECT, Recording, Recordings, checked, gathered
from pushjax.datasets.records import Fault, quoted

# Columns of a table: these, and each of the further groups either whole or not at all.
_PUSH = "push"
_REQUIRED = (_PUSH, *HAND[:2], *OBJECT)
_FURTHER = (("hand_theta",), ("hand_theta", "hand_distance"), ("time",), FORCE)
COLUMNS = (_PUSH, *HAND, *OBJECT, "time", *FORCE)
# A row may lack all numbers of one of these groups: the object was not seen there, no force was measured.
_MAY_LACK = (*OBJECT, *FORCE)

# Arrays of an archive, with n pushes of k samples: `path` with `start` and `end`, or with `pose`.
_BOTH_ENDS, _ALL_ALONG = ("start", "end"), ("pose",)
_OPTIONAL = ("force", "time")
ARRAYS = ("path", *_BOTH_ENDS, *_ALL_ALONG, *_OPTIONAL)
LAYOUT = "path (n, k, dof) with start and end (n, 3) or pose (n, k, 3), if known force (n, k, 2) and time (n, k)"


class _Row(NamedTuple):
    line: int
    cells: list[str]


def load_csv(path: Path) -> Recordings:
    """Reads a table with a header; columns in any order, rows of one push one after another.

    A push with a bad cell, or that does not see the object in its first and last row, becomes a problem. Raises
    LogError if the file is no such table, its columns are others, or no push is usable.
    """
    rows = _rows(path)
    header = next(rows, None)
    if header is None:
        raise LogError(path, f"expected a header of columns ({', '.join(COLUMNS)}), found an empty file")
    names = _header(path, header)
    label = names.index(_PUSH)
    # A row too short to say which push it is of belongs to one of its own.
    pushes = groupby(rows, key=lambda row: row.cells[label].strip() if label < len(row.cells) else "")
    return gathered(path, (_push(path, index, names, list(group)) for index, (_, group) in enumerate(pushes)))


def _rows(path: Path) -> Iterator[_Row]:
    """The rows that are not blank, each with the line it ends on."""
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


def _header(path: Path, header: _Row) -> list[str]:
    """The names of the columns. Raises LogError unless they are allowed, enough, and each there once."""
    names = [cell.strip() for cell in header.cells]
    missing = [name for name in _REQUIRED if name not in names]
    for group in _FURTHER:
        if group[-1] in names or (group == FORCE and group[0] in names):
            missing += [name for name in group if name not in names and name not in missing]
    unknown = [name for name in names if name not in COLUMNS]
    twice = sorted({name for name in names if names.count(name) > 1})
    kinds = (("no", missing), ("unknown", [quoted(name) for name in unknown]), ("more than one", twice))
    faults = [f"{what} {', '.join(found)}" for what, found in kinds if found]
    if faults:
        allowed = f"expected columns out of {', '.join(COLUMNS)}, separated by commas"
        raise LogError(path, f"{allowed}; found {'; '.join(faults)}", line=header.line)
    return names


def _push(path: Path, index: int, names: list[str], rows: list[_Row]) -> Recording | LogError:
    try:
        numbers = [_numbers(names, row) for row in rows]
    except Fault as fault:
        return LogError(path, str(fault), push=index, line=fault.line)

    def columns(wanted: tuple[str, ...]) -> Floats:
        return np.array([[row[name] for name in wanted] for row in numbers], dtype=np.float64)

    return checked(
        path,
        index,
        columns(tuple(name for name in HAND if name in names)),
        columns(OBJECT),
        force=columns(FORCE) if FORCE[0] in names else None,
        time=columns(("time",))[:, 0] if "time" in names else None,
        lines=[row.line for row in rows],
    )


def _numbers(names: list[str], row: _Row) -> Mapping[str, float]:
    """The numbers of a row by column, NaN for a blank where there may be one. Raises Fault."""
    if len(row.cells) != len(names):
        raise Fault(f"expected {len(names)} cells, as in the header, found {len(row.cells)}", row.line)
    cells = dict(zip(names, (cell.strip() for cell in row.cells), strict=True))
    if not cells.pop(_PUSH):
        raise Fault(f"expected the number of the push in column {_PUSH}, found a blank", row.line)
    return {name: _number(name, cell, row.line) for name, cell in cells.items()}


def _number(name: str, cell: str, line: int) -> float:
    if not cell and name in _MAY_LACK:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        found = quoted(cell) if cell else "a blank"
        raise Fault(f"expected a number in column {name}, found {found}", line) from None
    if not math.isfinite(value) and not (math.isnan(value) and name in _MAY_LACK):
        raise Fault(f"expected a finite number in column {name}, found {cell}", line)
    return value


def load_plain_npz(path: Path, names: frozenset[str]) -> Recordings:
    """Reads an archive that holds the arrays `names`, `path` one of them.

    A push with numbers that are not finite becomes a problem (NaN in `pose` and `force` means not seen, not measured).
    Raises LogError for other arrays or shapes, or if no push is usable.
    """
    wanted = _wanted(path, names)
    data = read_archive(path, wanted, "pushes")
    _check_arrays(path, data)
    numbers = {name: floats(array) for name, array in data.items()}
    if "pose" in numbers:
        pose = numbers["pose"]
    else:
        pose = np.full((*numbers["path"].shape[:2], 3), np.nan)
        pose[:, 0], pose[:, -1] = numbers["start"], numbers["end"]

    def row(name: str, index: int) -> Floats | None:
        return numbers[name][index] if name in numbers else None

    return gathered(
        path,
        (
            checked(path, index, hand, pose[index], force=row("force", index), time=row("time", index))
            for index, hand in enumerate(numbers["path"])
        ),
    )


def _wanted(path: Path, names: frozenset[str]) -> list[str]:
    """The arrays to read: all. Raises LogError for unknown ones, and unless one way of giving the poses is used."""
    unknown = sorted(names - set(ARRAYS))
    if unknown:
        raise LogError(path, f"expected {LAYOUT}; found unknown arrays {', '.join(unknown)}")
    if set(_ALL_ALONG) & names and set(_BOTH_ENDS) & names:
        raise LogError(path, "expected either start and end or pose, found both")
    poses = _ALL_ALONG if set(_ALL_ALONG) & names else _BOTH_ENDS
    # Those that are not there as well: reading says that they are missing.
    return ["path", *poses, *(name for name in _OPTIONAL if name in names)]


def _check_arrays(path: Path, data: Arrays) -> None:
    for name, array in data.items():
        if array.dtype.kind not in "fiu":
            raise LogError(path, f"expected numbers in {name}, found {array.dtype}")
    given = data["path"].shape
    if len(given) != 3 or given[0] < 1 or given[1] < 2 or given[2] < 2:
        message = "expected path of shape (n, k, dof) for n pushes of k samples, dof and k at least 2"
        raise LogError(path, f"{message}; found {given}")
    tails = {"start": (3,), "end": (3,), "pose": (given[1], 3), "force": (given[1], 2), "time": (given[1],)}
    for name in data.keys() - {"path"}:
        shape = (given[0], *tails[name])
        if data[name].shape != shape:
            raise LogError(path, f"expected {name} of shape {shape} to go with path {given}; found {data[name].shape}")
