"""The fit: residuals of pushes and prior as a sum of squares, and its minimization."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.jit import quick_jit
from pushjax.identification.model import Problem
from pushjax.identification.pushes import Pushes

MAX_STEPS = 60
EARLY = 0.01  # tolerance in all rounds but the last, while sigma is still being estimated
TINY = 1e-6  # prior precision of a friction: makes the precision matrix invertible if no push depends on it
ROUNDS = 6
LEAST = 1e-6  # m, lower bound of sigma: no measurement is more exact
KINDS = (3, 3, 1)  # measured numbers per push: of its poses, of its pairs, of its contact
CONTACT = 2  # index of the contact in KINDS
LOST = 3.0  # sigma: beyond this residual of a gap, the finger counts as having lost the slider and has little weight


class Fit(NamedTuple):
    """Result of a fit.

    Attributes:
        z: (size,) most probable vector of unknowns.
        sigma: (3,) standard deviations of poses (m), of directions of motion, and of gaps (m).
        precision: (size, size) inverse covariance of z.
        residual: (conditions, pushes, rows) all residuals, predicted less measured; see `Problem.residuals`.
        information: (conditions, pushes, size) contribution of each push to the diagonal of the precision.
        loss: Minimized sum of squares, prior included.
        steps: Optimizer steps, over all rounds.
        converged: Whether the optimizer converged in the last round.
    """

    z: Float[Array, "size"]
    sigma: Float[Array, "3"]
    precision: Float[Array, "size size"]
    residual: Float[Array, "conditions pushes rows"]
    information: Float[Array, "conditions pushes size"]
    loss: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class FixedEntries(NamedTuple):
    """Entries of z that are held fixed.

    Attributes:
        which: (size,) True for entries that are held.
        value: (size,) their values.
    """

    which: Bool[Array, "size"]
    value: Float[Array, "size"]

    @staticmethod
    def none(start: Array) -> "FixedEntries":
        """Hold no entry."""
        return FixedEntries(jnp.zeros(start.shape, bool), start)

    def on(self, z: Array) -> Array:
        """Return z with the held entries at their values."""
        return jnp.where(self.which, self.value, z)


class Counts(NamedTuple):
    """Weights of each push's poses, pairs and contact in the loss."""

    poses: Float[Array, "conditions pushes"]
    pairs: Float[Array, "conditions pushes"]
    contact: Float[Array, "conditions pushes"]

    @staticmethod
    def of(pushes: Pushes) -> "Counts":
        """Return the weights of `pushes`; pairs have weight zero in pushes that recorded none."""
        pairs = jnp.where(jnp.any(pushes.paired, axis=-1), pushes.weight, 0.0)
        return Counts(pushes.weight, pairs, pushes.weight)


def _parts(residual: Array, pushes: Pushes) -> tuple[Array, Array, Array]:
    """Split the last axis of residuals into poses, pairs and contacts."""
    poses = 3 * len(pushes.rows)
    pairs = poses + 3 * pushes.wrench.shape[-2]
    return residual[..., :poses], residual[..., poses:pairs], residual[..., pairs:]


def whitened(residual: Array, pushes: Pushes, sigma: Array, robust: float | None) -> Array:
    """Return residuals whose squares add up to the data part of the loss.

    The poses of each push, and its pairs, use the pseudo-Huber loss, which is linear beyond `robust` sigma (None: least
    squares). Gaps use the bounded Geman-McClure loss, so a push whose finger lost the slider has almost no influence.
    """
    whole = []
    for k, (r, weight) in enumerate(zip(_parts(residual, pushes), Counts.of(pushes), strict=True)):
        r = r / sigma[k]
        squared = jnp.sum(r**2, axis=-1, keepdims=True)
        if k == CONTACT:
            r = r / jnp.sqrt(1 + squared / LOST**2)
        elif robust is not None:
            r = r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + squared / robust**2)))
        whole.append(r * jnp.sqrt(weight)[..., None])
    return jnp.concatenate(whole, axis=-1)


