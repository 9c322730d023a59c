"""Rank correlations of `python -m benchmarks mit_repetitions`, for actions whose scatter is known."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from benchmarks import mit_repetitions


def objects(rng, cause):
    """Return two objects of 200 actions whose true scatter is the predicted spread, or the motion."""
    found = []
    for _ in range(2):
        motion = rng.uniform(0.01, 0.05, 200)
        spread = motion * rng.uniform(0.02, 0.2, 200)
        true = spread if cause == "spread" else 0.1 * motion
        size = np.linalg.norm(rng.standard_normal((200, 3)), axis=1) / np.sqrt(3)
        simulated = spread[:, None] * np.linalg.norm(rng.standard_normal((200, mit_repetitions.PAIRS, 3)), axis=2)
        found.append(np.column_stack([true * size, spread, motion, simulated / np.sqrt(3)]))
    return found


def test_the_spread_ranks_its_own_scatter_and_no_more(monkeypatch):
    monkeypatch.setattr(mit_repetitions, "RESAMPLED", 200)
    rng = np.random.default_rng(0)
    figures = mit_repetitions._figures(objects(rng, "spread"), rng)["correlations"]
    low, high = figures["spread"]["interval"]
    assert low < figures["attainable"]["value"] < high
    assert figures["spread at equal motion"]["interval"][0] > 0.3
    every = objects(rng, "motion")
    figures = mit_repetitions._figures(every, rng)["correlations"]
    low, high = figures["spread at equal motion"]["interval"]
    assert low < 0.05
    assert high > -0.05
    assert figures["spread"]["interval"][0] > 0  # only because it goes with the motion
    measured, spread = np.concatenate(every)[:, :2].T
    assert figures["spread"]["value"] == pytest.approx(spearmanr(measured, spread).statistic)
