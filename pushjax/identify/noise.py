"""How much pushes scatter about what was found: the noise that predicts what was recorded best.

A push meets a limit surface drawn about the one that was found, with `dof` degrees of freedom, and a friction, uniform
about the one found, up to `spread` away from it. Its hand is off by `offset` in x and in y, and its final pose is
measured with an error of `sigma` in x, y and length * theta; both are normal but for a factor that they have in common,
so that together they have Student's distribution with `tails` degrees of freedom: few pushes, but more than a normal
distribution would have, slip where no model says they do.

The mean energy score of the recorded final poses is minimised: a proper score, so that in the mean no other noise
scores better than that which the pushes had, and its mean does not depend on how many samples of a push are drawn. (The
likelihood, from as many samples as one can afford, does: with 64 a push it took tails of 4 for 1.8.)

Draws are smooth functions of the noise, but for one key a draw may jump with dof (Gamma's rejections); derivatives are
right in the mean. So the score is not minimised for one key, but by Adam's method with a new key for every step.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._checks import positive
from pushjax.friction_model import FrictionModel, RandomSurface, Sampler
from pushjax.hands import Hand
from pushjax.identify.identified import Identified, surfaces
from pushjax.identify.model import coefficients_of, push
from pushjax.identify.pushes import Pushes
from pushjax.identify.unknowns import Physical
from pushjax.rollout import Slider
from pushjax.scores import energy_score
from pushjax.shapes import Shape

SAMPLES = 32  # of each push, for each step of the search
STEPS = 80
CHUNK = 10  # steps between two reports of progress
RATE, LAST = 0.1, 0.1  # of a logarithm, per step, and what part of it is left at the end
AVERAGED = 30  # of the last steps
START = {"dof": 60.0, "spread": 0.1, "offset": 5e-4, "tails": 6.0}
LEAST_DOF, LEAST_TAILS = 9.0, 1.0


class Values(NamedTuple):
    """Of the noise. friction: (conditions, 2)."""

    dof: Float[Array, ""]
    friction: Float[Array, "*conditions 2"]
    offset: Float[Array, ""]
    sigma: Float[Array, ""]
    tails: Float[Array, ""]


class Noise(eqx.Module):
    """How pushes scatter about what was found.

    dof: of the limit surface. friction: (..., 2), the range on which mu is uniform, of each condition. offset: m, by
    how much the hand's place against the slider's is off, in x and in y, from push to push. sigma: m, the same of a
    measured final pose, in x, y and length * theta. tails: degrees of freedom of both. score: m, the mean
    energy score of the pushes' final poses at the end of the search, and history: (steps,), on the way there.
    """

    found: Identified
    values: Values
    score: Float[Array, ""]
    history: Float[Array, "steps"]
    sampler: Sampler = eqx.field(static=True)

    @property
    def dof(self) -> Float[Array, ""]:
        return self.values.dof

    @property
    def friction(self) -> Float[Array, "*conditions 2"]:
        return self.values.friction[0] if self.found.single else self.values.friction

    @property
    def offset(self) -> Float[Array, ""]:
        return self.values.offset

    @property
    def sigma(self) -> Float[Array, ""]:
        return self.values.sigma

    @property
    def tails(self) -> Float[Array, ""]:
        return self.values.tails

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
        several = jax.tree.map(lambda leaf: leaf[None], pushes) if self.found.single else pushes
        setup = _Setup.of(self.found, several, slider, hand, self.sampler)
        drawn = _predict(key, setup, self.values, n)
        return drawn[0] if self.found.single else drawn


def identify_noise(
    key: PRNGKeyArray,
    found: Identified,
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    *,
    sampler: Sampler = "terms",
    samples: int = SAMPLES,
    steps: int = STEPS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Noise:
    """The noise with which the pushes are predicted best, by the energy score.

    found: what `identify` says of these conditions, at best of other pushes: of those that it has learned from, it
    leaves less over. slider, hand: as given there. The middle of the friction's range
    is the friction found; conditions share everything else.
    samples: drawn of each push at every step. progress: called with steps done and of how many.

    Raises ValueError for a number of samples or steps that is too small.

    Source: Zhou et al. 2017, section VII, names the problem; Gneiting & Raftery 2007, section 4.3, the score.
    """
    if samples < 2:
        raise ValueError(f"samples must be at least 2; got {samples}")
    positive("steps", steps)
    several = jax.tree.map(lambda leaf: leaf[None], pushes) if found.single else pushes
    setup = _Setup.of(found, several, slider, hand, sampler)
    scatter = _first(found)
    state, values, visited = _rule(steps).init(scatter), [], []
    keys = jax.random.split(key, steps)
    for begin in range(0, steps, CHUNK):
        part = keys[begin : begin + CHUNK]
        scatter, state, each, passed = _descend(scatter, state, part, setup, samples, steps)
        values.append(each)
        visited.append(passed)
        progress(begin + len(part), steps)
    history = jnp.concatenate(values)
    passed = jax.tree.map(lambda *parts: jnp.concatenate(parts), *visited)
    last = min(AVERAGED, steps)
    mean = jax.tree.map(lambda leaf: jnp.mean(leaf[-last:], axis=0), passed)
    return Noise(found, setup.values(mean), jnp.mean(history[-last:]), history, sampler)


def _rule(steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(RATE, steps, LAST))


class _Scatter(NamedTuple):
    """What is searched for, as unbounded numbers."""

    dof: Float[Array, ""]
    spread: Float[Array, ""]
    offset: Float[Array, ""]
    sigma: Float[Array, ""]
    tails: Float[Array, ""]


class _Setup(eqx.Module):
    """Everything that stays as it is, with a leading axis of conditions but for the last three."""

    around: RandomSurface
    theta: Physical
    pushes: Pushes
    shape: Shape
    hand: Hand
    length: Float[Array, ""]

    @staticmethod
    def of(found: Identified, pushes: Pushes, slider: Slider, hand: Hand, sampler: Sampler) -> "_Setup":
        theta = found.prior.physical(found.z)
        each = surfaces(found.prior, theta)
        model = FrictionModel(START["dof"], 0.0, sampler)
        several = [model.around(jax.tree.map(lambda leaf, k=k: leaf[k], each)) for k in range(len(theta.friction))]
        around = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
        dtype = found.z.dtype
        pushes, shape, hand = jax.tree.map(lambda leaf: leaf.astype(dtype), (pushes, slider.shape, hand))
        return _Setup(around, theta, pushes, shape, hand, found.length)

    def values(self, scatter: _Scatter) -> Values:
        center, spread = self.theta.friction, jnp.exp(scatter.spread)
        friction = jnp.stack([jnp.maximum(center - spread, 0), center + spread], axis=-1)
        dof, tails = LEAST_DOF + jnp.exp(scatter.dof), LEAST_TAILS + jnp.exp(scatter.tails)
        return Values(dof, friction, jnp.exp(scatter.offset), jnp.exp(scatter.sigma), tails)

    def over_conditions(self, of: Callable, key: PRNGKeyArray, values: Values):
        """`of` a drawing, its key and its values, for every condition."""

        def condition(key, around, theta, pushes, friction):
            drawing = _Drawing(around, theta, pushes, self.shape, self.hand)
            return of(drawing, key, values._replace(friction=friction))

        keys = jax.random.split(key, len(self.theta.friction))
        return jax.vmap(condition)(keys, self.around, self.theta, self.pushes, values.friction)


def _first(found: Identified) -> _Scatter:
    dof, spread, offset, tails = (
        jnp.log(jnp.asarray(number, found.z.dtype))
        for number in (START["dof"] - LEAST_DOF, START["spread"], START["offset"], START["tails"] - LEAST_TAILS)
    )
    return _Scatter(dof, spread, offset, jnp.log(found.sigma / 2), tails)


@eqx.filter_jit
def _descend(scatter, state, keys, setup: _Setup, samples: int, steps: int):
    rule = _rule(steps)

    def step(carry, key):
        scatter, state = carry
        score, slope = _score(scatter, key, setup, samples)
        updates, state = rule.update(slope, state)
        scatter = optax.apply_updates(scatter, updates)
        return (scatter, state), (score, scatter)

    (scatter, state), (values, passed) = jax.lax.scan(step, (scatter, state), keys)
    return scatter, state, values, passed


def _score(scatter: _Scatter, key: PRNGKeyArray, setup: _Setup, samples: int) -> tuple[Array, _Scatter]:
    """The mean energy score, and its derivative.

    A pose depends on dof, its own mu and where its hand is: its derivatives by these are worked out forward. The rest
    is cheap, and differentiated backward through poses that are linear about where they are.
    """

    def local(drawing: _Drawing, key, values: Values):
        chances = drawing.chances(key, samples)
        return chances, drawing.slopes(chances, values)

    chances, (poses, slopes) = setup.over_conditions(local, key, setup.values(scatter))
    before = jax.lax.stop_gradient(_own(setup.values(scatter), chances))
    weight = setup.pushes.weight

    def score(scatter: _Scatter) -> Array:
        values = setup.values(scatter)
        dof, mu = ((now - then)[..., None] for now, then in zip(_own(values, chances), before, strict=True))
        off = poses + slopes.dof * dof + slopes.mu * mu - setup.pushes.end[..., None, :]
        errors = jax.vmap(lambda key: _student(key, values.tails))(chances.error.reshape(-1))
        errors = errors.reshape(*chances.mu.shape, 5)
        off = off + values.offset * jnp.einsum("...ij,...j->...i", slopes.aside, errors[..., :2])
        off = off + (values.sigma * errors[..., 2:]).at[..., 2].divide(setup.length)
        each = jax.vmap(jax.vmap(lambda x: energy_score(x, jnp.zeros(3, x.dtype), setup.length)))(off)
        return jnp.sum(weight * each) / jnp.sum(weight)

    return jax.value_and_grad(score)(scatter)


class _Chances(NamedTuple):
    """What is drawn of each push, with axes (..., pushes, samples): keys of surfaces and of errors, and mu's place in
    its range."""

    surface: PRNGKeyArray
    error: PRNGKeyArray
    mu: Float[Array, "*conditions pushes n"]


def _own(values: Values, chances: _Chances) -> tuple[Array, Array]:
    """dof and mu, (..., pushes, samples), of one condition, or of all."""
    low, high = values.friction[..., 0, None, None], values.friction[..., 1, None, None]
    mu = low + (high - low) * chances.mu
    return jnp.broadcast_to(values.dof, mu.shape), mu


class _Slopes(NamedTuple):
    """Of poses, by dof and mu (..., 3), and by where the hand is (..., 3, 2)."""

    dof: Array
    mu: Array
    aside: Array


class _Drawing(eqx.Module):
    """Pushes of one condition, under what is drawn."""

    around: RandomSurface
    theta: Physical
    pushes: Pushes
    shape: Shape
    hand: Hand

    def chances(self, key: PRNGKeyArray, n: int) -> _Chances:
        first, second, third = jax.random.split(key, 3)
        shape = (len(self.pushes.weight), n)
        mu = jax.random.uniform(third, shape, self.pushes.end.dtype)
        return _Chances(jax.random.split(first, shape), jax.random.split(second, shape), mu)

    def poses(self, chances: _Chances, values: Values, aside: Float[Array, "pushes n 2"]) -> Array:
        """Final poses (pushes, n, 3), as they really are."""
        return self._each(self._pose, chances, values, aside)

    def slopes(self, chances: _Chances, values: Values) -> tuple[Array, _Slopes]:
        """Those with hands that are not off, and their derivatives."""

        def value(own, *rest):
            pose = self._pose(own, *rest)
            return pose, pose

        nowhere = jnp.zeros((*chances.mu.shape, 2), chances.mu.dtype)
        slopes, poses = self._each(jax.jacfwd(value, has_aux=True), chances, values, nowhere)
        return poses, _Slopes(*slopes)

    def _each(self, of: Callable, chances: _Chances, values: Values, aside: Array):
        over_samples = jax.vmap(of, in_axes=(0, 0, None, None))
        own = (*_own(values, chances), aside)
        return jax.vmap(over_samples)(own, chances.surface, self.pushes.start, self.pushes.path)

    def _pose(self, own: tuple[Array, Array, Array], key, start, path) -> Float[Array, "3"]:
        dof, mu, aside = own
        surface = self.around.with_dof(dof).sample(key).surface
        met = self.theta._replace(friction=mu, surface=coefficients_of(surface), offset=self.theta.offset + aside)
        return push(met, surface, (self.shape, self.hand), start, path).pose[-1]


@eqx.filter_jit
def _predict(key: PRNGKeyArray, setup: _Setup, values: Values, n: int) -> Float[Array, "conditions pushes n 3"]:
    def measured(drawing: _Drawing, key, values: Values):
        chances = drawing.chances(key, n)
        off = jax.vmap(jax.vmap(lambda key: _student(key, values.tails)))(chances.error)
        errors = (values.sigma * off[..., 2:]).at[..., 2].divide(setup.length)
        return drawing.poses(chances, values, values.offset * off[..., :2]) + errors

    return setup.over_conditions(measured, key, values)


def _student(key: PRNGKeyArray, tails: Array) -> Float[Array, "5"]:
    """Normal numbers with one random factor: two of the hand, three of the pose."""
    first, second = jax.random.split(key)
    normal = jax.random.normal(first, (5,), tails.dtype)
    half = tails / 2
    return normal * jnp.sqrt(half / jnp.maximum(jax.random.gamma(second, half, dtype=half.dtype), 1e-6))
