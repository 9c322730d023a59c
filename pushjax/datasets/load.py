"""Read recorded pushes from a file of any known kind."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path

from pushjax.datasets._archive import archive_names
from pushjax.datasets.mit_logs import load_mit_hdf5, load_mit_json, load_mit_npz
from pushjax.datasets.plain import LAYOUT, load_csv, load_plain_npz
from pushjax.datasets.push_log import LogError
from pushjax.datasets.recordings import Recordings
from pushjax.datasets.triangle import load_triangle_log
from pushjax.datasets.triangle_archive import load_push_npz


def load_recordings(path: str | PathLike[str]) -> Recordings:
    """Read the pushes of one file of any known kind.

    Kinds of files:

    - `.csv`: one row for each sample, one push after another. The columns are `push` (a number or name), `hand_x`,
      `hand_y`, `object_x`, `object_y`, `object_theta` and, if known, `hand_theta`, `hand_distance`, `time`, `force_x`,
      `force_y`, in any order. The cells of the object are blank where it was not seen, those of the force where there
      was none.
    - `.npz` with `path` (n, k, dof), either `start` and `end` (n, 3) or `pose` (n, k, 3), and, if known, `force`
      (n, k, 2) and `time` (n, k). `pose` is NaN where the object was not seen.
    - `.npz` of the folders `three_point_push` and `mit_push_full`.
    - `.txt`, `.txt.gz`: an original log of the aluminum triangle.
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


def _load_triangle(path: Path) -> Recordings:
    """Read an original triangle log."""
    return Recordings.of_log(load_triangle_log(path))


def _load_npz(path: Path) -> Recordings:
    """Read an archive of the kind that its arrays indicate."""
    names = archive_names(path, "pushes")
    if "path" in names:
        return load_plain_npz(path, names)
    if "tip_offsets" in names:
        return Recordings.of_log(load_push_npz(path))
    if {"tip_t", "object_t"} <= names:
        return load_mit_npz(path, names)
    found_names = ", ".join(sorted(names)[:10]) or "none"
    known = "or the arrays of the folders three_point_push or mit_push_full"
    raise LogError(path, f"expected arrays of pushes: {LAYOUT}; {known}; found the arrays {found_names}")


Loader = Callable[[Path], Recordings]
_SIGNATURES: dict[bytes, Loader] = {
    b"PK\x03\x04": _load_npz,
    b"\x89HDF\r\n\x1a\n": load_mit_hdf5,
    b"\x1f\x8b": _load_triangle,
}
_SUFFIXES: dict[str, Loader] = {
    ".csv": load_csv,
    ".npz": _load_npz,
    ".json": load_mit_json,
    ".h5": load_mit_hdf5,
    ".hdf5": load_mit_hdf5,
    ".txt": _load_triangle,
    ".gz": _load_triangle,
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
