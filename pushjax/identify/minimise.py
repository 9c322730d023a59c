"""Sums of squares, made small."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int


class Minimum(NamedTuple):
    """beside: what the function gave beside its residuals, there."""

    z: Float[Array, "size"]
    beside: Any
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _LevenbergMarquardt(optx.LevenbergMarquardt):
    """Ends also where a step failed and the next would be within the tolerance, as MINPACK's does: at a change of
    contact mode, and where rounding hides how much better a step is, none is accepted any more.

    Steps grow tenfold where three quarters of what was promised is reached: the library's own choice, nearly all of it,
    is for smooth functions; where contacts change their mode it keeps them small, and takes up to half as many again.
    """

    def __init__(self, tolerance: Any):
        super().__init__(rtol=tolerance, atol=tolerance)
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=10.0)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        state = super().init(fn, y, args, options, f_struct, aux_struct, tags)
        # otherwise of JAX's default type, also where y is float32 and float64 enabled
        return eqx.tree_at(lambda s: s.search_state.step_size, state, jnp.ones((), y.dtype))

    def terminate(self, fn, y, args, options, state, tags):
        ends, result = super().terminate(fn, y, args, options, state, tags)
        within = self.norm((state.y_eval - y) / (self.atol + self.rtol * jnp.abs(y))) < 1
        return ends | (within & (state.num_steps_since_acceptance > 0)), result


def least_squares(
    residuals: Callable[[Array], tuple[Any, Any]], start: Array, max_steps: int, tolerance: Any
) -> Minimum:
    """Levenberg and Marquardt's method. residuals: gives arrays, whose squares are added up, and whatever it likes."""
    solver = _LevenbergMarquardt(tolerance)
    found = optx.least_squares(lambda z, _: residuals(z), solver, start, has_aux=True, max_steps=max_steps, throw=False)
    return Minimum(found.value, found.aux, found.stats["num_steps"], found.result == optx.RESULTS.successful)