def _trust(k: int, residual: Array, weight: Array, sigma: Array, robust: float | None) -> Array:
    """Return the effective weight of each push in the information, given its residual of kind `k`."""
    squared = jnp.sum((residual / sigma) ** 2, axis=-1)
    if k == CONTACT:
        return weight / (1 + squared / LOST**2) ** 2
    return weight if robust is None else weight / jnp.sqrt(1 + squared / robust**2)


class Schedule(NamedTuple):
    """How long to fit.

    Attributes:
        rounds: Number of alternations between z and sigma. One is enough if all of sigma is known.
        tolerance: Tolerance of z in the last round.
    """

    rounds: Int[Array, ""]
    tolerance: Float[Array, ""]

    @staticmethod
    def of(dtype, rounds: int, tolerance: float | None = None) -> "Schedule":
        """Return the effort for a floating dtype.

        Args:
            dtype: Floating dtype of the fit.
            rounds: Number of alternations between z and sigma.
            tolerance: Tolerance of z in the last round. Default: 1e-6 in float64, 1e-4 in float32.
        """
        least = 1e-6 if dtype == jnp.float64 else 1e-4
        return Schedule(jnp.asarray(rounds), jnp.asarray(least if tolerance is None else tolerance, dtype))


def fit(
    setup: Problem,
    pushes: Pushes,
    start: Array,
    sigma: Array,
    robust: float | None,
    known: Array,
    held: FixedEntries,
    effort,
) -> Fit:
    """Find the most probable z and the standard deviations of the residuals, in alternation.

    Args:
        setup: Everything that stays constant.
        pushes: Pushes with a leading axis of conditions.
        start: (size,) initial z.
        sigma: (3,) initial or known standard deviations of poses (m), of directions of motion, and of gaps (m).
        robust: Number of sigma from which a push has less influence. None: least squares.
        known: (3,) whether each entry of `sigma` is known.
        held: Entries of z that are not optimized.
        effort: A `Schedule`; may be traced.

    Returns:
        The result of the last round.
    """
    flat = jnp.asarray(setup.prior.layout.flat_prior, start.dtype)
    rounds, last = effort

    def round_(index, before: Fit) -> Fit:
        sigma = before.sigma

        def loss(z):
            z = held.on(z)
            local = setup.local(z, pushes)
            return (whitened(setup.expanded(z, local), pushes, sigma, robust), flat * z), local

        tolerance = jnp.where(index < rounds - 1, EARLY, last).astype(start.dtype)
        found = least_squares(loss, before.z, MAX_STEPS, tolerance)
        z, residual = held.on(found.z), found.beside.value
        slopes = setup.slopes(z, found.beside)
        information, each, left = [], jnp.zeros_like(before.information), []
        parts = zip(
            _parts(residual, pushes), _parts(jnp.moveaxis(slopes, 3, 0), pushes), Counts.of(pushes), strict=True
        )
        for k, (r, slope, weight) in enumerate(parts):
            count = _trust(k, r, weight, sigma[k], robust)
            scaled = slope * (jnp.sqrt(count) / sigma[k])[None, ..., None]
            information.append(jnp.einsum("icnr,jcnr->ij", scaled, scaled))
            each = each + jnp.moveaxis(jnp.sum(scaled**2, axis=3), 0, 2)
            left.append((jnp.sum(count), jnp.sum(count[..., None] * r**2)))
        precision = sum(information) + jnp.diag(jnp.maximum(flat, TINY))
        # The trace of `share` is the number of parameters that a kind of residual determines; it reduces the degrees of
        # freedom of the variance. One solve serves all kinds: two batched solves of jaxlib that run at once deadlock
        # (0.10.1, two cores).
        shares = jnp.linalg.solve(precision, jnp.concatenate(information, axis=1))
        again = [
            jnp.sqrt(squares / jnp.maximum(numbers * count - jnp.trace(share), 3.0))
            for numbers, share, (count, squares) in zip(KINDS, jnp.split(shares, len(KINDS), axis=1), left, strict=True)
        ]
        total = jnp.sum(whitened(residual, pushes, sigma, robust) ** 2) + jnp.sum((flat * z) ** 2)
        steps = before.steps + found.steps
        measured = jnp.where(known, sigma, jnp.maximum(jnp.stack(again), LEAST))
        # the last round keeps the sigma with which it fitted
        sigma = jnp.where(index < rounds - 1, measured, sigma)
        return Fit(z, sigma, precision, residual, each, total, steps, found.converged)

    many = pushes.weight.shape
    rows = 3 * len(pushes.rows) + 3 * pushes.wrench.shape[-2] + setup.touching
    size = len(start)
    precision, residual, information, loss = (
        jnp.zeros(shape, start.dtype) for shape in ((size, size), (*many, rows), (*many, size), ())
    )
    nothing, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    first = Fit(held.on(start), sigma, precision, residual, information, loss, nothing, no)
    return jax.lax.fori_loop(0, rounds, round_, first)


