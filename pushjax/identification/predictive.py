"""Predictive distribution of pushes under noise; the header of `noise` describes the model."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.jit import jit
from pushjax.friction.friction_model import FrictionModel, Sampler
from pushjax.friction.quartic import Quartic
from pushjax.friction.surface_distributions import SumOfSquaresQuartic, SurfaceDistribution
from pushjax.identification.model import Scene, coefficients_of, limit_surfaces, predict_push
from pushjax.identification.pushes import Pushes, PushInput
from pushjax.identification.result import Identified
from pushjax.identification.unknowns import Parameters
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

PLACEHOLDER_DOF = 60.0  # never used to sample: every sample sets its own dof


class NoiseParameters(NamedTuple):
    """Parameters of the noise."""

    surface_dof: Float[Array, ""]  # degrees of freedom of the limit surface
    friction: Float[Array, "*conditions 2"]  # range of mu
    hand_offset: Float[Array, ""]  # scale of the hand's displacement in x and in y, m
    sigma: Float[Array, ""]  # scale of the measurement error of a final pose, in x, y and length * theta, m
    # scale of the error per distance that the slider moved, and per length * angle that it turned
    relative_error: Float[Array, "2"]
    student_dof: Float[Array, ""]  # degrees of freedom of Student's distribution of the errors

    def dof_and_friction(self, inputs: "RandomInputs") -> tuple[Array, Array]:
        """Return dof and friction mu of each sample, (..., pushes, samples), for one condition or for all."""
        low, high = self.friction[..., 0, None, None], self.friction[..., 1, None, None]
        mu = low + (high - low) * inputs.mu
        return jnp.broadcast_to(self.surface_dof, mu.shape), mu


class RandomInputs(NamedTuple):
    """Random draws of each push, which do not depend on the parameters of the noise."""

    surface: PRNGKeyArray  # (..., pushes, n) keys of the limit surfaces
    error: PRNGKeyArray  # (..., pushes, n) keys of the errors, which `unit_errors` turns into numbers
    mu: Float[Array, "*conditions pushes n"]  # position of mu in its range, from 0 to 1

    def unit_errors(self, student_dof: Array) -> Float[Array, "*conditions pushes n 5"]:
        """Sample the errors in units of their scale: two of the hand's position and three of the final pose."""
        # The five numbers are normal with one common random factor, so together they have Student's distribution.

        def unit_error(key: PRNGKeyArray) -> Float[Array, "5"]:
            first, second = jax.random.split(key)
            normal = jax.random.normal(first, (5,), student_dof.dtype)
            half = student_dof / 2
            return normal * jnp.sqrt(half / jnp.maximum(jax.random.gamma(second, half, dtype=half.dtype), 1e-6))

        unit_errors: Callable = unit_error
        for _ in self.mu.shape:
            unit_errors = jax.vmap(unit_errors)
        return unit_errors(self.error)


class PoseJacobian(NamedTuple):
    """Derivatives of final poses."""

    dof: Float[Array, "*samples 3"]
    mu: Float[Array, "*samples 3"]
    hand_shift: Float[Array, "*samples 3 2"]  # with respect to the position of the hand


