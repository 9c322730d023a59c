"""A hand that pushes a straight edge of a slider in two places, and how tightly it can turn without slip.

Two round fingers side by side, or a flat pad, touch an edge along a line. The wrenches here are in the *pushing frame*:
its origin is midway between the two contacts, its x axis is the inward normal of the edge. Let the contacts be at
y = +b and y = -b, and their forces in cones of friction mu. Together they can apply exactly the wrenches with

    |f_y| <= mu f_x    and    |tau| <= b f_x,

because tangential forces along the line of the contacts have no torque about the origin. Both contacts stick where the
wrench that the slider's twist needs, by its limit surface, is strictly inside this cone. That the hand then moves the
slider with it follows for any limit surface; no mode is assumed.

The hand moves along its *heading*, and turns. One point of the slider moves like a car, always forward along the
heading: it is on the line through the origin in the direction of the heading, at some distance ahead of the origin.
The curvature of its path determines the twist, and so the wrench. For one limit surface and one coefficient of friction
the curvatures without slip form an interval. For many of them it is the intersection, whose ends are found by
bisection.

Where the point is decides how tight the turn can be: ahead of the center of friction the slider must swing out, which
takes a tangential force, and in exchange less torque. `tightest_turn` tries points over the whole depth of the slider
and takes the one with the tightest turns.

Reference: Lynch & Mason 1996, section 3 (stable pushes by line contact). Zhou & Mason 2017 (such a point, and paths of
bounded curvature).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.jit import quick_jit
from pushjax._math.vec import Vec3
from pushjax.friction.limit_surface import LimitSurface
from pushjax.geometry import se2
from pushjax.geometry.se2_numpy import compose
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.slider import Slider

# Points are side by side if their distance along an axis is less than this, for a hand in units of the surface's
# length, and for a slider in units of the edge's length.
FLAT = 1e-5
GRID, BISECTIONS = 48, 30  # curvatures tried to either side, and halvings of the interval between two of them
POINTS = 25  # points that are tried for the one that follows the path


class LineContact(NamedTuple):
    """A hand against an edge of a slider, in the slider's body frame."""

    edge: int  # its index, from vertex `edge` to the next one
    hand: np.ndarray  # (3,), pose of the hand, m and rad
    frame: np.ndarray  # (3,), pose of the pushing frame, m and rad
    half_width: float  # half of the distance between the two contacts, m
    heading: float  # direction in which the hand moves straight ahead, rad, in the pushing frame
    depth: float  # extent of the slider along the inward normal, m


class HandFront(NamedTuple):
    """The foremost part of a hand, along the x axis of its frame."""

    x: float  # how far it reaches along x, m
    low: float  # smallest y of the points that reach that far, m
    high: float  # largest y of them, m
    # whether it is the face of a pad, which may be longer than the edge; round fingers must both touch it
    is_flat: bool


def hand_front(
    hand: Hand,  # its configuration begins with its pose (x, y, theta)
    opening: np.ndarray,  # (dof - 3,), the other numbers of the configuration
    length: float,  # of the limit surface, m; it says what is flat
) -> HandFront:
    """Find the foremost points of a hand along the x axis of its frame."""
    if hand.dof < 3 or opening.shape != (hand.dof - 3,):
        raise ValueError(
            f"opening has shape {opening.shape}; expected ({max(hand.dof - 3, 0)},), what a configuration of the hand "
            "has beyond x, y and theta; a hand that does not turn cannot push stably"
        )
    rest = np.asarray(hand.poses(jnp.asarray(np.concatenate([np.zeros(3), opening]))), np.float64)
    placed = np.array([0.3 * length, -0.7 * length, 1.0])
    moved = np.asarray(hand.poses(jnp.asarray(np.concatenate([placed, opening]))), np.float64)
    if rest.shape[1] != 3 or np.abs(np.asarray(se2.compose(placed, rest)) - moved).max() > 1e-5:
        raise ValueError("hand must move like a rigid body with x, y and theta, the first numbers of its configuration")
    points, flat = [], []
    for finger, pose in zip(hand.fingers, rest, strict=True):
        if isinstance(finger, RoundFinger):
            points.append(np.array([[pose[0] + float(finger.radius), pose[1]]]))
        else:
            points.append(np.asarray(se2.transform(pose, finger.shape.vertices), np.float64))
        flat += [not isinstance(finger, RoundFinger)] * len(points[-1])
    corners = np.concatenate(points)
    foremost = corners[:, 0] > corners[:, 0].max() - FLAT * length
    low, high = corners[foremost, 1].min(), corners[foremost, 1].max()
    if high - low <= FLAT * length:
        raise ValueError("hand touches an edge in one point; a stable push needs two fingers side by side, or a pad")
    return HandFront(float(corners[:, 0].max()), float(low), float(high), bool(np.asarray(flat)[foremost].all()))


