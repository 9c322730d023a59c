"""How hard the hand squeezes: a certificate that there is a motion, and how far from a jam it is.

Contact forces in their friction cones whose wrenches cancel are an internal equilibrium: the fingers can press
through the slider against each other. The work they would do on it over the step, per unit of normal force,

    power = max  sum_e alpha_e p_e   over alpha >= 0,  sum alpha_e g_e = 0,  sum alpha_e = 1,

with p_e the pusher's displacement along edge e less the gap, is the squeeze power, in metres. Without a positive one
the problem has a solution (its LCP is copositive); the converse is false. A linear program in so few variables has few
basic solutions, four edges at most, and all are tried. Where all the edges lie in one plane (fingers at one and the
same point), it is three edges: a pure moment, of weight zero, makes the fourth.
"""

from itertools import combinations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._autodiff import undifferentiated
from pushjax._vec import Scalar, Vec3, settle
from pushjax.solve._several import Several, clean, pick

# Without friction the two edges of a cone are one, and four edges span nothing; so much friction has every contact.
LEAST_FRICTION = {4: 1e-3, 8: 1e-7}


def squeeze_power(problem: Several) -> Scalar:
    """Dimensionless (times `speed`: m); minus infinity where no internal equilibrium exists, as for one contact."""
    m = problem.count
    lowest = jnp.full_like(problem.speed, -jnp.inf)
    if m < 2:
        return lowest
    least = LEAST_FRICTION[problem.speed.dtype.itemsize]
    problem = problem._replace(friction=tuple(jnp.maximum(mu, least) for mu in problem.friction))
    zero = jnp.zeros_like(problem.speed)
    moment = Vec3(zero, zero, zero + 1)
    generators, powers = (*problem.generators(), moment), (*_powers(problem), zero)
    active = (*(problem.active[k // 2] for k in range(2 * m)), jnp.ones((), bool))
    best = undifferentiated(_best, generators, powers, active, problem.speed)
    # Only the best is differentiated. That it exists is not decided again: another rounding could deny it.
    return jnp.where(best[0] > lowest, _basic(generators, powers, best[1:])[0], lowest)


def _best(generators: tuple[Vec3, ...], powers: tuple[Scalar, ...], active: tuple, witness: Scalar) -> tuple:
    """The largest power, and its four edges."""

    def body(best, edges):
        value, exists = _basic(generators, powers, edges)
        for e in edges:
            exists &= pick(active, e)
        better = settle(exists & (value > best[0]), witness)
        return (
            jnp.where(better, value, best[0]),
            *(jnp.where(better, e, b) for e, b in zip(edges, best[1:], strict=True)),
        ), None

    sets = list(combinations(range(len(generators)), 4))
    lowest = jnp.full_like(witness, -jnp.inf)
    begin = (lowest, *(jnp.full(lowest.shape, e, jnp.int32) for e in sets[0]))
    columns = tuple(jnp.asarray(column, jnp.int32) for column in zip(*sets, strict=True))
    return jax.lax.scan(body, begin, columns)[0]


def _powers(problem: Several) -> tuple[Scalar, ...]:
    powers = []
    for push, mu in zip(problem.approach, problem.friction, strict=True):
        powers += [push.x + mu * push.y, push.x - mu * push.y]
    return tuple(powers)


def _basic(generators: tuple[Vec3, ...], powers: tuple[Scalar, ...], edges: tuple) -> tuple[Scalar, Bool[Array, ""]]:
    """The power of the internal equilibrium of four edges, and whether they have one."""
    g1, g2, g3, g4 = (pick(generators, e) for e in edges)
    x12, x34 = g1.cross(g2), g3.cross(g4)
    # settled: two roundings of a weight that cancels would differ by more than rounding
    weights = settle((g2.dot(x34), -g1.dot(x34), g4.dot(x12), -g3.dot(x12)), g1.x + g2.y)
    total = weights[0] + weights[1] + weights[2] + weights[3]
    extent = sum((jnp.abs(w) for w in weights), jnp.zeros_like(total))
    eps = jnp.finfo(total.dtype).eps
    # all of one sign, to rounding, and not all rounding
    exists = (jnp.abs(total) >= extent * (1 - 64 * eps)) & (extent > eps**1.5)
    exists &= (edges[3] < len(generators) - 1) | (jnp.abs(weights[3]) <= 64 * eps * extent)
    share = 1 / jnp.where(total != 0, total, 1.0)
    power = jnp.zeros_like(total)
    for w, e in zip(weights, edges, strict=True):
        power = power + w * pick(powers, e)
    rest = g1.scale(weights[0]) + g2.scale(weights[1]) + g3.scale(weights[2]) + g4.scale(weights[3])
    rest = rest.scale(share)
    # generous: with hardly any friction the total is small, and its rounding relatively large
    return share * power, exists & (rest.dot(rest) <= clean(total.dtype))
