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
    """Read arrays of an `.npz` archive.

    Args:
        path: The archive.
        wanted: Names of the arrays to read.
        holds: What the archive contains, for error messages ("pushes", say).

    Returns:
        The arrays by name.

    Raises:
        LogError: If the file is missing, is no archive, is damaged, or lacks an array.
    """
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
    """Return the names of the arrays in an `.npz` archive.

    Args:
        path: The archive.
        holds: What the archive contains, for error messages.

    Raises:
        LogError: If the file is missing, damaged or no archive, as in `read_archive`.
    """
    read_archive(path, (), holds)  # raises LogError if the file is no archive
    with np.load(path, allow_pickle=False) as archive:
        return frozenset(archive.files)


def row_count(path: Path, data: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Return the number of pushes in an archive, after checking that all arrays have this number of rows.

    Args:
        path: The archive, for error messages.
        data: Its arrays; the length of `push_index` is the number of pushes.
        shapes: Shape of one row of each array to check, by name.

    Raises:
        LogError: If an array has another number of rows or another row shape.
    """
    count = len(data["push_index"]) if data["push_index"].ndim else -1
    for name, row_shape in shapes.items():
        if data[name].shape != (count, *row_shape):
            wanted = ", ".join(map(str, ("n", *row_shape)))
            raise LogError(path, f"expected {name} of shape ({wanted}) for n pushes, found {data[name].shape}")
    return count


def check_shapes(path: Path, data: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check the shapes of arrays against those expected.

    Args:
        path: The archive, for error messages.
        data: Its arrays.
        shapes: Expected shape of each array to check, by name.

    Raises:
        LogError: For the first array that has another shape.
    """
    for name, shape in shapes.items():
        if data[name].shape != shape:
            raise LogError(path, f"expected {name} of shape {shape}, found {data[name].shape}")


def floats(array: NDArray[np.generic]) -> Floats:
    """Return a copy of an array in float64."""
    return np.array(array, dtype=np.float64)
