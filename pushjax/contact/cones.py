"""Friction cones, and the motion cones to which a limit surface maps them."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_shape, check_type, common_dtype
from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import entry_at
from pushjax._math.vec import Vec2
from pushjax.contact.contact_plane import LimitCurve
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
    return _edges(None, _checked_contacts(np.zeros(2), normal, friction, common_dtype(normal, friction)))


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
    return _edges(surface, _checked_contacts(point, normal, friction, dtype))


@quick_jit
def _edges(surface: LimitSurface | None, contacts: Contacts) -> Float[Array, "2 2"]:
    """The edges of the motion cone of the first contact, or without a surface those of the friction cone."""
    contact = entry_at(contacts_in_columns(contacts, contacts.friction), 0)
    ratio = jnp.stack([contact.friction, -contact.friction])
    edges = Vec2(jnp.ones_like(ratio), ratio)  # (n, t) of both
    if surface is not None:
        edges = LimitCurve.of(surface.form(), contact).motion(ratio)
    # Divided by the larger component first, because the squares below may underflow.
    edges = edges.scale(1 / jnp.maximum(jnp.abs(edges.x), jnp.abs(edges.y)))
    edges = edges.scale(1 / jnp.sqrt(edges.dot(edges)))
    return jnp.stack(contact.normal.scale(edges.x) + contact.normal.perp().scale(edges.y), axis=1)


def _checked_contacts(point: ArrayLike, normal: ArrayLike, friction: ArrayLike, dtype: Any) -> Contacts:
    """Check the arguments and make one contact with a pusher that does not move."""
    p, n = as_float(point, dtype, "point"), as_float(normal, dtype, "normal")
    mu = as_float(friction, dtype, "friction")
    check_shape("point", p, (2,))
    check_shape("normal", n, (2,))
    check_shape("friction", mu, ())
    return Contacts(p[None], n[None], np.zeros((1, 2), dtype), mu)
