"""One frictional contact: separated, sticking or sliding, and the twist that goes with it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._vec import Scalar, Vec2, Vec3, select, settle
from pushjax.limit_surface import Form
from pushjax.solve._contact_plane import Contact, LimitCurve
from pushjax.solve.sticking import StickingSolver, tolerance
from pushjax.status import ContactMode, Status


class SingleMotion(NamedTuple):
    """The answer to one contact, in scalars. twist: (m, m, rad); wrench: normalised, on H = 1; force: (n, t), N."""

    twist: Vec3
    wrench: Vec3
    force: Vec2
    mode: Int[Array, ""]
    status: Int[Array, ""]
    unique: Bool[Array, ""]


def solve_single(form: Form, contact: Contact, solver: StickingSolver) -> SingleMotion:
    """Map the pusher's displacement at one contact to the slider's twist (Zhou et al. 2017, section IV.A).

    The contact point follows the pusher along the normal exactly; along the tangent exactly where it sticks, else
    along the motion cone's edge. That part of the twist is never computed from the surface, so a sticking contact
    has zero slip to rounding; only the rotation is.

    The sliding scale v_n / motion_n needs no guard against a small motion_n: sliding left means
    motion_n v_t > motion_t v_n, so it stays below v_t / motion_t.
    """
    known, contact = _known(contact)
    # The motion does not depend on the scale of H, but squares of it over- or underflow in float32: compute with h
    # divided by its own size, a constant to the derivatives too.
    curve = LimitCurve.of(form, contact)
    size = jax.lax.stop_gradient(curve.c[0] + curve.c[-1])
    size = jnp.where(size > 0, size, 1.0)
    curve, size = settle((LimitCurve(tuple(c / size for c in curve.c)), size), contact.approach().x)
    mu = contact.friction
    v = contact.approach()
    valid = known & jnp.isfinite(sum(curve.c))
    pushes = settle(valid & (v.x > 0), v.x)
    v = select(pushes, v, Vec2(jnp.ones_like(v.x), jnp.zeros_like(v.y)))  # something to compute on
    curve = LimitCurve(tuple(jnp.where(valid, c, float(k == 0)) for k, c in enumerate(curve.c)))

    left_edge, right_edge = curve.motion(mu), curve.motion(-mu)
    left = (left_edge.x > 0) & (left_edge.cross(v) > 0)
    right = (right_edge.x > 0) & (right_edge.cross(v) < 0)
    left, right = settle((left, right & ~left), v.x)
    slides = left | right

    # what slides needs no root; with no room to search it also does not hold up those that do
    stuck = solver(curve, v, jnp.where(slides, 0.0, mu))
    s = jnp.where(left, mu, jnp.where(right, -mu, stuck.ratio))
    g = curve.motion(s)
    g2 = g.dot(g)
    k = jnp.where(slides, v.x / jnp.where(slides, g.x, 1.0), v.dot(g) / jnp.where(g2 > 0, g2, 1.0))
    follow = Vec2(v.x, jnp.where(slides, k * g.y, v.y))

    one = jnp.ones_like(s)
    ray = select(valid, contact.wrench(Vec2(one, s), form.length), Vec3(one, 0 * one, 0 * one))
    omega = k * form.spin(ray) / (size * form.length)
    normal = contact.normal
    linear = normal.scale(follow.x) + normal.perp().scale(follow.y) - contact.point.perp().scale(omega)
    h = curve.value(s)
    solved = (h > 0) & (slides | (stuck.residual <= tolerance(s.dtype))) & jnp.isfinite(omega)
    moves = settle(pushes & solved, v.x)
    scale = (jnp.where(h > 0, h, 1.0) ** (-1 / form.degree)) * size ** (-1 / form.degree)

    def where_moving(value):
        return type(value)(*(jnp.where(moves, entry, 0.0) for entry in value))

    mode = jnp.where(left, ContactMode.SLIDING_LEFT, jnp.where(right, ContactMode.SLIDING_RIGHT, ContactMode.STICKING))
    status = jnp.where(moves, Status.MOVING, jnp.where(pushes, Status.NOT_CONVERGED, Status.FREE))
    return SingleMotion(
        where_moving(Vec3(linear.x, linear.y, omega)),
        where_moving(ray.scale(scale)),
        where_moving(Vec2(scale, scale * s)),
        jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8),
        jnp.where(valid, status, Status.INVALID).astype(jnp.int8),
        ~(valid & ~pushes & _drags(curve, mu, contact.approach())),
    )


def _known(contact: Contact) -> tuple[Bool[Array, ""], Contact]:
    """Whether every number of a contact is usable; the contact, or else one out of reach."""
    known = jnp.isfinite(sum(jax.tree.leaves(contact))) & (contact.friction >= 0)
    return known, contact.where(known)


def _drags(curve: LimitCurve, mu: Scalar, v: Vec2) -> Bool[Array, ""]:
    """Whether a pusher that does not approach could also hold on to the slider and drag it along.

    Where the motion cone opens beyond 90 degrees, a push along or slightly off the surface lies inside it. Staying
    behind satisfies every condition too, and is what is answered: nothing pushes.
    """
    left, right = curve.motion(mu), curve.motion(-mu)
    drags_left = (left.x < 0) & (v.y > 0) & (left.cross(v) < 0)
    drags_right = (right.x < 0) & (v.y < 0) & (right.cross(v) > 0)
    return (v.x <= 0) & (drags_left | drags_right)
