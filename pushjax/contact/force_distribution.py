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
from jaxtyping import Array, Bool, Int

from pushjax._internal.autodiff import without_derivatives
from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.linalg import Symmetric3, complete_basis
from pushjax._math.vec import Scalar, Vec3, linear_combination
from pushjax.contact.scaled_problem import dynamic_index

MAX_NEWTON_ITERATIONS = 7
LINE_SEARCH_ITERATIONS = 5  # in each Newton iteration
REGULARIZATION = 256  # what is added to the Hessian's diagonal, in units of eps times its trace


def distribute_force(
    generators: tuple[Vec3, ...],
    admissible: tuple[Bool[Array, ""], ...],
    chosen: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]],
    chosen_weights: Vec3,
    f: Vec3,
) -> tuple[Scalar, ...]:
    """Compute the weight of every generator in a wrench.

    Where no more edges are admissible than were chosen, these are the chosen edges' own weights.

    Args:
        generators: Wrenches of the cone edges with unit normal force.
        admissible: For each generator, whether it may carry force under the motion.
        chosen: Numbers of the edges in the solution's set; negative where unused.
        chosen_weights: Weights of the chosen edges.
        f: The wrench, normalized.

    Returns:
        One weight for each generator.
    """
    zero = jnp.zeros_like(f.x)
    own_weights = _scatter(chosen, chosen_weights, len(generators))
    num_admissible = sum((may_carry.astype(jnp.int32) for may_carry in admissible), jnp.zeros((), jnp.int32))
    num_chosen = sum(((edge >= 0).astype(jnp.int32) for edge in chosen), jnp.zeros((), jnp.int32))

    squared = jax.lax.stop_gradient(f.dot(f))
    unit = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    target = f.scale(1 / unit)
    usable = tuple(
        tree_where(may_carry, g, Vec3(zero, zero, zero)) for g, may_carry in zip(generators, admissible, strict=True)
    )
    # If just three edges are admissible and they are coplanar, the weights are indeterminate too. If they are
    # independent, the search finds the chosen edges' own weights.
    needs_search = decide((num_admissible > num_chosen) | (num_admissible > 2), squared)
    y, hessian = without_derivatives(
        _minimize_dual, usable, chosen, chosen_weights.scale(1 / unit), target, needs_search
    )
    # Differentiated iterations: each makes one more order of derivative exact, with the Hessian held fixed.
    y = compute_once(
        y + _solve_regularized(hessian, target - linear_combination(usable, _weights_of_dual(usable, y))), squared
    )
    weights = compute_once(_weights_of_dual(usable, y), squared)
    step = compute_once(_solve_regularized(hessian, target - linear_combination(usable, weights)), squared)
    # `step` is zero up to roundoff. Its value is added to the weights, but its product with their change is not.
    step_value = jax.lax.stop_gradient(step)
    shared_weights = []
    for a, g in zip(weights, usable, strict=True):
        correction = jax.lax.stop_gradient(g.dot(step_value)) + g.dot(step - step_value)
        # only generators that carry force: others would get a weight that is the step's roundoff
        shared_weights.append(jnp.where(a > 0, jnp.maximum(a + correction, 0), 0.0))

    indeterminate = decide(needs_search & _reproduces(usable, shared_weights, target, 64), squared)
    return tuple(
        jnp.where(indeterminate, shared * unit, own) for shared, own in zip(shared_weights, own_weights, strict=True)
    )


def _scatter(chosen: tuple, chosen_weights: Vec3, count: int) -> list[Scalar]:
    """The weights of the chosen edges as one weight for each of `count` generators, zero for the others."""
    zero = jnp.zeros_like(chosen_weights.x)
    own_weights = []
    for k in range(count):
        weight = zero
        for edge, value in zip(chosen, chosen_weights, strict=True):
            weight = weight + jnp.where(edge == k, value, 0.0)
        own_weights.append(weight)
    return own_weights


def _minimize_dual(
    usable: tuple[Vec3, ...], chosen: tuple, chosen_weights: Vec3, target: Vec3, needs_search: Bool[Array, ""]
) -> tuple[Vec3, Symmetric3]:
    """Minimize phi(y) (see the header of this module).

    Returns:
        The minimizer y of phi and the Hessian of phi there. Where not `needs_search`, the starting point and the
        Hessian there.
    """

    def unfinished(y: Vec3) -> Bool[Array, ""]:
        # the part of the target that the weights do not reproduce is the gradient of phi
        return needs_search & ~_reproduces(usable, _weights_of_dual(usable, y), target, 8)

    def iterate(state):
        count, y, _ = state
        y = compute_once(y + _line_search_step(usable, target, y), target.x)
        return count + 1, y, (count + 1 < MAX_NEWTON_ITERATIONS) & unfinished(y)

    start = _starting_point(usable, chosen, chosen_weights, target)
    _, y, _ = jax.lax.while_loop(lambda state: state[2], iterate, (jnp.zeros((), jnp.int32), start, unfinished(start)))
    return y, _dual_hessian(usable, y)


