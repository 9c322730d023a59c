"""Recorded pushes with known numbers, the files that have them, and comparisons."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pushjax.datasets import LogError, Recording, Recordings, load_recordings

START, SPEED = 1.4e9, 0.1


def tables(
    tip: np.ndarray | None = None, body: np.ndarray | None = None, wrench: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return tip, object and wrench of a push along x, at the times given (s after START).

    The object turns at a constant rate through pi, and the wrench grows.
    """
    tip = np.linspace(0.0, 1.0, 41) if tip is None else tip
    body = np.linspace(-0.3, 0.8, 34) if body is None else body
    wrench = np.linspace(0.1, 1.1, 51) if wrench is None else wrench
    theta = (3.0 + 0.5 * body + math.pi) % (2 * math.pi) - math.pi
    columns = {
        "tip_pose": (tip, 0.3 + SPEED * tip, 0 * tip, 0 * tip),
        "object_pose": (body, 0.4 + SPEED * body, 0.01 * body, theta),
        "ft_wrench": (wrench, -2 * wrench, 1 + wrench, 0 * wrench),
    }
    made = {name: np.column_stack(values) for name, values in columns.items()}
    for rows in made.values():
        rows[:, 0] += START
    return made


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


def mit_log(folder: Path, made: dict[str, np.ndarray], suffix: str = ".json") -> Path:
    return write_streams(folder / f"log{suffix}", made)


def arrays(pushes: int = 3, samples: int = 5, dof: int = 2) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "start": rng.normal(size=(pushes, 3)),
        "path": rng.normal(size=(pushes, samples, dof)),
        "end": rng.normal(size=(pushes, 3)),
    }


def saved(tmp_path: Path, content: dict[str, np.ndarray], name: str = "log.npz") -> Path:
    path = tmp_path / name
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **content)
    return path


def fails(path: Path, *words: str) -> LogError:
    """Check the error for a file: one line that contains the words and names the file."""
    with pytest.raises(LogError) as caught:
        load_recordings(path)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    for word in words:
        assert word in text
    return caught.value


def only_problem(found: Recordings) -> LogError:
    assert len(found.problems) == 1, [str(problem) for problem in found.problems]
    return found.problems[0]


def same(a: Recording, b: Recording, tolerance: float) -> None:
    for name in ("hand", "pose", "force", "time"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=tolerance, err_msg=name)
    np.testing.assert_array_equal(a.tracked, b.tracked)
