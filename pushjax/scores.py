"""How far a prediction is from what happened."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, positive


def deviation(pose_a: Numeric, pose_b: Numeric, length: Numeric) -> Float[Array, "*batch"]:
    """The paper's distance of two poses: |difference in position| + length * |smaller angle between them|.

    Shapes (..., 3) each, `length` in m (the paper uses the object's characteristic length); the result is in m.
    Its gradient at equal positions, where the distance has a corner, is zero.

    Source: Zhou et al. 2017, section VI.A.
    """
    positive("length", length)
    a, b = as_float(pose_a), as_float(pose_b)
    delta = a - b
    squared = delta[..., 0] ** 2 + delta[..., 1] ** 2
    zero = squared == 0
    distance = jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
    angle = jnp.abs(delta[..., 2]) % (2 * jnp.pi)
    return distance + as_float(length) * jnp.minimum(angle, 2 * jnp.pi - angle)
