"""Poses, twists and wrenches of planar rigid motions, SE(2).

A pose (x, y, theta) places the body frame in the world: the body point p is the world point (x, y) + R(theta) p.
A twist (vx, vy, omega) and a wrench (fx, fy, tau) are expressed in the body frame about its origin, linear part first.
Lengths are in m, forces in N. Angles are in rad and are never wrapped.

The last axis has length three, or two for points. All functions broadcast over the axes before it.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, common_dtype

Pose = Float[Array, "*batch 3"]
Twist = Float[Array, "*batch 3"]
Wrench = Float[Array, "*batch 3"]


def _components(**named: ArrayLike) -> list[tuple[Array, ...]]:
    """Split each argument into its components along the last axis, in one dtype and broadcast over the other axes."""
    dtype = common_dtype(*named.values())
    arrays = {name: as_float(value, dtype, name) for name, value in named.items()}
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


def compose(pose: ArrayLike, relative: ArrayLike) -> Pose:
    """Compose two poses: the world pose of a frame whose pose in the frame `pose` is `relative`.

    Args:
        pose: Pose of the first frame in the world, shape (..., 3), m and rad.
        relative: Pose of the second frame in the first, shape (..., 3), m and rad.

    Returns:
        Pose of the second frame in the world, shape (..., 3), m and rad. The angles are added and not wrapped.

    Raises:
        ValueError: If a last axis does not have length three, or the other axes do not broadcast.
    """
    (x, y, theta), (dx, dy, dtheta) = _components(pose=pose, relative=relative)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([x + c * dx - s * dy, y + s * dx + c * dy, theta + dtheta], axis=-1)


def inverse(pose: ArrayLike) -> Pose:
    """Invert a pose: the pose of the world in the body frame.

    Args:
        pose: Pose of the body in the world, shape (..., 3), m and rad.

    Returns:
        Pose of the world in the body frame, shape (..., 3): compose(pose, inverse(pose)) is zero.

    Raises:
        ValueError: If the last axis does not have length three.
    """
    ((x, y, theta),) = _components(pose=pose)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([-c * x - s * y, s * x - c * y, -theta], axis=-1)


def transform(pose: ArrayLike, point: ArrayLike) -> Float[Array, "*batch 2"]:
    """Transform body points to world coordinates.

    Args:
        pose: Pose of the body in the world, shape (..., 3), m and rad.
        point: Points in the body frame, shape (..., 2), m.

    Returns:
        The same points in the world frame, shape (..., 2), m.

    Raises:
        ValueError: If a last axis has another length, or the other axes do not broadcast.
    """
    (x, y, theta), (px, py) = _components(pose=pose, point=point)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([x + c * px - s * py, y + s * px + c * py], axis=-1)


def _sinc_pair(omega: Array) -> tuple[Array, Array]:
    """Return sin(w)/w and (1 - cos(w))/w for w = omega; values and derivatives are right through w = 0 too."""
    # Below the threshold, the first omitted term of the series is below roundoff. Above it, the cancellation in the
    # derivative of sin(w)/w costs less than 50 eps (absolute).
    small = jnp.abs(omega) < (0.25 if jnp.finfo(omega.dtype).bits <= 32 else 0.03)
    safe_omega = jnp.where(small, 1.0, omega)  # keeps the derivative of the unused branch finite
    squared = omega * omega
    sine_ratio = jnp.where(
        small,
        1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42 * (1 - squared / 72))),
        jnp.sin(safe_omega) / safe_omega,
    )
    # 2 sin(w/2)^2 / w avoids the cancellation in 1 - cos(w).
    cosine_ratio = jnp.where(
        small,
        omega / 2 * (1 - squared / 12 * (1 - squared / 30 * (1 - squared / 56))),
        2 * jnp.sin(safe_omega / 2) ** 2 / safe_omega,
    )
    return sine_ratio, cosine_ratio


def exp(twist: ArrayLike) -> Pose:
    """Exponential map: the relative pose that a constant body twist reaches in unit time.

    Args:
        twist: Body twist, shape (..., 3), m and rad per unit time.

    Returns:
        Relative pose, shape (..., 3), m and rad. The angle is not wrapped.

    Raises:
        ValueError: If the last axis does not have length three.
    """
    ((vx, vy, omega),) = _components(twist=twist)
    a, b = _sinc_pair(omega)
    return jnp.stack([a * vx - b * vy, b * vx + a * vy, omega], axis=-1)


def log(relative: ArrayLike) -> Twist:
    """Logarithmic map: the constant body twist that reaches `relative` in unit time.

    It is the inverse of `exp` for |theta| < 2 pi, and singular at |theta| = 2 pi.

    Args:
        relative: Relative pose, shape (..., 3), m and rad.

    Returns:
        Body twist whose `exp` is `relative`, shape (..., 3), m and rad per unit time.

    Raises:
        ValueError: If the last axis does not have length three.
    """
    ((x, y, omega),) = _components(relative=relative)
    a, b = _sinc_pair(omega)
    scale = 1.0 / (a * a + b * b)
    return jnp.stack([scale * (a * x + b * y), scale * (a * y - b * x), omega], axis=-1)


def transport_twist(relative: ArrayLike, twist: ArrayLike) -> Twist:
    """Express a twist given in frame B in frame A (the adjoint map).

    Args:
        relative: Pose of B in A, shape (..., 3), m and rad.
        twist: Twist in frame B about its origin, shape (..., 3), m and rad per unit time.

    Returns:
        The same twist in frame A about its origin, shape (..., 3), m and rad per unit time.

    Raises:
        ValueError: If a last axis does not have length three, or the other axes do not broadcast.
    """
    (x, y, theta), (vx, vy, omega) = _components(relative=relative, twist=twist)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([c * vx - s * vy + y * omega, s * vx + c * vy - x * omega, omega], axis=-1)


def transport_wrench(relative: ArrayLike, wrench: ArrayLike) -> Wrench:
    """Express a wrench given in frame B in frame A.

    Power is the same in both frames: transport_twist(T, V) . transport_wrench(T, W) = V . W.

    Args:
        relative: Pose of B in A, shape (..., 3), m and rad.
        wrench: Wrench in frame B about its origin, shape (..., 3), N and N m.

    Returns:
        The same wrench in frame A about its origin, shape (..., 3), N and N m.

    Raises:
        ValueError: If a last axis does not have length three, or the other axes do not broadcast.
    """
    (x, y, theta), (fx, fy, tau) = _components(relative=relative, wrench=wrench)
    c, s = jnp.cos(theta), jnp.sin(theta)
    fx_a, fy_a = c * fx - s * fy, s * fx + c * fy
    return jnp.stack([fx_a, fy_a, tau + x * fy_a - y * fx_a], axis=-1)
