"""Fetch the triangle's recorded pushes from the repository in which their authors published them.

`triangle_files.csv` lists the files: name here, SHA-256, size in bytes, and path at a fixed commit of the repository
(github.com/robinzhoucmu/MLab_EXP, Apache-2.0).
"""

import csv
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets.load import default_folder

SOURCE = "https://raw.githubusercontent.com/robinzhoucmu/MLab_EXP/4d86db9438203f51c4368e5b886def5c402955f3/"
TIMEOUT = 30  # s without an answer


class RemoteFile(NamedTuple):
    """A published file."""

    file: str  # path in the folder of recorded pushes
    sha256: str
    bytes: int  # size
    source: str  # path in the repository


def triangle_files() -> list[RemoteFile]:
    """Return the files that `fetch_triangle` fetches: ten logs of one finger, 54 pairs of two fingers."""
    with open(Path(__file__).with_name("triangle_files.csv"), newline="") as table:
        rows = list(csv.DictReader(table))
    return [RemoteFile(row["file"], row["sha256"], int(row["bytes"]), row["source"]) for row in rows]


def fetch_triangle(to: str | PathLike[str] | None = None, *, progress: ProgressCallback = no_progress) -> Path:
    """Fetch the logs of the triangle, pushed by one finger and by two: 118 files, 34 MB.

    Args:
        to: Folder in which `three_point_push` and `two_finger_push` are created. Default: a folder for the user's data.
            `find_data` looks there, unless PUSHJAX_DATA names another folder.
        progress: Called with the number of bytes that are there and their total.

    Returns:
        The folder.

    Raises:
        OSError: As in `fetch`.
    """
    folder = default_folder() if to is None else Path(to).expanduser()
    fetch(triangle_files(), SOURCE, folder, progress=progress)
    return folder


def fetch(files: Sequence[RemoteFile], source: str, folder: Path, *, progress: ProgressCallback = no_progress) -> None:
    """Fetch files from the address `source` and check their SHA-256; OSError if one cannot be fetched or differs."""
    import pooch  # imported here, because only those who fetch need it
    import requests

    total, done = sum(remote.bytes for remote in files), 0
    pooch.get_logger().setLevel("WARNING")  # it prints a line for each file
    downloader: Any = pooch.HTTPDownloader(timeout=TIMEOUT)
    progress(done, total)
    for remote in files:
        target, address = folder / remote.file, source + quote(remote.source)
        # `retrieve` skips a file that is there with the right content, so an interrupted call can be repeated; it does
        # not keep a file that arrives incomplete or changed
        try:
            pooch.retrieve(address, f"sha256:{remote.sha256}", target.name, target.parent, downloader=downloader)
        except requests.RequestException as error:
            raise OSError(f"cannot fetch {address}: {_describe_failure(error)}") from error
        except ValueError as error:  # a wrong checksum
            raise OSError(
                f"cannot use {address}: it is not the file of {remote.bytes} bytes that was published"
            ) from error
        done += remote.bytes
        progress(done, total)


def _describe_failure(error: Exception) -> str:
    """Return one line on what went wrong with a request."""
    import requests

    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answers {response.status_code} {response.reason}"
    if type(error) in (requests.ConnectionError, requests.ConnectTimeout):  # its kinds, such as SSLError, say more
        return "no connection to the server; is there a network, and does it let this address through?"
    return " ".join(str(error).split()) or type(error).__name__
