"""The fraction of a step after which a finger first touches a slider at rest.

The hand advances again and again, by what the distances of its fingers from the slider allow at most, so that none can
pass through, however long the step is (conservative advancement; Mirtich 1996, section 2.3). Where a plane separates a
finger and a convex piece of the slider, each point of the finger comes to it by its own motion. Otherwise any point may
be as fast as the fastest. For a round finger that moves in a straight line and convex pieces, this is Newton's method,
which does not overshoot, because the distance to a convex body is convex along a line.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._internal.xla import map_items
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import pick
from pushjax.simulation.detection import pair_of
from pushjax.simulation.finger_motion import TOUCHING, BodyFrame, FingerMotion
from pushjax.simulation.hand import Pad

# Rounds of the search. If they do not suffice, the push begins early, with a gap that is still open. That is no error,
# because a contact problem takes gaps into account.
MAX_ROUNDS = 16
# The instant is differentiated if the finger comes nearer by at least this fraction of its own speed.
LEAST_APPROACH = 1e-2


@eqx.filter_custom_jvp
def time_of_impact(
    motions: tuple[FingerMotion, ...], outline: Outline, start: BodyFrame, length: Scalar, gap: Scalar
) -> Scalar:
    """Return the fraction of a step after which a finger first touches the slider, or one if none does.

    `gap` is how far the nearest finger is from the slider at the start, m.
    """
    touches = TOUCHING[gap.dtype.itemsize] * length  # a finger that touches begins to push at once

    def is_apart(state):
        _, apart, rounds = state
        return apart & (rounds < MAX_ROUNDS)

    def advance(state):
        fraction, _, rounds = state
        found = map_items(lambda motion: _gap_and_free(motion, outline, start, fraction), motions)
        gap, free = (jnp.min(jnp.stack(values)) for values in zip(*found, strict=True))
        after = jnp.where(gap > touches, jnp.minimum(fraction + free, 1.0), fraction)
        return after, (gap > touches) & (after < 1), rounds + 1

    state = jnp.zeros_like(gap), gap > touches, jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(is_apart, advance, state)[0]


@time_of_impact.def_jvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    # the implicit function theorem: where the gap closes, the instant depends on everything that the gap depends on
    fraction = time_of_impact(*primals)
    motions, outline, start, length, _ = primals
    gaps, changes = eqx.filter_jvp(lambda *scene: _gaps(scene[0], scene[1], scene[2], fraction), primals, tangents)
    if changes is None:  # nothing that the gaps depend on is differentiated
        return fraction, jnp.zeros_like(fraction)
    _, rates = jax.jvp(lambda f: _gaps(motions, outline, start, f), (fraction,), (jnp.ones_like(fraction),))
    speeds = jnp.stack([motion.arc_length() for motion in motions])
    gap, change, rate, speed = pick((gaps, changes, rates, speeds), jnp.argmin(gaps))
    is_near = gap <= TOUCHING[4] * length
    closes = (fraction > 0) & (fraction < 1) & is_near & (-rate > LEAST_APPROACH * speed)
    return fraction, jnp.where(closes, -change / jnp.where(closes, rate, 1.0), 0.0)


def _gaps(
    motions: tuple[FingerMotion, ...], outline: Outline, start: BodyFrame, fraction: Scalar
) -> Float[Array, "fingers"]:
    """Return how far each finger is from the slider after a fraction of the step, m."""

    def gap_of(motion: FingerMotion) -> Scalar:
        pose = motion.pose_in_slider(start, fraction)
        return pair_of(motion.finger, outline).distance(motion.finger, outline, pose)[0]

    return jnp.stack(map_items(gap_of, motions))


def _gap_and_free(motion: FingerMotion, outline: Outline, start: BodyFrame, fraction: Scalar) -> tuple[Scalar, Scalar]:
    """Return how far a finger is from the slider, m, and by which further fraction it can move without touching it."""
    pose, velocity = jax.jvp(lambda f: motion.pose_in_slider(start, f), (fraction,), (jnp.ones_like(fraction),))
    gaps, normals = pair_of(motion.finger, outline).pieces(motion.finger, outline, pose)
    fastest = motion.arc_length()
    if normals is None:
        speed, acceleration = jnp.broadcast_to(fastest, gaps.shape), None
    else:
        speed, acceleration = -normals.dot(velocity.center), None
        if motion.turning is not None:
            acceleration = fastest * jnp.abs(motion.turning)
            if isinstance(motion.finger, Pad):
                corner = Vec2.of(motion.finger.shape.vertices.T).rotate(pose.angle)
                lever = jax.tree.map(lambda n: n[:, None], normals).dot(jax.tree.map(lambda n: n[None], corner.perp()))
                speed = jnp.max(speed[:, None] - lever * motion.turning, axis=1)
        speed = jnp.maximum(speed, 0.0)
    # gap = speed t + acceleration t^2 / 2
    closing = 2 * speed if acceleration is None else speed + jnp.sqrt(speed**2 + 2 * acceleration * gaps)
    free = jnp.where(closing > 0, 2 * gaps / jnp.where(closing > 0, closing, 1.0), 1.0)
    return jnp.min(gaps), jnp.min(free)
