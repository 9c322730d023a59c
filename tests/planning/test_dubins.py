"""Shortest paths of bounded curvature: they arrive, and no other path is shorter."""

import numpy as np
import pytest

from pushjax.planning.dubins import WORDS, dubins

RADII = [(1.0, 1.0), (0.7, 1.6)]


def drive(start, curvature, lengths):
    """End of a path of arcs, with complex numbers."""
    z, heading = complex(start[0], start[1]), start[2]
    for k, length in zip(curvature, lengths, strict=True):
        turn = np.exp(1j * heading)
        z += turn * (length if k == 0 else (np.exp(1j * k * length) - 1) / (1j * k))
        heading += k * length
    return np.array([z.real, z.imag, heading])


def turn_between(a, b):
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize(("left", "right"), RADII)
def test_it_arrives_with_every_word(left, right):
    rng = np.random.default_rng(0)
    words = set()
    for _ in range(300):
        start, goal = rng.uniform(-2, 2, (2, 3)) * [1, 1, 2]
        path = dubins(start, goal, left, right)
        words.add(path.word)
        assert np.all((path.curvature <= 1 / left + 1e-12) & (path.curvature >= -1 / right - 1e-12))
        for arrived in (drive(start, path.curvature, path.lengths), path.poses(40)[-1]):
            np.testing.assert_allclose(arrived[:2], goal[:2], atol=1e-9)
            assert turn_between(arrived[2], goal[2]) < 1e-8
        assert path.poses(40).shape == (41, 3)
    assert words == set(WORDS)


@pytest.mark.parametrize(("left", "right"), RADII)
def test_no_path_of_up_to_five_parts_is_shorter(left, right):
    """To the end of a random path within the same bounds there is no longer way than that path itself."""
    rng = np.random.default_rng(1)
    tight = 0
    for _ in range(2000):
        parts = rng.integers(1, 6)
        curvature = rng.choice([1 / left, -1 / right, 0.0, rng.uniform(-1 / right, 1 / left)], parts)
        lengths = rng.uniform(0, 3, parts) * rng.integers(0, 2, parts)
        path = dubins(np.zeros(3), drive(np.zeros(3), curvature, lengths), left, right)
        assert path.length <= lengths.sum() + 1e-6
        tight += path.length > lengths.sum() - 1e-6
    assert tight > 200  # the bound is met: many random paths are shortest themselves


def test_where_it_cannot_turn():
    ahead = dubins((0, 0, 0), (3, 0, 0), 1.0, np.inf)
    assert ahead.word == "LSL"
    np.testing.assert_allclose(ahead.length, 3.0)
    assert "R" not in dubins((0, 0, 0), (0, -3, 1), 1.0, np.inf).word
    assert dubins((0, 0, 0), (3, 0, 0), np.inf, np.inf) is None
    still = dubins((1, 2, 3), (1, 2, 3), 1.0, 1.0)
    assert still.length == 0
    np.testing.assert_array_equal(still.poses(3), np.tile([1.0, 2.0, 3.0], (4, 1)))


def test_too_few_steps():
    with pytest.raises(ValueError, match="steps must be at least 3, one for each part of the path; got 2"):
        dubins((0, 0, 0), (1, 2, 1), 1.0, 1.0).poses(2)
