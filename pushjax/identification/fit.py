"""The fit: residuals of pushes and prior as a sum of squares, and its minimization."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.jit import quick_jit
from pushjax.identification.model import Problem, ResidualKinds
from pushjax.identification.pushes import Pushes

MAX_STEPS = 60
LOOSE_TOLERANCE = 0.01  # tolerance in all rounds but the last, while sigma is still being estimated
FRICTION_RIDGE = 1e-6  # prior precision of a friction: makes the precision matrix invertible if no push depends on it
SIGMA_ROUNDS = 6
MIN_SIGMA = 1e-6  # m, lower bound of sigma: no measurement is more exact
GAP_SCALE = 3.0  # sigma: beyond this residual of a gap, the finger counts as having lost the slider


# Numbers that a push counts as having measured. All its poses together weigh as much as one, and so do its directions.
NUMBERS_PER_KIND = ResidualKinds(poses=3, directions=2, gap=1)  # a direction is a unit vector


class Fit(NamedTuple):
    """Result of a fit."""

    z: Float[Array, "size"]  # most probable unknowns
    sigma: Float[Array, "3"]  # standard deviations of poses (m), of directions of motion, and of gaps (m)
    precision: Float[Array, "size size"]  # inverse covariance of z
    residual: ResidualKinds  # (conditions, pushes, rows) of each kind, predicted less measured; see `Problem.residuals`
    information: Float[Array, "conditions pushes size"]  # contribution of each push to the diagonal of the precision
    loss: Float[Array, ""]  # minimized sum of squares, prior included
    steps: Int[Array, ""]  # of the optimizer, over all rounds
    converged: Bool[Array, ""]  # whether the optimizer converged in the last round


def sum_of_squares(residuals: Any, axis: tuple[int, ...] | None = None) -> Array:
    """Return the sum of the squares of all arrays of a pytree, over all axes or some."""
    return jax.tree.reduce(jnp.add, jax.tree.map(lambda each: jnp.sum(each**2, axis=axis), residuals))


def push_weights(pushes: Pushes) -> ResidualKinds:
    """Return the weight (conditions, pushes) of each push for each kind of residual."""
    # pushes without a pair of wrench and motion have no directions
    directions = jnp.where(jnp.any(pushes.has_pair, axis=-1), pushes.weight, 0.0)
    return ResidualKinds(pushes.weight, directions, pushes.weight)


def weighted_residuals(
    residual: ResidualKinds, pushes: Pushes, sigma: Float[Array, "3"], robust: float | None
) -> ResidualKinds:
    """Return residuals whose squares add up to the data part of the loss."""
    # The poses of each push, and its directions, use the pseudo-Huber loss, which is linear beyond `robust` sigma
    # (None: least squares). Gaps use the bounded Geman-McClure loss, so a push whose finger lost the slider has almost
    # no influence.
    weighted = []
    kinds = zip(ResidualKinds._fields, residual, push_weights(pushes), sigma, strict=True)
    for kind, r, weight, std in kinds:
        r = r / std
        squared = jnp.sum(r**2, axis=-1, keepdims=True)
        if kind == "gap":
            r = r / jnp.sqrt(1 + squared / GAP_SCALE**2)
        elif robust is not None:
            r = r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + squared / robust**2)))
        weighted.append(r * jnp.sqrt(weight)[..., None])
    return ResidualKinds(*weighted)


def _robust_weights(kind: str, residual: Array, weight: Array, sigma: Array, robust: float | None) -> Array:
    """Return each push's weight in iteratively reweighted least squares, for one kind of residual."""
    # the weight with which the Gauss-Newton approximation of the robust loss counts the push
    squared = jnp.sum((residual / sigma) ** 2, axis=-1)
    if kind == "gap":
        return weight / (1 + squared / GAP_SCALE**2) ** 2
    return weight if robust is None else weight / jnp.sqrt(1 + squared / robust**2)


def _evidence(
    residual: ResidualKinds,  # at the minimizer, (conditions, pushes, rows) of each kind
    jacobian: ResidualKinds,  # its derivatives (conditions, pushes, rows, size) with respect to z
    pushes: Pushes,
    before: Fit,  # result of the round before, with whose sigma the minimizer was found
    robust: float | None,
    has_normal_prior: Float[Array, "size"],  # 1 for entries of z that have a normal prior, else 0
) -> tuple[Array, Array, Array]:
    """Return the precision of z, the information of each push, and sigma as the evidence procedure estimates it."""
    by_kind, information, counts_and_squares = [], jnp.zeros_like(before.information), []
    kinds = zip(ResidualKinds._fields, residual, jacobian, push_weights(pushes), before.sigma, strict=True)
    for kind, r, derivatives, weight, std in kinds:
        robust_weight = _robust_weights(kind, r, weight, std, robust)
        scaled = derivatives * (jnp.sqrt(robust_weight) / std)[..., None, None]
        by_kind.append(jnp.einsum("cnri,cnrj->ij", scaled, scaled))
        information = information + jnp.sum(scaled**2, axis=2)
        counts_and_squares.append((jnp.sum(robust_weight), jnp.sum(robust_weight[..., None] * r**2)))
    precision = sum(by_kind) + jnp.diag(jnp.maximum(has_normal_prior, FRICTION_RIDGE))
    # The trace of a kind's resolution matrix is the number of parameters that this kind determines; it reduces the
    # degrees of freedom of the variance. One solve serves all kinds: two batched solves of jaxlib that run at once
    # deadlock (0.10.1, two cores).
    resolutions = jnp.split(
        jnp.linalg.solve(precision, jnp.concatenate(by_kind, axis=1)), len(NUMBERS_PER_KIND), axis=1
    )
    new_sigma = [
        jnp.sqrt(squares / jnp.maximum(numbers * count - jnp.trace(resolution), 3.0))
        for numbers, resolution, (count, squares) in zip(NUMBERS_PER_KIND, resolutions, counts_and_squares, strict=True)
    ]
    return precision, information, jnp.stack(new_sigma)


