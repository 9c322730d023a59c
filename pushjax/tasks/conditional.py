"""A computation that only some examples of a batch need, differentiable."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool

from pushjax._internal.compaction import only_where
from pushjax._internal.xla import tree_where


def where_needed(needed: Bool[Array, ""], compute: Callable[..., Any], otherwise: Any, *args: Any) -> Any:
    """Return `compute(*args)` where `needed` holds, else `otherwise`.

    In a batch, `compute` runs only for the examples that need it. For derivatives it runs for all of them.

    Args:
        needed: Whether this example needs the computation.
        compute: Function of `args`. It must not close over anything that is batched or differentiated.
        otherwise: Result where `needed` is False, of the same structure as the result of `compute`.
        *args: Arguments of `compute`, pytrees of arrays.
    """

    @eqx.filter_custom_jvp
    def chosen(needed, otherwise, args):
        return only_where(needed, compute, otherwise, *args)

    @chosen.def_jvp
    def _(primals, tangents):
        return eqx.filter_jvp(
            lambda needed, otherwise, args: tree_where(needed, compute(*args), otherwise), primals, tangents
        )

    return chosen(needed, otherwise, args)
