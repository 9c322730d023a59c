"""Cells of a long run are deleted only when its results are on the disk."""

import functools
import json

import pytest

from benchmarks.__main__ import main as benchmarks
from benchmarks.robot import causes
from pushjax.cli.main import main as pushjax
from pushjax.experiments import table1
from pushjax.experiments._cell_cache import CellCache

RUNS = {
    "table1-causes": (causes, benchmarks, ["table1_causes"]),
    "table1": (table1, pushjax, ["reproduce", "table1"]),
}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("is_written", [True, False])
def test_cells_are_deleted_after_the_results_are_written(name, is_written, tmp_path, monkeypatch):
    """If the file cannot be written, the cells are kept, and no page says that the run is over."""
    study, main, command = RUNS[name]
    about = {"settings": {}, "versions": {}, "machine": {}}

    @functools.wraps(study.run)
    def run(*given, out=tmp_path, **options):
        CellCache(name, tmp_path, {}).add({"figure": 1.0})
        return {"experiment": name, "figure": 1.0} | about

    monkeypatch.setattr(study, "run", run)
    monkeypatch.setattr(study, "summary", lambda record: "figures")
    arguments = [*command, "--data", str(tmp_path), "--out", str(tmp_path)]
    if is_written:
        main(arguments)
        assert json.loads((tmp_path / f"{name}.json").read_text())["figure"] == 1
        assert not (tmp_path / f"{name}-cells.json").exists()
    else:
        (tmp_path / f"{name}.json").mkdir()
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == 1
        written = {path.name for path in tmp_path.iterdir()}
        assert f"{name}-cells.json" in written
        assert f"{name}.html" not in written
