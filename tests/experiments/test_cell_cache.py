"""Cells of a long run are deleted only when its results are on the disk."""

import functools
import json

import pytest

from pushjax.cli.main import main as pushjax
from pushjax.experiments import table1
from pushjax.experiments._cell_cache import find_or_compute, saved_cells_file


@pytest.mark.parametrize("is_written", [True, False])
def test_cells_are_deleted_after_the_results_are_written(is_written, tmp_path, monkeypatch):
    """If the file cannot be written, the cells are kept, and no page says that the run is over."""
    name, about = "table1", {"settings": {}, "versions": {}, "machine": {}}

    @functools.wraps(table1.run)
    def run(*given, out=tmp_path, **options):
        find_or_compute(saved_cells_file(name, tmp_path), {}, [({"figure": "one"}, dict)])
        return {"experiment": name, "figure": 1.0} | about

    monkeypatch.setattr(table1, "run", run)
    monkeypatch.setattr(table1, "summary", lambda record: "figures")
    arguments = ["reproduce", "table1", "--data", str(tmp_path), "--out", str(tmp_path)]
    if is_written:
        pushjax(arguments)
        assert json.loads((tmp_path / f"{name}.json").read_text())["figure"] == 1
        assert not (tmp_path / f"{name}-cells.json").exists()
    else:
        (tmp_path / f"{name}.json").mkdir()
        with pytest.raises(SystemExit) as end:
            pushjax(arguments)
        assert end.value.code == 1
        written = {path.name for path in tmp_path.iterdir()}
        assert f"{name}-cells.json" in written
        assert f"{name}.html" not in written
