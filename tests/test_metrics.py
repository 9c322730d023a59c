"""Scores of distributions: closed forms and brute force, propriety, derivatives, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import pushjax as pj
from pushjax.metrics import mean_pose

LENGTH = 0.03


@pytest.fixture
def samples(rng):
    return rng.normal(size=(400, 3)) * np.array([0.003, 0.002, 0.1]) + np.array([0.05, -0.02, 3.1])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_energy_score_is_its_definition(samples, rng, dtype):
    observed = rng.normal(size=(5, 3)) * 0.01 + samples.mean(axis=0)
    loose = 1e-6 if dtype == "float32" else 1e-12
    score = pj.metrics.energy_score(samples.astype(dtype), observed.astype(dtype), LENGTH)
    assert score.dtype == dtype

    def embedded(poses):
        return np.c_[poses[:, :2], LENGTH * np.cos(poses[:, 2]), LENGTH * np.sin(poses[:, 2])]

    x, y = embedded(samples), embedded(observed)
    spread = np.linalg.norm(x[:, None] - x[None], axis=-1).sum() / (400 * 399)
    to = np.linalg.norm(x[:, None] - y[None], axis=-1).mean(axis=0)
    np.testing.assert_allclose(score, to - spread / 2, atol=loose)
    assert pj.metrics.energy_score(samples, observed[0], LENGTH).shape == ()


def test_energy_score_of_a_certain_prediction_is_its_distance():
    seen = np.array([0.0, 0.004, 0.2 - 2 * np.pi])
    certain = np.tile([0.003, 0.0, 0.2], (3, 1))
    assert float(pj.metrics.energy_score(certain, seen, LENGTH)) == pytest.approx(0.005)


def test_energy_score_is_proper(rng):
    """Averaged over observations, the truth scores best: better than a shifted, a wider or a narrower distribution."""
    scale = np.array([0.003, 0.002, 0.1])
    truth, seen = (rng.normal(size=(n, 3)) * scale for n in (1500, 1500))
    best = float(jnp.mean(pj.metrics.energy_score(truth, seen, LENGTH)))
    for other in (truth + 0.5 * scale, 1.5 * truth, 0.6 * truth):
        assert float(jnp.mean(pj.metrics.energy_score(other, seen, LENGTH))) > 1.01 * best


def test_energy_score_sees_dependence_and_half_turns(rng):
    """The score depends on the correlation of position and angle, and distinguishes angles with equal arc lengths.

    One pair of distributions has the same marginal distributions of position and angle. The angles of the other pair
    are a quarter turn off and have the same arc length to everything.
    """
    x = rng.normal(size=1000)
    together = np.stack([0.003 * x, 0 * x, 0.1 * x], axis=1)
    against = together * np.array([1, 1, -1])
    half = np.zeros((1000, 3))
    half[:500, 2] = np.pi
    quarter = half + np.array([0, 0, np.pi / 2])
    for truth, other in ((together, against), (half, quarter)):
        best = float(jnp.mean(pj.metrics.energy_score(truth, truth, LENGTH)))
        assert float(jnp.mean(pj.metrics.energy_score(other, truth, LENGTH))) > 1.05 * best


def test_log_density_of_a_gaussian(rng):
    """The density agrees with scipy's where the smallest bandwidth does not matter, and is near the true density."""
    scale = np.array([0.003, 0.002, 0.1])
    x, at = rng.normal(size=(4000, 3)) * scale, rng.normal(size=(50, 3)) * scale
    unit = np.array([1, 1, LENGTH])
    found = pj.metrics.log_density(x, at, LENGTH, min_bandwidth=1e-9)
    np.testing.assert_allclose(found, scipy.stats.gaussian_kde((x * unit).T).logpdf((at * unit).T), atol=1e-7)
    exact = scipy.stats.multivariate_normal(cov=np.diag((scale * unit) ** 2)).logpdf(at * unit)
    assert np.mean(np.abs(np.asarray(found) - exact)) < 0.25


