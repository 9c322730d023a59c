"""Identification of noise: how much pushes scatter about their prediction.

In the model of the noise, each push has its own limit surface, sampled about the identified one with `surface_dof`
degrees of freedom. It has its own friction, uniform about the identified one, up to half the width of `friction` away
from it. Its hand is displaced by `hand_offset` in x and in y. Its final pose has an error in x, y and length * theta,
whose scale combines three parts in quadrature: the measurement error `sigma`; a fraction `relative_error[0]` of the
distance between the slider's start and end; and a fraction `relative_error[1]` of length times the angle that it
turned. So a push that hardly moves the slider is predicted far better than one that turns it around. All of these
errors are normal except for a common random factor, so together they have Student's distribution with `student_dof`
degrees of freedom. Its tails describe pushes that slip where no model predicts it. These are few, but more than a
normal distribution would have.

The search minimizes the mean score of the recorded final poses. The score is proper: in expectation, no other noise
scores better than the true one. The expectation of "energy" does not depend on the number of samples of a push, and
"energy" is hardly sensitive to the tails. "density" is the negative log density, where the density is the mean over
samples that each have a measurement error. It is most sensitive to the tails, and overestimates them slightly when few
samples are drawn.

Samples are smooth functions of the noise, except that for a fixed key a sample may jump with dof (rejections in the
sampler of the gamma distribution). Derivatives are correct in expectation. Therefore the score is not minimized for one
key, but by Adam with a new key for every step.
"""

from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import check_positive
from pushjax._internal.files import load_json, save_json, to_list
from pushjax._internal.jit import jit
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.friction.friction_model import FrictionModel, Sampler
from pushjax.identification.predictive import NoiseParameters, PredictiveModel, log_density, predict
from pushjax.identification.pushes import Pushes
from pushjax.identification.result import Identified, from_record, to_record
from pushjax.metrics import energy_score
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

Score = Literal["energy", "density"]
FORMAT, VERSION = "pushjax noise", 1
ARRAYS = (*(field.name for field in fields(NoiseParameters)), "score", "history")
SAMPLES = 32  # samples of each push in each step of the search
STEPS = 80
CHUNK = 10  # steps between two calls of `progress`
LEARNING_RATE = 0.1  # of the logarithms of the parameters
FINAL_RATE_FRACTION = 0.1  # of the learning rate, left at the end
AVERAGED = 30  # number of last steps whose parameters and scores are averaged
START = {
    "surface_dof": 60.0,
    "friction_half_width": 0.1,
    "hand_offset": 5e-4,
    "relative_error": (0.05, 0.05),
    "student_dof": 6.0,
}
LOWER_BOUNDS = {"surface_dof": 9.0, "student_dof": 1.0}


