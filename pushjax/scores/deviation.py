"""How far one pose is from another."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, positive


def deviation(pose_a: Numeric, pose_b: Numeric, length: Numeric) -> Float[Array, "*batch"]:
    """The paper's distance of two poses: |difference in position| + length * |smaller angle between them|.

    Shapes (..., 3) each, `length` in m (the paper uses the object's characteristic length); the result is in m.
    Its gradient at equal positions, where the distance has a corner, is zero; at equal angles likewise.

    Raises ValueError for poses of other shapes, or a length that is not positive and finite.

    Source: Zhou et al. 2017, section VI.A.

    >>> print(f"{1e3 * deviation((0.003, 0.004, 0.0), (0.0, 0.0, 0.1), length=0.05):.1f} mm")
    10.0 mm
    """
    finite("length", length)
    positive("length", length)
    dtype = common_dtype(pose_a, pose_b, length)
    a, b, scale = (as_float(value, dtype) for value in (pose_a, pose_b, length))
    for name, pose in (("pose_a", a), ("pose_b", b)):
        if pose.ndim == 0 or pose.shape[-1] != 3:
            raise ValueError(f"{name} has shape {pose.shape}; expected (..., 3)")
    shape = jnp.broadcast_shapes(a.shape, b.shape)
    delta = jnp.broadcast_to(a, shape) - jnp.broadcast_to(b, shape)
    squared = delta[..., 0] ** 2 + delta[..., 1] ** 2
    zero = squared == 0
    distance = jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
    # not abs, whose derivative at zero is one
    angle = delta[..., 2] * jnp.sign(delta[..., 2]) % (2 * jnp.pi)
    return distance + scale * jnp.minimum(angle, 2 * jnp.pi - angle)
