"""How much pushes scatter about what was found: the noise that predicts what was recorded best.

A push meets a limit surface drawn about the one that was found, with `dof` degrees of freedom, and a friction, uniform
about the one found, up to `spread` away from it. Its hand is off by `offset` in x and in y. Its final pose is off, in
x, y and length * theta, by `sigma`, an error of measurement, and by shares `relative` of how far from its start the
slider ends and by how much it has turned: a push that hardly moves the slider is predicted far better than one that
turns it around. All of these errors are normal but for a factor that they have in common, so that they have Student's
distribution with `tails` degrees of freedom: few pushes, but more than a normal distribution would have, slip where no
model says they do.

The mean score of the recorded final poses is minimised, a proper one, so that in the mean no other noise scores better
than that which the pushes had. "energy" does not depend in the mean on how many samples of a push are drawn, and hardly
sees tails. "density" is the negative logarithm of the density, of as many samples as are drawn each with an error of
measurement: it sees tails first of all, and takes a finite number of samples for a little more of them.

Draws are smooth functions of the noise, but for one key a draw may jump with dof (Gamma's rejections); derivatives are
right in the mean. So the score is not minimised for one key, but by Adam's method with a new key for every step.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._checks import positive
from pushjax._programs import compiled
from pushjax.friction_model import FrictionModel, Sampler
from pushjax.hands import Hand
from pushjax.identify.identified import Identified
from pushjax.identify.predictive import (
    Chances,
    Drawing,
    Predictive,
    Slopes,
    Values,
    log_density,
    predict,
)
from pushjax.identify.pushes import Pushes
from pushjax.rollout import Slider
from pushjax.scores import energy_score

Score = Literal["energy", "density"]
SAMPLES = 32  # of each push, for each step of the search
STEPS = 80
CHUNK = 10  # steps between two reports of progress
RATE, LAST = 0.1, 0.1  # of a logarithm, per step, and what part of it is left at the end
AVERAGED = 30  # of the last steps
START = {"dof": 60.0, "spread": 0.1, "offset": 5e-4, "relative": (0.05, 0.05), "tails": 6.0}
LEAST_DOF, LEAST_TAILS = 9.0, 1.0


class Noise(eqx.Module):
    """How pushes scatter about what was found.

    dof: of the limit surface. friction: (..., 2), the range on which mu is uniform, of each condition. offset: m, by
    how much the hand's place against the slider's is off, in x and in y, from push to push. sigma: m, the same of a
    final pose, in x, y and length * theta, however far the slider went; and relative: (2,), by what shares of how far
    it went, and of length * its turn, it is off besides. tails: degrees of freedom of all of these. score: the mean
    score of the pushes' final poses at the end of the search (energy: m), and history: (steps,), on the way there.
    """

    found: Identified
    dof: Float[Array, ""]
    friction: Float[Array, "*conditions 2"]
    offset: Float[Array, ""]
    sigma: Float[Array, ""]
    relative: Float[Array, "2"]
    tails: Float[Array, ""]
    score: Float[Array, ""]
    history: Float[Array, "steps"]
    sampler: Sampler = eqx.field(static=True)

    @property
    def model(self) -> FrictionModel:
        """For rollouts and `monte_carlo` around `found.surface`: of one condition."""
        if not self.found.single:
            raise ValueError("model is for what was found of one condition; of several there is `predict`")
        return FrictionModel(self.dof, self.friction, self.sampler)

    def save(self, path: str | Path) -> None:
        """Write everything to a JSON file that `load` reads back to the same bits."""
        from pushjax.identify.files import save_noise

        save_noise(self, path)

    @staticmethod
    def load(path: str | Path) -> "Noise":
        """Read what `save` wrote. Raises ValueError for a file that holds something else."""
        from pushjax.identify.files import load_noise

        return load_noise(path)

    def predict(
        self, key: PRNGKeyArray, pushes: Pushes, slider: Slider, hand: Hand, n: int
    ) -> Float[Array, "*conditions pushes n 3"]:
        """`n` measured final poses of each of these or other pushes, of the same conditions, drawn from what is
        predicted. slider, hand: as `identify` was given them."""
        predictive = Predictive.of(self.found, pushes, slider, hand, self.sampler)
        drawn = predict(key, predictive, self._values, n)
        return drawn[0] if self.found.single else drawn

    def log_density(
        self, key: PRNGKeyArray, pushes: Pushes, slider: Slider, hand: Hand, n: int
    ) -> Float[Array, "*conditions pushes"]:
        """The logarithm of what is predicted, per cubic metre of (x, y, length * theta), at the final poses of these or
        other pushes of the same conditions: the mean of Student's densities about `n` draws, which the error of
        the final pose makes of them. (There, that error and the hand's have no factor in common.)"""
        predictive = Predictive.of(self.found, pushes, slider, hand, self.sampler)
        density = log_density(key, predictive, self._values, n)
        return density[0] if self.found.single else density

    def about(self, found: Identified) -> "Noise":
        """The same noise about what was found of other pushes, of one condition or of several: of several noises of
        the friction, the widest."""
        spread = jnp.max(self.friction[..., 1] - self.found.friction)
        friction = jnp.stack([jnp.maximum(found.friction - spread, 0), found.friction + spread], axis=-1)
        return eqx.tree_at(lambda noise: (noise.found, noise.friction), self, (found, friction))

    @property
    def _values(self) -> Values:
        friction = self.friction[None] if self.found.single else self.friction
        return Values(self.dof, friction, self.offset, self.sigma, self.relative, self.tails)


def identify_noise(
    key: PRNGKeyArray,
    found: Identified,
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    *,
    sampler: Sampler = "terms",
    score: Score = "energy",
    samples: int = SAMPLES,
    steps: int = STEPS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Noise:
    """The noise with which the pushes are predicted best, by the energy score or by the density.

    found: what `identify` says of these conditions, at best of other pushes: of those that it has learned from, it
    leaves less over. slider, hand: as given there. The middle of the friction's range is the friction found; conditions
    share everything else. samples: drawn of each push at every step. progress: called with steps done and of how many.

    Raises ValueError for another score, and for a number of samples or steps that is too small.

    Source: Zhou et al. 2017, section VII, names the problem; Gneiting & Raftery 2007, section 4.3, the score.
    """
    if score not in get_args(Score):
        raise ValueError(f"score must be one of {', '.join(get_args(Score))}; got {score!r}")
    if samples < 2:
        raise ValueError(f"samples must be at least 2; got {samples}")
    positive("steps", steps)
    predictive = Predictive.of(found, pushes, slider, hand, sampler)
    scatter = _first(found)
    state, values, visited = _rule(steps).init(scatter), [], []
    keys = jax.random.split(key, steps)
    for begin in range(0, steps, CHUNK):
        part = keys[begin : begin + CHUNK]
        scatter, state, each, passed = _descend(scatter, state, part, predictive, samples, steps, score)
        values.append(each)
        visited.append(passed)
        progress(begin + len(part), steps)
    history = jnp.concatenate(values)
    passed = jax.tree.map(lambda *parts: jnp.concatenate(parts), *visited)
    last = min(AVERAGED, steps)
    best = jax.tree.map(lambda leaf: jnp.mean(leaf[-last:], axis=0), passed).values(predictive.theta.friction)
    if found.single:
        best = best._replace(friction=best.friction[0])
    return Noise(found, score=jnp.mean(history[-last:]), history=history, sampler=sampler, **best._asdict())


def _rule(steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(RATE, steps, LAST))


class _Scatter(NamedTuple):
    """What is searched for, as unbounded numbers."""

    dof: Float[Array, ""]
    spread: Float[Array, ""]
    offset: Float[Array, ""]
    sigma: Float[Array, ""]
    relative: Float[Array, "2"]
    tails: Float[Array, ""]

    def values(self, center: Float[Array, "conditions"]) -> Values:
        """center: the friction found."""
        spread = jnp.exp(self.spread)
        friction = jnp.stack([jnp.maximum(center - spread, 0), center + spread], axis=-1)
        dof, tails = LEAST_DOF + jnp.exp(self.dof), LEAST_TAILS + jnp.exp(self.tails)
        return Values(dof, friction, jnp.exp(self.offset), jnp.exp(self.sigma), jnp.exp(self.relative), tails)


def _first(found: Identified) -> _Scatter:
    least = {"dof": LEAST_DOF, "tails": LEAST_TAILS}
    first = {name: jnp.asarray(value, found.z.dtype) - least.get(name, 0.0) for name, value in START.items()}
    return _Scatter(**jax.tree.map(jnp.log, first | {"sigma": found.sigma / 2}))


@compiled
def _descend(scatter, state, keys, predictive: Predictive, samples: int, steps: int, score: Score):
    rule = _rule(steps)

    def step(carry, key):
        scatter, state = carry
        value, slope = _score(scatter, key, predictive, samples, score)
        updates, state = rule.update(slope, state)
        scatter = optax.apply_updates(scatter, updates)
        return (scatter, state), (value, scatter)

    (scatter, state), (values, passed) = jax.lax.scan(step, (scatter, state), keys)
    return scatter, state, values, passed


def _score(
    scatter: _Scatter, key: PRNGKeyArray, predictive: Predictive, samples: int, score: Score
) -> tuple[Array, _Scatter]:
    """The mean score, and its derivative.

    A pose depends on dof, its own mu and where its hand is: its derivatives by these are worked out forward. The rest
    is cheap, and differentiated backward through poses that are linear about where they are.
    """

    def local(drawing: Drawing, key: PRNGKeyArray, values: Values) -> tuple[Chances, tuple[Array, Slopes]]:
        chances = drawing.chances(key, samples)
        return chances, drawing.slopes(chances, values)

    center, pushes = predictive.theta.friction, predictive.pushes
    start = scatter.values(center)
    chances, (poses, slopes) = predictive.over_conditions(local, key, start)
    before = jax.lax.stop_gradient(start.own(chances))

    def mean(scatter: _Scatter) -> Array:
        values = scatter.values(center)
        dof, mu = ((now - then)[..., None] for now, then in zip(values.own(chances), before, strict=True))
        errors = chances.errors(values.tails)
        there = poses + slopes.dof * dof + slopes.mu * mu
        aside = values.offset * jnp.einsum("...ij,...j->...i", slopes.aside, errors[..., :2])
        if score == "density":
            each = -predictive.log_density(there + aside, pushes, values)
        else:
            # without the hand's error: a share of that would be a product of two with tails, whose mean may be infinite
            error = predictive.error(there, pushes, values)
            off = predictive.measured(there + aside, error, errors) - pushes.end[..., None, :]
            each = jax.vmap(jax.vmap(lambda x: energy_score(x, jnp.zeros(3, x.dtype), predictive.length)))(off)
        return jnp.sum(pushes.weight * each) / jnp.sum(pushes.weight)

    return jax.value_and_grad(mean)(scatter)