class Noise(NoiseParameters):
    """Distribution of pushes about their prediction.

    Attributes:
        surface_dof: Degrees of freedom of the limit surface.
        friction: (..., 2) range on which mu is uniform, for each condition.
        hand_offset: Scale in m of the hand's displacement against the slider, in x and in y, which differs from push to
            push.
        sigma: Scale in m of the error of a final pose in x, y and length * theta, however far the slider moved.
        relative_error: (2,) scale of the additional error per distance that the slider moved, and per length * angle
            that it turned.
        student_dof: Degrees of freedom of Student's distribution of all of these errors.
        identified: What `identify` returned.
        score: Mean score of the final poses at the end of the search; in m if it is the energy score.
        history: (steps,) mean score during the search.
        sampler: Sampler of the limit surfaces; see `FrictionModel`.
    """

    identified: Identified
    score: Float[Array, ""]
    history: Float[Array, "steps"]
    sampler: Sampler = eqx.field(static=True)

    @property
    def model(self) -> FrictionModel:
        """Friction model for rollouts and `monte_carlo` around `identified.surface`.

        Raises:
            ValueError: If several conditions were identified.
        """
        if not self.identified.one_condition:
            raise ValueError("model is for what was found of one condition; of several there is `predict`")
        return FrictionModel(self.surface_dof, self.friction, self.sampler)

    def save(self, path: str | Path) -> None:
        """Write everything to a JSON file that `load` reads back to the same bits."""
        record = {"sampler": self.sampler, "identified": to_record(self.identified)}
        record |= {name: to_list(getattr(self, name)) for name in ARRAYS}
        save_json(path, FORMAT, VERSION, self.score.dtype, record)

    @staticmethod
    def load(path: str | Path) -> "Noise":
        """Read a file that `save` wrote.

        Raises:
            ValueError: If the file holds something else.
        """
        return load_json(path, "a noise file", FORMAT, VERSION, _noise_from_record)

    def predict(
        self, key: PRNGKeyArray, pushes: Pushes, slider: Slider, hand: Hand, n: int
    ) -> Float[Array, "*conditions pushes n 3"]:
        """Sample measured final poses of these or other pushes of the same conditions.

        Args:
            key: PRNG key.
            pushes: Pushes of the same conditions.
            slider: Slider, as given to `identify`.
            hand: Hand, as given to `identify`.
            n: Number of samples of each push.

        Returns:
            (..., pushes, n, 3) final poses, world, m and rad.
        """
        predictive = PredictiveModel.of(self.identified, pushes, slider, hand, self.sampler)
        return self.identified._drop_condition_axis(predict(key, predictive, self, n))

    def log_density(
        self, key: PRNGKeyArray, pushes: Pushes, slider: Slider, hand: Hand, n: int
    ) -> Float[Array, "*conditions pushes"]:
        """Return the log of the predicted density at the recorded final poses.

        The density is the mean of Student's densities about `n` sampled poses; their width is the error of the final
        pose. Unlike in `predict`, the random factors of this error and of the hand's displacement are independent.

        Args:
            key: PRNG key.
            pushes: Pushes of the same conditions, those of `identify` or others.
            slider: Slider, as given to `identify`.
            hand: Hand, as given to `identify`.
            n: Number of samples of each push.

        Returns:
            (..., pushes) log density per cubic meter of (x, y, length * theta).
        """
        predictive = PredictiveModel.of(self.identified, pushes, slider, hand, self.sampler)
        return self.identified._drop_condition_axis(log_density(key, predictive, self, n))

    def transferred_to(self, identified: Identified) -> "Noise":
        """Return the same noise about an estimate from other pushes.

        Args:
            identified: The other estimate, of one condition or of several.

        Returns:
            The noise. If the range of friction differs between conditions, it has the widest range.
        """
        half_width = jnp.max(self.friction[..., 1] - self.identified.friction)
        friction = _friction_range(identified.friction, half_width)
        return eqx.tree_at(lambda noise: (noise.identified, noise.friction), self, (identified, friction))


def identify_noise(
    key: PRNGKeyArray,
    found: Identified,
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    *,
    sampler: Sampler = "sum_of_squares",
    score: Score = "energy",
    samples: int = SAMPLES,
    steps: int = STEPS,
    progress: ProgressCallback = no_progress,
) -> Noise:
    """Identify the noise that predicts the pushes best, by the energy score or by the density.

    The range of friction of each condition is centered at its identified friction. Conditions share all other
    parameters.

    Args:
        key: PRNG key.
        found: What `identify` returned for these conditions, preferably from other pushes: the residuals of the pushes
            from which it was identified are smaller.
        pushes: Pushes of the same conditions.
        slider: Slider, as given to `identify`.
        hand: Hand, as given to `identify`.
        sampler: Sampler of the limit surfaces; see `FrictionModel`.
        score: Score to minimize, "energy" or "density".
        samples: Number of samples of each push in every step.
        steps: Number of steps of the search.
        progress: Function called with the number of steps done and the total number.

    Returns:
        The noise.

    Raises:
        ValueError: If `score` is another score, or if `samples` is less than 2 or `steps` is not positive.

    Reference: Zhou et al. 2017, section VII, states the problem. Gneiting & Raftery 2007, section 4.3, describes the
    score.
    """
    if score not in get_args(Score):
        raise ValueError(f"score must be one of {', '.join(get_args(Score))}; got {score!r}")
    if samples < 2:
        raise ValueError(f"samples must be at least 2; got {samples}")
    check_positive("steps", steps)
    predictive = PredictiveModel.of(found, pushes, slider, hand, sampler)
    start = {name: jnp.asarray(value, found.z.dtype) - LOWER_BOUNDS.get(name, 0.0) for name, value in START.items()}
    logs = jax.tree.map(jnp.log, start | {"sigma": found.sigma / 2})
    state, chunks, keys = _optimizer(steps).init(logs), [], jax.random.split(key, steps)
    for first in range(0, steps, CHUNK):
        chunk = keys[first : first + CHUNK]
        logs, state, *scores_and_iterates = _descend(logs, state, chunk, predictive, samples, steps, score)
        chunks.append(scores_and_iterates)
        progress(first + len(chunk), steps)
    history, iterates = jax.tree.map(lambda *parts: jnp.concatenate(parts), *chunks)
    last = min(AVERAGED, steps)
    mean = jax.tree.map(lambda leaf: jnp.mean(leaf[-last:], axis=0), iterates)
    parameters = vars(_parameters(mean, predictive.parameters.friction))
    parameters["friction"] = found._drop_condition_axis(parameters["friction"])
    return Noise(**parameters, identified=found, score=jnp.mean(history[-last:]), history=history, sampler=sampler)


