"""Compilation of the library's functions, without Python's garbage collector and with short compile times.

A function that is called by itself can be compiled for a short compile time (`quick_jit`). A function that is part of a
user's program is compiled for a short run time.
"""

import functools
import gc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # JAX up to 0.9
    from jax.core import get_opaque_trace_state  # pyright: ignore[reportAttributeAccessIssue]

try:
    from jax import enable_x64
except ImportError:  # JAX up to 0.7
    from jax.experimental import enable_x64  # pyright: ignore[reportAttributeAccessIssue]

P = ParamSpec("P")
R = TypeVar("R")

# A program that is called by itself runs once or a few times, on one example, for milliseconds, so the user waits only
# for its compilation. Level 0 is not an option: without fusion emitters, one solve in a hundred then does not converge.
QUICK_OPTIONS: dict[str, str | bool | int] = {"xla_backend_optimization_level": 1}
if jax.__version_info__ < (0, 11):  # later versions have no fusion emitters, and reject options that they do not know
    QUICK_OPTIONS["xla_cpu_use_fusion_emitters"] = False
with ThreadPoolExecutor(1) as thread:  # this module may be imported within a trace, but a new thread has none
    NO_TRACE = thread.submit(get_opaque_trace_state).result()


def outside_trace() -> bool:
    """Return whether the caller is not inside `jit`, `grad` or `vmap`."""
    return get_opaque_trace_state() == NO_TRACE


def is_staging() -> bool:
    """Return whether the caller becomes part of a program: inside `jit`, `checkpoint`, `eval_shape`, a loop of JAX."""
    return isinstance(jnp.zeros(()), Tracer)


def eager_context() -> AbstractContextManager[Any]:
    """Return a context in which arrays are computed at once, also while a program is being traced."""
    # Outside of a trace they are anyway. There JAX's own context would only compute one by one the constants of each
    # function that is compiled, which took a third of the time of the default parameters of a task.
    return nullcontext() if outside_trace() else jax.ensure_compile_time_eval()


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with `equinox.filter_jit`, and trace it without the garbage collector (`without_gc`)."""
    # every argument that is not an array is a constant of the program
    return without_gc(eqx.filter_jit(function))


def quick_jit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` as `jit` does, but with `QUICK_OPTIONS` when it is called by itself."""
    # With these options compilation takes a third of the time (JAX up to 0.10), and the program takes up to twice as
    # long to run. Inside `jit` the function is compiled with the options of the surrounding program. Inside `grad` and
    # `vmap` it is compiled with the default options, because batches may be large.
    quick = eqx.filter_jit(function, compiler_options=QUICK_OPTIONS)  # pyright: ignore[reportCallIssue]
    thorough = eqx.filter_jit(function)

    @functools.wraps(function, updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return (quick if outside_trace() else thorough)(*args, **kwargs)

    return without_gc(call)


def with_own_floats(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function` for another thread, where it computes with the caller's choice of float64 or float32."""
    # `jax.enable_x64` holds for one thread: another one has the default, and would mix the types of both
    x64 = jnp.zeros(()).dtype == jnp.float64

    @functools.wraps(function, updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with enable_x64(x64):
            return function(*args, **kwargs)

    return call


def without_gc(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function` with Python's garbage collector disabled, in all threads, during its calls."""

    # The first call of a program traces it, and traces it again for each surrounding `vmap` and `grad`. That creates
    # millions of objects, nearly all of which stay. The collector would scan them at every few hundred new objects and
    # find nothing; it took up to half of the time of tracing.
    @functools.wraps(function, updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not gc.isenabled():  # disabled by an outer call, or by the user
            return function(*args, **kwargs)
        try:  # all of it is inside `try`, because an interrupt may come between any two lines
            gc.disable()
            return function(*args, **kwargs)
        finally:
            gc.enable()

    return call
