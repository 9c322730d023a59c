"""The fraction of a step after which a finger first touches a slider at rest.

A round finger that does not turn is swept along its path. Any other finger advances again and again, by what its
distance from the slider allows at most, so that it cannot pass through (conservative advancement; Mirtich 1996,
section 2.3).
"""

import jax
import jax.numpy as jnp

from pushjax._internal.xla import compute_once, decide
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import Outline
from pushjax.simulation.detection import is_convex, penetration_depth
from pushjax.simulation.finger_motion import TOUCHING, BodyFrame, FingerMotion
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Pad, RoundFinger

# Rounds of the search. If they do not suffice, the push begins early, with a gap that is still open. That is no error,
# because a contact problem takes gaps into account.
MAX_ROUNDS = 16
# The instant is differentiated, and refined by a step of Newton's method, if the finger comes nearer by at least this
# fraction of its own speed.
LEAST_APPROACH = 1e-2


def time_of_impact(motion: FingerMotion, outline: Outline, start: BodyFrame, length: Scalar) -> Scalar:
    """Return the fraction of a step after which a finger first touches the slider, or one if it never does."""
    if isinstance(motion.finger, RoundFinger) and motion.turning is None:
        return _swept(motion, outline, start)
    return _advanced(motion, outline, start, length)


def _swept(motion: FingerMotion, outline: Outline, start: BodyFrame) -> Scalar:
    """Return the fraction for a round finger that moves in a straight line."""
    assert isinstance(motion.finger, RoundFinger)
    radius = motion.finger.radius
    center, path = compute_once((start.local(motion.center), motion.path.unrotate(start.angle)), start.pose.x)
    presses = jnp.zeros((), bool)
    for candidate in outline.contact_candidates(center):
        # in contact and pressing: the push begins at once
        gap = candidate.distance - radius
        presses |= (gap <= 0) & (-candidate.normal.dot(path) > gap)
    # Otherwise the first hit along the path counts, also for a finger that touches but moves away.
    hit = outline.sweep(center, path, radius)
    presses, hits = compute_once((presses, hit <= 1), start.pose.x)
    return jnp.where(presses, 0.0, jnp.where(hits, hit, 1.0))


def _advanced(motion: FingerMotion, outline: Outline, start: BodyFrame, length: Scalar) -> Scalar:
    """Return the fraction for any finger, by conservative advancement."""
    assert not isinstance(motion.finger, Wall)
    x = start.pose.x

    def gap_after(motion: FingerMotion, outline: Outline, start: BodyFrame, fraction: Scalar) -> Scalar:
        return -penetration_depth(motion.finger, outline, compute_once(motion.pose_in_slider(start, fraction), x))

    fixed = still_motion, still_outline, still_start = jax.lax.stop_gradient((motion, outline, start))
    # a finger that touches begins to push at once
    touches = TOUCHING[x.dtype.itemsize] * jax.lax.stop_gradient(length)
    largest_speed = still_motion.arc_length()

    def bounds_at(fraction: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Return the gap, and the most by which speed and acceleration can close it."""
        if not is_convex(outline):
            return gap_after(*fixed, fraction), largest_speed, jnp.zeros_like(x)
        # a plane separates convex bodies, and each point of the finger comes to it by its own motion
        pose, velocity = jax.jvp(
            lambda f: still_motion.pose_in_slider(still_start, f), (fraction,), (jnp.ones_like(fraction),)
        )

        def gap_at(center: Vec2) -> Scalar:
            return -penetration_depth(still_motion.finger, still_outline, pose._replace(center=center))

        gap, normal = jax.value_and_grad(gap_at)(compute_once(pose.center, x))
        approach = -normal.dot(velocity.center)
        if isinstance(still_motion.finger, Pad):
            assert pose.angle is not None
            assert still_motion.turning is not None
            offset = Vec2.of(still_motion.finger.shape.vertices.T).rotate(pose.angle)
            approach = jnp.max(approach - normal.dot(offset.perp()) * still_motion.turning)
        turning = jnp.zeros_like(x) if still_motion.turning is None else jnp.abs(still_motion.turning)
        return gap, jnp.maximum(approach, 0.0), largest_speed * turning

    def is_apart(state):
        _, apart, rounds = state
        return apart & (rounds < MAX_ROUNDS)

    def advance(state):
        fraction, _, rounds = state
        gap, speed, acceleration = bounds_at(fraction)
        # gap = speed t + acceleration t^2 / 2
        closing = speed + jnp.sqrt(speed**2 + 2 * acceleration * gap)
        free = jnp.where(closing > 0, 2 * gap / jnp.where(closing > 0, closing, 1.0), 1.0)
        after = jnp.where(gap > touches, jnp.minimum(fraction + free, 1.0), fraction)
        return after, (gap > touches) & (after < 1), rounds + 1

    state = jnp.zeros_like(x), jnp.ones((), bool), jnp.zeros((), jnp.int32)
    fraction, _, _ = jax.lax.while_loop(is_apart, advance, state)
    # the implicit function theorem: where the gap closes, the instant depends on everything that the gap depends on
    gap, rate = jax.jvp(lambda f: gap_after(motion, outline, start, f), (fraction,), (jnp.ones_like(fraction),))
    rate = jax.lax.stop_gradient(rate)
    is_near = gap <= TOUCHING[4] * jax.lax.stop_gradient(length)  # near enough for the step of Newton's method
    closes = (fraction > 0) & (fraction < 1) & is_near & (-rate > LEAST_APPROACH * largest_speed)
    is_regular = decide(closes, x)
    refined = fraction - gap / jnp.where(is_regular, rate, 1.0)
    return jnp.where(is_regular, jnp.clip(refined, 0.0, 1.0), fraction)
