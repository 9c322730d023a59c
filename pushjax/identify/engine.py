"""From pushes to what they tell."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._checks import Numeric, as_float, common_dtype, finite, instance, non_negative, positive, shaped
from pushjax._programs import quickly_compiled
from pushjax.hands import Hand, RoundFinger
from pushjax.identify.fit import ROUNDS, Effort, Fit, Held, fit, whitened
from pushjax.identify.identified import Identified
from pushjax.identify.model import Setup
from pushjax.identify.pushes import Pushes
from pushjax.identify.unknowns import Prior, Unknowns
from pushjax.rollout import Slider, check_kinds
from pushjax.status import Status

ROBUST = 2.0
SIGMA = 0.002  # m, where the search for it begins
DIRECTION = 0.3  # the same, of directions of motion
GAP = 0.002  # m, and of gaps: as wide, so that none is lost too soon
FRICTIONS = 9  # from which the search begins


def identify(
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    unknowns: Unknowns | None = None,
    *,
    friction: Numeric = 0.25,
    length: Numeric | None = None,
    robust: float | None = ROBUST,
    sigma: Numeric | None = None,
    touching: bool = False,
) -> Identified:
    """Friction, limit surface and calibration from recorded pushes, with how well they are known.

    pushes: of one condition, or of several (`Pushes.conditions`), which share what `unknowns` says. slider: the
    outline, and the limit surface that is expected before any push was seen, as from its pressure; it may have a
    leading axis of conditions. hand: what pushed. unknowns: what is to be found (default: friction and surface).
    friction: mu, where it is known. length: m, makes angles commensurate with positions in what is minimised; the
    surface's unless given. sigma: m, by how much each of x, y and length * theta of a final pose is off its prediction,
    as standard deviation; None: found too. robust: pushes that are farther off than so many sigma count less, by
    pseudo-Huber's loss; None: by least squares. touching: the hand, a single round finger, touches the slider at the
    end of most pushes: where it was seen inside the slider, or apart from it, it really was elsewhere. That tells
    inset, end, lag, offset and marker far better than where pushes end does; how far gaps are off is found too, and
    pushes whose finger has lost the slider do not matter.

    Maximises the posterior: pushes, and the prior that `unknowns` describes, by Levenberg and Marquardt's method, from
    the best of several frictions. Its normal distribution is that of the linearised pushes.

    Works under `vmap`, of many objects at once, and `jit`; not under `grad`.

    Raises ValueError for arrays of the wrong shape, values that are not finite or out of range.

    Source: goes beyond Zhou et al. 2017, section VI, where the friction alone is found, on a grid; sigma is that of
    the evidence (MacKay 1992).
    """
    instance("pushes", pushes, Pushes)
    check_kinds(slider, hand)
    unknowns = Unknowns() if unknowns is None else unknowns
    dtype = common_dtype(pushes, slider, hand)
    pushes, slider, hand = jax.tree.map(lambda leaf: leaf.astype(dtype), (pushes, slider, hand))
    single = pushes.weight.ndim == 1
    several = pushes.as_conditions()
    conditions = several.weight.shape[0]
    surface = slider.surface
    if surface.length.ndim == 0:
        surface = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (conditions, *leaf.shape)), surface)
    shaped("slider.surface.length", surface.length, (conditions,))
    if several.path.shape[-1] != hand.dof:
        raise ValueError(f"path has {several.path.shape[-1]} columns; the hand's configuration has {hand.dof}")
    mu = as_float(friction, dtype)
    if mu.shape not in ((), (conditions,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({conditions},), one per condition")
    finite("friction", mu)
    non_negative("friction", mu)
    metric = surface.length[0] if length is None else as_float(length, dtype)
    first = as_float(SIGMA if sigma is None else sigma, dtype)
    for name, value in (("length", metric), ("sigma", first)):
        shaped(name, value, ())
        finite(name, value)
        positive(name, value)
    if robust is not None:
        positive("robust", robust)
    for name, asked in (("overlap", unknowns.overlap is not None), ("touching", touching)):
        if asked and not (len(hand.fingers) == 1 and isinstance(hand.fingers[0], RoundFinger)):
            raise ValueError(f"{name} is for a single round finger; the hand has {len(hand.fingers)} fingers")
    total = jnp.maximum(jnp.sum(several.weight), 1.0)
    origin = jnp.einsum("cn,cni->i", several.weight, several.start[..., :2]) / total
    prior = _prior(unknowns, surface, mu, origin)
    setup = Setup(slider.shape, hand, surface, prior, metric, touching)
    pairs = several.wrench.shape[-2] > 0
    known = jnp.array([sigma is not None, not pairs, not touching])
    sigmas = jnp.stack([first, *(jnp.asarray(value, dtype) for value in (DIRECTION, GAP))])
    effort = Effort.of(dtype, 1 if sigma is not None and not (pairs or touching) else ROUNDS)
    start = _best_start(setup, several, sigmas, robust=robust)
    found = program(setup, several, start, sigmas, known, Held.none(start), effort, robust=robust)
    status = jnp.where(found.converged, Status.MOVING, Status.NOT_CONVERGED).astype(jnp.int8)
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
        status,
        single,
        robust,
        touching,
    )


_prior = quickly_compiled(Prior.of)


@quickly_compiled
def program(
    setup: Setup, pushes: Pushes, start, sigma, known, held: Held, effort: Effort, *, robust: float | None
) -> Fit:
    """One compiled program for everything that is fitted."""
    return fit(setup, pushes, start, sigma, robust, known, held, effort)


@quickly_compiled
def _best_start(setup: Setup, pushes: Pushes, sigma: Array, *, robust: float | None) -> Array:
    """Everything else at its mean, the friction with which that explains most: of each condition, or of all."""
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
