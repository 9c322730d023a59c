"""One figure of each robot's table in the README is computed again, from recorded pushes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pushjax.experiments import table1
from pushjax.experiments._mit_pushes import load, noise_floor_mm

README = (Path(__file__).parents[2] / "README.md").read_text()


@pytest.mark.slow
def test_table_2_from_the_known_support(converted, tmp_path):
    """The command, in float32, and so with its own random splits."""
    options = ["--method", "ideal", "--data", str(converted), "--out", str(tmp_path), "--json", "table2.json"]
    subprocess.run([sys.executable, "-m", "pushjax", "reproduce", "table2", *options], cwd=tmp_path, check=True)
    rows = json.loads((tmp_path / "table2.json").read_text())["means"]
    means = {row["model"]: row["mean_mm"] for row in rows if row["surface"] == "all"}
    (row,) = [line for line in README.splitlines() if "from forces (table 2: from the known support)" in line]
    expected = f"| {means['quartic']:.2f} mm | {means['ellipsoid']:.2f} mm |"
    assert row.endswith(expected), expected


def test_noise_of_table_1(converted):
    logs = [load(converted, "abs", name) for name in table1.OBJECTS if name not in table1.NOT_IN_PAPER]
    noise = np.mean([floor for floor in map(noise_floor_mm, logs) if floor is not None])
    assert f"Repetitions of one push differ from their mean by {noise:.2f} mm (table 1, abs)" in README
