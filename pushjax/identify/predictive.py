"""How pushes come out under noise: a limit surface and a friction drawn for each, a hand that is off, and an error of
the final pose that grows with how far the slider went and turned."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._programs import compiled
from pushjax.friction_model import FrictionModel, RandomSurface, Sampler, TermsQuartic
from pushjax.hands import Hand
from pushjax.identify.identified import Identified, surfaces
from pushjax.identify.model import Body, coefficients_of, push
from pushjax.identify.pushes import Given, Pushes
from pushjax.identify.unknowns import Physical
from pushjax.limit_surface import Quartic
from pushjax.rollout import Slider

ANY_DOF = 60.0  # every draw brings its own


class Values(NamedTuple):
    """Of the noise. friction: (conditions, 2), or, of one of them, (2,)."""

    dof: Float[Array, ""]
    friction: Float[Array, "*conditions 2"]
    offset: Float[Array, ""]
    sigma: Float[Array, ""]
    relative: Float[Array, "2"]
    tails: Float[Array, ""]

    def own(self, chances: "Chances") -> tuple[Array, Array]:
        """dof and mu, (..., pushes, samples), of one condition, or of all."""
        low, high = self.friction[..., 0, None, None], self.friction[..., 1, None, None]
        mu = low + (high - low) * chances.mu
        return jnp.broadcast_to(self.dof, mu.shape), mu


class Chances(NamedTuple):
    """What is drawn of each push, with axes (..., pushes, samples): keys of surfaces, mu's place in its range, and
    keys of errors, which `errors` turns into numbers."""

    surface: PRNGKeyArray
    error: PRNGKeyArray
    mu: Float[Array, "*conditions pushes n"]

    def errors(self, tails: Array) -> Float[Array, "*conditions pushes n 5"]:
        """Of the hand, two, and of the pose, three: normal numbers with one random factor, Student's together."""

        def student(key: PRNGKeyArray) -> Float[Array, "5"]:
            first, second = jax.random.split(key)
            normal = jax.random.normal(first, (5,), tails.dtype)
            half = tails / 2
            return normal * jnp.sqrt(half / jnp.maximum(jax.random.gamma(second, half, dtype=half.dtype), 1e-6))

        each: Callable = student
        for _ in self.mu.shape:
            each = jax.vmap(each)
        return each(self.error)


class Slopes(NamedTuple):
    """Of poses, by dof and mu (..., 3), and by where the hand is (..., 3, 2)."""

    dof: Array
    mu: Array
    aside: Array


class Drawing(eqx.Module):
    """Pushes of one condition, under what is drawn."""

    around: RandomSurface
    theta: Physical
    pushes: Pushes
    body: Body

    def chances(self, key: PRNGKeyArray, n: int) -> Chances:
        first, second, third = jax.random.split(key, 3)
        shape = (len(self.pushes.weight), n)
        mu = jax.random.uniform(third, shape, self.pushes.end.dtype)
        return Chances(jax.random.split(first, shape), jax.random.split(second, shape), mu)

    def poses(self, chances: Chances, values: Values, aside: Float[Array, "pushes n 2"]) -> Array:
        """Final poses (pushes, n, 3), as they really are."""
        return self._each(self._pose, chances, values, aside)

    def slopes(self, chances: Chances, values: Values) -> tuple[Array, Slopes]:
        """Those with hands that are not off, and their derivatives."""

        def value(own, *rest):
            pose = self._pose(own, *rest)
            return pose, pose

        nowhere = jnp.zeros((*chances.mu.shape, 2), chances.mu.dtype)
        slopes, poses = self._each(jax.jacfwd(value, has_aux=True), chances, values, nowhere)
        return poses, Slopes(*slopes)

    def _each(self, of: Callable, chances: Chances, values: Values, aside: Array):
        over_samples = jax.vmap(of, in_axes=(0, 0, None))
        own = (*values.own(chances), aside)
        return jax.vmap(over_samples)(own, chances.surface, self.pushes.given)

    def _pose(self, own: tuple[Array, Array, Array], key, given: Given) -> Float[Array, "3"]:
        dof, mu, aside = own
        surface = self.around.with_dof(dof).sample(key).surface
        met = self.theta._replace(friction=mu, surface=coefficients_of(surface), offset=self.theta.offset + aside)
        return push(met, surface, self.body, given).pose[-1]