def line_contacts(slider: Slider, front: HandFront) -> list[LineContact]:
    """Place a hand on every edge of a slider, a polygon, on which it fits and can push straight ahead."""
    # A normal force moves the slider without turning it if its torque makes H least. The middle of the contact is put
    # where the force has this torque, or as near as the edge allows, and the heading is the direction of that motion.
    # The slider's surface is the mean of the sampled surfaces.
    vertices, found = np.asarray(slider.shape.vertices, np.float64), []  # pyright: ignore[reportAttributeAccessIssue]
    for edge, (start, end) in enumerate(zip(vertices, np.roll(vertices, -1, axis=0), strict=True)):
        edge_length = float(np.hypot(*(end - start)))
        along = (end - start) / edge_length
        normal = np.array([-along[1], along[0]])
        inward = (vertices - start[None]) @ normal
        # only edges with the whole slider behind them
        if inward.min() < -FLAT * edge_length or (front.high - front.low > edge_length and not front.is_flat):
            continue
        torque, motion = _straight_push(slider.surface, normal)
        # the torque about the body origin of a force along the normal, which acts at a distance from the start
        distance = torque - (start[0] * normal[1] - start[1] * normal[0])
        width = min(front.high - front.low, edge_length)
        middle = start + np.clip(distance, width / 2, edge_length - width / 2) * along
        frame = np.array([*middle, np.arctan2(normal[1], normal[0])])
        hand = np.array([-front.x, -(front.low + front.high) / 2, 0.0])
        heading = float(np.arctan2(-motion @ along, motion @ normal))  # the frame's y axis is against the edge
        found.append(LineContact(edge, compose(frame, hand), frame, width / 2, heading, float(inward.max())))
    return found


def _straight_push(surface: LimitSurface, force: np.ndarray) -> tuple[float, np.ndarray]:
    """Find the torque with which a force moves the slider without turning it, N m, and the direction of the motion."""
    # The angular velocity is zero where H is least over the torque. H is a convex polynomial of the torque.
    form, one = surface.form(), jnp.ones_like(surface.length)
    push, torque = Vec3(one * force[0], one * force[1], 0 * one), Vec3(0 * one, 0 * one, one)
    polynomial = np.polynomial.Polynomial([float(c) for c in form.restrict(push, torque)])
    roots = polynomial.deriv().roots()
    best = float(np.real(roots[np.argmin(np.abs(np.imag(roots)))]))
    motion = form.gradient(Vec3(push.x, push.y, one * best))
    return best * float(surface.length), np.array([float(motion.x), float(motion.y)])


class Turn(NamedTuple):
    """How tightly a line contact can turn without slip."""

    point: float  # distance ahead of the pushing frame's origin of the point that follows the path, m
    left: float  # largest curvature of its path to the left, 1/m
    right: float  # largest curvature of its path to the right, 1/m

    @property
    def radii(self) -> tuple[float, float]:
        """Radii of the tightest turns to the left and to the right, m; infinite where there is none."""
        return 1 / self.left if self.left > 0 else np.inf, 1 / self.right if self.right > 0 else np.inf


