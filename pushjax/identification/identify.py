"""The function `identify`: from recorded pushes to estimates with their uncertainty."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_non_negative,
    check_positive,
    check_shape,
    check_type,
    common_dtype,
)
from pushjax._internal.jit import quick_jit
from pushjax.identification.fit import ROUNDS, FixedEntries, Schedule, compiled_fit, whitened
from pushjax.identification.model import Problem
from pushjax.identification.pushes import Pushes
from pushjax.identification.result import Identified
from pushjax.identification.unknowns import Prior, Unknowns
from pushjax.simulation.arguments import check_slider_and_hand
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.slider import Slider

ROBUST = 2.0  # sigma: where the pseudo-Huber loss turns from quadratic to linear
SIGMA = 0.002  # m, initial value if sigma is estimated
DIRECTION = 0.3  # initial sigma of directions of motion
GAP = 0.002  # m, initial sigma of gaps: wide, so that no finger counts as lost too soon
FRICTIONS = 9  # candidates for the initial friction


def identify(
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    unknowns: Unknowns | None = None,
    *,
    friction: ArrayLike = 0.25,
    length: ArrayLike | None = None,
    robust: float | None = ROBUST,
    sigma: ArrayLike | None = None,
    touching: bool = False,
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
        length: Length in m that makes angles commensurate with positions in the loss. Default: that of the limit
            surface (of the first condition).
        robust: Number of sigma from which a push has less influence, by the pseudo-Huber loss. None: least squares.
        sigma: Standard deviation in m of each of x, y and length * theta of a measured pose about its prediction. None:
            estimated too.
        touching: Whether the hand, a single round finger, touches the slider at the end of most pushes. A finger that
            was measured inside the slider, or apart from it, was then really elsewhere. This information determines
            `inset`, `end`, `lag`, `offset` and `marker` far better than the final poses do. The standard deviation of
            the gaps is estimated too. Pushes whose finger lost the slider have almost no influence.

    Returns:
        The estimates, their precision matrix, and the residuals of the pushes.

    Raises:
        TypeError: If `pushes`, `slider` or `hand` is of another type.
        ValueError: If an array has the wrong shape, if a value is not finite or out of range, or if `overlap` or
            `touching` is asked for with a hand that is not a single round finger.

    Reference: Extends Zhou et al. 2017, section VI, where only the friction is identified, on a grid. sigma is the
    estimate of the evidence procedure (MacKay 1992).
    """
    check_type("pushes", pushes, Pushes)
    check_slider_and_hand(slider, hand)
    unknowns = Unknowns() if unknowns is None else unknowns
    dtype = common_dtype(pushes, slider, hand)
    pushes, slider, hand = jax.tree.map(lambda leaf: leaf.astype(dtype), (pushes, slider, hand))
    single = pushes.weight.ndim == 1
    several = pushes.as_conditions()
    conditions = several.weight.shape[0]
    surface = slider.surface
    if surface.length.ndim == 0:
        surface = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (conditions, *leaf.shape)), surface)
    check_shape("slider.surface.length", surface.length, (conditions,))
    if several.path.shape[-1] != hand.dof:
        raise ValueError(f"path has {several.path.shape[-1]} columns; the hand's configuration has {hand.dof}")
    mu = as_float(friction, dtype)
    if mu.shape not in ((), (conditions,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({conditions},), one per condition")
    check_finite("friction", mu)
    check_non_negative("friction", mu)
    metric = surface.length[0] if length is None else as_float(length, dtype)
    first = as_float(SIGMA if sigma is None else sigma, dtype)
    for name, value in (("length", metric), ("sigma", first)):
        check_shape(name, value, ())
        check_finite(name, value)
        check_positive(name, value)
    if robust is not None:
        check_positive("robust", robust)
    for name, asked in (("overlap", unknowns.overlap is not None), ("touching", touching)):
        if asked and not (len(hand.fingers) == 1 and isinstance(hand.fingers[0], RoundFinger)):
            raise ValueError(f"{name} is for a single round finger; the hand has {len(hand.fingers)} fingers")
    total = jnp.maximum(jnp.sum(several.weight), 1.0)
    origin = jnp.einsum("cn,cni->i", several.weight, several.start[..., :2]) / total
    prior = _prior(unknowns, surface, mu, origin)
    setup = Problem(slider.shape, hand, surface, prior, metric, touching)
    pairs = several.wrench.shape[-2] > 0
    known = jnp.array([sigma is not None, not pairs, not touching])
    sigmas = jnp.stack([first, *(jnp.asarray(value, dtype) for value in (DIRECTION, GAP))])
    effort = Schedule.of(dtype, 1 if sigma is not None and not (pairs or touching) else ROUNDS)
    start = _best_start(setup, several, sigmas, robust=robust)
    found = compiled_fit(setup, several, start, sigmas, known, FixedEntries.none(start), effort, robust=robust)
    last = 3 * len(several.rows)
    residual = found.residual[..., last - 3 : last] * len(several.rows) ** 0.5
    residual, information = jax.tree.map(lambda leaf: leaf[0] if single else leaf, (residual, found.information))
    direction, gap = (jnp.where(asked, found.sigma[k], 0.0) for k, asked in ((1, pairs), (2, touching)))
    return Identified(
        found.z,
        found.precision,
        prior,
        found.sigma[0],
        direction,
        gap,
        residual,
        information,
        found.loss,
        metric,
        found.steps,
        found.converged,
        single,
        robust,
        touching,
    )


_prior = quick_jit(Prior.of)


@quick_jit
def _best_start(setup: Problem, pushes: Pushes, sigma: Array, *, robust: float | None) -> Array:
    """Return a start with the friction that explains the pushes best, and all other parameters at their prior mean.

    The friction is chosen for each condition, or for all conditions together if they share it.
    """
    z, layout = setup.prior.start, setup.prior.layout
    if "friction" not in layout.names:
        return z
    share = (jnp.arange(FRICTIONS, dtype=z.dtype) + 0.5) / FRICTIONS
    tried = jnp.log(share / (1 - share))
    places = layout.index[:, layout.local["friction"]][:, 0]

    def losses(value: Array) -> Array:
        left = whitened(setup.residuals(z.at[places].set(value), pushes), pushes, sigma, robust)
        return jnp.sum(left**2, axis=(1, 2))

    loss = jax.lax.map(losses, tried)
    if "friction" in layout.shared:
        loss = jnp.broadcast_to(jnp.sum(loss, axis=1, keepdims=True), loss.shape)
    return z.at[places].set(tried[jnp.argmin(loss, axis=0)])
