"""The fit itself: pushes and prior, as a sum of squares."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax.identify.minimise import least_squares
from pushjax.identify.model import Setup
from pushjax.identify.pushes import Pushes

MAX_STEPS = 60
EARLY = 0.01  # tolerance, while sigma is still looked for
TINY = 1e-6  # the prior of a friction, so that the precision has an inverse where no push tells of it
ROUNDS = 6
LEAST = 1e-6  # m, that sigma may be: less, nothing is measured


class Fit(NamedTuple):
    z: Float[Array, "size"]
    sigma: Float[Array, ""]
    precision: Float[Array, "size size"]
    residual: Float[Array, "conditions pushes 3"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def whitened(residual: Array, weight: Array, sigma: Array, robust: float | None) -> Array:
    """Residuals whose squares add up to the loss: pseudo-Huber's of each push's, from `robust` sigma on."""
    r = residual / sigma
    if robust is not None:
        squared = jnp.sum(r**2, axis=-1, keepdims=True)
        r = r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + squared / robust**2)))
    return r * jnp.sqrt(weight)[..., None]


def trust(residual: Array, weight: Array, sigma: Array, robust: float | None) -> Array:
    """How much a push counts in the end."""
    if robust is None:
        return weight
    squared = jnp.sum((residual / sigma) ** 2, axis=-1)
    return weight / jnp.sqrt(1 + squared / robust**2)


def fit(setup: Setup, pushes: Pushes, start: Array, sigma: Array, robust: float | None, known: bool = False) -> Fit:
    """The most probable z and, unless sigma is `known`, the size of what is left over: in turns."""
    flat = jnp.asarray(setup.prior.layout.flat_prior, start.dtype)
    tolerance = 1e-6 if start.dtype == jnp.float64 else 1e-4

    def round_(carry, tolerance):
        z, sigma, steps, _ = carry

        def loss(z):
            return whitened(setup.residuals(z, pushes), pushes.weight, sigma, robust), flat * z

        found = least_squares(loss, z, MAX_STEPS, tolerance)
        residual, precision, determined = around(setup, pushes, found.z, sigma, robust)
        count = trust(residual, pushes.weight, sigma, robust)
        left = jnp.sum(count[..., None] * residual**2)
        free = jnp.maximum(3 * jnp.sum(count) - determined, 3.0)
        fit = Fit(found.z, sigma, precision, residual, steps + found.steps, found.converged)
        return (found.z, jnp.maximum(jnp.sqrt(left / free), LEAST), fit.steps, found.converged), fit

    carry = (start, sigma, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    tolerances = [tolerance] if known else [*[EARLY] * (ROUNDS - 1), tolerance]
    _, fits = jax.lax.scan(round_, carry, jnp.asarray(tolerances, start.dtype))
    return jax.tree.map(lambda leaf: leaf[-1], fits)


def around(setup: Setup, pushes: Pushes, z: Array, sigma: Array, robust: float | None):
    """Residuals, the precision matrix of z, and how many numbers of it the pushes determine."""
    residual, slopes = setup.linearised(z, pushes)
    count = trust(residual, pushes.weight, sigma, robust)
    information = jnp.einsum("cn,cnri,cnrj->ij", count, slopes, slopes) / sigma**2
    flat = jnp.asarray(setup.prior.layout.flat_prior, z.dtype)
    precision = information + jnp.diag(jnp.maximum(flat, TINY))
    return residual, precision, jnp.trace(jnp.linalg.solve(precision, information))
