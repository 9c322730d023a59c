"""Checks of arguments, their conversion to arrays, and warnings.

A value is checked if it is known. Of a tracer (inside `jit`, `vmap` or `grad`) only the shape is checked, and a status
reports an invalid value. Every message names the argument, the given value and the allowed values.
"""

import functools
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike as SingleArrayLike
from typing_extensions import TypeAliasType

from pushjax._internal.jit import outside_trace

OWN_PACKAGES = ("pushjax.", "equinox.")  # equinox makes the instances of our classes
# Accepted in place of an array: also lists and tuples of numbers. `help` shows the name instead of a long union.
ArrayLike = TypeAliasType("ArrayLike", SingleArrayLike | Sequence[Any])


def concrete(value: Any) -> np.ndarray | None:
    """Return `value` as a NumPy array, or None if it is a tracer."""
    if isinstance(value, Tracer):
        return None
    return np.asarray(value)


def as_float(value: Any, dtype: Any = None, name: str = "argument") -> jax.Array:
    """Return `value` (array, number, nested sequence) as a floating array; TypeError unless it holds real numbers."""
    array = value
    if not isinstance(value, jax.Array):
        holds_jax_arrays = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value))
        try:
            array = jnp.asarray(value) if holds_jax_arrays else np.asarray(value)
        except ValueError as error:
            raise ValueError(f"{name}: expected an array of numbers; got rows that differ: {error}") from None
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating)):
        raise TypeError(f"{name}: expected real numbers; got {value!r}")
    if jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize < 4:
        raise TypeError(f"{name}: expected float32 or float64; got {array.dtype}, which is too coarse for contacts")
    # By default the result has the value's own dtype if that is floating, else the default one (float32 without x64).
    if dtype is None:
        is_floating = jnp.issubdtype(array.dtype, jnp.floating)
        dtype = jax.dtypes.canonicalize_dtype(array.dtype) if is_floating else jnp.result_type(float)
    if isinstance(array, np.ndarray):
        return on_device(array.astype(dtype))
    return array.astype(dtype)


def on_device(array: np.ndarray) -> jax.Array:
    """Return `array` as a JAX array without compiling anything."""
    # outside of a trace `jnp.asarray` would compile a program for every shape
    return jax.device_put(array) if outside_trace() else jnp.asarray(array)


def in_numpy(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that evaluates `function` with NumPy if all arrays are known, else with `jax.numpy`."""

    # Called as `function(np, *arrays)` or `function(jnp, *arrays)`, with the keyword arguments unchanged. NumPy
    # compiles nothing. Its results are cast to the common dtype of the arrays.
    @functools.wraps(function)
    def call(*arrays: jax.Array, **static: Any) -> Any:
        known = [concrete(array) for array in arrays]
        if any(array is None for array in known):
            return function(jnp, *arrays, **static)
        dtype = jnp.result_type(*arrays)
        return jax.tree.map(lambda entry: on_device(np.asarray(entry, dtype)), function(np, *known, **static))

    return call


def common_dtype(*values: Any) -> Any:
    """Return the floating dtype of a computation over `values`; Python numbers do not affect it."""
    # a NumPy float64 counts as the widest float that is enabled: float32, unless x64 is enabled
    dtypes = [jax.dtypes.canonicalize_dtype(v.dtype) for v in jax.tree.leaves(values) if hasattr(v, "dtype")]
    floats = [dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating)]
    return jnp.result_type(*floats) if floats else jnp.result_type(float)


def check_shape(name: str, value: jax.Array, shape: tuple[int | str, ...]) -> None:
    """Raise ValueError unless `value.shape` matches `shape`, in which a string stands for any length."""
    ok = value.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, value.shape, strict=False)
    )
    if not ok:
        wanted = "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name} has shape {value.shape}; expected {wanted}")


def check_key(key: Any) -> None:
    """Raise TypeError unless `key` is an array, as a PRNG key is."""
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise TypeError(f"key: expected a PRNG key, of jax.random.key or PRNGKey; got {key!r}")


def check_count(name: str, value: Any) -> None:
    """Raise ValueError unless `value` is a whole number of at least one."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{name} must be a whole number, at least 1; got {value!r}")


def check_type(name: str, value: Any, *kinds: type) -> None:
    """Raise TypeError unless `value` is an instance of one of `kinds`."""
    if not isinstance(value, kinds):
        *wanted, given = (kind.__name__ for kind in (*kinds, type(value)))
        if given in wanted:  # a class of the same name in another package
            *wanted, given = (f"{kind.__module__}.{kind.__name__}" for kind in (*kinds, type(value)))
        raise TypeError(f"{name}: expected a {' or '.join(wanted)}; got a {given}")


def check_finite(name: str, value: Any) -> None:
    """Raise ValueError if `value` is known and has an entry that is NaN or infinite."""
    known = concrete(value)
    if known is not None and not np.all(np.isfinite(known)):
        bad = np.argwhere(~np.isfinite(np.atleast_1d(known)))
        raise ValueError(
            f"{name} must be finite; found {len(bad)} NaN or infinite value(s), "
            f"the first at index {tuple(bad[0].tolist())}"
        )


def check_positive(name: str, value: Any) -> None:
    """Raise ValueError if `value` is known and has an entry that is not positive."""
    _check_sign(name, value, lambda known: known > 0, "must be positive")


def check_non_negative(name: str, value: Any) -> None:
    """Raise ValueError if `value` is known and has an entry that is negative or NaN."""
    _check_sign(name, value, lambda known: known >= 0, "must not be negative")


def checked_array(
    name: str,
    value: Any,
    shape: tuple[int | str, ...],
    dtype: Any = None,
    *,
    positive: bool = False,
    non_negative: bool = False,
) -> jax.Array:
    """Return `value` as a floating array, after checks of its shape, of finite entries and of their sign."""
    array = as_float(value, dtype, name)
    check_shape(name, array, shape)
    check_finite(name, array)
    if positive:
        check_positive(name, array)
    if non_negative:
        check_non_negative(name, array)
    return array


def checked_weights(weights: Any, count: int, dtype: Any) -> jax.Array:
    """Return `weights` (None: ones) as (count,) non-negative numbers, not all zero and not normalized."""
    value = checked_array("weights", np.ones(count) if weights is None else weights, (count,), dtype, non_negative=True)
    known = concrete(value)
    if known is not None and not known.any():
        raise ValueError("weights must not all be zero")
    return value


def _check_sign(name: str, value: Any, is_right: Callable[[np.ndarray], Any], rule: str) -> None:
    """Raise ValueError, with the number or the range of the numbers, if `value` is known and breaks a rule."""
    known = concrete(value)
    if known is not None and not np.all(is_right(known)):
        got = f"{known.item():.6g}" if known.size == 1 else f"values from {np.nanmin(known)} to {np.nanmax(known)}"
        raise ValueError(f"{name} {rule}; got {got}")


def traced(tree: Any) -> bool:
    """Return whether any leaf of `tree` is a tracer."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def warn(message: str) -> None:
    """Show a UserWarning at the line of code outside the package that made the call."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(OWN_PACKAGES):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, UserWarning, stacklevel=level)
