"""Recorded pushes from a file of any of the known kinds."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path

from pushjax.datasets._archive import archive_names
from pushjax.datasets.mit import load_mit_hdf5, load_mit_json, load_mit_npz
from pushjax.datasets.plain import LAYOUT, load_csv, load_plain_npz
from pushjax.datasets.pushes import LogError
from pushjax.datasets.recordings import Recordings
from pushjax.datasets.tidy import load_push_npz
from pushjax.datasets.triangle import load_triangle_log


def load_recordings(path: str | PathLike[str]) -> Recordings:
    """Reads the pushes of one file, of whichever of these kinds it is.

    `.csv`: a row per sample, one push after another; columns `push` (a number or name), `hand_x`, `hand_y`, `object_x`,
        `object_y`, `object_theta`, and if known `hand_theta`, `hand_distance`, `time`, `force_x`, `force_y`, in any
        order. The object's cells are blank where it was not seen, the force's where there was none.
    `.npz` with `path` (n, k, dof), `start` and `end` (n, 3) or `pose` (n, k, 3), NaN where not seen, and if known
        `force` (n, k, 2) and `time` (n, k).
    `.npz` of the folders `three_point_push` and `mit_push_full`.
    `.txt`, `.txt.gz`: an original log of the aluminium triangle.
    `.json`, `.h5`, `.hdf5`: a log of the MIT pushing data set (`pip install '.[hdf5]'` for the latter two).

    Lengths are m, angles rad, forces N, times s; all in the world, forces on the object. How a file begins tells its
    kind before its name does. What is wrong with single pushes is in `problems`. Raises LogError if the file is none
    of these, or no push of it is usable.
    """
    file = Path(path)
    return _loader(file)(file)


def _load_triangle(path: Path) -> Recordings:
    return Recordings.of_log(load_triangle_log(path))


def _load_npz(path: Path) -> Recordings:
    """Reads an archive; the arrays in it tell its kind."""
    names = archive_names(path, "pushes")
    if "path" in names:
        return load_plain_npz(path, names)
    if "tip_offsets" in names:
        return Recordings.of_log(load_push_npz(path))
    if {"tip_t", "object_t"} <= names:
        return load_mit_npz(path, names)
    there = ", ".join(sorted(names)[:10]) or "none"
    known = "or the arrays of the folders three_point_push or mit_push_full"
    raise LogError(path, f"expected arrays of pushes: {LAYOUT}; {known}; found the arrays {there}")


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


def _loader(path: Path) -> Loader:
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
