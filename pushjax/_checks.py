"""Checks of what a caller passes in.

A value is checked where it is known. Inside `jit`, `vmap` or `grad` it may be a tracer; then shapes are still
checked, values are not, and what goes wrong shows up as a status. Every message says which argument, what was
given and what is allowed.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

from pushjax._programs import outermost

Numeric = ArrayLike | Sequence[Any]  # what a caller may give for an array: also lists and tuples of numbers


def concrete(value: Any) -> np.ndarray | None:
    """The value as a numpy array, or None while it is being traced."""
    if isinstance(value, Tracer):
        return None
    return np.asarray(value)


def as_float(value: Any, dtype: Any = None) -> jax.Array:
    """`value` as a floating array: its own floating dtype, else the default one (float32 unless x64 is on)."""
    array = value
    if not isinstance(value, jax.Array):
        held = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value))
        array = jnp.asarray(value) if held else np.asarray(value)
    if dtype is None:
        own = jnp.issubdtype(array.dtype, jnp.floating)
        dtype = jax.dtypes.canonicalize_dtype(array.dtype) if own else jnp.result_type(float)
    if isinstance(array, np.ndarray):
        return on_device(array.astype(dtype))
    return array.astype(dtype)


def on_device(array: np.ndarray) -> jax.Array:
    """`array` for JAX. By itself `jnp.asarray` would compile a program for every shape."""
    return jax.device_put(array) if outermost() else jnp.asarray(array)


def in_numpy(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function(np, *arrays)` by numpy where all arrays are known, which compiles nothing; else by `jax.numpy`. What is
    given by name is passed on as it is."""

    @functools.wraps(function)
    def call(*arrays: jax.Array, **static: Any) -> Any:
        known = [concrete(array) for array in arrays]
        if any(array is None for array in known):
            return function(jnp, *arrays, **static)
        dtype = jnp.result_type(*arrays)
        return jax.tree.map(lambda found: on_device(np.asarray(found, dtype)), function(np, *known, **static))

    return call


def common_dtype(*values: Any) -> Any:
    """The floating dtype in which a computation over `values` runs; Python numbers do not decide it."""
    # a numpy float64 counts as the widest float there is: float32, unless x64 is on
    dtypes = [jax.dtypes.canonicalize_dtype(v.dtype) for v in jax.tree.leaves(values) if hasattr(v, "dtype")]
    floats = [dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating)]
    return jnp.result_type(*floats) if floats else jnp.result_type(float)


def shaped(name: str, value: jax.Array, shape: tuple[int | str, ...]) -> None:
    """`value.shape` must match `shape`; a string stands for any length."""
    ok = value.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, value.shape, strict=False)
    )
    if not ok:
        wanted = "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name} has shape {value.shape}; expected {wanted}")


def instance(name: str, value: Any, *kinds: type) -> None:
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(f"{name}: expected a {wanted}; got a {type(value).__name__}")


def finite(name: str, value: Any) -> None:
    known = concrete(value)
    if known is not None and not np.all(np.isfinite(known)):
        bad = np.argwhere(~np.isfinite(np.atleast_1d(known)))
        raise ValueError(
            f"{name} must be finite; found {len(bad)} NaN or infinite value(s), "
            f"the first at index {tuple(bad[0].tolist())}"
        )


def positive(name: str, value: Any) -> None:
    known = concrete(value)
    if known is not None and not np.all(known > 0):
        raise ValueError(f"{name} must be positive; got {_brief(known)}")


def non_negative(name: str, value: Any) -> None:
    known = concrete(value)
    if known is not None and not np.all(known >= 0):
        raise ValueError(f"{name} must not be negative; got {_brief(known)}")


def weights_of(weights: Any, count: int, dtype: Any) -> jax.Array:
    """The argument `weights` as (count,) numbers, none negative and not all zero; ones for None."""
    value = as_float(np.ones(count) if weights is None else weights, dtype)
    shaped("weights", value, (count,))
    finite("weights", value)
    non_negative("weights", value)
    known = concrete(value)
    if known is not None and not known.any():
        raise ValueError("weights must not all be zero")
    return value


def _brief(value: np.ndarray) -> str:
    return f"{value.item():.6g}" if value.size == 1 else f"values from {np.nanmin(value)} to {np.nanmax(value)}"


def traced(tree: Any) -> bool:
    """Whether anything in `tree` is being traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
