"""Friction from what is seen: samples of friction, weighted by how well they explain the motions of the slider.

It is a particle filter. Each sample is a limit surface and a coefficient of contact friction from a
`FrictionModel`. A motion that is seen, from one pose to another along a path of the hand, is simulated under each
sample. The likelihood of the pose that is seen after it is Student's distribution about the simulated pose. Its scale
combines the error of poses and a fraction of the motion, for what no sample can explain: contact points, and friction
that varies over the table.

A few samples never contain the truth. With the whole evidence, soon one would carry all the weight, however wrong it
is. So the likelihood of all motions together is taken to the largest power, up to one, that leaves a least number of
effective samples (tempering). There is no resampling. Friction is constant, and later samples would lack the evidence
of the motions before; with resampling, intervals are far too narrow.

A limit surface and its multiples move a slider alike. So poses say nothing about the scale of the surface.

Reference: Gordon, Salmond & Smith 1993, the particle filter; Neal 2001, tempering.
"""

from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, as_float, check_count, check_shape, check_type, checked_array, concrete
from pushjax._internal.jit import quick_jit
from pushjax._math.vec import wrap_to_pi
from pushjax.friction.limit_surface import LimitSurface
from pushjax.planning.scene import PushScene, draw_friction
from pushjax.simulation.rollout import rollout
from pushjax.simulation.slider import Slider

STUDENT_DOF = 4.0  # of the errors: a motion that is far off makes no weight vanish for good
POWERS = 2.0 ** -np.arange(0, 12.5, 0.5)  # of the likelihood
LOST = 10.0  # scales of the error beyond which a motion is not explained by a sample


class BeliefStatus(IntEnum):
    """What the last motion did to a belief."""

    PRIOR = 0  # nothing was seen yet
    UPDATED = 1
    UNEXPLAINED = 2  # no sample explains the motion, or a number was not finite; the belief is as it was


class FrictionBelief(NamedTuple):
    """Weighted samples of friction."""

    surface: LimitSurface  # with a leading axis of samples
    friction: Float[Array, "samples"]  # coefficients of contact friction
    evidence: Float[Array, "samples"]  # log likelihood of the motions that were seen so far
    weight: Float[Array, "samples"]  # add up to one
    status: Int[Array, ""]  # `BeliefStatus` of the last motion

    def mean(self) -> tuple[LimitSurface, Float[Array, ""]]:
        """Return the weighted means of the limit surfaces and of the coefficients of friction."""
        return jax.tree.map(lambda leaf: jnp.tensordot(self.weight, leaf, 1), (self.surface, self.friction))

    def effective(self) -> Float[Array, ""]:
        """Return the number of samples of equal weight that would be as good (Kish's effective sample size)."""
        return _effective(self.weight)


class FrictionFilter(eqx.Module):
    """Settings of the filter.

    `init` and `update` are pure functions, compiled, and may be part of other programs and of batches. A belief is a
    NamedTuple of the samples' limit surfaces, `surface`, coefficients of contact friction, `friction`, and weights,
    `weight`, which add up to one. Its `status` says whether the last motion was UPDATED, or UNEXPLAINED by all samples.
    `mean()` returns the weighted means of surface and friction, and `effective()` the number of effective samples.

    Args:
        scene: Slider, hand, and the distribution of friction. Fixtures are not considered: push away from them.
        samples: Number of samples.
        effective: Least number of effective samples that tempering leaves.
        error: Standard deviation of the error of a motion that is seen, in x, y and length * theta, m. It includes the
            errors of both poses.
        relative_error: Further error, as a fraction of the motion.

    Raises:
        ValueError: If a number is out of its range.
        TypeError: If an argument is of another type.
    """

    scene: PushScene
    effective: Float[Array, ""]
    error: Float[Array, ""]
    relative_error: Float[Array, ""]
    samples: int = eqx.field(static=True)

    def __init__(
        self,
        scene: PushScene,
        *,
        samples: int = 128,
        effective: ArrayLike = 6.0,
        error: ArrayLike = 5e-4,
        relative_error: ArrayLike = 0.05,
    ):
        check_type("scene", scene, PushScene)
        check_count("samples", samples)
        self.scene, self.samples = scene, samples
        numbers = {"effective": effective, "error": error, "relative_error": relative_error}
        for name, value in numbers.items():
            sign = {"non_negative" if name == "relative_error" else "positive": True}
            setattr(self, name, checked_array(name, value, (), scene.one_slider.surface.length.dtype, **sign))
        known = concrete(self.effective)
        if known is not None and not 1 <= known <= samples:
            raise ValueError(f"effective must be from 1 to the number of samples, {samples}; got {effective!r}")

    def init(self, key: PRNGKeyArray) -> FrictionBelief:
        """Draw samples, with equal weights, which are those of `PushLibrary.build` with this key."""
        draws = draw_friction(key, self.scene.one_slider.surface, self.scene.friction, self.samples)
        surface, friction = jax.tree.map(lambda leaf: leaf[:, 0], (draws.surface, draws.friction))
        weight = jnp.full((self.samples,), 1 / self.samples, self.error.dtype)
        status = jnp.asarray(BeliefStatus.PRIOR, jnp.int32)
        return FrictionBelief(surface, friction, jnp.zeros_like(weight), weight, status)

    def update(self, belief: FrictionBelief, before: ArrayLike, path: ArrayLike, after: ArrayLike) -> FrictionBelief:
        """Update a belief by a motion that was seen.

        Args:
            belief: The belief.
            before: Pose of the slider that was seen at the start, (3,), world, m and rad.
            path: Configurations of the hand in between, (steps + 1, dof), world, m.
            after: Pose of the slider that was seen at the end, (3,), world, m and rad.

        Returns:
            The belief after it; its status says what was done.

        Raises:
            ValueError: If a shape is wrong.
        """
        dtype = self.error.dtype
        start, end = as_float(before, dtype, "before"), as_float(after, dtype, "after")
        check_shape("before", start, (3,))
        check_shape("after", end, (3,))
        hand_path = as_float(path, dtype, "path")
        check_shape("path", hand_path, ("steps + 1", self.scene.hand.dof))
        return _update(self, belief, start, hand_path, end)


