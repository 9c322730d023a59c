"""Solver for one frictional contact: whether it separates, sticks or slides, and the slider's twist."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact, LimitCurve
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import StickingSolver
from pushjax.contact.tolerances import relative_tolerance
from pushjax.friction.limit_surface import Form


class SingleSolution(NamedTuple):
    """The solution for one contact, in scalars."""

    twist: Vec3  # of the slider over the step (m, m, rad)
    wrench: Vec3  # normalized, on H = 1
    force: Vec2  # along (normal, tangent), N
    mode: Int[Array, ""]  # `ContactMode`
    status: Int[Array, ""]  # `Status`
    unique: Bool[Array, ""]  # False where another twist satisfies every condition too


def solve_single(form: Form, contact: Contact, solver: StickingSolver) -> SingleSolution:
    """Compute the slider's twist from the pusher's displacement at one contact.

    The contact point follows the pusher exactly along the normal. Along the tangent it follows the pusher exactly where
    the contact sticks, else it moves along the motion cone's edge. So where the contact sticks, only the rotation is
    computed from the surface, and the slip is zero up to roundoff.

    Args:
        form: H of the limit surface, in scalars.
        contact: The contact, in the body frame.
        solver: Finds the force of a sticking contact.

    Returns:
        The motion, zero unless the status is MOVING.

    Reference: Zhou et al. 2017, section IV.A.
    """
    usable = jnp.isfinite(sum(jax.tree.leaves(contact))) & (contact.friction >= 0)
    contact = contact.where(usable)
    # The motion does not depend on the scale of H, but squares of H overflow or underflow in float32. So h is divided
    # by its own size, which is a constant to every derivative too.
    curve = LimitCurve.of(form, contact)
    size = jax.lax.stop_gradient(curve.c[0] + curve.c[-1])
    size = jnp.where(size > 0, size, 1.0)
    curve, size = compute_once((LimitCurve(tuple(c / size for c in curve.c)), size), contact.approach().x)
    mu, v = contact.friction, contact.approach()
    valid = usable & jnp.isfinite(sum(curve.c))
    pushes = compute_once(valid & (v.x > 0), v.x)
    v = tree_where(pushes, v, Vec2(jnp.ones_like(v.x), jnp.zeros_like(v.y)))  # placeholder where nothing pushes
    curve = LimitCurve(tuple(jnp.where(valid, c, float(k == 0)) for k, c in enumerate(curve.c)))

    left_edge, right_edge = curve.motion(mu), curve.motion(-mu)
    slides_left = (left_edge.x > 0) & (left_edge.cross(v) > 0)
    slides_right = (right_edge.x > 0) & (right_edge.cross(v) < 0)
    slides_left, slides_right = compute_once((slides_left, slides_right & ~slides_left), v.x)
    slides = slides_left | slides_right

    # A sliding contact needs no root. Its search gets friction zero and ends at once, so that in a batch it does not
    # delay the contacts that stick.
    ratio, residual = solver(curve, v, jnp.where(slides, 0.0, mu))
    s = jnp.where(slides_left, mu, jnp.where(slides_right, -mu, ratio))
    motion = curve.motion(s)
    squared = motion.dot(motion)
    # A sliding motion is scaled by v_n / motion_n. This needs no guard against a small motion_n. Sliding left means
    # motion_n v_t > motion_t v_n, so for motion_t > 0 the factor stays below v_t / motion_t. For motion_t <= 0 motion_n
    # is not small, because motion_n = d h - mu motion_t >= d h by Euler's identity.
    factor = jnp.where(
        slides, v.x / jnp.where(slides, motion.x, 1.0), v.dot(motion) / jnp.where(squared > 0, squared, 1.0)
    )
    point_motion = Vec2(v.x, jnp.where(slides, factor * motion.y, v.y))

    one = jnp.ones_like(s)
    # the wrench up to its scale
    direction = tree_where(valid, contact.wrench(Vec2(one, s), form.length), Vec3(one, 0 * one, 0 * one))
    omega = factor * form.gradient(direction).z / (size * form.length)
    normal = contact.normal
    linear = normal.scale(point_motion.x) + normal.perp().scale(point_motion.y) - contact.point.perp().scale(omega)
    h = curve.value(s)
    solved = (h > 0) & (slides | (residual <= relative_tolerance(s.dtype))) & jnp.isfinite(omega)
    moves = compute_once(pushes & solved, v.x)
    force_scale = (jnp.where(h > 0, h, 1.0) ** (-1 / form.degree)) * size ** (-1 / form.degree)
    found = Vec3(linear.x, linear.y, omega), direction.scale(force_scale), Vec2(force_scale, force_scale * s)
    twist, wrench, force = jax.tree.map(lambda entry: jnp.where(moves, entry, 0.0), found)
    mode = jnp.where(
        slides_left, ContactMode.SLIDING_LEFT, jnp.where(slides_right, ContactMode.SLIDING_RIGHT, ContactMode.STICKING)
    )
    status = jnp.where(moves, Status.MOVING, jnp.where(pushes, Status.NOT_CONVERGED, Status.FREE))
    return SingleSolution(
        twist,
        wrench,
        force,
        jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8),
        jnp.where(valid, status, Status.INVALID).astype(jnp.int8),
        ~(valid & ~pushes & _can_drag(curve, mu, contact.approach())),
    )


def _can_drag(curve: LimitCurve, mu: Scalar, v: Vec2) -> Bool[Array, ""]:
    """Return whether a pusher that does not approach could also hold on to the slider and drag it along."""
    # Where the motion cone opens beyond 90 degrees, a pusher that moves along the surface, or slightly away from it,
    # may move inside the cone. The slider may also stay behind, which satisfies every condition too. `solve_single`
    # gives this answer: nothing pushes.
    left, right = curve.motion(mu), curve.motion(-mu)
    drags_left = (left.x < 0) & (v.y > 0) & (left.cross(v) < 0)
    drags_right = (right.x < 0) & (v.y < 0) & (right.cross(v) > 0)
    return (v.x <= 0) & (drags_left | drags_right)
