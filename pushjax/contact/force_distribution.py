"""The distribution of contact forces that make up a wrench, where more than one is possible.

Where more than three cone edges are admissible under the motion (two fingers flat against an edge, say) the twist and
the wrench are determined but the forces are not. Of all distributions that make up the wrench, this module gives the
one with the least sum of squared edge weights. It is that of equally soft fingers whose compliance along the tangent is
1 / mu^2 times that along the normal. It does not depend on the order of the contacts, on the frame or on a mirror.

The problem is min 1/2 sum alpha_e^2 with sum alpha_e g_e = F, alpha >= 0. By duality alpha_e = max(0, g_e . y), where y
is the minimizer of the convex, piecewise quadratic phi(y) = 1/2 sum max(0, g_e . y)^2 - F . y. Newton's method with an
exact line search ends after finitely many iterations. It starts from the weights of the chosen edges; of 2600 random
indeterminate problems none took more than five iterations from there.

Where forces nearly cancel, y is large and so is its roundoff. So what is left over at the end is added to the weights,
not to y.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._math.arrays import ENTRIES, dot
from pushjax._math.sums import summed

MAX_NEWTON_ITERATIONS = 7
LINE_SEARCH_ITERATIONS = 5  # in each Newton iteration
# By the bytes of a float: what is added to the Hessian's diagonal, relative to its trace, 256 eps.
REGULARIZATION = {4: 2.0**-15, 8: 2.0**-44}

Vector = Float[Array, "3 *batch"]
Weights = Float[Array, "edges *batch"]


def distribute_force(
    edges: Float[Array, "3 edges *batch"],
    admissible: Bool[Array, "edges *batch"],
    chosen: Int[Array, "3 *batch"],
    chosen_weights: Vector,
    f: Vector,
    start: Vector,  # the shortest y that gives the chosen edges their weights
) -> tuple[Weights, Bool[Array, "*batch"], Vector]:
    """Compute the weight of every edge in the wrench f, whether more than the chosen edges share it, and then y."""
    # Where no more edges are admissible under the motion than were chosen, these are the chosen edges' own weights.
    # This is not differentiated.
    own_weights = of_chosen(edges, chosen, chosen_weights)
    num_admissible, num_chosen = jnp.sum(admissible, axis=0), jnp.sum(chosen >= 0, axis=0)
    # If just three edges are admissible and they are coplanar, the weights are indeterminate too. If they are
    # independent, the search finds the chosen edges' own weights.
    needs_search = (num_admissible > num_chosen) | (num_admissible > 2)
    shared, reproduced, y = jax.lax.cond(
        jnp.any(needs_search),
        _shared,
        lambda *_: (own_weights, jnp.zeros_like(needs_search), jnp.zeros_like(start)),
        *(edges, admissible, needs_search, f, start),
    )
    indeterminate = needs_search & reproduced
    return jnp.where(indeterminate[None], shared, own_weights), indeterminate, y


def of_chosen(edges: Float[Array, "3 edges *batch"], chosen: Int[Array, "3 *batch"], weights: Vector) -> Weights:
    """The weights of the chosen edges as one weight for each edge, zero for the others."""
    numbers = jnp.arange(edges.shape[1]).reshape(1, -1, *(1,) * (weights.ndim - 1))
    return summed(jnp.where(chosen[:, None] == numbers, weights[:, None], 0.0), 0)


def _shared(
    edges: Array, admissible: Array, needs_search: Array, f: Vector, start: Vector
) -> tuple[Weights, Bool[Array, "*batch"], Vector]:
    """The weights with the least sum of squares, whether they make up the wrench, and y."""
    squared = dot(f, f)
    unit = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    target, usable = f / unit[None], jnp.where(admissible[None], edges, 0.0)
    least = _minimize_dual(usable, start / unit[None], target, needs_search)
    hessian = _dual_hessian(usable, _weights(usable, least) > 0)
    y = least + _solve_regularized(hessian, target - _total(usable, _weights(usable, least)))
    weights = _weights(usable, y)
    correction = _products(usable, _solve_regularized(hessian, target - _total(usable, weights)))
    # only edges that carry force: others would get a weight that is the step's roundoff
    weights = jnp.where(weights > 0, jnp.maximum(weights + correction, 0), 0.0)
    return weights * unit[None], _reproduces(usable, weights, target, 64), least * unit[None]


def shared_weights(
    edges: Float[Array, "3 edges *batch"], loaded: Bool[Array, "edges *batch"], f: Vector, y: Vector
) -> Weights:
    """The weights of the loaded edges in f with the least sum of squares, for derivatives: y is known."""
    usable = jnp.where(loaded[None], edges, 0.0)
    hessian = jax.lax.stop_gradient(_dual_hessian(usable, loaded))
    # Each iteration makes one more order of derivative exact, with the Hessian held fixed. Its value is not added: it
    # is roundoff, which the small pivots of coplanar edges magnify.
    for _ in range(3):
        step = _solve_regularized(hessian, f - _total(usable, _products(usable, y)))
        y = y + (step - jax.lax.stop_gradient(step))
    return _products(usable, y)


def _products(edges: Array, y: Vector) -> Weights:
    """The products g . y."""
    return summed(edges * y[:, None], 0)


def _weights(edges: Array, y: Vector) -> Weights:
    """The weights max(0, g . y)."""
    return jnp.maximum(_products(edges, y), 0)


def _total(edges: Array, weights: Weights) -> Vector:
    """The wrench of the weights."""
    return summed(edges * weights[None], 1)


def _minimize_dual(usable: Array, start: Vector, target: Vector, needs_search: Bool[Array, "*batch"]) -> Vector:
    """The minimizer y of phi (see the header of this module); `start` where not `needs_search`."""

    def unfinished(y: Vector) -> Bool[Array, "*batch"]:
        # the part of the target that the weights do not reproduce is the gradient of phi
        return needs_search & ~_reproduces(usable, _weights(usable, y), target, 8)

    def iterate(state):
        count, y, going = state
        y = jnp.where(going[None], y + _line_search_step(usable, target, y), y)
        return count + 1, y, going & unfinished(y)

    initial = jnp.zeros((), jnp.int32), start, unfinished(start)
    return jax.lax.while_loop(lambda state: (state[0] < MAX_NEWTON_ITERATIONS) & jnp.any(state[2]), iterate, initial)[1]


def _reproduces(usable: Array, weights: Weights, target: Vector, roundings: int) -> Bool[Array, "*batch"]:
    """Whether the weights make up the target, up to `roundings` times eps of the sum of the forces."""
    residual = target - _total(usable, weights)
    allowed = roundings * jnp.finfo(target.dtype).eps * (1 + summed(weights, 0))
    return dot(residual, residual) <= allowed**2


def _dual_hessian(usable: Array, loaded: Bool[Array, "edges *batch"]) -> Float[Array, "6 *batch"]:
    """The Hessian of phi where these edges carry force, with a small multiple of the identity added."""
    # without it, coplanar edges leave one direction of y undetermined, which F does not need
    chosen = jnp.where(loaded[None], usable, 0.0)
    hessian = summed(jnp.stack([chosen[i] * usable[j] for i, j in ENTRIES]), 1)
    diagonal = REGULARIZATION[usable.dtype.itemsize] * (summed(hessian[:3], 0) + 1e-3)
    is_diagonal = jnp.asarray([1.0, 1, 1, 0, 0, 0], usable.dtype).reshape(6, *(1,) * (usable.ndim - 2))
    return hessian + is_diagonal * diagonal[None]


def _solve_regularized(m: Float[Array, "6 *batch"], v: Vector) -> Vector:
    """m^-1 v by elimination, with no pivot smaller than half of what was added to the diagonal."""
    # where the edges leave one or two directions undetermined, an adjugate would be nothing but roundoff
    xx, yy, zz, xy, xz, yz = m
    min_pivot = REGULARIZATION[v.dtype.itemsize] / 2 * (xx + yy + zz)
    l2, l3 = xy / xx, xz / xx
    d2 = jnp.maximum(yy - l2 * xy, min_pivot)
    yz = yz - l2 * xz
    l23 = yz / d2
    d3 = jnp.maximum(zz - l3 * xz - l23 * yz, min_pivot)
    y = v[1] - l2 * v[0]
    z = (v[2] - l3 * v[0] - l23 * y) / d3
    y = y / d2 - l23 * z
    return jnp.stack([v[0] / xx - l2 * y - l3 * z, y, z])


def _line_search_step(usable: Array, target: Vector, y: Vector) -> Vector:
    """The step from y: Newton's, shortened to where phi is least along it."""
    at_y = _products(usable, y)
    step = _solve_regularized(_dual_hessian(usable, at_y > 0), target - _total(usable, jnp.maximum(at_y, 0)))
    rates, gain = _products(usable, step), dot(target, step)

    def shorten(_, state):
        t, low, high = state
        along = at_y + t[None] * rates
        slope = summed(jnp.maximum(along, 0) * rates, 0) - gain
        curvature = summed(jnp.where(along > 0, rates * rates, 0.0), 0)
        descends = slope <= 0
        low, high = jnp.where(descends, t, low), jnp.where(descends, high, t)
        newton = t - slope / jnp.where(curvature > 0, curvature, 1.0)
        inside = (newton > low) & (newton < high)
        return jnp.where(low >= 1, 1.0, jnp.where(inside, newton, (low + high) / 2)), low, high

    one = jnp.ones_like(gain)
    t, _, _ = jax.lax.fori_loop(0, LINE_SEARCH_ITERATIONS, shorten, (one, 0 * one, one))
    return step * t[None]