@quick_jit
def _update(
    settings: FrictionFilter, belief: FrictionBelief, before: Array, path: Array, after: Array
) -> FrictionBelief:
    finite = jnp.all(jnp.isfinite(before)) & jnp.all(jnp.isfinite(after)) & jnp.all(jnp.isfinite(path))
    squared = jnp.where(finite, _squared_errors(settings, belief, before, path, after), jnp.inf)
    # a simulation that failed counts as a motion that is not explained: it must not remove the sample for good
    bounded = jnp.where(jnp.isfinite(squared), squared, LOST**2)
    evidence = belief.evidence - (STUDENT_DOF + 3) / 2 * jnp.log1p(bounded / STUDENT_DOF)
    possible = jnp.any(squared < LOST**2) & jnp.any(jnp.isfinite(evidence))
    evidence = jnp.where(possible, evidence, belief.evidence)
    weight = jnp.where(possible, _tempered(jnp.where(possible, evidence, 0.0), settings.effective), belief.weight)
    status = jnp.where(possible, BeliefStatus.UPDATED, BeliefStatus.UNEXPLAINED).astype(jnp.int32)
    return FrictionBelief(belief.surface, belief.friction, evidence, weight, status)


def _tempered(evidence: Float[Array, "samples"], effective: Float[Array, ""]) -> Float[Array, "samples"]:
    """Return weights from the largest of `POWERS` of the likelihood that leaves enough effective samples."""
    weights = jax.nn.softmax(jnp.asarray(POWERS, evidence.dtype)[:, None] * evidence[None], axis=1)
    enough = jax.vmap(_effective)(weights) >= effective
    return weights[jnp.where(jnp.any(enough), jnp.argmax(enough), len(POWERS) - 1)]


def _effective(weight: Float[Array, "samples"]) -> Float[Array, ""]:
    return 1 / jnp.maximum(jnp.sum(weight**2), jnp.finfo(weight.dtype).tiny)


def _squared_errors(
    settings: FrictionFilter, belief: FrictionBelief, before: Array, path: Array, after: Array
) -> Float[Array, "samples"]:
    """Return the squared pose error of the simulation under each sample, in scales of the error."""
    slider, length = settings.scene.one_slider, settings.scene.one_slider.surface.length
    scale = settings.error**2 + settings.relative_error**2 * _distance_squared(before, after, length)

    def squared_error(surface: LimitSurface, mu: Array) -> Float[Array, ""]:
        push = rollout(Slider(slider.shape, surface), settings.scene.hand, path, pose=before, friction=mu)
        # a sample whose simulation failed explains nothing
        return jnp.where(jnp.any(push.failed), jnp.inf, _distance_squared(push.pose[-1], after, length) / scale)

    return jax.vmap(squared_error)(belief.surface, belief.friction)


def _distance_squared(a: Float[Array, "3"], b: Float[Array, "3"], length: Array) -> Float[Array, ""]:
    """Return the squared distance of two poses, m^2, with the angle between them wrapped to [-pi, pi]."""
    x, y, theta = a - b
    return x**2 + y**2 + (length * wrap_to_pi(theta)) ** 2
