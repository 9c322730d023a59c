"""Read pushes from plain files: a `.csv` table, or an `.npz` archive as `Recordings.save` writes it.

Units are SI, and the frame is the world frame. The constants at the top of this file list names and shapes.
"""

import csv
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.checks import FORCE, HAND, OBJECT, checked_recording, collect_checked
from pushjax.datasets.recordings import FACTS, Floats, LogError, Recording, Recordings, quoted

# Columns of a table; only those of _REQUIRED have to be there.
_PUSH = "push"
_REQUIRED = (_PUSH, *HAND[:2], *OBJECT)
COLUMNS = (_PUSH, *HAND, *OBJECT, "time", *FORCE)
# A row may lack all numbers of the object's pose, if the object was not tracked, or of the force, if none was measured.
_MAY_BE_BLANK = (*OBJECT, *FORCE)

# Arrays of an archive, with their shapes for n pushes of k samples. Arrays `about_...` have n rows of any shape. Only
# `path` and the poses are required.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "path": ("n", "k", "dof"),
    "start": ("n", 3),
    "end": ("n", 3),
    "pose": ("n", "k", 3),
    "force": ("n", "k", 2),
    "time": ("n", "k"),
    "wrench": ("n", "p", 3),
    "twist": ("n", "p", 3),
    "index": ("n",),
    "vertices": ("v", 2),
    "length": (),
    "tip_radius": (),
    "support_points": ("s", 2),
    "support_force": ("s",),
    "surface": (),
    "object": (),
    "problem": ("q",),
    "problem_push": ("q",),
}
_TEXT = ("surface", "object", "problem")
_ABOUT = "about_"
LAYOUT = (
    "path (n, k, dof) with start and end (n, 3) or pose (n, k, 3), if known force (n, k, 2), time (n, k) and others"
)
Arrays = dict[str, NDArray[Any]]


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
    # A push becomes a problem if a cell is bad, or if the object is not tracked in its first or last row.
    return collect_checked(
        path,
        (_read_push(path, index, names, list(rows_of_push)) for index, (_, rows_of_push) in enumerate(pushes)),
    )


