"""The belief about friction: closer to the true friction than before, calibrated, and defined in every case."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.planning import PushScene
from pushjax.planning.friction_filter import BeliefStatus, FrictionBelief, FrictionFilter

RADIUS, STEPS, NOISE = 0.01, 8, 2e-4
SLIDER = pj.Slider(pj.Polygon.rectangle(0.1, 0.06), pj.Ellipsoid(np.diag([1.0, 1.0, 1.2]), 0.04))
HAND = pj.Hand.finger(RADIUS)
SCENE = PushScene(SLIDER, HAND, pj.FrictionModel(20, (0.1, 0.5)))
# of x, y and length * theta together, of the difference of two poses with the noise
ERROR = float(NOISE * np.sqrt(2))
WORLDS, SEEN, UNSEEN, DRAWN = 32, 10, 4, 32


def some_pushes(rng, count):
    """Return paths that push different sides of the box off center, (count, steps + 1, 2)."""
    angle = rng.uniform(-0.4, 0.4, count)
    offset = rng.uniform(-0.03, 0.03, count)
    back = rng.random(count) < 0.5
    start = np.stack([offset, np.full(count, -0.03 - RADIUS)], axis=1)
    way = 0.03 * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    paths = start[:, None] + np.linspace(0, 1, STEPS + 1)[:, None] * way[:, None]
    return np.where(back[:, None, None], -paths, paths)


class Worlds(NamedTuple):
    friction: np.ndarray  # the true coefficient, (worlds,)
    beliefs: list[FrictionBelief]
    unseen: np.ndarray  # true outcomes of pushes that the filter has not seen, (worlds, unseen, 3)
    prior_draws: np.ndarray  # outcomes of the same pushes under draws from the belief, (worlds, unseen, drawn, 3)
    belief_draws: np.ndarray


@pytest.fixture(scope="module")
def made():
    return FrictionFilter(SCENE, samples=128, error=ERROR)


@jax.jit
def outcomes(surfaces, frictions, paths):
    """Return the final poses of all pushes under all samples, (samples, pushes, 3)."""

    def outcome(surface, mu, path):
        return pj.rollout(pj.Slider(SLIDER.shape, surface), HAND, path, pose=jnp.zeros(3), friction=mu).pose[-1]

    return jax.vmap(jax.vmap(outcome, (None, None, 0)), (0, 0, None))(surfaces, frictions, paths)


@pytest.fixture(scope="module")
def worlds(made):
    """Beliefs in worlds with friction from the same distribution, after the same pushes from noisy poses.

    The true friction of a world is its first sample; the filter gets the others, and a copy of the second.
    """
    rng, paths = np.random.default_rng(0), jnp.asarray(some_pushes(np.random.default_rng(0), SEEN + UNSEEN))
    found = []
    for k in range(WORLDS):
        drawn = made.init(jax.random.key(k))
        ends = np.asarray(outcomes(drawn.surface, drawn.friction, paths))
        rows = np.maximum(np.arange(128), 1)
        samples = jax.tree.map(lambda leaf, rows=rows: leaf[rows], (drawn.surface, drawn.friction))
        belief = drawn._replace(surface=samples[0], friction=samples[1])
        noise = NOISE * rng.standard_normal((SEEN, 2, 3)) / np.array([1, 1, 0.04])
        for push in range(SEEN):
            belief = made.update(belief, noise[push, 0], paths[push], ends[0, push] + noise[push, 1])
        kept = rows[rng.choice(128, DRAWN, p=np.asarray(belief.weight) / np.sum(belief.weight))]
        draws = [np.swapaxes(ends[each, SEEN:], 0, 1) for each in (rows[-DRAWN:], kept)]
        found.append((float(drawn.friction[0]), belief, ends[0, SEEN:], *draws))
    friction, beliefs, *rest = zip(*found, strict=True)
    return Worlds(np.array(friction), list(beliefs), *(np.stack(each) for each in rest))


def energy_scores(draws, truth):
    """Return the mean energy score in each world, m, in NumPy."""
    scale = np.array([1, 1, 0.04])
    to_truth = np.linalg.norm((draws - truth[:, :, None]) * scale, axis=-1).mean(-1)
    pairs = np.linalg.norm((draws[:, :, :, None] - draws[:, :, None]) * scale, axis=-1).sum((-1, -2))
    return (to_truth - pairs / (2 * DRAWN * (DRAWN - 1))).mean(1)


@pytest.mark.slow
def test_pushes_that_were_not_seen_are_predicted_better_than_before(worlds):
    before, after = (energy_scores(draws, worlds.unseen) for draws in (worlds.prior_draws, worlds.belief_draws))
    gained = before - after
    assert gained.mean() > 4 * gained.std(ddof=1) / np.sqrt(WORLDS)
    assert after.mean() < 0.65 * before.mean()


def test_friction_is_found(worlds):
    """The mean is nearer to the truth than the middle of the model's range."""
    mean = np.array([float(belief.mean()[1]) for belief in worlds.beliefs])
    off, before = (np.sqrt(np.mean((each - worlds.friction) ** 2)) for each in (mean, 0.3))
    assert off < 0.9 * before


