"""What is compiled, and kept compiled."""

import functools
import gc
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`function` as a compiled program, of which everything that is not an array is a constant (`equinox.filter_jit`);
    traced as `uncollected` says."""
    return uncollected(eqx.filter_jit(function))


def uncollected(function: Callable[P, R]) -> Callable[P, R]:
    """`function` without Python's garbage collector.

    The first call of a program traces it, and then again for each `vmap` and `grad` around it, which makes objects by
    the million, nearly all of which stay. The collector looks through them every few hundred, finds nothing, and took
    up to half of the time of tracing. So it pauses for the call; and what has been made counts as old afterwards, as it
    would had the collector run, or it would look through all of that three times more.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not gc.isenabled():  # paused by an outer program, or off altogether
            return function(*args, **kwargs)
        gc.disable()
        try:
            return function(*args, **kwargs)
        finally:
            if not gc.get_freeze_count():  # else someone has put objects aside, and wants them to stay there
                gc.freeze()
                gc.unfreeze()  # gives everything back as old
            gc.enable()

    return call