def _optimizer(steps: int) -> optax.GradientTransformation:
    """Return the optimizer: Adam with a cosine decay of the learning rate."""
    return optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, steps, FINAL_RATE_FRACTION))


def _friction_range(center: Float[Array, "*conditions"], half_width: Array) -> Float[Array, "*conditions 2"]:
    """Return the lowest and highest friction."""
    return jnp.stack([jnp.maximum(center - half_width, 0), center + half_width], axis=-1)


# What is optimized are unbounded numbers by name: logarithms of the distance to the lower bound.
_Logs = dict[str, Array]


def _parameters(logs: _Logs, center: Float[Array, "conditions"]) -> NoiseParameters:
    """Return the parameters of the noise; `center` is the identified friction of each condition."""
    values = {name: LOWER_BOUNDS.get(name, 0.0) + jnp.exp(value) for name, value in logs.items()}
    return NoiseParameters(friction=_friction_range(center, values.pop("friction_half_width")), **values)


@jit
def _descend(logs: _Logs, state, keys, predictive: PredictiveModel, samples: int, steps: int, score: Score):
    """Take one optimizer step per key; return logs and state, and the scores before and logs after each."""
    optimizer = _optimizer(steps)

    def step(carry, key):
        logs, state = carry
        value, gradient = _score(logs, key, predictive, samples, score)
        updates, state = optimizer.update(gradient, state)
        logs: Any = optax.apply_updates(logs, updates)
        return (logs, state), (value, logs)

    (last, state), (scores, iterates) = jax.lax.scan(step, (logs, state), keys)
    return last, state, scores, iterates


def _score(
    logs: _Logs, key: PRNGKeyArray, predictive: PredictiveModel, samples: int, score: Score
) -> tuple[Array, _Logs]:
    """Return the mean score and its gradient."""
    # A pose depends on dof, on its own mu and on the position of its hand. Its derivatives with respect to these use
    # forward mode. The rest is cheap, and uses reverse mode through the linearized poses.

    def linearize(condition: PredictiveModel, key: PRNGKeyArray, noise: NoiseParameters):
        inputs = condition.sample_inputs(key, samples)
        return inputs, condition.linearize(inputs, noise)

    center, pushes = predictive.parameters.friction, predictive.pushes
    start = _parameters(logs, center)
    inputs, (poses, jacobian) = predictive.over_conditions(linearize, key, start)
    linearized_at = jax.lax.stop_gradient(inputs.dof_and_friction(start))

    def mean_score(logs: _Logs) -> Array:
        noise = _parameters(logs, center)
        changes = zip(inputs.dof_and_friction(noise), linearized_at, strict=True)
        dof, mu = ((now - then)[..., None] for now, then in changes)
        unit_errors = inputs.unit_errors(noise.student_dof)
        unshifted = poses + jacobian.dof * dof + jacobian.mu * mu
        shift = noise.hand_offset * jnp.einsum("...ij,...j->...i", jacobian.hand_shift, unit_errors[..., :2])
        if score == "density":
            scores = -predictive.log_density(unshifted + shift, noise)
        else:
            # `unshifted` does not include the hand's displacement: a relative error of that would be a product of two
            # heavy-tailed variables, whose mean may be infinite
            error_scale = predictive.error_scale(unshifted, noise)
            difference = predictive.with_errors(unshifted + shift, error_scale, unit_errors) - pushes.end[..., None, :]
            scores = jax.vmap(jax.vmap(lambda x: energy_score(x, jnp.zeros(3, x.dtype), predictive.length)))(difference)
        return jnp.sum(pushes.weight * scores) / jnp.sum(pushes.weight)

    return jax.value_and_grad(mean_score)(logs)


def _noise_from_record(record: dict[str, Any], dtype: Any) -> Noise:
    """Return the noise that `Noise.save` wrote as a record, in a floating dtype."""
    arrays = {name: jnp.asarray(record[name], dtype) for name in ARRAYS}
    return Noise(identified=from_record(record["identified"], dtype), sampler=record["sampler"], **arrays)
