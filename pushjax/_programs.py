"""What is compiled, and how: quickly where it is called by itself, for speed where it is part of a user's program."""

import functools
import gc
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # JAX up to 0.9
    from jax.core import get_opaque_trace_state  # pyright: ignore[reportAttributeAccessIssue]

P = ParamSpec("P")
R = TypeVar("R")

MANY = 50_000  # objects that a call has made, from which on it has traced something
ASIDE = gc.get_freeze_count()  # of the interpreter's own


# XLA's fusion emitters are gone from later versions, which end with an error on an option that they do not know.
HAS_EMITTERS = jax.__version_info__ < (0, 11)
# A program that is called by itself runs once or a few times, on one example, for milliseconds: compiling it is all
# that is waited for. Not level 0: one in a hundred solves then does not converge, without fusion emitters.
QUICK: dict[str, str | bool | int] = {"xla_backend_optimization_level": 1}
if HAS_EMITTERS:
    QUICK["xla_cpu_use_fusion_emitters"] = False
OUTERMOST = get_opaque_trace_state()


def outermost() -> bool:
    """Whether nothing is being traced: no `jit`, `grad` or `vmap` is around the caller."""
    return get_opaque_trace_state() == OUTERMOST


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`function` as a compiled program, of which everything that is not an array is a constant (`equinox.filter_jit`);
    traced as `uncollected` says."""
    return uncollected(eqx.filter_jit(function))


def quickly_compiled(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`; but called by itself, it is compiled with the options `QUICK`, in a third of the time (JAX up to
    0.10) for a program that takes up to twice as long.

    Within `jit` it is part of that program, and compiled as its caller wants it; so it is within `grad` and `vmap`,
    where batches may be large.
    """
    quick = eqx.filter_jit(function, compiler_options=QUICK)  # pyright: ignore[reportCallIssue]
    thorough = eqx.filter_jit(function)

    @functools.wraps(function, updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return (quick if outermost() else thorough)(*args, **kwargs)

    return uncollected(call)


def uncollected(function: Callable[P, R]) -> Callable[P, R]:
    """`function` without Python's garbage collector.

    The first call of a program traces it, and then again for each `vmap` and `grad` around it, which makes objects by
    the million, nearly all of which stay. The collector looks through them every few hundred, finds nothing, and took
    up to half of the time of tracing. So it pauses for the call, in all threads; and what has been traced counts as old
    afterwards, as it would had the collector run, or it would look through all of that three times more. A call that
    traces nothing leaves no trace in the collector either: garbage is found as soon as without it.
    """

    @functools.wraps(function, updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not gc.isenabled():  # paused by an outer program, or off altogether
            return function(*args, **kwargs)
        try:  # everything in it: an interrupt may come between any two lines
            gc.disable()
            return function(*args, **kwargs)
        finally:
            try:
                _age()
            finally:
                gc.enable()

    return call


def _age() -> None:
    """All objects count as old from now on, if there are many new ones."""
    if gc.get_count()[0] < MANY or gc.get_freeze_count() > ASIDE:  # who has put objects aside wants them to stay there
        return
    try:
        gc.freeze()
    finally:
        gc.unfreeze()  # gives everything back as old
