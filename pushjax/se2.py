"""Planar rigid motions.

A pose (x, y, theta) places the body frame in the world: the world point of a body point p is (x, y) + R(theta) p.
A twist (vx, vy, omega) and a wrench (fx, fy, tau) are in the body frame about its origin, linear part first.
Angles are in rad and never wrapped. All functions take arrays whose last axis has length three (points: two) and
broadcast over the axes before it; other shapes raise ValueError.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype

Pose = Float[Array, "*batch 3"]
Twist = Float[Array, "*batch 3"]
Wrench = Float[Array, "*batch 3"]


def _parts(**named: Numeric) -> list[tuple[Array, ...]]:
    """Every argument's components along its last axis, in one dtype and broadcast over the axes before it."""
    dtype = common_dtype(*named.values())
    arrays = {name: as_float(value, dtype) for name, value in named.items()}
    for name, array in arrays.items():
        size = 2 if name == "point" else 3
        if array.ndim == 0 or array.shape[-1] != size:
            raise ValueError(f"{name} has shape {array.shape}; expected (..., {size})")
    try:
        batch = jnp.broadcast_shapes(*(array.shape[:-1] for array in arrays.values()))
    except ValueError:
        shapes = " and ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"{shapes} do not broadcast over the axes before the last") from None
    return [tuple(jnp.broadcast_to(a[..., k], batch) for k in range(a.shape[-1])) for a in arrays.values()]


def compose(pose: Numeric, relative: Numeric) -> Pose:
    """The pose of a frame that has pose `relative` in the frame `pose`. Shapes (..., 3), m and rad."""
    (x, y, theta), (dx, dy, dtheta) = _parts(pose=pose, relative=relative)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([x + c * dx - s * dy, y + s * dx + c * dy, theta + dtheta], axis=-1)


def inverse(pose: Numeric) -> Pose:
    """The pose of the world in the body frame: compose(pose, inverse(pose)) is zero. Shape (..., 3)."""
    ((x, y, theta),) = _parts(pose=pose)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([-c * x - s * y, s * x - c * y, -theta], axis=-1)


def transform(pose: Numeric, point: Numeric) -> Float[Array, "*batch 2"]:
    """World coordinates (..., 2) of body points (..., 2), m."""
    (x, y, theta), (px, py) = _parts(pose=pose, point=point)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([x + c * px - s * py, y + s * px + c * py], axis=-1)


def _sinc_pair(omega: Array) -> tuple[Array, Array]:
    """sin(w)/w and (1 - cos(w))/w, smooth through zero in value and derivative."""
    # Below this the series' next term is beyond rounding; above it, so is what the derivative of sin(w)/w cancels
    small = jnp.abs(omega) < (0.25 if jnp.finfo(omega.dtype).bits <= 32 else 0.03)
    safe = jnp.where(small, 1.0, omega)  # keeps the unused branch's derivative finite
    w2 = omega * omega
    a = jnp.where(small, 1 - w2 / 6 * (1 - w2 / 20 * (1 - w2 / 42 * (1 - w2 / 72))), jnp.sin(safe) / safe)
    # 2 sin(w/2)^2 / w does not cancel where 1 - cos(w) does
    b = jnp.where(small, omega / 2 * (1 - w2 / 12 * (1 - w2 / 30 * (1 - w2 / 56))), 2 * jnp.sin(safe / 2) ** 2 / safe)
    return a, b


def exp(twist: Numeric) -> Pose:
    """The relative pose reached by a constant body twist (..., 3) in unit time; the angle is not wrapped."""
    ((vx, vy, omega),) = _parts(twist=twist)
    a, b = _sinc_pair(omega)
    return jnp.stack([a * vx - b * vy, b * vx + a * vy, omega], axis=-1)


def log(relative: Numeric) -> Twist:
    """The body twist whose `exp` is `relative`; inverse of `exp` for |theta| < 2 pi (it is singular there)."""
    ((x, y, omega),) = _parts(relative=relative)
    a, b = _sinc_pair(omega)
    scale = 1.0 / (a * a + b * b)
    return jnp.stack([scale * (a * x + b * y), scale * (a * y - b * x), omega], axis=-1)


def transport_twist(relative: Numeric, twist: Numeric) -> Twist:
    """A twist given in frame B, expressed in frame A, where B has pose `relative` in A (the adjoint map)."""
    (x, y, theta), (vx, vy, omega) = _parts(relative=relative, twist=twist)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([c * vx - s * vy + y * omega, s * vx + c * vy - x * omega, omega], axis=-1)


def transport_wrench(relative: Numeric, wrench: Numeric) -> Wrench:
    """A wrench given in frame B, expressed in frame A, where B has pose `relative` in A.

    Power is the same in both frames: transport_twist(T, V) . transport_wrench(T, W) = V . W.
    """
    (x, y, theta), (fx, fy, tau) = _parts(relative=relative, wrench=wrench)
    c, s = jnp.cos(theta), jnp.sin(theta)
    gx, gy = c * fx - s * fy, s * fx + c * fy
    return jnp.stack([gx, gy, tau + x * gy - y * gx], axis=-1)
