"""Exact Coulomb friction of support points: the wrench for a twist, and random wrench-twist pairs.

JAX samples the random numbers. NumPy computes the rest where values are known, because that compiles nothing.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from pushjax._internal.checks import in_numpy
from pushjax._internal.jit import QUICK_OPTIONS, outside_trace

FACET_FRACTION = 0.1  # fraction of the wrench-twist pairs that lie on a facet


def wrenches(xp, point, limit, twist, in_disk):
    """Return the body wrenches (twists, 3), N and N m, that balance friction for body twists (twists, 3), any norm."""
    largest = xp.max(xp.abs(twist), axis=1, keepdims=True)
    v = twist / xp.where(largest > 0, largest, 1)  # so that squares neither underflow nor overflow
    vx, vy, omega = v[:, 0:1], v[:, 1:2], v[:, 2:3]
    x, y = point[None, :, 0], point[None, :, 1]
    velocity = xp.stack([vx - omega * y, vy + omega * x], axis=2)
    squared_speed = xp.sum(velocity**2, axis=2)
    # A point does not slide if its speed is within the roundoff of the products above.
    speed_scale = xp.abs(omega) * xp.max(xp.abs(point)) + xp.maximum(xp.abs(vx), xp.abs(vy))
    is_pivot = squared_speed <= (8 * xp.finfo(squared_speed.dtype).eps * speed_scale) ** 2
    sliding = velocity / xp.sqrt(xp.where(is_pivot, 1, squared_speed))[..., None]
    # `in_disk`, (twists, points, 2), is the force in units of its limit where a point does not slide: on a facet it
    # chooses the wrench. A zero twist gives a zero wrench.
    force = limit[None, :, None] * xp.where(is_pivot[..., None], xp.where(largest[..., None] > 0, in_disk, 0), sliding)
    torque = x * force[..., 1] - y * force[..., 0]
    return xp.concatenate([xp.sum(force, axis=1), xp.sum(torque, axis=1, keepdims=True)], axis=1)


class PairDraws(NamedTuple):
    """The random numbers behind wrench-twist pairs."""

    free: Float[Array, "pairs 3"]  # twists (vx, vy, length * omega) of any norm, of pairs that are not on a facet
    pivot: Float[Array, "pairs 2"]  # support points, m; the twist of a pair on a facet rotates about this point
    positive: Bool[Array, "pairs"]  # whether that rotation is counterclockwise
    on_facet: Bool[Array, "pairs"]
    uniform: Float[Array, "pairs 2 points"]  # numbers in [0, 1), see `in_unit_disk`


def draw(key: Key[Array, ""], point: Array, limit: Array, pairs: int) -> PairDraws:
    """Sample the random numbers of `pairs` wrench-twist pairs, given the support points and their friction limits."""
    return (_draw_alone if outside_trace() else _draw)(key, point, limit, pairs)


def _draw(key: Key[Array, ""], point: Array, limit: Array, pairs: int) -> PairDraws:
    dtype = point.dtype
    k_free, k_point, k_side, k_facet, k_order = jax.random.split(key, 5)
    facet_pairs = round(FACET_FRACTION * pairs)
    return PairDraws(
        free=jax.random.normal(k_free, (pairs, 3), dtype),
        pivot=jax.random.choice(k_point, point, (pairs,), p=limit / jnp.sum(limit)),
        positive=jax.random.bernoulli(k_side, 0.5, (pairs,)),
        on_facet=jax.random.permutation(k_order, jnp.arange(pairs) < facet_pairs),
        uniform=jax.vmap(lambda k: draw_uniform(k, len(point), dtype))(jax.random.split(k_facet, pairs)),
    )


# Draws have no rounding that matters, and run for a millisecond, so they are compiled in the shortest time.
DRAW_OPTIONS = QUICK_OPTIONS | {"xla_backend_optimization_level": 0}
_draw_alone = eqx.filter_jit(_draw, compiler_options=DRAW_OPTIONS)  # pyright: ignore[reportCallIssue]


@in_numpy
def pairs_of(xp, point, limit, length, free, pivot, positive, on_facet, uniform):
    """Return the wrenches and twists of `Support.wrench_twist_pairs`, given the random numbers of `draw`."""
    # A rotation about r moves the origin with (r_y, -r_x) omega.
    about = xp.stack([pivot[:, 1], -pivot[:, 0], xp.broadcast_to(length, positive.shape)], axis=1)
    normalized = xp.where(on_facet[:, None], xp.where(positive[:, None], about, -about), free)
    normalized = normalized / xp.linalg.norm(normalized, axis=1, keepdims=True)
    twist = normalized / xp.stack([xp.ones_like(length), xp.ones_like(length), length])[None]
    return wrenches(xp, point, limit, twist, in_unit_disk(xp, uniform)), twist


def draw_uniform(key: Key[Array, ""], points: int, dtype) -> Float[Array, "2 {points}"]:
    """Sample two numbers in [0, 1) for each of `points` points."""
    return jax.vmap(lambda k: jax.random.uniform(k, (points,), dtype))(jax.random.split(key))


def in_unit_disk(xp, uniform):
    """Return points (..., points, 2) that are uniform in the unit disk, from uniform numbers (..., 2, points)."""
    radius, angle = xp.sqrt(uniform[..., 0, :]), 2 * np.pi * uniform[..., 1, :]
    return xp.stack([radius * xp.cos(angle), radius * xp.sin(angle)], axis=-1)