def test_angles_count_modulo_a_turn(samples):
    turned = samples.copy()
    turned[::2, 2] -= 2 * np.pi
    seen = samples[:3] + np.array([0, 0, 4 * np.pi])
    for score in (pj.metrics.energy_score, pj.metrics.log_density, pj.metrics.coverage):
        np.testing.assert_allclose(score(turned, seen, LENGTH), score(samples, samples[:3], LENGTH), rtol=1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_coverage_of_the_truth(rng, dtype):
    scale = np.array([0.003, 0.002, 0.1])
    x, seen = ((rng.normal(size=(1000, 3)) * scale).astype(dtype) for _ in range(2))
    half, most = np.asarray(pj.metrics.coverage(x, seen, LENGTH))
    assert half == pytest.approx(0.5, abs=0.06)
    assert most == pytest.approx(0.9, abs=0.04)
    narrow = np.asarray(pj.metrics.coverage(0.3 * x, seen, LENGTH))
    assert np.all(narrow < [0.1, 0.35])
    assert pj.metrics.coverage(x, seen[0], LENGTH, levels=(0.2, 0.5, 0.99)).shape == (3,)


def test_density_repeats_after_a_turn(rng):
    """With angles all round, the density is the same at the cut as anywhere else."""
    x = np.stack([*(1e-3 * rng.normal(size=(2, 4000))), rng.uniform(-np.pi, np.pi, 4000)], axis=1)
    angles = np.linspace(-np.pi, np.pi, 9)
    at = np.stack([np.zeros(9), np.zeros(9), angles], axis=1)
    found = np.asarray(pj.metrics.log_density(x, at, LENGTH))
    assert np.ptp(found) < 0.35  # half of the density would be 0.69 less
    assert found[0] == pytest.approx(found[-1], abs=1e-9)


def test_no_density_is_blurred(rng):
    """With all samples in one place, as in a grasp, the density is finite, and an observation there is covered."""
    x = np.tile([0.0, 0.01, 0.5], (50, 1))
    assert np.isfinite(float(pj.metrics.log_density(x, x[0], LENGTH)))
    np.testing.assert_array_equal(pj.metrics.coverage(x, x[:2], LENGTH), [1, 1])
    np.testing.assert_array_equal(pj.metrics.coverage(x, x[:2] + 0.01, LENGTH), [0, 0])


def test_derivatives(samples):
    seen = samples.mean(axis=0) + np.array([1e-3, 2e-3, 0.05])
    for score in (pj.metrics.energy_score, pj.metrics.log_density):
        slope = np.asarray(jax.grad(lambda x, score=score: score(x, seen, LENGTH))(jnp.asarray(samples)))
        assert np.all(np.isfinite(slope))
        for i, k in ((0, 0), (7, 1), (11, 2)):
            h = 1e-6 * np.array([0.05, 0.05, 1.0])[k]
            ends = [samples.copy() for _ in range(2)]
            ends[0][i, k] += h
            ends[1][i, k] -= h
            above, below = (float(score(end, seen, LENGTH)) for end in ends)
            assert slope[i, k] == pytest.approx((above - below) / (2 * h), rel=1e-3, abs=1e-7)
    # at equal poses the distance has a kink
    assert np.all(np.isfinite(jax.grad(lambda x: pj.metrics.energy_score(x, x[0], LENGTH))(jnp.zeros((4, 3)))))


def test_the_mean_pose_is_the_same_in_any_frame(samples):
    """Poses around half a turn have their mean there, and whole turns change nothing but the branch."""
    mean = np.asarray(mean_pose(samples))
    half = np.asarray(mean_pose(jnp.asarray(samples + np.array([0, 0, np.pi]))))
    assert np.allclose(half - mean, [0, 0, np.pi], atol=1e-5)
    wrapped = np.array([[1.0, 2.0, 3.1], [3.0, 4.0, -3.1]])
    assert np.allclose(mean_pose(jnp.asarray(wrapped)), [2.0, 3.0, np.pi], atol=1e-6)


def test_bad_input(samples):
    for arguments, message in (
        ((samples[:1], samples[0], LENGTH), r"samples has shape \(1, 3\)"),
        ((samples[:, :2], samples[0], LENGTH), "samples has shape"),
        ((samples, samples[0, :2], LENGTH), "observed has shape"),
        ((samples, samples[0] * np.nan, LENGTH), "observed must be finite"),
        ((samples, samples[0], -1.0), "length must be positive"),
        ((samples, samples[0], [0.1, 0.1]), r"length has shape \(2,\)"),
    ):
        for score in (pj.metrics.energy_score, pj.metrics.log_density, pj.metrics.coverage):
            with pytest.raises(ValueError, match=message):
                score(*arguments)
    with pytest.raises(ValueError, match="min_bandwidth must be positive"):
        pj.metrics.log_density(samples, samples[0], LENGTH, min_bandwidth=0.0)
    with pytest.raises(ValueError, match="levels must be numbers between 0 and 1"):
        pj.metrics.coverage(samples, samples[0], LENGTH, levels=(0.5, 1.0))
