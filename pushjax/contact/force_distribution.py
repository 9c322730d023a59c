"""The distribution of contact forces that make up a wrench, where more than one is possible.

Where more than three cone edges suit the motion (two fingers flat against an edge, say) the twist and the wrench are
determined but the forces are not. Of all distributions that fit, this module gives the one with the least sum of
squared edge weights, as if the fingers were equally soft. It does not depend on the order of the contacts, on the frame
or on a mirror.

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

ROUNDS = 7  # Newton iterations at most
SEARCHES = 5  # iterations of the line search in each of them
SOFTNESS = 256  # what is added to the Hessian's diagonal, in roundings of its trace


def distribute_force(
    generators: tuple[Vec3, ...],
    suitable: tuple[Bool[Array, ""], ...],
    chosen: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]],
    alpha: Vec3,
    f: Vec3,
) -> tuple[Scalar, ...]:
    """Compute the weight of every generator in a wrench.

    Where it is plain that no other edges suit, these are the chosen edges' own weights.

    Args:
        generators: Wrenches of the cone edges with unit normal force.
        suitable: For each generator, whether it may carry force under the motion.
        chosen: Numbers of the edges in the solution's set; negative where unused.
        alpha: Weights of the chosen edges.
        f: The wrench, normalized.

    Returns:
        One weight for each generator.
    """
    zero = jnp.zeros_like(f.x)
    own = []
    for k in range(len(generators)):
        weight = zero
        for edge, value in zip(chosen, alpha, strict=True):
            weight = weight + jnp.where(edge == k, value, 0.0)
        own.append(weight)
    count = sum((s.astype(jnp.int32) for s in suitable), jnp.zeros((), jnp.int32))
    used = sum(((edge >= 0).astype(jnp.int32) for edge in chosen), jnp.zeros((), jnp.int32))

    size = jax.lax.stop_gradient(f.dot(f))
    unit = jnp.sqrt(jnp.where(size > 0, size, 1.0))
    target = f.scale(1 / unit)
    kept = tuple(tree_where(s, g, Vec3(zero, zero, zero)) for g, s in zip(generators, suitable, strict=True))
    # Three coplanar edges may be all that suit and still be one too many. With three independent ones both ways agree.
    several = decide((count > used) | (count > 2), size)
    y, curvature = without_derivatives(_minimized, kept, chosen, alpha.scale(1 / unit), target, several)
    # Differentiated iterations: each makes one more order of derivative exact, with the curvature held fixed.
    y = compute_once(y + _solve(curvature, target - linear_combination(kept, _weights_of_dual(kept, y))), size)
    weights = compute_once(_weights_of_dual(kept, y), size)
    step = compute_once(_solve(curvature, target - linear_combination(kept, weights)), size)
    # `step` is zero up to roundoff. Its value is added to the weights, but its product with their change is not.
    rounding = jax.lax.stop_gradient(step)
    shared = []
    for a, g in zip(weights, kept, strict=True):
        more = jax.lax.stop_gradient(g.dot(rounding)) + g.dot(step - rounding)
        # only generators that carry force: others would get a weight that is the step's roundoff
        shared.append(jnp.where(a > 0, jnp.maximum(a + more, 0), 0.0))

    indeterminate = decide(several & _reproduces(kept, shared, target, 64), size)
    return tuple(jnp.where(indeterminate, s * unit, o) for s, o in zip(shared, own, strict=True))


def _minimized(
    kept: tuple[Vec3, ...], chosen: tuple, alpha: Vec3, target: Vec3, several: Bool[Array, ""]
) -> tuple[Vec3, Symmetric3]:
    """Minimize phi.

    Returns:
        The minimizer y, and the Hessian of phi there. Where not `several`, the y of the start and the Hessian there.
    """

    def goes_on(y: Vec3) -> Bool[Array, ""]:
        return several & ~_reproduces(
            kept, _weights_of_dual(kept, y), target, 8
        )  # what does not fit is the gradient of phi

    def round_(state):
        count, y, _ = state
        y = compute_once(y + _line_search_step(kept, target, y), target.x)
        return count + 1, y, (count + 1 < ROUNDS) & goes_on(y)

    begin = _begin(kept, chosen, alpha, target)
    _, y, _ = jax.lax.while_loop(lambda state: state[2], round_, (jnp.zeros((), jnp.int32), begin, goes_on(begin)))
    return y, _curvature(kept, y)


def _reproduces(kept: tuple[Vec3, ...], weights: list[Scalar], target: Vec3, roundings: int) -> Bool[Array, ""]:
    """Whether the weights make up the target, up to so many `roundings`."""
    rest = target - linear_combination(kept, weights)
    allowed = roundings * jnp.finfo(target.x.dtype).eps * (1 + sum(weights, 0 * target.x))
    return rest.dot(rest) <= allowed**2


def _begin(kept: tuple[Vec3, ...], chosen: tuple, alpha: Vec3, target: Vec3) -> Vec3:
    """The shortest y that gives the chosen edges their weights."""
    first, second, third = (dynamic_index(kept, jnp.maximum(edge, 0)) for edge in chosen)
    basis = complete_basis(first, second, third, chosen[1] >= 0, chosen[2] >= 0, float(jnp.finfo(target.x.dtype).eps))
    return tree_where(basis.regular, basis.with_products(alpha), target)


def _weights_of_dual(kept: tuple[Vec3, ...], y: Vec3) -> list[Scalar]:
    """The weights max(0, g . y) of the generators."""
    return [jnp.maximum(g.dot(y), 0) for g in kept]


def _curvature(kept: tuple[Vec3, ...], y: Vec3) -> Symmetric3:
    """The Hessian of phi, with a small multiple of the identity added.

    Without it, coplanar edges leave one direction of y undetermined, which F does not need.
    """
    xx, yy, zz, xy, xz, yz = (jnp.zeros_like(y.x),) * 6
    for g in kept:
        pulling = jnp.where(g.dot(y) > 0, 1.0, 0.0)
        p = g.scale(pulling)
        xx, yy, zz = xx + p.x * g.x, yy + p.y * g.y, zz + p.z * g.z
        xy, xz, yz = xy + p.x * g.y, xz + p.x * g.z, yz + p.y * g.z
    soft = _softness(y.x.dtype) * (xx + yy + zz + 1e-3)
    return compute_once(Symmetric3(xx + soft, yy + soft, zz + soft, xy, xz, yz), y.x)


def _softness(dtype) -> float:
    """The number added to the Hessian's diagonal, relative to its trace."""
    return SOFTNESS * float(jnp.finfo(dtype).eps)


