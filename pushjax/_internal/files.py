"""JSON files of dictionaries whose floating-point numbers are read back bit for bit."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def save_json(path: str | Path, format_name: str, version: int, dtype: Any, record: dict[str, Any]) -> None:
    """Write a record to a JSON file, with the header that `load_json` checks.

    Args:
        path: The file.
        format_name: Name of the format.
        version: Version of the format.
        dtype: Floating dtype of the record's numbers.
        record: Content that `json` can write (see `to_list`).
    """
    with_header = {"format": format_name, "version": version, "dtype": str(dtype)} | record
    Path(path).expanduser().write_text(json.dumps(with_header, indent=1) + "\n")


def to_list(value: Any) -> Any:
    """Return an array as nested lists of float64 numbers; None stays None.

    Their decimal text is lossless for float32 and float64.
    """
    return None if value is None else np.asarray(value, np.float64).tolist()


def load_json(
    path: str | Path, content: str, format_name: str, version: int, build: Callable[[dict[str, Any], Any], T]
) -> T:
    """Read a record that `save_json` wrote, and build an object from it.

    Args:
        path: The file.
        content: The file's expected content in words, for the error message.
        format_name: Name of the format that the file must have.
        version: Version of the format that the file must have.
        build: Called as `build(record, dtype)`, where `dtype` is the floating dtype of the record's numbers.

    Returns:
        The result of `build`.

    Raises:
        ValueError: If the file does not hold such a record.
    """
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
        raise ValueError(f"{path} does not hold {content}: {reason}") from error
