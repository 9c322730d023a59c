"""JSON files of dictionaries whose floating-point numbers are read back bit for bit."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def save_json(path: str | Path, format_name: str, version: int, dtype: Any, record: dict[str, Any]) -> None:
    """Write a record of values that `json` can write (see `to_list`), with the header that `load_json` checks."""
    with_header = {"format": format_name, "version": version, "dtype": str(dtype)} | record
    Path(path).expanduser().write_text(json.dumps(with_header, indent=1) + "\n")


def to_list(value: Any) -> Any:
    """Return an array as nested lists of float64 numbers, whose decimal text is lossless; None stays None."""
    return None if value is None else np.asarray(value, np.float64).tolist()


def load_json(
    path: str | Path, content: str, format_name: str, version: int, build: Callable[[dict[str, Any], Any], T]
) -> T:
    """Return `build(record, dtype)` for a record of `save_json`; raise ValueError if the file holds no such record."""
    # `content` names the kind of file, for the error message
    try:
        record = json.loads(Path(path).expanduser().read_text())
        if record["format"] != format_name:
            raise ValueError("its format is another")
        if record["version"] != version:
            raise ValueError(f"version {record['version']!r} of the format; this program reads {version}")
        # float64 becomes float32 unless x64 is enabled
        return build(record, jax.dtypes.canonicalize_dtype(record["dtype"]))
    except (ValueError, KeyError, TypeError, IndexError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is not {content}: {reason}") from error
