"""Find recorded pushes on this machine, and read them from a file of any known kind.

The package contains no recordings.
"""

import os
from collections.abc import Callable
from os import PathLike
from pathlib import Path

import platformdirs

from pushjax.datasets.mit_logs import load_mit_hdf5, load_mit_json
from pushjax.datasets.plain import load_csv, load_npz
from pushjax.datasets.recordings import LogError, Recordings
from pushjax.datasets.triangle import load_triangle_log

ENVIRONMENT_VARIABLE = "PUSHJAX_DATA"


def default_folder() -> Path:
    """Return the folder that recorded pushes are fetched to (`fetch_triangle`); it need not exist."""
    return platformdirs.user_data_path("pushjax", appauthor=False) / "data"


def find_data() -> Path | None:
    """Return the folder of recorded pushes.

    It is the folder that the environment variable PUSHJAX_DATA names. If the variable is not set, it is the folder that
    recorded pushes are fetched to.

    Returns:
        The folder, or None if it does not exist.
    """
    given = os.environ.get(ENVIRONMENT_VARIABLE)
    folder = Path(given).expanduser() if given else default_folder()
    return folder if folder.exists() else None


def load_recordings(path: str | PathLike[str]) -> Recordings:
    """Read the pushes of one file of any known kind.

    Kinds of files:

    - `.csv`: one row for each sample, one push after another. The columns are `push` (a number or name), `hand_x`,
      `hand_y`, `object_x`, `object_y`, `object_theta` and, if known, `hand_theta`, `hand_distance`, `time`, `force_x`,
      `force_y`, in any order. The cells of the object are blank where it was not tracked, those of the force where
      there was none.
    - `.npz` with `path` (n, k, dof), either `start` and `end` (n, 3) or `pose` (n, k, 3), and, if known, `force`
      (n, k, 2), `time` (n, k) and what else `Recordings.save` writes. `pose` is NaN where the object was not tracked.
      The path of a push with fewer than k samples ends with rows of NaN.
    - `.txt`, `.txt.gz`: an original log of the aluminum triangle, as by `load_triangle_log`.
    - `.json`, `.h5`, `.hdf5`: a log of the MIT pushing data set (`pip install '.[hdf5]'` for the latter two).

    Lengths are in m, angles in rad, forces in N, times in s. All are in the world frame, and forces are those on the
    object. The first bytes of a file determine its kind. If they do not, its suffix does.

    Args:
        path: The file.

    Returns:
        The usable pushes. The field `problems` has an error for each push that cannot be used.

    Raises:
        LogError: If the file is of no known kind, or if no push of it is usable.
    """
    file = Path(path).expanduser()
    return _select_loader(file)(file)


Loader = Callable[[Path], Recordings]
_SIGNATURES: dict[bytes, Loader] = {
    b"PK\x03\x04": load_npz,
    b"\x89HDF\r\n\x1a\n": load_mit_hdf5,
    b"\x1f\x8b": load_triangle_log,
}
_SUFFIXES: dict[str, Loader] = {
    ".csv": load_csv,
    ".npz": load_npz,
    ".json": load_mit_json,
    ".h5": load_mit_hdf5,
    ".hdf5": load_mit_hdf5,
    ".txt": load_triangle_log,
    ".gz": load_triangle_log,
}


def _select_loader(path: Path) -> Loader:
    """Select the loader by the first bytes of the file or else by its suffix."""
    try:
        with path.open("rb") as file:
            head = file.read(max(len(signature) for signature in _SIGNATURES))
    except OSError as error:
        reason = error.strerror or error
        raise LogError(path, f"expected a file of recorded pushes, but cannot read the file: {reason}") from error
    if not head:
        raise LogError(path, "expected a file of recorded pushes, found an empty file")
    for signature, loader in _SIGNATURES.items():
        if head.startswith(signature):
            return loader
    loader = _SUFFIXES.get(path.suffix.lower())
    if loader is None:
        found = repr(path.suffix) if path.suffix else "none"
        raise LogError(path, f"expected a file of recorded pushes by its suffix: {', '.join(_SUFFIXES)}; found {found}")
    return loader