class ConditionSampler(eqx.Module):
    """Simulation of the pushes of one condition under random draws."""

    distribution: SurfaceDistribution  # of the limit surface
    parameters: Parameters  # estimated
    pushes: Pushes
    scene: Scene

    def draw_inputs(self, key: PRNGKeyArray, n: int) -> RandomInputs:
        """Draw the random numbers for `n` samples of each push."""
        first, second, third = jax.random.split(key, 3)
        shape = (len(self.pushes.weight), n)
        mu = jax.random.uniform(third, shape, self.pushes.end.dtype)
        return RandomInputs(jax.random.split(first, shape), jax.random.split(second, shape), mu)

    def poses(
        self,
        inputs: RandomInputs,
        noise: NoiseParameters,
        hand_shift: Float[Array, "pushes n 2"],  # displacement of each hand, world, m
    ) -> Array:
        """Return the true final poses (pushes, n, 3), without measurement error."""
        return self._over_samples(self._final_pose, inputs, noise, hand_shift)

    def linearize(self, inputs: RandomInputs, noise: NoiseParameters) -> tuple[Array, PoseJacobian]:
        """Return the true final poses (pushes, n, 3) without displacement of the hands, and their derivatives."""

        def pose_twice(sample, *rest):
            pose = self._final_pose(sample, *rest)
            return pose, pose

        no_shift = jnp.zeros((*inputs.mu.shape, 2), inputs.mu.dtype)
        jacobian, poses = self._over_samples(jax.jacfwd(pose_twice, has_aux=True), inputs, noise, no_shift)
        return poses, PoseJacobian(*jacobian)

    def _over_samples(self, function: Callable, inputs: RandomInputs, noise: NoiseParameters, hand_shift: Array):
        """Map `function` of (dof, mu, hand shift), key of the surface and push over pushes and samples."""
        over_samples = jax.vmap(function, in_axes=(0, 0, None))
        samples = (*noise.dof_and_friction(inputs), hand_shift)
        return jax.vmap(over_samples)(samples, inputs.surface, self.pushes.inputs)

    def _final_pose(self, sample: tuple[Array, Array, Array], key, push: PushInput) -> Float[Array, "3"]:
        """Return the true final pose (3,) for one sample (dof, mu, displacement of the hand)."""
        dof, mu, hand_shift = sample
        surface = self.distribution.with_dof(dof).sample(key).surface
        parameters = self.parameters._replace(
            friction=mu, surface=coefficients_of(surface), hand_offset=self.parameters.hand_offset + hand_shift
        )
        return predict_push(parameters, surface, self.scene, push).pose[-1]


class PredictiveModel(eqx.Module):
    """The pushes of all conditions, with everything about them that does not depend on the noise."""

    # all but `scene` and `length` have a leading axis of conditions

    distribution: SurfaceDistribution  # of the limit surface
    parameters: Parameters  # estimated
    pushes: Pushes
    scene: Scene
    length: Float[Array, ""]  # m, makes angles commensurate with positions

    @staticmethod
    def of(found: Identified, pushes: Pushes, slider: Slider, hand: Hand, sampler: Sampler) -> "PredictiveModel":
        """Prepare the prediction of `pushes` from what was identified."""
        parameters = found.prior.parameters(found.z)
        surfaces = limit_surfaces(found.prior, parameters)
        model, factors = FrictionModel(PLACEHOLDER_DOF, 0.0, sampler), found.prior.factors(found.z)
        dof = jnp.asarray(PLACEHOLDER_DOF, found.z.dtype)
        distributions: list[SurfaceDistribution] = []
        for k in range(len(parameters.friction)):
            surface = jax.tree.map(lambda leaf, k=k: leaf[k], surfaces)
            # The search for the factors of the sum of squares can be skipped, because they are known.
            factors_are_known = sampler == "sum_of_squares" and isinstance(surface, Quartic)
            if factors_are_known:
                distributions.append(SumOfSquaresQuartic.of_terms(surface, factors[k], dof))
            else:
                distributions.append(model.around(surface))
        distribution = jax.tree.map(lambda *leaves: jnp.stack(leaves), *distributions)
        scene = Scene(slider.shape, hand, found.prior.origin)
        pushes, scene = jax.tree.map(lambda leaf: leaf.astype(found.z.dtype), (pushes.as_conditions(), scene))
        return PredictiveModel(distribution, parameters, pushes, scene, found.length)

    def over_conditions(self, function: Callable, key: PRNGKeyArray, noise: NoiseParameters):
        """Call `function` with the `ConditionSampler`, the key and the noise parameters of every condition."""

        def one_condition(key, distribution, parameters, pushes, friction):
            condition = ConditionSampler(distribution, parameters, pushes, self.scene)
            return function(condition, key, noise._replace(friction=friction))

        keys = jax.random.split(key, len(self.parameters.friction))
        return jax.vmap(one_condition)(keys, self.distribution, self.parameters, self.pushes, noise.friction)

    def error_scale(
        self, poses: Float[Array, "*pushes n 3"], pushes: Pushes, noise: NoiseParameters
    ) -> Float[Array, "*pushes n"]:
        """Return the scale in m of the error of each final pose, in x, y and length * theta."""
        moved = poses - pushes.start[..., None, :]
        # both squared
        distance, turn = moved[..., 0] ** 2 + moved[..., 1] ** 2, (self.length * moved[..., 2]) ** 2
        of_distance, of_turn = noise.relative_error**2
        return jnp.sqrt(noise.sigma**2 + of_distance * distance + of_turn * turn)

    def with_errors(
        self,
        poses: Float[Array, "*pushes n 3"],
        error_scale: Float[Array, "*pushes n"],
        unit_errors: Float[Array, "*pushes n 5"],
    ) -> Float[Array, "*pushes n 3"]:
        """Return measured final poses: the true ones plus `unit_errors` times their scale in m."""
        return poses + (error_scale[..., None] * unit_errors[..., 2:]).at[..., 2].divide(self.length)

    def log_density(
        self, poses: Float[Array, "*pushes n 3"], pushes: Pushes, noise: NoiseParameters
    ) -> Float[Array, "*pushes"]:
        """Return the log density of the recorded final poses: the mean of Student's densities about `poses`."""
        difference = poses - pushes.end[..., None, :]
        return log_student_density(difference, self.error_scale(poses, pushes, noise), noise.student_dof, self.length)


