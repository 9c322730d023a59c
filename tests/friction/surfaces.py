"""Random limit surfaces of the tests, in batches of one size."""

import functools

import jax
import numpy as np

from pushjax import LimitSurface
from pushjax.testing.problems import random_surface

# Largest condition number of the Hessian. The inverse map stops at a residual of 32 roundings; this multiplies its
# effect on F.
CONDITION = 1e3
BATCH = 1000


@functools.cache
def _many(degree: int) -> LimitSurface:
    make = jax.jit(jax.vmap(lambda key: random_surface(key, degree=degree, condition=CONDITION, length=0.05)))
    return make(jax.random.split(jax.random.key(degree), BATCH))


def surfaces(degree: int, dtype=np.float64) -> LimitSurface:
    return jax.tree.map(lambda leaf: leaf.astype(dtype), _many(degree))


def one(batch: LimitSurface, k: int = 0) -> LimitSurface:
    return jax.tree.map(lambda leaf: leaf[k], batch)
