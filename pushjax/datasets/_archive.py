"""Curated `.npz` archives: read whole, with one clear error for whatever is wrong with the file."""

import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.pushes import Floats, LogError

Arrays = dict[str, NDArray[np.generic]]


def read_archive(path: Path, wanted: Iterable[str], holds: str) -> Arrays:
    """The `wanted` arrays of a file that `holds` what it is named for, "pushes" say. Raises LogError."""
    names = list(wanted)
    try:
        # Opened here, because np.load leaves a file open that turns out to be no archive.
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise LogError(path, f"expected an .npz archive of {holds}, found a single array")
            missing = [name for name in names if name not in archive.files]
            if missing:
                raise LogError(path, f"expected the arrays of {holds}, found no {', '.join(missing)}")
            return {name: archive[name] for name in names}
    except LogError:
        raise
    except OSError as error:
        reason = error.strerror or error
        raise LogError(path, f"expected an .npz archive, but cannot read the file: {reason}") from error
    # a damaged archive may ask for a method of compression that does not exist, or for all the memory there is
    except (ValueError, EOFError, RuntimeError, MemoryError, zlib.error, zipfile.BadZipFile) as error:
        raise LogError(path, f"expected an .npz archive of {holds}, found something else: {error}") from error


def archive_names(path: Path, holds: str) -> frozenset[str]:
    """Which arrays a file has. Raises LogError as `read_archive` does."""
    read_archive(path, (), holds)  # says what is wrong with a file that is no archive
    with np.load(path, allow_pickle=False) as archive:
        return frozenset(archive.files)


def row_count(path: Path, data: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """How many pushes the archive has: the rows of `push_index`, and of all in `shapes` (each row's shape). Raises
    LogError where these differ."""
    count = len(data["push_index"]) if data["push_index"].ndim else -1
    for name, tail in shapes.items():
        if data[name].shape != (count, *tail):
            raise LogError(path, f"expected {name} of shape (n, *{tail}) for n pushes, found {data[name].shape}")
    return count


def check_shapes(path: Path, data: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raises LogError for the first array that has another shape."""
    for name, shape in shapes.items():
        if data[name].shape != shape:
            raise LogError(path, f"expected {name} of shape {shape}, found {data[name].shape}")


def floats(array: NDArray[np.generic]) -> Floats:
    """A copy in float64."""
    return np.array(array, dtype=np.float64)