@quick_jit
def compiled_fit(
    setup: Problem, pushes: Pushes, start, sigma, known, held: FixedEntries, effort: Schedule, *, robust: float | None
) -> Fit:
    """Run `fit` as the one compiled program that all callers share."""
    return fit(setup, pushes, start, sigma, robust, known, held, effort)


class Minimum(NamedTuple):
    """Result of `least_squares`.

    Attributes:
        z: Minimizer.
        beside: Auxiliary output of the residual function at z.
        steps: Number of steps.
        converged: Whether the method converged.
    """

    z: Float[Array, "size"]
    beside: Any
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _LevenbergMarquardt(optx.LevenbergMarquardt):
    """Levenberg-Marquardt method with another stopping rule and another growth of the trust region.

    It also terminates if a step was rejected and the next trial step is within the tolerance, as MINPACK does. No step
    is accepted any more at a change of contact mode, or where roundoff hides the improvement.

    The trust region grows tenfold if a step achieves three quarters of the predicted reduction. The library's default
    requires nearly all of the predicted reduction, which suits smooth functions. Where contacts change their mode, that
    default keeps steps small and takes up to half as many steps again.
    """

    def __init__(self, tolerance: Any):
        super().__init__(rtol=tolerance, atol=tolerance)
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=10.0)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        state = super().init(fn, y, args, options, f_struct, aux_struct, tags)
        # otherwise the step size has JAX's default dtype, even if y is float32 and float64 is enabled
        return eqx.tree_at(lambda s: s.search_state.step_size, state, jnp.ones((), y.dtype))

    def terminate(self, fn, y, args, options, state, tags):
        ends, result = super().terminate(fn, y, args, options, state, tags)
        within = self.norm((state.y_eval - y) / (self.atol + self.rtol * jnp.abs(y))) < 1
        return ends | (within & (state.num_steps_since_acceptance > 0)), result


def least_squares(
    residuals: Callable[[Array], tuple[Any, Any]], start: Array, max_steps: int, tolerance: Any
) -> Minimum:
    """Minimize a sum of squares by the Levenberg-Marquardt method.

    Args:
        residuals: Function of z that returns a pytree of residual arrays and an auxiliary output.
        start: (size,) initial z.
        max_steps: Largest number of steps.
        tolerance: Relative and absolute tolerance.

    Returns:
        The minimizer, the auxiliary output there, the number of steps, and whether the method converged.
    """
    solver = _LevenbergMarquardt(tolerance)
    found = optx.least_squares(lambda z, _: residuals(z), solver, start, has_aux=True, max_steps=max_steps, throw=False)
    return Minimum(found.value, found.aux, found.stats["num_steps"], found.result == optx.RESULTS.successful)
