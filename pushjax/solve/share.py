"""Which contact forces make up a wrench, where more than one choice does.

Where more than three cone edges suit the motion (two fingers flat against an edge, say) the twist and the wrench are
determined but the forces are not. Of all that fit, the one with the least sum of squared edge weights is given, as if
the fingers were equally soft: it depends neither on the order of the contacts nor on the frame or a mirror.

It is min 1/2 sum alpha_e^2 with sum alpha_e g_e = F, alpha >= 0; by duality alpha_e = max(0, g_e . y), with y the
minimiser of the convex, piecewise quadratic phi(y) = 1/2 sum max(0, g_e . y)^2 - F . y. Newton's method with an exact
line search ends after finitely many rounds; of 2600 indeterminate random problems none took more than five from the
weights that the chosen edges have. Where forces nearly cancel, y is large and its rounding too: so the weights, not y,
take up what is left at the end.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._autodiff import undifferentiated
from pushjax._vec import Scalar, Vec3, select, settle, weighted
from pushjax.limit_surface import Symmetric3
from pushjax.solve._basis import completed
from pushjax.solve._several import pick

ROUNDS = 7  # at most
SEARCHES = 5  # rounds of the line search, in each
SOFTNESS = 256  # roundings of its trace, by which the curvature is stiffened


def share_force(
    generators: tuple[Vec3, ...],
    suitable: tuple[Bool[Array, ""], ...],
    chosen: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]],
    alpha: Vec3,
    f: Vec3,
) -> tuple[Scalar, ...]:
    """The weight of every generator. Where it is plain that no other suits, the chosen edges' own weights."""
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
    kept = tuple(select(s, g, Vec3(zero, zero, zero)) for g, s in zip(generators, suitable, strict=True))
    # three edges in one plane are all there are, and yet one too many: with independent ones both ways agree
    several = settle((count > used) | (count > 2), size)
    y, curvature = undifferentiated(_minimised, kept, chosen, alpha.scale(1 / unit), target, several)
    # Differentiated rounds: each makes one order of derivative exact, with the curvature held fixed
    y = settle(y + _solve(curvature, target - weighted(kept, _pulls(kept, y))), size)
    weights = settle(_pulls(kept, y), size)
    step = settle(_solve(curvature, target - weighted(kept, weights)), size)
    # The step is zero but for rounding: its value is taken up by the weights, but not its product with their change
    rounding = jax.lax.stop_gradient(step)
    shared = []
    for a, g in zip(weights, kept, strict=True):
        more = jax.lax.stop_gradient(g.dot(rounding)) + g.dot(step - rounding)
        # only those that pull: the others would be given what the step rounds to
        shared.append(jnp.where(a > 0, jnp.maximum(a + more, 0), 0.0))

    indeterminate = settle(several & _fits(kept, shared, target, 64), size)
    return tuple(jnp.where(indeterminate, s * unit, o) for s, o in zip(shared, own, strict=True))


def _minimised(
    kept: tuple[Vec3, ...], chosen: tuple, alpha: Vec3, target: Vec3, several: Bool[Array, ""]
) -> tuple[Vec3, Symmetric3]:
    """y, and the Hessian of phi there; where not `several`, of y as it begins."""

    def goes_on(y: Vec3) -> Bool[Array, ""]:
        return several & ~_fits(kept, _pulls(kept, y), target, 8)  # the gradient of phi is what is missing

    def round_(state):
        count, y, _ = state
        y = settle(y + _searched(kept, target, y), target.x)
        return count + 1, y, (count + 1 < ROUNDS) & goes_on(y)

    begin = _begin(kept, chosen, alpha, target)
    _, y, _ = jax.lax.while_loop(lambda state: state[2], round_, (jnp.zeros((), jnp.int32), begin, goes_on(begin)))
    return y, _curvature(kept, y)


def _fits(kept: tuple[Vec3, ...], weights: list[Scalar], target: Vec3, roundings: int) -> Bool[Array, ""]:
    """Whether the weights make up the target."""
    rest = target - weighted(kept, weights)
    allowed = roundings * jnp.finfo(target.x.dtype).eps * (1 + sum(weights, 0 * target.x))
    return rest.dot(rest) <= allowed**2


def _begin(kept: tuple[Vec3, ...], chosen: tuple, alpha: Vec3, target: Vec3) -> Vec3:
    """The shortest y that gives the chosen edges their weights."""
    first, second, third = (pick(kept, jnp.maximum(edge, 0)) for edge in chosen)
    basis = completed(first, second, third, chosen[1] >= 0, chosen[2] >= 0, float(jnp.finfo(target.x.dtype).eps))
    return select(basis.regular, basis.with_products(alpha), target)


def _pulls(kept: tuple[Vec3, ...], y: Vec3) -> list[Scalar]:
    return [jnp.maximum(g.dot(y), 0) for g in kept]


def _curvature(kept: tuple[Vec3, ...], y: Vec3) -> Symmetric3:
    """The Hessian of phi, a little stiffened: edges in one plane leave a direction undetermined, which F does not
    need."""
    xx, yy, zz, xy, xz, yz = (jnp.zeros_like(y.x),) * 6
    for g in kept:
        pulling = jnp.where(g.dot(y) > 0, 1.0, 0.0)
        p = g.scale(pulling)
        xx, yy, zz = xx + p.x * g.x, yy + p.y * g.y, zz + p.z * g.z
        xy, xz, yz = xy + p.x * g.y, xz + p.x * g.z, yz + p.y * g.z
    soft = _softness(y.x.dtype) * (xx + yy + zz + 1e-3)
    return settle(Symmetric3(xx + soft, yy + soft, zz + soft, xy, xz, yz), y.x)


def _softness(dtype) -> float:
    return SOFTNESS * float(jnp.finfo(dtype).eps)


def _solve(m: Symmetric3, v: Vec3) -> Vec3:
    """m^-1 v by elimination, no pivot smaller than the stiffening: where edges leave one or two directions
    undetermined, an adjugate would be nothing but rounding."""
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


def _searched(kept: tuple[Vec3, ...], target: Vec3, y: Vec3) -> Vec3:
    """The step from y: Newton's, shortened to where phi is least along it."""
    along = settle([g.dot(y) for g in kept], target.x)
    step = _solve(_curvature(kept, y), target - weighted(kept, [jnp.maximum(a, 0) for a in along]))
    step = settle(step, target.x)
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
