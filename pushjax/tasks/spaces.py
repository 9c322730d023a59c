"""Spaces of actions and observations, with the interface of gymnax: `shape`, `dtype`, `sample` and `contains`."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray


class Box(NamedTuple):
    """Arrays whose entries lie between bounds.

    Attributes:
        low: Lower bounds, a number or an array that broadcasts to `shape`.
        high: Upper bounds, likewise.
        shape: Shape of the arrays.
        dtype: Dtype of the arrays.
    """

    low: Any
    high: Any
    shape: tuple[int, ...]
    dtype: Any = np.float32

    def sample(self, key: PRNGKeyArray) -> Array:
        """Draw an array uniformly from the box; integers may take the value of the upper bound, too."""
        if jnp.issubdtype(self.dtype, jnp.integer):
            return jax.random.randint(key, self.shape, self.low, np.asarray(self.high, np.int32) + 1, np.int32).astype(
                self.dtype
            )
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: Any) -> Bool[Array, ""]:
        """Whether `x` has the shape of the box and lies in it."""
        value = jnp.asarray(x)
        if value.shape != tuple(self.shape):
            return jnp.zeros((), bool)
        return jnp.all((value >= jnp.asarray(self.low)) & (value <= jnp.asarray(self.high)))


class Dict(NamedTuple):
    """Dictionaries of arrays.

    Attributes:
        spaces: The space of each entry, by its name.
    """

    spaces: Mapping[str, Box]

    def sample(self, key: PRNGKeyArray) -> dict[str, Array]:
        """Draw a dictionary, each entry from its space."""
        keys = jax.random.split(key, len(self.spaces))
        return {name: space.sample(k) for k, (name, space) in zip(keys, self.spaces.items(), strict=True)}

    def contains(self, x: Mapping[str, Any]) -> Bool[Array, ""]:
        """Whether `x` has the names of the space, and each entry lies in its space."""
        if set(x) != set(self.spaces):
            return jnp.zeros((), bool)
        return jnp.all(jnp.stack([space.contains(x[name]) for name, space in self.spaces.items()]))


Space = Box | Dict