def _nonblank_rows(path: Path) -> Iterator[_Row]:
    """Iterate over the rows that are not blank."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file)
        try:
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    yield _Row(reader.line_num, cells)
        except (csv.Error, UnicodeDecodeError) as error:
            message = f"expected a table in UTF-8 text, found something else: {error}"
            raise LogError(path, message, line=reader.line_num + 1) from error


def _check_header(path: Path, header: _Row) -> list[str]:
    """Return the names of the columns; LogError if one is unknown, missing or duplicated."""
    names = [cell.strip() for cell in header.cells]
    needed: list[str] = list(_REQUIRED)
    if "hand_distance" in names:
        needed.append("hand_theta")
    if not set(FORCE).isdisjoint(names):
        needed += FORCE
    missing = [name for name in needed if name not in names]
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
    numbers = []
    for row in rows:
        try:
            numbers.append(_read_cells(names, row.cells))
        except ValueError as fault:
            return LogError(path, str(fault), push=index, line=row.line)

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


def _read_cells(names: list[str], cells: list[str]) -> Mapping[str, float]:
    """Return the numbers of a row, by column, or raise ValueError; NaN for a blank cell where it is allowed."""
    if len(cells) != len(names):
        raise ValueError(f"expected {len(names)} cells, as in the header, found {len(cells)}")
    numbers = {}
    for name, cell in zip(names, map(str.strip, cells), strict=True):
        if name == _PUSH:
            if not cell:
                raise ValueError(f"expected the number of the push in column {_PUSH}, found a blank")
            continue
        try:
            value = float(cell) if cell or name not in _MAY_BE_BLANK else math.nan
        except ValueError:
            found = quoted(cell) if cell else "a blank"
            raise ValueError(f"expected a number in column {name}, found {found}") from None
        if not math.isfinite(value) and not (math.isnan(value) and name in _MAY_BE_BLANK):
            raise ValueError(f"expected a finite number in column {name}, found {cell}")
        numbers[name] = value
    return numbers


def load_npz(path: Path) -> Recordings:
    """Read an `.npz` archive of pushes; rows of NaN at the end of a path stand for samples that the push lacks."""
    data = _read_archive(path)
    _check_arrays(path, data)
    numbers: dict[str, Floats] = {
        name: np.array(array, np.float64)
        for name, array in data.items()
        if name not in _TEXT and not name.startswith(_ABOUT)
    }
    # A push becomes a problem if it has numbers that are not finite, other than NaN for an unseen pose or no force.
    recordings = collect_checked(
        path,
        (_read_row(path, row, numbers, data) for row in range(len(data["path"]))),
        **{name: _fact(data[name]) for name in FACTS if name in data},
    )
    stored = zip(data.get("problem", ()), numbers.get("problem_push", ()), strict=True)
    problems = tuple(LogError(path, str(text), push=None if push < 0 else int(push)) for text, push in stored)
    return replace(recordings, problems=(*problems, *recordings.problems))


def _fact(array: NDArray[Any]) -> Any:
    """Return the fact that an array holds: text, a number or an array of numbers."""
    if array.dtype.kind == "U":
        return str(array)
    return np.array(array, np.float64) if array.ndim else float(array)


def _read_row(path: Path, row: int, numbers: Mapping[str, Floats], data: Arrays) -> Recording | LogError:
    """Read one push of an archive."""
    hand = numbers["path"][row]
    count = 1 + max(np.flatnonzero(~np.isnan(hand).all(axis=1)), default=-1)
    if "pose" in numbers:
        pose = numbers["pose"][row, :count]
    else:
        pose = np.full((count, 3), np.nan)
        if count:
            pose[0], pose[-1] = numbers["start"][row], numbers["end"][row]
    samples = {name: numbers[name][row, :count] for name in ("force", "time") if name in numbers}
    pairs = {name: numbers[name][row] for name in ("wrench", "twist") if name in numbers}
    known = np.isfinite(sum(pairs.values(), np.zeros(3))).all(axis=-1)
    pairs = {name: values[known] for name, values in pairs.items()}
    about = {name.removeprefix(_ABOUT): array[row] for name, array in data.items() if name.startswith(_ABOUT)}
    index = int(numbers["index"][row]) if "index" in numbers else row
    return checked_recording(path, index, hand[:count], pose, **samples, **pairs, about=about)


def _read_archive(path: Path) -> Arrays:
    """Read the arrays of an `.npz` archive of pushes, or raise LogError."""
    try:
        # The file is opened here, because np.load does not close a file that is no archive.
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise LogError(path, "expected an .npz archive of pushes, found a single array")
            _check_names(path, set(archive.files))
            return {name: archive[name] for name in archive.files}
    except LogError:
        raise
    # A damaged archive may request a compression method that does not exist, or more memory than there is.
    except (OSError, ValueError, EOFError, RuntimeError, MemoryError, zlib.error, zipfile.BadZipFile) as error:
        raise LogError(path, f"expected an .npz archive of pushes, found something else: {error}") from error


def _check_names(path: Path, names: set[str]) -> None:
    """Raise LogError for unknown, missing or conflicting arrays."""
    if "pose" in names and names & {"start", "end"}:
        raise LogError(path, "expected either start and end or pose, found both")
    needed = {"path", *(("pose",) if "pose" in names else ("start", "end"))}
    needed = needed.union(*(pair for pair in (("wrench", "twist"), ("problem", "problem_push")) if names & set(pair)))
    unknown = sorted(name for name in names if name not in _SHAPES and not name.startswith(_ABOUT))
    kinds = (("unknown arrays", unknown[:10]), ("no", sorted(needed - names)))
    faults = [f"{what} {', '.join(found)}" for what, found in kinds if found]
    if faults:
        raise LogError(path, f"expected arrays of pushes: {LAYOUT}; found {'; '.join(faults)}")


def _check_arrays(path: Path, data: Arrays) -> None:
    """Raise LogError unless the arrays have the types and shapes of `_SHAPES`, which fit each other."""
    given = data["path"].shape
    if len(given) != 3 or given[0] < 1 or min(given[1:]) < 2:
        message = "expected path of shape (n, k, dof) for n pushes of k samples, dof and k at least 2"
        raise LogError(path, f"{message}; found {given}")
    sizes: dict[str | int, int] = {}
    for name in sorted(data, key=lambda name: name != "path"):
        array = data[name]
        shape = _SHAPES.get(name, ("n", *array.shape[1:]))
        if not name.startswith(_ABOUT) and array.dtype.kind not in ("U" if name in _TEXT else "fiu"):
            raise LogError(path, f"expected {'text' if name in _TEXT else 'numbers'} in {name}, found {array.dtype}")
        fits = len(shape) == array.ndim
        for size, length in zip(shape, array.shape, strict=False):
            fits &= length == (size if isinstance(size, int) else sizes.setdefault(size, length))
        if not fits:
            wanted = ", ".join(f"{size}={sizes[size]}" if size in sizes else str(size) for size in shape)
            raise LogError(path, f"expected {name} of shape ({wanted}), found {array.shape}")
    for name in ("vertices", "length", "tip_radius", "support_points", "support_force", "index", "problem_push"):
        if name in data and not np.isfinite(data[name]).all():
            raise LogError(path, f"expected finite numbers in {name}, found NaN or infinity")
