"""Objects in JSON files: written, and read back to the same bits."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def write_record(path: str | Path, form: str, version: int, dtype: Any, record: dict[str, Any]) -> None:
    """A record and what `read_record` asks for: the form's name and version, the floating dtype."""
    whole = {"format": form, "version": version, "dtype": str(dtype)} | record
    Path(path).write_text(json.dumps(whole, indent=1) + "\n")


def numbers(value: Any) -> Any:
    """An array as lists; None as it is. The text of a float64 is exact, and a float32 is a float64."""
    return None if value is None else np.asarray(value, np.float64).tolist()


def read_record(path: str | Path, what: str, form: str, version: int, build: Callable[[dict[str, Any], Any], T]) -> T:
    """What `build` makes of the record in a file and of its floating dtype; `form`: the record's format.

    Raises ValueError, which says that the file does not hold `what`, for anything else.
    """
    try:
        record = json.loads(Path(path).read_text())
        if record["format"] != form:
            raise ValueError("its format is another")
        if record["version"] != version:
            raise ValueError(f"version {record['version']!r} of the format; this program reads {version}")
        # float64 needs x64 to be on; else float32
        return build(record, jax.dtypes.canonicalize_dtype(record["dtype"]))
    except (ValueError, KeyError, TypeError, IndexError) as error:
        wrong = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} does not hold {what}: {wrong}") from error
