"""Cells of a long run, kept in a file until its results are written, so that an interrupted run can continue.

A cell is one entry of an experiment's table of results: a dictionary of labels that say which entry it is, and of the
results that were computed for it.
"""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import write_json

Cell = dict[str, Any]


def saved_cells_file(experiment: str, folder: Path) -> Path:
    """Return the file that keeps the cells of an experiment; who writes the results deletes it."""
    return folder / f"{experiment}-cells.json"


def find_or_compute(
    path: Path | None,  # of the file that keeps the cells; None: they are not kept
    settings: dict[str, Any],
    todo: Sequence[tuple[dict[str, str], Callable[[], Cell]]],  # labels, and what computes the rest of a cell
    progress: ProgressCallback = no_progress,
) -> list[Cell]:
    """Return the cells of a run in the order of `todo`, and compute and save those that are not known."""
    known: list[Cell] = []
    if path is not None and path.exists():
        record = json.loads(path.read_text())
        if record["settings"] != settings:
            raise ValueError(f"{path} is of a run with other settings, {record['settings']}: remove it, or use those")
        known = record["cells"]
    cells = []
    for labels, compute in todo:
        cell = next((cell for cell in known if labels.items() <= cell.items()), None)
        if cell is None:
            begin = time.perf_counter()
            results = compute()
            cell = labels | results | {"run_s": time.perf_counter() - begin}
            known.append(cell)
            if path is not None:
                partial = path.with_suffix(".part")
                write_json({"settings": settings, "cells": known}, partial)
                partial.replace(path)  # atomic, so that an interruption cannot leave a half-written file
        cells.append(cell)
        progress(len(cells), len(todo))
    return cells