class _LevenbergMarquardt(optx.LevenbergMarquardt):
    """Levenberg-Marquardt method with MINPACK's stopping rule and faster growth of the trust region."""

    def __init__(self, tolerance: Any):
        super().__init__(rtol=tolerance, atol=tolerance)
        # Grow tenfold after a step that achieves three quarters of the predicted reduction. The library's default
        # requires nearly all of it, which suits smooth functions. Where contacts change their mode, it keeps steps
        # small and takes up to half as many steps again.
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=10.0)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        state = super().init(fn, y, args, options, f_struct, aux_struct, tags)
        # otherwise the step size has JAX's default dtype, even if y is float32 and float64 is enabled
        return eqx.tree_at(lambda s: s.search_state.step_size, state, jnp.ones((), y.dtype))

    def terminate(self, fn, y, args, options, state, tags):
        converged, result = super().terminate(fn, y, args, options, state, tags)
        # Also stop if a step was rejected and the next trial step is within the tolerance, as MINPACK does. At a change
        # of contact mode, or where roundoff hides the improvement, every further step would be rejected.
        next_step_is_small = self.norm((state.y_eval - y) / (self.atol + self.rtol * jnp.abs(y))) < 1
        return converged | (next_step_is_small & (state.num_steps_since_acceptance > 0)), result


@quick_jit
def fit(
    problem: Problem,
    pushes: Pushes,  # with a leading axis of conditions
    start: Float[Array, "size"],
    sigma: Float[Array, "3"],  # initial or known standard deviations of poses (m), of directions, and of gaps (m)
    sigma_is_given: Bool[Array, "3"],
    frozen: Bool[Array, "size"],  # entries of z that stay as in `start`
    rounds: Int[Array, ""],  # alternations between z and sigma; one is enough if all of sigma is known
    tolerance: Float[Array, ""],  # of z in the last round
    *,
    robust: float | None,  # number of sigma from which a push has less influence; None: least squares
) -> Fit:
    """Find the most probable z and the standard deviations of the residuals, in alternation."""
    has_normal_prior = jnp.asarray(problem.prior.layout.has_normal_prior, start.dtype)

    def one_round(index, before: Fit) -> Fit:
        sigma = before.sigma

        def residuals(z, _):
            """Return the residuals of pushes and prior, whose squares add up to the loss, and their linearization."""
            z = jnp.where(frozen, start, z)
            linearized = problem.linearize(z, pushes)
            linear_residuals = problem.linear_residuals(z, linearized)
            return (weighted_residuals(linear_residuals, pushes, sigma, robust), has_normal_prior * z), linearized

        is_last = index == rounds - 1
        solver = _LevenbergMarquardt(jnp.where(is_last, tolerance, LOOSE_TOLERANCE).astype(start.dtype))
        found = optx.least_squares(residuals, solver, before.z, has_aux=True, max_steps=MAX_STEPS, throw=False)
        z, residual = jnp.where(frozen, start, found.value), found.aux.value
        jacobian = problem.jacobian(z, found.aux)
        precision, information, new_sigma = _evidence(residual, jacobian, pushes, before, robust, has_normal_prior)
        weighted = weighted_residuals(residual, pushes, sigma, robust)
        minimum = sum_of_squares((*weighted, has_normal_prior * z))
        steps, converged = before.steps + found.stats["num_steps"], found.result == optx.RESULTS.successful
        new_sigma = jnp.where(sigma_is_given, sigma, jnp.maximum(new_sigma, MIN_SIGMA))
        # The last round keeps the sigma with which it fitted.
        sigma = jnp.where(is_last, sigma, new_sigma)
        return Fit(z, sigma, precision, residual, information, minimum, steps, converged)

    leading, size = pushes.weight.shape, len(start)
    precision, information, minimum = (jnp.zeros(shape, start.dtype) for shape in ((size, size), (*leading, size), ()))
    rows = ResidualKinds(3 * len(pushes.observed_steps), 3 * pushes.wrench.shape[-2], int(problem.contact_at_end))
    residual = ResidualKinds(*(jnp.zeros((*leading, count), start.dtype) for count in rows))
    no_steps, not_converged = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    first = Fit(start, sigma, precision, residual, information, minimum, no_steps, not_converged)
    return jax.lax.fori_loop(0, rounds, one_round, first)
