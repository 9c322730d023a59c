"""Where recorded pushes lie on this machine; none of them is part of the package."""

import os
from pathlib import Path

ENVIRONMENT_VARIABLE = "PUSHJAX_DATA"


def find_data(name: str | None = None) -> Path | None:
    """The folder that the environment variable PUSHJAX_DATA names, or `name` inside it; None where there is none."""
    given = os.environ.get(ENVIRONMENT_VARIABLE)
    if not given:
        return None
    found = Path(given) if name is None else Path(given) / name
    return found if found.exists() else None
