"""Locate the folder of recorded pushes on this machine. The package contains no recordings."""

import os
from pathlib import Path

import platformdirs

ENVIRONMENT_VARIABLE = "PUSHJAX_DATA"


def default_folder() -> Path:
    """Return the folder that recorded pushes are fetched to (`fetch_triangle`); it need not exist."""
    return platformdirs.user_data_path("pushjax", appauthor=False) / "data"


def find_data(name: str | None = None) -> Path | None:
    """Return the folder of recorded pushes, or an entry of it.

    It is the folder that the environment variable PUSHJAX_DATA names. If the variable is not set, it is the folder that
    recorded pushes are fetched to.

    Args:
        name: File or folder inside that folder; None for the folder itself.

    Returns:
        The path, or None if it does not exist.
    """
    given = os.environ.get(ENVIRONMENT_VARIABLE)
    folder = Path(given).expanduser() if given else default_folder()
    found = folder if name is None else folder / name
    return found if found.exists() else None
