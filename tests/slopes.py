"""Derivatives of a function in both modes, in one program."""

from typing import Any

import equinox as eqx
import jax


def slopes(function, at, along, weights) -> tuple[Any, Any, Any, Any]:
    """Return values, what else `function` returns, the derivative along `along`, and that of the weighted values.

    The last has the structure of `at`. One program with both modes compiles faster than one for each.
    """
    floats, rest = eqx.partition(at, eqx.is_inexact_array)
    value, push, other = jax.linearize(lambda x: function(eqx.combine(x, rest)), floats, has_aux=True)
    return value, other, push(along), jax.linear_transpose(push, floats)(weights)[0]