def _solve(m: Symmetric3, v: Vec3) -> Vec3:
    """m^-1 v by elimination, with no pivot smaller than half the stiffening.

    Where the edges leave one or two directions undetermined, an adjugate would be nothing but roundoff.
    """
    least = _softness(v.x.dtype) / 2 * (m.xx + m.yy + m.zz)
    l2, l3 = m.xy / m.xx, m.xz / m.xx
    d2 = jnp.maximum(m.yy - l2 * m.xy, least)
    yz = m.yz - l2 * m.xz
    l23 = yz / d2
    d3 = jnp.maximum(m.zz - l3 * m.xz - l23 * yz, least)
    y = v.y - l2 * v.x
    z = (v.z - l3 * v.x - l23 * y) / d3
    y = y / d2 - l23 * z
    return Vec3(v.x / m.xx - l2 * y - l3 * z, y, z)


def _line_search_step(kept: tuple[Vec3, ...], target: Vec3, y: Vec3) -> Vec3:
    """The step from y: Newton's, shortened to where phi is least along it."""
    along = compute_once([g.dot(y) for g in kept], target.x)
    step = _solve(_curvature(kept, y), target - linear_combination(kept, [jnp.maximum(a, 0) for a in along]))
    step = compute_once(step, target.x)
    rates, gain = [g.dot(step) for g in kept], target.dot(step)
    one = jnp.ones_like(gain)

    def shorten(_, state):
        t, low, high = state
        slope, bend = -gain, 0 * gain
        for a, rate in zip(along, rates, strict=True):
            now = a + t * rate
            slope = slope + jnp.maximum(now, 0) * rate
            bend = bend + jnp.where(now > 0, rate * rate, 0.0)
        descends = slope <= 0
        low, high = jnp.where(descends, t, low), jnp.where(descends, high, t)
        newton = t - slope / jnp.where(bend > 0, bend, 1.0)
        inside = (newton > low) & (newton < high)
        return jnp.where(low >= 1, 1.0, jnp.where(inside, newton, (low + high) / 2)), low, high

    t, _, _ = jax.lax.fori_loop(0, SEARCHES, shorten, (one, 0 * one, one))
    return step.scale(t)
