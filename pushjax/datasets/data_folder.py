"""Locate the folder of recorded pushes on this machine. The package contains no recordings."""

import os
from pathlib import Path

ENVIRONMENT_VARIABLE = "PUSHJAX_DATA"


def find_data(name: str | None = None) -> Path | None:
    """Return the folder that the environment variable PUSHJAX_DATA names, or an entry of it.

    Args:
        name: File or folder inside that folder; None for the folder itself.

    Returns:
        The path, or None if the variable is not set or the path does not exist.
    """
    given = os.environ.get(ENVIRONMENT_VARIABLE)
    if not given:
        return None
    found = Path(given) if name is None else Path(given) / name
    return found if found.exists() else None
