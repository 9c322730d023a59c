"""The root of a function of one variable, in a bracket."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._math.vec import Scalar


class Proposal(NamedTuple):
    """The next point of a search for a root, as the function at the current point proposes it."""

    is_above: Bool[Array, ""]  # whether the root lies above the current point
    next: Scalar  # by Newton's method for example
    usable: Bool[Array, ""] | bool  # whether `next` may be taken; if not, the bracket is halved
    # Whether the step to `next` is so small that it may leave the bracket, as it can by roundoff after convergence.
    is_tiny: Bool[Array, ""]


def bracketed_root(
    propose: Callable[[Scalar], Proposal], start: Scalar, low: Scalar, high: Scalar, iterations: int
) -> Scalar:
    """Return a root in a bracket after a fixed number of proposed steps, with bisection as the safeguard."""
    # JAX would differentiate the iterations, so callers use `stop_gradient`.

    def iterate(_, carry):
        point, low, high = carry
        proposal = propose(point)
        low, high = jnp.where(proposal.is_above, point, low), jnp.where(proposal.is_above, high, point)
        accepted = proposal.usable & (((proposal.next >= low) & (proposal.next <= high)) | proposal.is_tiny)
        return jnp.where(accepted, proposal.next, (low + high) / 2), low, high

    return jax.lax.fori_loop(0, iterations, iterate, (start, low, high))[0]
