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

Labels = dict[str, str]


class CellCache:
    """Cells of a run, saved in a file until `delete` is called."""

    def __init__(self, experiment: str, folder: Path | None, settings: dict[str, Any]):
        self.path = None if folder is None else _cache_file(experiment, folder)
        self.settings = settings
        self.cells: list[dict[str, Any]] = []
        if self.path is not None and self.path.exists():
            record = json.loads(self.path.read_text())
            if record["settings"] != settings:
                other = record["settings"]
                raise ValueError(f"{self.path} is of a run with other settings, {other}: remove it, or use those")
            self.cells = record["cells"]

    def find_or_compute(
        self,
        todo: Sequence[tuple[Labels, Callable[[], dict[str, Any]]]],
        progress: ProgressCallback = no_progress,
    ) -> list[dict[str, Any]]:
        """Return the cells of a run in the order of `todo`, and compute and save those that are not known."""
        cells = []
        # a known cell has all these labels; `compute` returns the rest of a cell
        for labels, compute in todo:
            cell = next((cell for cell in self.cells if labels.items() <= cell.items()), None)
            if cell is None:
                begin = time.perf_counter()
                results = compute()
                # `run_s` is the time of the computation, s
                cell = self.add(labels | results | {"run_s": time.perf_counter() - begin})
            cells.append(cell)
            progress(len(cells), len(todo))
        return cells

    def add(self, cell: dict[str, Any]) -> dict[str, Any]:
        """Append a cell, save all cells, and return the cell that was appended."""
        self.cells.append(cell)
        if self.path is not None:
            partial = self.path.with_suffix(".part")
            write_json({"settings": self.settings, "cells": self.cells}, partial)
            partial.replace(self.path)  # atomic, so that an interruption cannot leave a half-written file
        return cell

    @staticmethod
    def delete(experiment: str, folder: Path) -> None:
        """Delete the file of an experiment, if there is one, once the results are on the disk."""
        _cache_file(experiment, folder).unlink(missing_ok=True)


def _cache_file(experiment: str, folder: Path) -> Path:
    return folder / f"{experiment}-cells.json"
