"""The function `identify`: from recorded pushes to estimates with their uncertainty."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._internal.checks import (
    ArrayLike,
    check_non_negative,
    check_positive,
    check_shape,
    check_type,
    checked_array,
    common_dtype,
)
from pushjax._internal.jit import quick_jit
from pushjax.friction.limit_surface import LimitSurface
from pushjax.identification.fit import SIGMA_ROUNDS, fit, sum_of_squares, weighted_residuals
from pushjax.identification.model import Problem, Scene
from pushjax.identification.prior import Prior
from pushjax.identification.pushes import Pushes
from pushjax.identification.result import Identified
from pushjax.identification.unknowns import Unknowns, known_parameters, per_condition
from pushjax.simulation.arguments import check_slider_and_hand
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.slider import Slider

ROBUST = 2.0  # number of sigma at which the pseudo-Huber loss turns from quadratic to linear
START_SIGMA = 0.002  # m, initial sigma of poses, if it is estimated
START_DIRECTION_SIGMA = 0.3  # initial sigma of directions of motion
START_GAP_SIGMA = 0.002  # m, initial sigma of gaps: wide, so that no finger counts as lost too soon
NUM_FRICTIONS = 9  # candidates for the initial friction


def identify(
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    unknowns: Unknowns | None = None,
    *,
    friction: ArrayLike = 0.25,
    known: Mapping[str, ArrayLike] | None = None,
    length: ArrayLike | None = None,
    robust: float | None = ROBUST,
    sigma: ArrayLike | None = None,
    contact_at_end: bool = False,
) -> Identified:
    """Identify friction, limit surface and calibration from recorded pushes, with their uncertainty.

    The estimate maximizes the posterior density, given the pushes and the prior that `unknowns` describes. The
    optimizer is the Levenberg-Marquardt method. It starts from the best of several frictions. The posterior is
    approximated by a normal distribution, which follows from the linearized pushes.

    Works under `vmap` (many objects at once) and under `jit`, but not under `grad`.

    Args:
        pushes: Pushes of one condition, or of several (`Pushes.conditions`). Conditions share the unknowns that
            `unknowns.shared` names.
        slider: Its shape is the outline. Its limit surface is the one expected before any push was recorded, for
            example from the pressure distribution. The surface may have a leading axis of conditions.
        hand: The hand that pushed.
        unknowns: The parameters to identify, with their prior. Default: friction and limit surface.
        friction: Friction coefficient mu, used if it is not an unknown. A scalar or (conditions,).
        known: Values of other parameters that are not to be estimated, by the name of the unknown, such as
            {"overlap": 1.0}. Units are those of `Unknowns`; the angle of `frame_offset` is in rad. Each value may have
            a leading axis of conditions. Default: all are zero.
        length: Length in m that makes angles commensurate with positions in the loss. Default: that of the limit
            surface (of the first condition).
        robust: Number of sigma from which a push has less influence, by the pseudo-Huber loss. None: least squares.
        sigma: Standard deviation in m of each of x, y and length * theta of a measured pose about its prediction. None:
            estimated too.
        contact_at_end: Whether the hand, a single round finger, touches the slider at the end of most pushes. A finger
            that was measured inside the slider, or apart from it, was then really elsewhere. This information
            determines `inset`, `overshoot`, `lag_distance`, `hand_offset` and `frame_offset` far better than the final
            poses do. The standard deviation of the gaps is estimated too. Pushes whose finger lost the slider have
            almost no influence.

    Returns:
        The estimates, their precision matrix, and the residuals of the pushes.

    Raises:
        TypeError: If `pushes`, `slider` or `hand` is of another type.
        ValueError: If an array has the wrong shape, if a value is not finite or out of range, if a name in `known` is
            not that of a parameter or is estimated, or if `overlap` or `contact_at_end` is asked for with a hand that
            is not a single round finger.

    Reference: Extends Zhou et al. 2017, section VI, where only the friction is identified, on a grid. sigma is the
    estimate of the evidence procedure (MacKay 1992).
    """
    check_type("pushes", pushes, Pushes)
    check_slider_and_hand(slider, hand)
    unknowns = Unknowns() if unknowns is None else unknowns
    dtype = common_dtype(pushes, slider, hand)
    pushes, slider, hand = jax.tree.map(lambda leaf: leaf.astype(dtype), (pushes, slider, hand))
    one_condition, pushes = pushes.weight.ndim == 1, pushes.as_conditions()
    conditions = pushes.weight.shape[0]
    surface = _surface_per_condition(slider.surface, conditions)
    known_values = {"friction": per_condition("friction", friction, (), conditions, dtype)}
    check_non_negative("friction", known_values["friction"])
    known_values |= known_parameters(known or {}, unknowns, conditions, dtype)
    metric_length = checked_array("length", surface.length[0] if length is None else length, (), dtype, positive=True)
    pose_sigma = checked_array("sigma", START_SIGMA if sigma is None else sigma, (), dtype, positive=True)
    needs_round_finger = {"overlap": "overlap" in (*unknowns.names, *known_values), "contact_at_end": contact_at_end}
    _check_settings(pushes, hand, robust, needs_round_finger)
    prior = _prior(unknowns, surface, known_values, _mean_start(pushes))
    problem = Problem(Scene(slider.shape, hand, prior.origin), surface, prior, metric_length, contact_at_end)
    has_pairs = pushes.wrench.shape[-2] > 0
    # Of poses, directions and gaps. A kind of residual that was not measured has no sigma to estimate.
    sigma_is_given = (sigma is not None, not has_pairs, not contact_at_end)
    start_sigma = jnp.stack([pose_sigma, *jnp.asarray([START_DIRECTION_SIGMA, START_GAP_SIGMA], dtype)])
    start = _best_start(problem, pushes, start_sigma, robust=robust)
    given, frozen = jnp.array(sigma_is_given), jnp.zeros(start.shape, bool)
    rounds = jnp.asarray(1 if all(sigma_is_given) else SIGMA_ROUNDS)
    tolerance = jnp.asarray(1e-6 if dtype == jnp.float64 else 1e-4, dtype)
    fitted = fit(problem, pushes, start, start_sigma, given, frozen, rounds, tolerance, robust=robust)
    # `Problem` divides pose residuals by the root of the number of poses, so that the poses of a push count as one.
    final_pose_residual = fitted.residual.poses[..., -3:] * len(pushes.observed_steps) ** 0.5
    per_push = (final_pose_residual, fitted.information)
    residual, information = jax.tree.map(lambda leaf: leaf[0], per_push) if one_condition else per_push
    return Identified(
        z=fitted.z,
        precision=fitted.precision,
        prior=prior,
        sigma=fitted.sigma[0],
        direction_sigma=jnp.where(has_pairs, fitted.sigma[1], 0.0),
        gap_sigma=jnp.where(contact_at_end, fitted.sigma[2], 0.0),
        residual=residual,
        information=information,
        loss=fitted.loss,
        length=metric_length,
        steps=fitted.steps,
        converged=fitted.converged,
        one_condition=one_condition,
        robust=robust,
        contact_at_end=contact_at_end,
    )


_prior = quick_jit(Prior.of)


def _mean_start(pushes: Pushes) -> Array:
    """Return the weighted mean of the start positions of all pushes, (2,), world, m."""
    total_weight = jnp.maximum(jnp.sum(pushes.weight), 1.0)
    return jnp.einsum("cn,cni->i", pushes.weight, pushes.start[..., :2]) / total_weight


def _check_settings(
    pushes: Pushes,
    hand: Hand,
    robust: float | None,
    needs_round_finger: Mapping[str, bool],  # whether each argument for a single round finger was given
) -> None:
    """Check that the settings of `identify` fit each other and the hand."""
    if pushes.path.shape[-1] != hand.dof:
        raise ValueError(f"path has {pushes.path.shape[-1]} columns; the hand's configuration has {hand.dof}")
    if robust is not None:
        check_positive("robust", robust)
    for name, requested in needs_round_finger.items():
        if requested and not (len(hand.fingers) == 1 and isinstance(hand.fingers[0], RoundFinger)):
            raise ValueError(f"{name} is for a single round finger; the hand has {len(hand.fingers)} fingers")


def _surface_per_condition(surface: LimitSurface, conditions: int) -> LimitSurface:
    """Return the surface with a leading axis of conditions; without one, all conditions have the same surface."""
    if surface.length.ndim == 0:
        surface = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (conditions, *leaf.shape)), surface)
    check_shape("slider.surface.length", surface.length, (conditions,))
    return surface


@quick_jit
def _best_start(problem: Problem, pushes: Pushes, sigma: Array, *, robust: float | None) -> Array:
    """Return the prior mean of z, but with the friction that explains the pushes best."""
    z, layout = problem.prior.mean, problem.prior.layout
    if "friction" not in layout.names:
        return z
    fraction = (jnp.arange(NUM_FRICTIONS, dtype=z.dtype) + 0.5) / NUM_FRICTIONS  # of the friction's range
    candidates = jnp.log(fraction / (1 - fraction))  # the same as entries of z
    positions = layout.positions[:, layout.slices["friction"]][:, 0]

    def push_losses(value: Array) -> Array:
        residuals = problem.residuals(z.at[positions].set(value), pushes)
        weighted = weighted_residuals(residuals, pushes, sigma, robust)
        return sum_of_squares(weighted, axis=(1, 2))

    loss = jax.lax.map(push_losses, candidates)
    if "friction" in layout.shared:  # one friction for all conditions together
        loss = jnp.broadcast_to(jnp.sum(loss, axis=1, keepdims=True), loss.shape)
    return z.at[positions].set(candidates[jnp.argmin(loss, axis=0)])
