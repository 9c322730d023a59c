"""Friction cones, and the motion cones to which a limit surface maps them."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_shape, check_type, common_dtype
from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import entry_at
from pushjax.contact.contact_plane import Contact, LimitCurve
from pushjax.contact.problem import Contacts, contacts_in_columns
from pushjax.friction.limit_surface import LimitSurface


def friction_cone(normal: ArrayLike, friction: ArrayLike) -> Float[Array, "2 2"]:
    """Compute the unit directions of the left and right edge of a friction cone.

    The left edge is counterclockwise from the normal, the right edge clockwise.

    Args:
        normal: Unit normal into the slider, (2,), body frame.
        friction: Coefficient of friction mu.

    Returns:
        Unit force directions, (2, 2), body frame: the left edge, then the right edge.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, the normal is not of unit length or the friction is
            negative.
    """
    return _force_edges(_checked_contacts(np.zeros(2), normal, friction, common_dtype(normal, friction)))


def _first(contacts: Contacts) -> Contact:
    """Return the first contact."""
    return entry_at(contacts_in_columns(contacts, contacts.friction), 0)


@quick_jit
def _force_edges(contacts: Contacts) -> Float[Array, "2 2"]:
    """Return the edges of the friction cone of the first contact."""
    contact = _first(contacts)
    n, mu = contact.normal, contact.friction
    edges = jnp.stack([(n + n.perp().scale(ratio)).array() for ratio in (mu, -mu)])
    return edges / jnp.sqrt(jnp.sum(edges**2, axis=1, keepdims=True))


def motion_cone(surface: LimitSurface, point: ArrayLike, normal: ArrayLike, friction: ArrayLike) -> Float[Array, "2 2"]:
    """Compute the unit directions of the left and right edge of a motion cone.

    A force along the left edge of the friction cone moves the contact point along the left edge of the motion cone. The
    same holds for the right edges. A pusher that moves between the two edges sticks. An edge may be more than 90
    degrees from the normal.

    Args:
        surface: The slider's limit surface.
        point: Contact point, (2,), m, body frame.
        normal: Unit normal into the slider, (2,), body frame.
        friction: Coefficient of friction mu.

    Returns:
        Unit velocities of the contact point, (2, 2), body frame: the left edge, then the right edge.

    Raises:
        TypeError: For a surface of another type.
        ValueError: If a shape is wrong, a number is not finite, the normal is not of unit length or the friction is
            negative.

    Examples:
        >>> import numpy as np, pushjax as pj
        >>> surface = pj.Ellipsoid(np.eye(3), length=0.03)
        >>> print(np.asarray(motion_cone(surface, (0.02, -0.04), (0.0, 1.0), friction=0.25)).round(3))
        [[0.157 0.988]
         [0.689 0.725]]

    Reference: Mason 1986; Zhou et al. 2017, section IV.A.
    """
    check_type("surface", surface, LimitSurface)
    dtype = common_dtype(surface, point, normal, friction)
    return _motion_edges(surface, _checked_contacts(point, normal, friction, dtype))


@quick_jit
def _motion_edges(surface: LimitSurface, contacts: Contacts) -> Float[Array, "2 2"]:
    """Return the edges of the motion cone of the first contact."""
    contact = _first(contacts)
    curve = LimitCurve.of(surface.form(), contact)
    edges = []
    for ratio in (contact.friction, -contact.friction):
        motion = curve.motion(ratio)
        # Divided by the larger component first, because the squares below may underflow.
        motion = motion.scale(1 / jnp.maximum(jnp.abs(motion.x), jnp.abs(motion.y)))
        motion = motion.scale(1 / jnp.sqrt(motion.dot(motion)))
        edges.append((contact.normal.scale(motion.x) + contact.normal.perp().scale(motion.y)).array())
    return jnp.stack(edges)


def _checked_contacts(point: ArrayLike, normal: ArrayLike, friction: ArrayLike, dtype: Any) -> Contacts:
    """Check the arguments and make one contact with a pusher that does not move."""
    p, n = as_float(point, dtype, "point"), as_float(normal, dtype, "normal")
    mu = as_float(friction, dtype, "friction")
    check_shape("point", p, (2,))
    check_shape("normal", n, (2,))
    check_shape("friction", mu, ())
    return Contacts(p[None], n[None], np.zeros((1, 2), dtype), mu)
