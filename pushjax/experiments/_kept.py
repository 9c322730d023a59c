"""Cells of a long run, kept in a file until it is over, so that an interrupted run goes on where it was."""

import json
from pathlib import Path
from typing import Any

from pushjax.report import write_json


class Kept:
    """Cells in a file, as long as the run is not over."""

    def __init__(self, path: Path | None, settings: dict[str, Any]):
        self.path, self.settings = path, settings
        self.cells: list[dict[str, Any]] = []
        if path is not None and path.exists():
            record = json.loads(path.read_text())
            if record["settings"] != settings:
                other = record["settings"]
                raise ValueError(f"{path} is of a run with other settings, {other}: remove it, or use those")
            self.cells = record["cells"]

    def find(self, labels: dict[str, str]) -> dict[str, Any] | None:
        return next((cell for cell in self.cells if labels.items() <= cell.items()), None)

    def add(self, cell: dict[str, Any]) -> dict[str, Any]:
        self.cells.append(cell)
        if self.path is not None:
            aside = self.path.with_suffix(".part")
            write_json({"settings": self.settings, "cells": self.cells}, aside)
            aside.replace(self.path)  # at once, so that no interruption leaves half of it
        return cell

    def forget(self) -> None:
        if self.path is not None:
            self.path.unlink(missing_ok=True)
