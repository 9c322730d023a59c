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
KINDS = (3, 3, 1)  # numbers that a push tells by its poses, its pairs, its contact
CONTACT = 2  # which of them
LOST = 3.0  # sigma: where a gap is farther off, the finger is taken to have lost the slider, and counts for little


class Fit(NamedTuple):
    """sigma: (3,), of poses (m), of directions of motion, and of gaps (m). residual: (..., rows), of all. loss: the sum
    of squares."""

    z: Float[Array, "size"]
    sigma: Float[Array, "3"]
    precision: Float[Array, "size size"]
    residual: Float[Array, "conditions pushes rows"]
    information: Float[Array, "conditions pushes size"]
    loss: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class Held(NamedTuple):
    """Numbers of z that are not free: which (size,), and what they are."""

    which: Bool[Array, "size"]
    value: Float[Array, "size"]

    @staticmethod
    def none(start: Array) -> "Held":
        return Held(jnp.zeros(start.shape, bool), start)

    def on(self, z: Array) -> Array:
        return jnp.where(self.which, self.value, z)


class Counts(NamedTuple):
    """How much the poses of a push count, how much its pairs, and how much its contact."""

    poses: Float[Array, "conditions pushes"]
    pairs: Float[Array, "conditions pushes"]
    contact: Float[Array, "conditions pushes"]

    @staticmethod
    def of(pushes: Pushes) -> "Counts":
        pairs = jnp.where(jnp.any(pushes.paired, axis=-1), pushes.weight, 0.0)
        return Counts(pushes.weight, pairs, pushes.weight)


def _parts(residual: Array, pushes: Pushes) -> tuple[Array, Array, Array]:
    """Poses, pairs and contacts."""
    poses = 3 * len(pushes.rows)
    pairs = poses + 3 * pushes.wrench.shape[-2]
    return residual[..., :poses], residual[..., poses:pairs], residual[..., pairs:]


def whitened(residual: Array, pushes: Pushes, sigma: Array, robust: float | None) -> Array:
    """Residuals whose squares add up to the loss: pseudo-Huber's of each push's, from `robust` sigma on; of a gap that
    of Geman and McClure, which is bounded: a finger that has gone tells nothing."""
    whole = []
    for k, (r, weight) in enumerate(zip(_parts(residual, pushes), Counts.of(pushes), strict=True)):
        r = r / sigma[k]
        squared = jnp.sum(r**2, axis=-1, keepdims=True)
        if k == CONTACT:
            r = r / jnp.sqrt(1 + squared / LOST**2)
        elif robust is not None:
            r = r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + squared / robust**2)))
        whole.append(r * jnp.sqrt(weight)[..., None])
    return jnp.concatenate(whole, axis=-1)


def _trust(k: int, residual: Array, weight: Array, sigma: Array, robust: float | None) -> Array:
    """How much a push counts in the end."""
    squared = jnp.sum((residual / sigma) ** 2, axis=-1)
    if k == CONTACT:
        return weight / (1 + squared / LOST**2) ** 2
    return weight if robust is None else weight / jnp.sqrt(1 + squared / robust**2)


class Effort(NamedTuple):
    """rounds: how many turns of z and sigma, one where all of sigma is known. tolerance: of z, in the last."""

    rounds: Int[Array, ""]
    tolerance: Float[Array, ""]

    @staticmethod
    def of(dtype, rounds: int, tolerance: float | None = None) -> "Effort":
        """tolerance: what the type allows, if None."""
        least = 1e-6 if dtype == jnp.float64 else 1e-4
        return Effort(jnp.asarray(rounds), jnp.asarray(least if tolerance is None else tolerance, dtype))


def fit(
    setup: Setup, pushes: Pushes, start: Array, sigma: Array, robust: float | None, known: Array, held: Held, effort
) -> Fit:
    """The most probable z, but for what is `held`, and the size of what is left over, in turns. known: (2,), whether
    `sigma` is. effort: an `Effort`, may be traced."""
    flat = jnp.asarray(setup.prior.layout.flat_prior, start.dtype)
    rounds, last = effort

    def round_(index, before: Fit) -> Fit:
        sigma = before.sigma

        def loss(z):
            z = held.on(z)
            local = setup.local(z, pushes)
            return (whitened(setup.expanded(z, local), pushes, sigma, robust), flat * z), local

        tolerance = jnp.where(index < rounds - 1, EARLY, last).astype(start.dtype)
        found = least_squares(loss, before.z, MAX_STEPS, tolerance)
        z, residual = held.on(found.z), found.beside.value
        slopes = setup.slopes(z, found.beside)
        information, each, left = [], jnp.zeros_like(before.information), []
        parts = zip(
            _parts(residual, pushes), _parts(jnp.moveaxis(slopes, 3, 0), pushes), Counts.of(pushes), strict=True
        )
        for k, (r, slope, weight) in enumerate(parts):
            count = _trust(k, r, weight, sigma[k], robust)
            scaled = slope * (jnp.sqrt(count) / sigma[k])[None, ..., None]
            information.append(jnp.einsum("icnr,jcnr->ij", scaled, scaled))
            each = each + jnp.moveaxis(jnp.sum(scaled**2, axis=3), 0, 2)
            left.append((jnp.sum(count), jnp.sum(count[..., None] * r**2)))
        precision = sum(information) + jnp.diag(jnp.maximum(flat, TINY))
        # as many numbers as the pushes determine are no longer free to scatter. One solve for both: jaxlib's batched
        # ones wait for each other forever where two run at once (0.10.1, two cores)
        shares = jnp.linalg.solve(precision, jnp.concatenate(information, axis=1))
        again = [
            jnp.sqrt(squares / jnp.maximum(numbers * count - jnp.trace(share), 3.0))
            for numbers, share, (count, squares) in zip(KINDS, jnp.split(shares, len(KINDS), axis=1), left, strict=True)
        ]
        total = jnp.sum(whitened(residual, pushes, sigma, robust) ** 2) + jnp.sum((flat * z) ** 2)
        steps = before.steps + found.steps
        measured = jnp.where(known, sigma, jnp.maximum(jnp.stack(again), LEAST))
        # the last round's sigma is the one that it fitted with
        sigma = jnp.where(index < rounds - 1, measured, sigma)
        return Fit(z, sigma, precision, residual, each, total, steps, found.converged)

    many = pushes.weight.shape
    rows = 3 * len(pushes.rows) + 3 * pushes.wrench.shape[-2] + setup.touching
    size = len(start)
    precision, residual, information, loss = (
        jnp.zeros(shape, start.dtype) for shape in ((size, size), (*many, rows), (*many, size), ())
    )
    nothing, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    first = Fit(held.on(start), sigma, precision, residual, information, loss, nothing, no)
    return jax.lax.fori_loop(0, rounds, round_, first)