def test_errors_are_as_large_as_the_belief_says(worlds):
    """The error of the mean friction, in standard deviations of the belief, which has a few effective samples."""
    standardized = []
    for belief, true in zip(worlds.beliefs, worlds.friction, strict=True):
        mean = float(belief.mean()[1])
        deviation = np.sqrt(float(jnp.sum(belief.weight * (belief.friction - mean) ** 2)))
        few = 1 / float(belief.effective())  # a variance from n samples is (n - 1) / n of the true one, and adds 1 / n
        standardized.append((mean - true) / (deviation * np.sqrt((1 + few) / (1 - few))))
    size = np.sqrt(np.mean(np.square(standardized)))
    assert 0.6 < size < 1.4


def test_enough_samples_stay(worlds):
    effective = np.array([float(belief.effective()) for belief in worlds.beliefs])
    assert effective.min() >= 6 * (1 - 1e-5)
    assert effective.mean() < 12
    assert all(float(jnp.sum(belief.weight)) == pytest.approx(1, abs=1e-5) for belief in worlds.beliefs)


def test_a_motion_that_nothing_explains_leaves_the_belief(made):
    path = jnp.asarray(some_pushes(np.random.default_rng(1), 1)[0])
    belief = made.init(jax.random.key(0))
    assert belief.status == BeliefStatus.PRIOR
    truth = belief.surface.A[3], belief.friction[3]
    push = pj.rollout(
        pj.Slider(SLIDER.shape, pj.Ellipsoid(truth[0], 0.04)), HAND, path, pose=np.zeros(3), friction=truth[1]
    )
    seen = made.update(belief, np.zeros(3), path, push.pose[-1])
    assert seen.status == BeliefStatus.UPDATED
    jumped = push.pose[-1] + jnp.array([0.05, 0, 0])
    for before, after in ((np.zeros(3), jumped), (np.full(3, np.nan), jumped), (np.zeros(3), jumped * np.inf)):
        kept = made.update(seen, before, path, after)
        assert kept.status == BeliefStatus.UNEXPLAINED
        assert np.array_equal(kept.weight, seen.weight)
    turned = made.update(belief, np.zeros(3), path, push.pose[-1] + jnp.array([0, 0, 2 * np.pi]))
    np.testing.assert_allclose(turned.weight, seen.weight, rtol=1e-4)
    nothing = seen._replace(weight=jnp.zeros(128), evidence=jnp.full(128, -jnp.inf))
    kept = made.update(nothing, np.zeros(3), path, push.pose[-1])
    assert kept.status == BeliefStatus.UNEXPLAINED
    assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves((kept, kept.mean(), kept.effective())))


def test_a_failed_simulation_does_not_remove_a_sample(made):
    """A sample whose simulation fails once, and which explains all that is seen later, has most of the weight."""
    paths = jnp.asarray(some_pushes(np.random.default_rng(2), 8))
    belief = made.init(jax.random.key(0))
    surface, mu = jax.tree.map(lambda leaf: leaf[3], (belief.surface, belief.friction))
    failed = belief._replace(friction=belief.friction.at[3].set(jnp.nan))
    for k, path in enumerate(paths):
        after = pj.rollout(pj.Slider(SLIDER.shape, surface), HAND, path, pose=np.zeros(3), friction=mu).pose[-1]
        belief = made.update(failed if k == 0 else belief, np.zeros(3), path, after)
        belief = belief._replace(friction=belief.friction.at[3].set(mu))
        assert belief.status == BeliefStatus.UPDATED
        assert np.isfinite(belief.evidence).all()
    assert float(belief.weight[3]) > 1 / 128


def test_a_hand_that_touches_nothing_teaches_nothing(made):
    path = 0.2 + jnp.zeros((STEPS + 1, 2))
    belief = made.init(jax.random.key(0))
    seen = made.update(belief, np.zeros(3), path, np.zeros(3))
    np.testing.assert_allclose(seen.weight, 1 / 128, rtol=1e-6)


def test_bad_input(made):
    for settings, words in (
        ({"samples": 0}, "samples"),
        ({"error": 0.0}, "error"),
        ({"relative_error": -0.1}, "relative_error"),
        ({"effective": 200.0}, "effective"),
    ):
        with pytest.raises(ValueError, match=words):
            FrictionFilter(SCENE, **settings)
    belief = made.init(jax.random.key(0))
    with pytest.raises(ValueError, match="path"):
        made.update(belief, np.zeros(3), np.zeros((3, 3)), np.zeros(3))
    with pytest.raises(ValueError, match="before"):
        made.update(belief, np.zeros(2), np.zeros((3, 2)), np.zeros(3))