def _reproduces(usable: tuple[Vec3, ...], weights: list[Scalar], target: Vec3, roundings: int) -> Bool[Array, ""]:
    """Whether the weights make up the target, up to `roundings` times eps of the sum of the forces."""
    residual = target - linear_combination(usable, weights)
    allowed = roundings * jnp.finfo(target.x.dtype).eps * (1 + sum(weights, 0 * target.x))
    return residual.dot(residual) <= allowed**2


def _starting_point(usable: tuple[Vec3, ...], chosen: tuple, chosen_weights: Vec3, target: Vec3) -> Vec3:
    """The shortest y that gives the chosen edges their weights."""
    first, second, third = (dynamic_index(usable, jnp.maximum(edge, 0)) for edge in chosen)
    basis = complete_basis(first, second, third, chosen[1] >= 0, chosen[2] >= 0, float(jnp.finfo(target.x.dtype).eps))
    return tree_where(basis.regular, basis.with_products(chosen_weights), target)


def _weights_of_dual(usable: tuple[Vec3, ...], y: Vec3) -> list[Scalar]:
    """The weights max(0, g . y) of the generators."""
    return [jnp.maximum(g.dot(y), 0) for g in usable]


def _dual_hessian(usable: tuple[Vec3, ...], y: Vec3) -> Symmetric3:
    """The Hessian of phi, with a small multiple of the identity added.

    Without it, coplanar edges leave one direction of y undetermined, which F does not need.
    """
    xx, yy, zz, xy, xz, yz = (jnp.zeros_like(y.x),) * 6
    for g in usable:
        carries_force = jnp.where(g.dot(y) > 0, 1.0, 0.0)
        active = g.scale(carries_force)
        xx, yy, zz = xx + active.x * g.x, yy + active.y * g.y, zz + active.z * g.z
        xy, xz, yz = xy + active.x * g.y, xz + active.x * g.z, yz + active.y * g.z
    diagonal = _relative_regularization(y.x.dtype) * (xx + yy + zz + 1e-3)
    return compute_once(Symmetric3(xx + diagonal, yy + diagonal, zz + diagonal, xy, xz, yz), y.x)


def _relative_regularization(dtype) -> float:
    """The number added to the Hessian's diagonal, relative to its trace."""
    return REGULARIZATION * float(jnp.finfo(dtype).eps)


def _solve_regularized(m: Symmetric3, v: Vec3) -> Vec3:
    """m^-1 v by elimination, with no pivot smaller than half of what was added to the diagonal.

    Where the edges leave one or two directions undetermined, an adjugate would be nothing but roundoff.
    """
    min_pivot = _relative_regularization(v.x.dtype) / 2 * (m.xx + m.yy + m.zz)
    l2, l3 = m.xy / m.xx, m.xz / m.xx
    d2 = jnp.maximum(m.yy - l2 * m.xy, min_pivot)
    yz = m.yz - l2 * m.xz
    l23 = yz / d2
    d3 = jnp.maximum(m.zz - l3 * m.xz - l23 * yz, min_pivot)
    y = v.y - l2 * v.x
    z = (v.z - l3 * v.x - l23 * y) / d3
    y = y / d2 - l23 * z
    return Vec3(v.x / m.xx - l2 * y - l3 * z, y, z)


def _line_search_step(usable: tuple[Vec3, ...], target: Vec3, y: Vec3) -> Vec3:
    """The step from y: Newton's, shortened to where phi is least along it."""
    products = compute_once([g.dot(y) for g in usable], target.x)
    step = _solve_regularized(
        _dual_hessian(usable, y), target - linear_combination(usable, [jnp.maximum(a, 0) for a in products])
    )
    step = compute_once(step, target.x)
    rates, gain = [g.dot(step) for g in usable], target.dot(step)
    one = jnp.ones_like(gain)

    def shorten(_, state):
        t, low, high = state
        slope, curvature = -gain, 0 * gain
        for a, rate in zip(products, rates, strict=True):
            product = a + t * rate
            slope = slope + jnp.maximum(product, 0) * rate
            curvature = curvature + jnp.where(product > 0, rate * rate, 0.0)
        descends = slope <= 0
        low, high = jnp.where(descends, t, low), jnp.where(descends, high, t)
        newton = t - slope / jnp.where(curvature > 0, curvature, 1.0)
        inside = (newton > low) & (newton < high)
        return jnp.where(low >= 1, 1.0, jnp.where(inside, newton, (low + high) / 2)), low, high

    t, _, _ = jax.lax.fori_loop(0, LINE_SEARCH_ITERATIONS, shorten, (one, 0 * one, one))
    return step.scale(t)
