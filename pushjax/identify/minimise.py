"""Sums of squares, made small."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int


class Minimum(NamedTuple):
    """beside: what the function gave beside its residuals, there."""

    z: Float[Array, "size"]
    beside: Any
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def least_squares(
    residuals: Callable[[Array], tuple[Any, Any]], start: Array, max_steps: int, tolerance: Any
) -> Minimum:
    """Levenberg and Marquardt's method. residuals: gives arrays, whose squares are added up, and whatever it likes.

    Steps grow tenfold where three quarters of what was promised is reached: the library's own choice, nearly all of it,
    is for smooth functions; where contacts change their mode it keeps them small, and takes up to half as many again.
    """
    solver = eqx.tree_at(
        lambda s: s.search,
        optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance),
        optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=10.0),
    )
    found = optx.least_squares(lambda z, _: residuals(z), solver, start, has_aux=True, max_steps=max_steps, throw=False)
    return Minimum(found.value, found.aux, found.stats["num_steps"], found.result == optx.RESULTS.successful)
