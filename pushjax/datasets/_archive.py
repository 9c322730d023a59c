"""Read `.npz` archives of recorded pushes, with one clear error for any fault of the file, and check their shapes."""

import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets.push_log import Floats, LogError

Arrays = dict[str, NDArray[np.generic]]


def read_archive(path: Path, wanted: Iterable[str], holds: str) -> Arrays:
    """Read the wanted arrays of an `.npz` archive, or raise LogError with what the archive `holds`."""
    names = list(wanted)
    try:
        # The file is opened here, because np.load does not close a file that is no archive.
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
    # A damaged archive may request a compression method that does not exist, or more memory than there is.
    except (ValueError, EOFError, RuntimeError, MemoryError, zlib.error, zipfile.BadZipFile) as error:
        raise LogError(path, f"expected an .npz archive of {holds}, found something else: {error}") from error


def archive_names(path: Path, holds: str) -> frozenset[str]:
    """Return the names of the arrays in an `.npz` archive, or raise LogError as `read_archive` does."""
    read_archive(path, (), holds)  # raises LogError if the file is no archive
    with np.load(path, allow_pickle=False) as archive:
        return frozenset(archive.files)


def row_count(path: Path, data: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Return the number of pushes, after checking that arrays have as many rows, of the given row shapes."""
    # `push_index` has one row for each push
    count = len(data["push_index"]) if data["push_index"].ndim else -1
    for name, row_shape in shapes.items():
        if data[name].shape != (count, *row_shape):
            wanted = ", ".join(map(str, ("n", *row_shape)))
            raise LogError(path, f"expected {name} of shape ({wanted}) for n pushes, found {data[name].shape}")
    return count


def check_shapes(path: Path, data: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise LogError for the first array that does not have the given shape."""
    for name, shape in shapes.items():
        if data[name].shape != shape:
            raise LogError(path, f"expected {name} of shape {shape}, found {data[name].shape}")


def floats(array: NDArray[np.generic]) -> Floats:
    """Return a copy of an array in float64."""
    return np.array(array, dtype=np.float64)