@jit
def predict(
    key: PRNGKeyArray, predictive: PredictiveModel, noise: NoiseParameters, n: int
) -> Float[Array, "conditions pushes n 3"]:
    """Sample `n` measured final poses of each push."""

    def measured(condition: ConditionSampler, key, noise: NoiseParameters):
        inputs = condition.draw_inputs(key, n)
        unit_errors = inputs.unit_errors(noise.student_dof)
        poses = condition.poses(inputs, noise, noise.hand_offset * unit_errors[..., :2])
        return predictive.with_errors(poses, predictive.error_scale(poses, condition.pushes, noise), unit_errors)

    return predictive.over_conditions(measured, key, noise)


@jit
def log_density(
    key: PRNGKeyArray, predictive: PredictiveModel, noise: NoiseParameters, n: int
) -> Float[Array, "conditions pushes"]:
    """Return the log density of the recorded final poses: the mean of Student's densities about `n` samples."""

    def density(condition: ConditionSampler, key, noise: NoiseParameters):
        inputs = condition.draw_inputs(key, n)
        poses = condition.poses(inputs, noise, noise.hand_offset * inputs.unit_errors(noise.student_dof)[..., :2])
        return predictive.log_density(poses, condition.pushes, noise)

    return predictive.over_conditions(density, key, noise)


def log_student_density(
    difference: Float[Array, "*pushes n 3"],  # between the poses and the recorded pose: x, y (m), theta (rad)
    sigma: Float[Array, "*pushes n"],  # scale of the error of each pose, m
    student_dof: Array,
    length: Float[Array, ""],  # m, makes angles commensurate with positions
) -> Float[Array, "*pushes"]:
    """Return the log of the mean of Student's densities about poses, per m^3 of (x, y, length * theta)."""
    turn = 2 * jnp.pi
    angle = difference[..., 2] - turn * jax.lax.stop_gradient(jnp.round(difference[..., 2] / turn))
    squared = (difference[..., 0] ** 2 + difference[..., 1] ** 2 + (length * angle) ** 2) / sigma**2
    nu = student_dof
    scale = gammaln((nu + 3) / 2) - gammaln(nu / 2) - 1.5 * jnp.log(nu * jnp.pi) - 3 * jnp.log(sigma)
    log_densities = scale - (nu + 3) / 2 * jnp.log1p(squared / nu)
    return jax.nn.logsumexp(log_densities, axis=-1) - jnp.log(jnp.asarray(difference.shape[-2], log_densities.dtype))
