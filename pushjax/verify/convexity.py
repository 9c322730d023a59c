"""Are quartics convex? By a sweep of the Hessian that knows nothing of certificates, for millions at once."""

from functools import partial
from typing import Any

import jax
import jax.experimental
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax.limit_surface._rays import half_sphere
from pushjax.limit_surface.quartic import MONOMIALS

RAYS, REFINED, ROUNDS = 200, 4, 12
BATCH = 20_000


def least_curvatures(coefficients: np.ndarray) -> np.ndarray:
    """(n,): the least of z' hess H(F) z over unit F, z, each divided by the largest coefficient; (n, 15) given.

    200 rays, and from the four lowest F and z are improved by turns: z the Hessian's lowest eigenvector at F, then F
    the lowest at z (the form is the same with both exchanged), which can only lower it. In float64, whatever is given.
    """
    c = np.asarray(coefficients, np.float64)
    found = []
    for first in range(0, len(c), BATCH):
        part = c[first : first + BATCH]
        padded = np.concatenate([part, np.repeat(part[-1:], BATCH - len(part), axis=0)]) if len(c) > BATCH else part
        with _float64():
            found.append(np.asarray(_sweep(jnp.asarray(padded)))[: len(part)])
    return np.concatenate(found)


def _float64() -> Any:
    """Within it, 64-bit floats are on; of newer and older JAX."""
    where: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    return where.enable_x64(True)


@jax.jit
def _sweep(c: Float[Array, "n 15"]) -> Float[Array, "n"]:
    c = c / jnp.max(jnp.abs(c), axis=1, keepdims=True)
    rays = jnp.asarray(half_sphere(RAYS), c.dtype)
    table = jnp.asarray(_HESSIAN, c.dtype)  # (6, 6, 15): entry of the Hessian, product of F, coefficient
    hessians = jnp.einsum("epm,rp,nm->ern", table, _products(rays), c)
    lowest = _least_eigenvalue(*hessians)
    best = jax.lax.top_k(-lowest.T, REFINED)[1].T  # (refined, n)
    refine = jax.vmap(jax.vmap(partial(_refined, table)), in_axes=(0, None))
    return jnp.min(refine(rays[best], c), axis=0)


def _refined(table: Array, f: Float[Array, "3"], c: Float[Array, "15"]) -> Array:
    def half(carry, _):
        at, least = carry
        entries = jnp.einsum("epm,p,m->e", table, _products(at[None])[0], c)
        z = _eigenvector(entries, _least_eigenvalue(*entries))
        # of a double eigenvalue the cubic's root has but half the digits
        value = _products(z[None])[0] @ (entries * jnp.asarray([1.0, 1, 1, 2, 2, 2], c.dtype))
        return (z, jnp.minimum(least, value)), None

    return jax.lax.scan(half, (f, jnp.asarray(jnp.inf, c.dtype)), None, length=2 * ROUNDS)[0][1]


def _products(f: Float[Array, "n 3"]) -> Float[Array, "n 6"]:
    x, y, z = f[:, 0], f[:, 1], f[:, 2]
    return jnp.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=1)


def _least_eigenvalue(xx, yy, zz, xy, xz, yz):
    """Of a symmetric 3 x 3 matrix, by the trigonometric solution of its cubic."""
    mean = (xx + yy + zz) / 3
    a, b, d = xx - mean, yy - mean, zz - mean
    p = (a * a + b * b + d * d + 2 * (xy * xy + xz * xz + yz * yz)) / 6
    size = jnp.sqrt(jnp.maximum(p, jnp.finfo(p.dtype).tiny))
    det = a * (b * d - yz * yz) - xy * (xy * d - yz * xz) + xz * (xy * yz - b * xz)
    cubed = jnp.maximum(2 * size**3, jnp.finfo(p.dtype).tiny)  # of a multiple of the identity there is no angle
    angle = jnp.arccos(jnp.clip(det / cubed, -1, 1)) / 3
    return mean + 2 * size * jnp.cos(angle + 2 * np.pi / 3)


def _eigenvector(entries, value):
    """The longest cross product of two rows of the matrix less its eigenvalue."""
    xx, yy, zz, xy, xz, yz = entries
    m = jnp.array([[xx - value, xy, xz], [xy, yy - value, yz], [xz, yz, zz - value]])
    crosses = jnp.stack([jnp.cross(m[0], m[1]), jnp.cross(m[0], m[2]), jnp.cross(m[1], m[2])])
    squared = jnp.sum(crosses**2, axis=1)
    best = jnp.argmax(squared)
    tiny = squared[best] <= jnp.finfo(value.dtype).tiny
    return jnp.where(tiny, jnp.array([1.0, 0, 0]), crosses[best] / jnp.sqrt(jnp.where(tiny, 1.0, squared[best])))


def _hessian_table() -> np.ndarray:
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    products = [np.bincount(pair, minlength=3) for pair in pairs]
    table = np.zeros((6, 6, len(MONOMIALS)))
    for m, exponent in enumerate(MONOMIALS):
        for e, (i, j) in enumerate(pairs):
            left = exponent.copy()
            factor = left[i]
            left[i] -= 1
            factor *= left[j]
            if factor > 0:
                left[j] -= 1
                table[e, [tuple(p) for p in products].index(tuple(left)), m] = factor
    return table


_HESSIAN = _hessian_table()
