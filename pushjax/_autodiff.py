"""Searches kept from automatic differentiation."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

FOUND = "found"


def undifferentiated(search: Callable, *args) -> Any:
    """`search(*args)`, constant to every derivative.

    `stop_gradient` on the arguments gives the same numbers, but differentiation still walks through every loop of the
    search, several times over: most of the time a gradient took to trace. `search` must not close over anything that
    is differentiated.
    """

    @eqx.filter_custom_jvp
    def opaque(args):
        return search(*args)

    @opaque.def_jvp
    def _(primals, tangents):
        out = opaque(*primals)
        zeros = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None, out)
        return out, zeros

    return checkpoint_name(jax.lax.stop_gradient(opaque(args)), FOUND)


# What reverse mode keeps of a step, instead of searching again on the way back.
keep_found = jax.checkpoint_policies.save_only_these_names(FOUND)
