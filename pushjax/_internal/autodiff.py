"""A function call that automatic differentiation treats as a constant, and the matching rematerialization policy."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

SEARCH_RESULT = "found"


def without_derivatives(search: Callable, *args) -> Any:
    """Return `search(*args)` as a constant with respect to every derivative."""
    # `stop_gradient` on the arguments gives the same numbers. But JAX then still traces every loop of the search
    # several times, which took most of the time of tracing a gradient. `search` must not close over anything that is
    # differentiated.

    @eqx.filter_custom_jvp
    def opaque(args):
        return search(*args)

    @opaque.def_jvp
    def _(primals, tangents):
        out = opaque(*primals)
        zeros = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None, out)
        return out, zeros

    return search_result(jax.lax.stop_gradient(opaque(args)))


def search_result(values: Any) -> Any:
    """Return values that `save_search_results` saves."""
    return checkpoint_name(values, SEARCH_RESULT)


# Policy for `jax.checkpoint`: only the results of searches are saved, so that the backward pass recomputes everything
# else but does not search again.
save_search_results = jax.checkpoint_policies.save_only_these_names(SEARCH_RESULT)
