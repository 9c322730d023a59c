"""Where the benchmark data lies on this machine; none of it is part of the package."""

import os
from pathlib import Path

ENVIRONMENT_VARIABLE = "PUSHJAX_DATA"


def find_data(name: str | None = None) -> Path | None:
    """The data folder, or the file or folder `name` inside it; None where there is none.

    The environment variable PUSHJAX_DATA decides when it is set, even to a folder that does not exist (the
    answer is then None: quietly reading other data than what was asked for would be worse). Without it,
    `../shared/data` beside the repository is tried, then beside the current folder.
    """
    given = os.environ.get(ENVIRONMENT_VARIABLE)
    if given:
        roots = [Path(given)]
    else:
        repository = Path(__file__).resolve().parents[2]
        roots = [folder.parent / "shared" / "data" for folder in (repository, Path.cwd())]
    for root in roots:
        found = root if name is None else root / name
        if root.is_dir() and found.exists():
            return found
    return None