def tightest_turn(
    contact: LineContact,
    surfaces: LimitSurface,  # with a leading axis of samples, all of one length
    friction: Float[Array, "samples"],
    margin: float,  # fraction by which friction and width are reduced
) -> Turn | None:
    """Find the tightest turns of a line contact without slip, or None if not even a straight push is stable."""
    points = np.linspace(0, contact.depth, POINTS)
    numbers = (contact.frame, contact.half_width, contact.heading, points, margin)
    numbers = (jnp.asarray(number, friction.dtype) for number in numbers)
    curvatures = np.asarray(_stable_curvatures(surfaces, friction, *numbers), np.float64)
    if np.isnan(curvatures).any():  # whether straight ahead is stable does not depend on the point
        return None
    turns = [
        Turn(float(point), float(left), float(right)) for point, (left, right) in zip(points, curvatures, strict=True)
    ]
    # the smallest sum of the radii
    return min(turns, key=lambda each: sum(each.radii))


@quick_jit
def _stable_curvatures(
    surfaces: LimitSurface,  # with a leading axis of samples
    friction: Float[Array, "samples"],
    frame: Float[Array, "3"],  # pose of the pushing frame in the body frame, m and rad
    half_width: Float[Array, ""],  # half of the distance between the two contacts, m
    heading: Float[Array, ""],  # straight ahead, rad, in the pushing frame
    points: Float[Array, "points"],  # distances ahead of the pushing frame's origin, m
    margin: Float[Array, ""],  # fraction by which friction and width are reduced
) -> Float[Array, "points 2"]:
    """Find the largest curvatures of the path of each point, to the left and to the right, 1/m."""
    # NaN if not even the straight push is stable.
    length, to_frame = surfaces.length[0], se2.inverse(frame)
    ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading)])

    def slack(surface: LimitSurface, mu: Array, point: Array, psi: Array) -> Array:
        """How far the wrench of the curvature tan(psi) / length is inside the cone; not positive outside."""
        spin = jnp.sin(psi) / length
        swing = -spin * point
        twist = jnp.stack(
            [jnp.cos(psi) * ahead[0] - swing * ahead[1], jnp.cos(psi) * ahead[1] + swing * ahead[0], spin]
        )
        normal, tangential, torque = se2.transport_wrench(to_frame, surface.wrench(se2.transport_twist(frame, twist)))
        kept = 1 - margin
        return jnp.minimum(
            kept * mu * normal - jnp.abs(tangential), (kept * half_width * normal - jnp.abs(torque)) / length
        )

    @jax.vmap
    def is_stable(point: Array, psi: Array) -> Array:
        """Whether the contact sticks for all samples at each of the angles psi, (angles,)."""
        each = jax.vmap(jax.vmap(slack, (0, 0, None, None)), (None, None, None, 0))
        return jnp.all(each(surfaces, friction, point, psi) > 0, axis=1)

    signs = jnp.array([[1.0, -1.0]], points.dtype)
    stride = 0.499 * jnp.pi / GRID  # up to almost a turn about the point itself

    def search(_, ends):
        """Go on until an angle is not stable, then halve the interval."""
        low, high = ends
        tried = jnp.where(jnp.isinf(high), jnp.minimum(low + stride, 0.499 * jnp.pi), (low + high) / 2)
        stable = is_stable(points, signs * tried)
        return jnp.where(stable, tried, low), jnp.where(stable, high, tried)

    start = jnp.full((len(points), 2), -stride), jnp.full((len(points), 2), jnp.inf)
    low, _ = jax.lax.fori_loop(0, GRID + 1 + BISECTIONS, search, start)
    return jnp.where(low >= 0, jnp.tan(low) / length, jnp.nan)
