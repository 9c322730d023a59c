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
    information: Float[Array, "conditions pushes size"]
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
        z, sigma, steps = carry

        def loss(z):
            local = setup.local(z, pushes)
            left = whitened(setup.expanded(z, local), pushes.weight, sigma, robust)
            return (left, flat * z), local

        found = least_squares(loss, z, MAX_STEPS, tolerance)
        residual, slopes, steps = found.beside.value, setup.slopes(found.z, found.beside), steps + found.steps
        count = trust(residual, pushes.weight, sigma, robust)
        information = jnp.einsum("cn,cnri,cnrj->ij", count, slopes, slopes) / sigma**2
        precision = information + jnp.diag(jnp.maximum(flat, TINY))
        each = count[..., None] * jnp.sum(slopes**2, axis=2) / sigma**2
        fit = Fit(found.z, sigma, precision, residual, each, steps, found.converged)
        # as many numbers as the pushes determine are no longer free to scatter
        determined = jnp.trace(jnp.linalg.solve(precision, information))
        free = jnp.maximum(3 * jnp.sum(count) - determined, 3.0)
        left = jnp.sqrt(jnp.sum(count[..., None] * residual**2) / free)
        return (found.z, jnp.maximum(left, LEAST), steps), fit

    tolerances = [tolerance] if known else [*[EARLY] * (ROUNDS - 1), tolerance]
    carry = (start, sigma, jnp.zeros((), jnp.int32))
    _, fits = jax.lax.scan(round_, carry, jnp.asarray(tolerances, start.dtype))
    return jax.tree.map(lambda leaf: leaf[-1], fits)
