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
def time_of_impact(motions: tuple[FingerMotion, ...], outline: Outline, start: BodyFrame, length: Scalar) -> Scalar:
    """Return the fraction of a step after which a finger first presses on the slider, or one if none does."""

    def is_free(state):
        _, free, rounds = state
        return free & (rounds < MAX_ROUNDS)

    def advance(state):
        fraction, _, rounds = state
        found = map_items(lambda motion: _free_fraction(motion, outline, start, fraction, length), motions)
        after = jnp.minimum(fraction + jnp.min(jnp.stack(found)), 1.0)
        return after, (after > fraction) & (after < 1), rounds + 1

    state = jnp.zeros_like(length), jnp.ones((), bool), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(is_free, advance, state)[0]


@time_of_impact.def_jvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    # the implicit function theorem: where the gap closes, the instant depends on everything that the gap depends on
    fraction = time_of_impact(*primals)
    motions, outline, start, length = primals
    gaps, changes = eqx.filter_jvp(lambda *scene: _gaps(scene[0], scene[1], scene[2], fraction), primals, tangents)
    if changes is None:  # nothing that the gaps depend on is differentiated
        return fraction, jnp.zeros_like(fraction)
    _, rates = jax.jvp(lambda f: _gaps(motions, outline, start, f), (fraction,), (jnp.ones_like(fraction),))
    speeds = jnp.stack([motion.arc_length() for motion in motions])
    gap, change, rate, speed = pick((gaps, changes, rates, speeds), jnp.argmin(gaps))
    is_near = gap <= 4 * TOUCHING[4] * length
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


def _free_fraction(
    motion: FingerMotion, outline: Outline, start: BodyFrame, fraction: Scalar, length: Scalar
) -> Scalar:
    """Return the further fraction by which a finger can move without pressing on the slider; zero if it presses."""
    pose, velocity = jax.jvp(lambda f: motion.pose_in_slider(start, f), (fraction,), (jnp.ones_like(fraction),))
    gaps, normals = pair_of(motion.finger, outline).pieces(motion.finger, outline, pose)
    fastest = motion.arc_length()
    speed, acceleration = jnp.broadcast_to(fastest, gaps.shape), None
    if normals is not None:
        speed = -normals.dot(velocity.center)
        if motion.turning is not None:
            acceleration = fastest * jnp.abs(motion.turning)
            if isinstance(motion.finger, Pad):
                corner = Vec2.of(motion.finger.shape.vertices.T).rotate(pose.angle)
                lever = jax.tree.map(lambda n: n[:, None], normals).dot(jax.tree.map(lambda n: n[None], corner.perp()))
                speed = jnp.max(speed[:, None] - lever * motion.turning, axis=1)
    # a finger that touches a piece presses on it, unless it moves away
    leaves = speed + (0.0 if acceleration is None else acceleration) <= jnp.minimum(gaps, 0.0)
    touches = ~(gaps > TOUCHING[length.dtype.itemsize] * length)  # also where a number is NaN, which ends the search
    # gap = speed t + acceleration t^2 / 2
    speed, gaps = jnp.maximum(speed, 0.0), jnp.maximum(gaps, 0.0)
    closing = 2 * speed if acceleration is None else speed + jnp.sqrt(speed**2 + 2 * acceleration * gaps)
    free = jnp.where(closing > 0, 2 * gaps / jnp.where(closing > 0, closing, 1.0), 1.0)
    return jnp.min(jnp.where(touches, jnp.where(leaves, 1.0, 0.0), free))
