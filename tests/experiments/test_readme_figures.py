"""One figure of each robot's table in the README is computed again, from recorded pushes."""

from pathlib import Path

import numpy as np
import pytest

from pushjax.experiments import table2
from pushjax.experiments.table1 import conditions
from pushjax.experiments.table1.groups import noise_floor_mm

README = (Path(__file__).parents[2] / "README.md").read_text()


@pytest.mark.slow
def test_table_2_from_the_known_support(converted):
    means = table2.run(converted, method=("ideal",))["means"]["ideal"]
    (row,) = [line for line in README.splitlines() if "from forces (table 2: from the known support)" in line]
    expected = f"| {means['quartic']['mean_mm']:.2f} mm | {means['ellipsoid']['mean_mm']:.2f} mm |"
    assert row.endswith(expected), expected


def test_noise_of_table_1(converted):
    logs = [
        conditions.load(converted, "abs", name) for name in conditions.OBJECTS if name not in conditions.NOT_IN_PAPER
    ]
    noise = np.mean([floor for floor in map(noise_floor_mm, logs) if floor is not None])
    assert f"Repetitions of one push differ from their mean by {noise:.2f} mm (table 1, abs)" in README