class Predictive(eqx.Module):
    """The pushes of all conditions, and everything about them that no noise changes. around, theta, pushes: with a
    leading axis of conditions. length: m, makes angles commensurate."""

    around: RandomSurface
    theta: Physical
    pushes: Pushes
    body: Body
    length: Float[Array, ""]

    @staticmethod
    def of(found: Identified, pushes: Pushes, slider: Slider, hand: Hand, sampler: Sampler) -> "Predictive":
        theta = found.prior.physical(found.z)
        each = surfaces(found.prior, theta)
        model, factors = FrictionModel(ANY_DOF, 0.0, sampler), found.prior.factors(found.z)
        dof = jnp.asarray(ANY_DOF, found.z.dtype)
        several: list[RandomSurface] = []
        for k in range(len(theta.friction)):
            surface = jax.tree.map(lambda leaf, k=k: leaf[k], each)
            # no search for the terms of a sum that is known
            known = sampler == "terms" and isinstance(surface, Quartic)
            several.append(TermsQuartic.of_terms(surface, factors[k], dof) if known else model.around(surface))
        around = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
        body = Body(slider.shape, hand, found.prior.origin)
        pushes, body = jax.tree.map(lambda leaf: leaf.astype(found.z.dtype), (pushes.as_conditions(), body))
        return Predictive(around, theta, pushes, body, found.length)

    def over_conditions(self, of: Callable, key: PRNGKeyArray, values: Values):
        """`of` a drawing, its key and its values, for every condition."""

        def condition(key, around, theta, pushes, friction):
            drawing = Drawing(around, theta, pushes, self.body)
            return of(drawing, key, values._replace(friction=friction))

        keys = jax.random.split(key, len(self.theta.friction))
        return jax.vmap(condition)(keys, self.around, self.theta, self.pushes, values.friction)

    def error(self, poses: Float[Array, "*pushes n 3"], pushes: Pushes, values: Values) -> Float[Array, "*pushes n"]:
        """Of each of these final poses, in x, y and length * theta: m."""
        moved = poses - pushes.start[..., None, :]
        went, turned = moved[..., 0] ** 2 + moved[..., 1] ** 2, (self.length * moved[..., 2]) ** 2
        by_way, by_turn = values.relative**2
        return jnp.sqrt(values.sigma**2 + by_way * went + by_turn * turned)

    def measured(
        self, poses: Float[Array, "*pushes n 3"], error: Float[Array, "*pushes n"], errors: Float[Array, "*pushes n 5"]
    ) -> Float[Array, "*pushes n 3"]:
        """Final poses, with their errors, of the size `error`."""
        return poses + (error[..., None] * errors[..., 2:]).at[..., 2].divide(self.length)

    def log_density(
        self, poses: Float[Array, "*pushes n 3"], pushes: Pushes, values: Values
    ) -> Float[Array, "*pushes"]:
        """Of the recorded final poses: of the mean of Student's densities about these."""
        off = poses - pushes.end[..., None, :]
        return student_density(off, self.error(poses, pushes, values), values.tails, self.length)


@compiled
def predict(key: PRNGKeyArray, predictive: Predictive, values: Values, n: int) -> Float[Array, "conditions pushes n 3"]:
    """`n` measured final poses of each push."""

    def measured(drawing: Drawing, key, values: Values):
        chances = drawing.chances(key, n)
        errors = chances.errors(values.tails)
        poses = drawing.poses(chances, values, values.offset * errors[..., :2])
        return predictive.measured(poses, predictive.error(poses, drawing.pushes, values), errors)

    return predictive.over_conditions(measured, key, values)


@compiled
def log_density(key: PRNGKeyArray, predictive: Predictive, values: Values, n: int) -> Float[Array, "conditions pushes"]:
    """Of the recorded final poses: the mean of Student's densities about `n` poses of each push."""

    def density(drawing: Drawing, key, values: Values):
        chances = drawing.chances(key, n)
        poses = drawing.poses(chances, values, values.offset * chances.errors(values.tails)[..., :2])
        return predictive.log_density(poses, drawing.pushes, values)

    return predictive.over_conditions(density, key, values)


def student_density(
    off: Float[Array, "*pushes n 3"], sigma: Float[Array, "*pushes n"], tails: Array, length: Float[Array, ""]
) -> Float[Array, "*pushes"]:
    """The logarithm of the mean, over poses that are off by so much, of the density of their errors."""
    turn = 2 * jnp.pi
    angle = off[..., 2] - turn * jax.lax.stop_gradient(jnp.round(off[..., 2] / turn))
    squared = (off[..., 0] ** 2 + off[..., 1] ** 2 + (length * angle) ** 2) / sigma**2
    scale = gammaln((tails + 3) / 2) - gammaln(tails / 2) - 1.5 * jnp.log(tails * jnp.pi) - 3 * jnp.log(sigma)
    each = scale - (tails + 3) / 2 * jnp.log1p(squared / tails)
    return jax.nn.logsumexp(each, axis=-1) - jnp.log(jnp.asarray(off.shape[-2], each.dtype))
