"""Predictive distribution of pushes under noise; the header of `noise` describes the model."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.jit import jit
from pushjax.friction.feet import Feet
from pushjax.friction.friction_model import FrictionModel, Sampler
from pushjax.friction.quartic import Quartic
from pushjax.friction.surface_distributions import SumOfSquaresQuartic, SurfaceDistribution
from pushjax.identification.model import Scene, coefficients_of, limit_surfaces, predict_push
from pushjax.identification.pushes import Pushes
from pushjax.identification.result import Identified
from pushjax.identification.unknowns import Parameters
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

PLACEHOLDER_DOF = 60.0  # never used to sample: every sample sets its own dof


class NoiseParameters(eqx.Module):
    """The numbers of the noise; `Noise` describes them."""

    surface_dof: Float[Array, ""]
    friction: Float[Array, "*conditions 2"]
    hand_offset: Float[Array, ""]
    sigma: Float[Array, ""]
    relative_error: Float[Array, "2"]
    student_dof: Float[Array, ""]


class RandomInputs(NamedTuple):
    """Random numbers of each push, which do not depend on the parameters of the noise."""

    surface: PRNGKeyArray  # (..., pushes, n) keys of the limit surfaces
    error: PRNGKeyArray  # (..., pushes, n) keys of the errors, which `unit_errors` turns into numbers
    mu: Float[Array, "*conditions pushes n"]  # position of mu in its range, from 0 to 1

    def dof_and_friction(self, noise: NoiseParameters) -> tuple[Array, Array]:
        """Return dof and friction mu of each sample, (..., pushes, n), for one condition or for all."""
        low, high = noise.friction[..., 0, None, None], noise.friction[..., 1, None, None]
        mu = low + (high - low) * self.mu
        return jnp.broadcast_to(noise.surface_dof, mu.shape), mu

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


class PredictiveModel(eqx.Module):
    """The pushes of all conditions or of one, with everything about them that does not depend on the noise."""

    # of all conditions, the first three have a leading axis
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
        # of exact support points there are none
        factors = surfaces.length if isinstance(surfaces, Feet) else found.prior.factors(found.z)
        model, dof = FrictionModel(PLACEHOLDER_DOF, 0.0, sampler), jnp.asarray(PLACEHOLDER_DOF, found.z.dtype)

        def around(surface, factors) -> SurfaceDistribution:
            # the search for the factors of the sum of squares can be skipped, because they are known
            if sampler == "sum_of_squares" and isinstance(surface, Quartic):
                return SumOfSquaresQuartic.of(surface, dof, factors)
            return model.around(surface)

        conditions = range(len(parameters.friction))
        distributions = [around(*jax.tree.map(lambda leaf, k=k: leaf[k], (surfaces, factors))) for k in conditions]
        distribution = jax.tree.map(lambda *leaves: jnp.stack(leaves), *distributions)
        scene = Scene(slider.shape, hand, found.prior.origin)
        pushes, scene = jax.tree.map(lambda leaf: leaf.astype(found.z.dtype), (pushes.as_conditions(), scene))
        return PredictiveModel(distribution, parameters, pushes, scene, found.length)

    def over_conditions(self, function: Callable, key: PRNGKeyArray, noise: NoiseParameters):
        """Call `function` with the model of every condition, a key, and the noise with the condition's friction."""

        def one_condition(key, distribution, parameters, pushes, friction):
            condition = PredictiveModel(distribution, parameters, pushes, self.scene, self.length)
            return function(condition, key, eqx.tree_at(lambda each: each.friction, noise, friction))

        keys = jax.random.split(key, len(self.parameters.friction))
        friction = jnp.atleast_2d(noise.friction)
        return jax.vmap(one_condition)(keys, self.distribution, self.parameters, self.pushes, friction)

    def sample_inputs(self, key: PRNGKeyArray, n: int) -> RandomInputs:
        """Sample the random numbers for `n` samples of each push of one condition."""
        first, second, third = jax.random.split(key, 3)
        shape = (len(self.pushes.weight), n)
        mu = jax.random.uniform(third, shape, self.pushes.end.dtype)
        return RandomInputs(jax.random.split(first, shape), jax.random.split(second, shape), mu)

    def sample_poses(self, key: PRNGKeyArray, noise: NoiseParameters, n: int) -> tuple[Array, Array]:
        """Sample true final poses (pushes, n, 3) of one condition; return them and the unit errors (pushes, n, 5)."""
        inputs = self.sample_inputs(key, n)
        unit_errors = inputs.unit_errors(noise.student_dof)
        poses = self._over_samples(self._final_pose, inputs, noise, noise.hand_offset * unit_errors[..., :2])
        return poses, unit_errors

    def linearize(self, inputs: RandomInputs, noise: NoiseParameters) -> tuple[Array, PoseJacobian]:
        """Return one condition's true final poses (pushes, n, 3) for hands as logged, and their derivatives."""

        def pose_twice(sample, *rest):
            pose = self._final_pose(sample, *rest)
            return pose, pose

        no_shift = jnp.zeros((*inputs.mu.shape, 2), inputs.mu.dtype)
        jacobian, poses = self._over_samples(jax.jacfwd(pose_twice, has_aux=True), inputs, noise, no_shift)
        return poses, PoseJacobian(*jacobian)

    def _over_samples(self, function: Callable, inputs: RandomInputs, noise: NoiseParameters, hand_shift: Array):
        """Map `function` of (dof, mu, hand shift), key of the surface and push over pushes and samples."""
        over_samples = jax.vmap(function, in_axes=(0, 0, None))
        samples = (*inputs.dof_and_friction(noise), hand_shift)
        return jax.vmap(over_samples)(samples, inputs.surface, self.pushes)

    def _final_pose(self, sample: tuple[Array, Array, Array], key: PRNGKeyArray, push: Pushes) -> Float[Array, "3"]:
        """Return the true final pose for one sample: dof, mu, and displacement of the hand (world, m)."""
        dof, mu, hand_shift = sample
        surface = self.distribution.with_dof(dof).sample(key).surface
        parameters = self.parameters._replace(
            friction=mu, surface=coefficients_of(surface), hand_offset=self.parameters.hand_offset + hand_shift
        )
        return predict_push(parameters, surface, self.scene, push).pose[-1]

    def error_scale(self, poses: Float[Array, "*pushes n 3"], noise: NoiseParameters) -> Float[Array, "*pushes n"]:
        """Return the scale in m of the error of each final pose, in x, y and length * theta."""
        moved = poses - self.pushes.start[..., None, :]
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

    def log_density(self, poses: Float[Array, "*pushes n 3"], noise: NoiseParameters) -> Float[Array, "*pushes"]:
        """Return the log density of the recorded final poses: of the mean of Student's densities about `poses`."""
        difference = poses - self.pushes.end[..., None, :]
        scale, nu, turn = self.error_scale(poses, noise), noise.student_dof, 2 * jnp.pi
        angle = difference[..., 2] - turn * jax.lax.stop_gradient(jnp.round(difference[..., 2] / turn))
        squared = (difference[..., 0] ** 2 + difference[..., 1] ** 2 + (self.length * angle) ** 2) / scale**2
        log_peak = gammaln((nu + 3) / 2) - gammaln(nu / 2) - 1.5 * jnp.log(nu * jnp.pi) - 3 * jnp.log(scale)
        log_densities = log_peak - (nu + 3) / 2 * jnp.log1p(squared / nu)
        return jax.nn.logsumexp(log_densities, axis=-1) - jnp.log(jnp.asarray(poses.shape[-2], log_densities.dtype))


@jit
def predict(
    key: PRNGKeyArray, predictive: PredictiveModel, noise: NoiseParameters, n: int
) -> Float[Array, "conditions pushes n 3"]:
    """Sample `n` measured final poses of each push."""

    def measured(condition: PredictiveModel, key, noise: NoiseParameters):
        poses, unit_errors = condition.sample_poses(key, noise, n)
        return condition.with_errors(poses, condition.error_scale(poses, noise), unit_errors)

    return predictive.over_conditions(measured, key, noise)


@jit
def log_density(
    key: PRNGKeyArray, predictive: PredictiveModel, noise: NoiseParameters, n: int
) -> Float[Array, "conditions pushes"]:
    """Return the log density of the recorded final poses: of the mean of Student's densities about `n` samples."""

    def density(condition: PredictiveModel, key, noise: NoiseParameters):
        return condition.log_density(condition.sample_poses(key, noise, n)[0], noise)

    return predictive.over_conditions(density, key, noise)
