"""Files in the layout of the MIT data set."""

import json
from pathlib import Path

import numpy as np
import pytest


def write_streams(path: Path, streams: dict[str, np.ndarray]) -> Path:
    """Write streams, each (n, 4), as JSON or HDF5, by the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".json":
        path.write_text(json.dumps({name: rows.tolist() for name, rows in streams.items()}))
        return path
    with pytest.importorskip("h5py").File(path, "w") as file:
        for name, rows in streams.items():
            file[name] = rows
    return path
