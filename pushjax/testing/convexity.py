"""Check of the convexity of quartics by a sweep of the Hessian, without the certificates that it tests."""

from functools import partial
from typing import Any

import jax
import jax.experimental
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._math.directions import fibonacci_hemisphere
from pushjax.testing.batch import HESSIANS, UPPER

# Number of directions F, on the half sphere, at which the Hessian is evaluated; how many of them are refined; and the
# rounds of refinement.
DIRECTIONS, REFINED, ROUNDS = 200, 4, 12
# (entry of the Hessian, product of two coordinates of F, coefficient of the quartic)
HESSIAN_TABLE = np.stack([HESSIANS[:, i, j].T for i, j in UPPER])
BATCH = 20_000  # quartics that are checked at once, to bound the memory


def least_curvatures(coefficients: np.ndarray) -> np.ndarray:
    """Return the smallest curvature that a search finds: the minimum of z' hess H(F) z over unit F and z.

    But for roundoff, the result is never below the true minimum. The search evaluates the Hessian in 200 directions F.
    From the four lowest, it improves F and z in turns: z becomes the eigenvector of the smallest eigenvalue of the
    Hessian at F, then F likewise at z (the form is symmetric in F and z). Each step can only lower the value. The
    computation is in float64.

    Args:
        coefficients: Coefficients (n, 15) in the order of `Quartic`.

    Returns:
        The smallest curvatures, (n,), each divided by the largest |coefficient| of its quartic.
    """
    array = np.asarray(coefficients, np.float64)
    found = []
    for begin in range(0, len(array), BATCH):
        chunk = array[begin : begin + BATCH]
        # the last chunk is padded, so that one compiled program serves all chunks
        padded = (
            np.concatenate([chunk, np.repeat(chunk[-1:], BATCH - len(chunk), axis=0)]) if len(array) > BATCH else chunk
        )
        with _float64():
            found.append(np.asarray(_sweep(jnp.asarray(padded)))[: len(chunk)])
    return np.concatenate(found)


def _float64() -> Any:
    """Return a context that enables 64-bit floats, in newer and older versions of JAX."""
    where: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    return where.enable_x64(True)


@jax.jit
def _sweep(c: Float[Array, "n 15"]) -> Float[Array, "n"]:
    """Return the smallest curvature of each quartic; see `least_curvatures`."""
    c = c / jnp.max(jnp.abs(c), axis=1, keepdims=True)
    directions = jnp.asarray(fibonacci_hemisphere(DIRECTIONS), c.dtype)
    table = jnp.asarray(HESSIAN_TABLE, c.dtype)
    hessians = jnp.einsum("epm,rp,nm->ern", table, _products(directions), c)
    lowest = _least_eigenvalue(*hessians)
    best = jax.lax.top_k(-lowest.T, REFINED)[1].T  # (refined, n)
    refine = jax.vmap(jax.vmap(partial(_refined, table)), in_axes=(0, None))
    return jnp.min(refine(directions[best], c), axis=0)


def _refined(table: Array, f: Float[Array, "3"], c: Float[Array, "15"]) -> Array:
    """Return the smallest curvature of the quartic `c` that alternating eigenvectors reach from the direction `f`."""

    def half_step(carry, _):
        direction, lowest = carry
        entries = jnp.einsum("epm,p,m->e", table, _products(direction[None])[0], c)
        z = _eigenvector(entries, _least_eigenvalue(*entries))
        # At a double eigenvalue the root of the cubic has only half of the digits, so take the value at z.
        value = _products(z[None])[0] @ (entries * jnp.asarray([1.0, 1, 1, 2, 2, 2], c.dtype))
        return (z, jnp.minimum(lowest, value)), None

    return jax.lax.scan(half_step, (f, jnp.asarray(jnp.inf, c.dtype)), None, length=2 * ROUNDS)[0][1]


def _products(f: Float[Array, "n 3"]) -> Float[Array, "n 6"]:
    """Return the products xx, yy, zz, xy, xz, yz of the coordinates of each vector."""
    x, y, z = f[:, 0], f[:, 1], f[:, 2]
    return jnp.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=1)


def _least_eigenvalue(xx, yy, zz, xy, xz, yz):
    """Return the smallest eigenvalue of a symmetric 3 x 3 matrix, by the trigonometric solution of its cubic."""
    mean = (xx + yy + zz) / 3
    a, b, d = xx - mean, yy - mean, zz - mean
    p = (a * a + b * b + d * d + 2 * (xy * xy + xz * xz + yz * yz)) / 6
    size = jnp.sqrt(jnp.maximum(p, jnp.finfo(p.dtype).tiny))
    det = a * (b * d - yz * yz) - xy * (xy * d - yz * xz) + xz * (xy * yz - b * xz)
    cubed = jnp.maximum(2 * size**3, jnp.finfo(p.dtype).tiny)  # a multiple of the identity has no angle
    angle = jnp.arccos(jnp.clip(det / cubed, -1, 1)) / 3
    return mean + 2 * size * jnp.cos(angle + 2 * np.pi / 3)


def _eigenvector(entries, value):
    """Return the unit eigenvector of an eigenvalue of a symmetric 3 x 3 matrix."""
    xx, yy, zz, xy, xz, yz = entries
    m = jnp.array([[xx - value, xy, xz], [xy, yy - value, yz], [xz, yz, zz - value]])
    # It is the longest cross product of two rows of m.
    crosses = jnp.stack([jnp.cross(m[0], m[1]), jnp.cross(m[0], m[2]), jnp.cross(m[1], m[2])])
    squared = jnp.sum(crosses**2, axis=1)
    best = jnp.argmax(squared)
    tiny = squared[best] <= jnp.finfo(value.dtype).tiny
    return jnp.where(tiny, jnp.array([1.0, 0, 0]), crosses[best] / jnp.sqrt(jnp.where(tiny, 1.0, squared[best])))
