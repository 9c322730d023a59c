"""Predictive distribution of pushes under noise.

For each push, a limit surface and a friction are sampled, the hand is displaced, and the final pose has an error that
grows with how far the slider moved and turned.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.jit import jit
from pushjax.friction.quartic import Quartic
from pushjax.friction.random import FrictionModel, Sampler, SumOfSquaresQuartic, SurfaceDistribution
from pushjax.identification.model import Scene, coefficients_of, push, surfaces
from pushjax.identification.pushes import Pushes, PushInput
from pushjax.identification.result import Identified
from pushjax.identification.unknowns import Parameters
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

ANY_DOF = 60.0  # placeholder: every sample sets its own dof


class NoiseParameters(NamedTuple):
    """Parameters of the noise.

    Attributes:
        dof: Degrees of freedom of the limit surface.
        friction: (conditions, 2) range of mu, or (2,) for one condition.
        offset: Scale of the hand's displacement in x and in y, m.
        sigma: Scale of the measurement error of a final pose, in x, y and length * theta, m.
        relative: (2,) scale of the error per distance that the slider moved, and per length * angle that it turned.
        tails: Degrees of freedom of Student's distribution of the errors.
    """

    dof: Float[Array, ""]
    friction: Float[Array, "*conditions 2"]
    offset: Float[Array, ""]
    sigma: Float[Array, ""]
    relative: Float[Array, "2"]
    tails: Float[Array, ""]

    def own(self, chances: "RandomInputs") -> tuple[Array, Array]:
        """Return dof and mu of each sample, (..., pushes, samples), for one condition or for all."""
        low, high = self.friction[..., 0, None, None], self.friction[..., 1, None, None]
        mu = low + (high - low) * chances.mu
        return jnp.broadcast_to(self.dof, mu.shape), mu


class RandomInputs(NamedTuple):
    """Random draws of each push, with axes (..., pushes, samples). They do not depend on the noise's parameters.

    Attributes:
        surface: Keys of the limit surfaces.
        error: Keys of the errors, which `errors` turns into numbers.
        mu: Position of mu in its range, from 0 to 1.
    """

    surface: PRNGKeyArray
    error: PRNGKeyArray
    mu: Float[Array, "*conditions pushes n"]

    def errors(self, tails: Array) -> Float[Array, "*conditions pushes n 5"]:
        """Sample the errors, in units of their scale: two of the hand and three of the final pose.

        The five numbers are normal with one common random factor, so that together they have Student's distribution
        with `tails` degrees of freedom.
        """

        def student(key: PRNGKeyArray) -> Float[Array, "5"]:
            first, second = jax.random.split(key)
            normal = jax.random.normal(first, (5,), tails.dtype)
            half = tails / 2
            return normal * jnp.sqrt(half / jnp.maximum(jax.random.gamma(second, half, dtype=half.dtype), 1e-6))

        each: Callable = student
        for _ in self.mu.shape:
            each = jax.vmap(each)
        return each(self.error)


class PoseJacobian(NamedTuple):
    """Derivatives of final poses.

    Attributes:
        dof: (..., 3) with respect to dof.
        mu: (..., 3) with respect to mu.
        aside: (..., 3, 2) with respect to the position of the hand.
    """

    dof: Array
    mu: Array
    aside: Array


class ConditionSampler(eqx.Module):
    """Simulation of the pushes of one condition under random draws.

    Attributes:
        around: Distribution of the limit surface.
        theta: Estimated parameters of the condition.
        pushes: Pushes of the condition.
        body: Slider and hand.
    """

    around: SurfaceDistribution
    theta: Parameters
    pushes: Pushes
    body: Scene

    def chances(self, key: PRNGKeyArray, n: int) -> RandomInputs:
        """Draw the random numbers for `n` samples of each push."""
        first, second, third = jax.random.split(key, 3)
        shape = (len(self.pushes.weight), n)
        mu = jax.random.uniform(third, shape, self.pushes.end.dtype)
        return RandomInputs(jax.random.split(first, shape), jax.random.split(second, shape), mu)

    def poses(self, chances: RandomInputs, values: NoiseParameters, aside: Float[Array, "pushes n 2"]) -> Array:
        """Return the true final poses (pushes, n, 3), without measurement error; `aside` displaces the hands (m)."""
        return self._each(self._pose, chances, values, aside)

    def slopes(self, chances: RandomInputs, values: NoiseParameters) -> tuple[Array, PoseJacobian]:
        """Return the true final poses without displacement of the hands, and their derivatives."""

        def value(own, *rest):
            pose = self._pose(own, *rest)
            return pose, pose

        nowhere = jnp.zeros((*chances.mu.shape, 2), chances.mu.dtype)
        slopes, poses = self._each(jax.jacfwd(value, has_aux=True), chances, values, nowhere)
        return poses, PoseJacobian(*slopes)

    def _each(self, of: Callable, chances: RandomInputs, values: NoiseParameters, aside: Array):
        """Map `of` over pushes and samples."""
        over_samples = jax.vmap(of, in_axes=(0, 0, None))
        own = (*values.own(chances), aside)
        return jax.vmap(over_samples)(own, chances.surface, self.pushes.given)

    def _pose(self, own: tuple[Array, Array, Array], key, given: PushInput) -> Float[Array, "3"]:
        """Return the final pose for one dof, mu and displacement of the hand."""
        dof, mu, aside = own
        surface = self.around.with_dof(dof).sample(key).surface
        met = self.theta._replace(friction=mu, surface=coefficients_of(surface), offset=self.theta.offset + aside)
        return push(met, surface, self.body, given).pose[-1]


class PredictiveModel(eqx.Module):
    """The pushes of all conditions, with everything about them that does not depend on the noise.

    Attributes:
        around: Distribution of the limit surface, with a leading axis of conditions.
        theta: Estimated parameters, with a leading axis of conditions.
        pushes: Pushes, with a leading axis of conditions.
        body: Slider and hand.
        length: Length in m that makes angles commensurate with positions.
    """

    around: SurfaceDistribution
    theta: Parameters
    pushes: Pushes
    body: Scene
    length: Float[Array, ""]

    @staticmethod
    def of(found: Identified, pushes: Pushes, slider: Slider, hand: Hand, sampler: Sampler) -> "PredictiveModel":
        """Prepare the prediction of `pushes` from what was identified."""
        theta = found.prior.physical(found.z)
        each = surfaces(found.prior, theta)
        model, factors = FrictionModel(ANY_DOF, 0.0, sampler), found.prior.factors(found.z)
        dof = jnp.asarray(ANY_DOF, found.z.dtype)
        several: list[SurfaceDistribution] = []
        for k in range(len(theta.friction)):
            surface = jax.tree.map(lambda leaf, k=k: leaf[k], each)
            # the factors of the sum of squares are known: skip the search for them
            known = sampler == "sum_of_squares" and isinstance(surface, Quartic)
            several.append(SumOfSquaresQuartic.of_terms(surface, factors[k], dof) if known else model.around(surface))
        around = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
        body = Scene(slider.shape, hand, found.prior.origin)
        pushes, body = jax.tree.map(lambda leaf: leaf.astype(found.z.dtype), (pushes.as_conditions(), body))
        return PredictiveModel(around, theta, pushes, body, found.length)

    def over_conditions(self, of: Callable, key: PRNGKeyArray, values: NoiseParameters):
        """Call `of` with the drawing, the key and the values of every condition."""

        def condition(key, around, theta, pushes, friction):
            drawing = ConditionSampler(around, theta, pushes, self.body)
            return of(drawing, key, values._replace(friction=friction))

        keys = jax.random.split(key, len(self.theta.friction))
        return jax.vmap(condition)(keys, self.around, self.theta, self.pushes, values.friction)

    def error(
        self, poses: Float[Array, "*pushes n 3"], pushes: Pushes, values: NoiseParameters
    ) -> Float[Array, "*pushes n"]:
        """Return the scale in m of the error of each final pose, in x, y and length * theta."""
        moved = poses - pushes.start[..., None, :]
        went, turned = moved[..., 0] ** 2 + moved[..., 1] ** 2, (self.length * moved[..., 2]) ** 2
        by_way, by_turn = values.relative**2
        return jnp.sqrt(values.sigma**2 + by_way * went + by_turn * turned)

    def measured(
        self, poses: Float[Array, "*pushes n 3"], error: Float[Array, "*pushes n"], errors: Float[Array, "*pushes n 5"]
    ) -> Float[Array, "*pushes n 3"]:
        """Return measured final poses: the true ones plus `errors` times their scale `error`."""
        return poses + (error[..., None] * errors[..., 2:]).at[..., 2].divide(self.length)

    def log_density(
        self, poses: Float[Array, "*pushes n 3"], pushes: Pushes, values: NoiseParameters
    ) -> Float[Array, "*pushes"]:
        """Return the log density of the recorded final poses.

        The density is the mean of Student's densities about `poses`.
        """
        off = poses - pushes.end[..., None, :]
        return student_density(off, self.error(poses, pushes, values), values.tails, self.length)


@jit
def predict(
    key: PRNGKeyArray, predictive: PredictiveModel, values: NoiseParameters, n: int
) -> Float[Array, "conditions pushes n 3"]:
    """Sample `n` measured final poses of each push."""

    def measured(drawing: ConditionSampler, key, values: NoiseParameters):
        chances = drawing.chances(key, n)
        errors = chances.errors(values.tails)
        poses = drawing.poses(chances, values, values.offset * errors[..., :2])
        return predictive.measured(poses, predictive.error(poses, drawing.pushes, values), errors)

    return predictive.over_conditions(measured, key, values)


@jit
def log_density(
    key: PRNGKeyArray, predictive: PredictiveModel, values: NoiseParameters, n: int
) -> Float[Array, "conditions pushes"]:
    """Return the log density of the recorded final poses.

    The density is the mean of Student's densities about `n` sampled poses of each push.
    """

    def density(drawing: ConditionSampler, key, values: NoiseParameters):
        chances = drawing.chances(key, n)
        poses = drawing.poses(chances, values, values.offset * chances.errors(values.tails)[..., :2])
        return predictive.log_density(poses, drawing.pushes, values)

    return predictive.over_conditions(density, key, values)


def student_density(
    off: Float[Array, "*pushes n 3"], sigma: Float[Array, "*pushes n"], tails: Array, length: Float[Array, ""]
) -> Float[Array, "*pushes"]:
    """Return the logarithm of the mean of Student's densities about several poses.

    Args:
        off: (..., n, 3) differences between the poses and the recorded pose: x, y (m), theta (rad).
        sigma: (..., n) scale of the error of each pose, m.
        tails: Degrees of freedom.
        length: Length in m that makes angles commensurate with positions.

    Returns:
        Log density per cubic meter of (x, y, length * theta).
    """
    turn = 2 * jnp.pi
    angle = off[..., 2] - turn * jax.lax.stop_gradient(jnp.round(off[..., 2] / turn))
    squared = (off[..., 0] ** 2 + off[..., 1] ** 2 + (length * angle) ** 2) / sigma**2
    scale = gammaln((tails + 3) / 2) - gammaln(tails / 2) - 1.5 * jnp.log(tails * jnp.pi) - 3 * jnp.log(sigma)
    each = scale - (tails + 3) / 2 * jnp.log1p(squared / tails)
    return jax.nn.logsumexp(each, axis=-1) - jnp.log(jnp.asarray(off.shape[-2], each.dtype))
