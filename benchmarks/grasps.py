"""The grasp of the benchmarks, in which two fingers turn an askew square, and its converged answer.

The fingers close along y until the opening is 1 mm more than the straight square needs. By then they have turned the
square nearly straight, but do not hold it yet. They stop there because `pushjax` locates a jam to one step only, and
other simulators let the fingers sink in. Each grasp begins where its first finger touches, so that every step is in
contact.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import pushjax as pj
from benchmarks import reference_push

FRICTION = 0.1
# Start pose of the square: largest offset in x and y (m), least and largest |angle| (rad).
MAX_OFFSET, MIN_ANGLE, MAX_ANGLE = 5e-3, 0.2, 0.4
PAD = (0.05, 0.01)  # width and thickness of a pad of the parallel jaw, m
# Opening (distance between the fingers' centers) at which both fingers touch the straight square, m.
STRAIGHT_OPENING = reference_push.SIDE + 2 * reference_push.RADIUS
CLEARANCE = 1e-3  # m, by how much the opening at the end exceeds STRAIGHT_OPENING
# Angle at which the square fits the opening at the end, rad.
END_ANGLE = float(np.arccos(STRAIGHT_OPENING / (STRAIGHT_OPENING + CLEARANCE)))


def hand(dtype: str) -> pj.Hand:
    """Return the hand of two fingers, in `dtype`."""
    return reference_push.cast(pj.Hand.two_fingers(reference_push.RADIUS), dtype)


def jaw(dtype: str) -> pj.Hand:
    """Return the parallel jaw, in `dtype`."""
    return reference_push.cast(pj.Hand.parallel_jaw(*PAD), dtype)


def touching(pose: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Return the opening, m, at which the first finger touches a side of the square at `pose`."""
    x, y, theta = pose.T
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    upper, lower = (sign * y + (STRAIGHT_OPENING / 2 - sign * x * sin) / cos for sign in (1, -1))
    return 2 * jnp.maximum(upper, lower)


def touching_jaw(pose: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Return the opening between the faces, m, at which the first pad of the jaw touches the square at `pose`."""
    # Either a corner of the pad touches a side of the square, or a corner of the square touches the face of the pad.
    # The square must be turned by less than 45 degrees.
    x, y, theta = pose.T
    cos, sin, turn = jnp.cos(theta), jnp.sin(theta), jnp.sign(theta)
    half, edge = reference_push.SIDE / 2, PAD[0] / 2

    def height(side):  # of the highest point of the square above (1) or below (-1) the hand's middle, within the pad
        corner = turn * (side * x - half * sin) + half * cos
        at = turn * jnp.minimum(corner, edge)
        return side * y + (half + (at - side * x) * sin) / cos

    return 2 * jnp.maximum(height(1), height(-1))


def openings(pose: Float[Array, "n 3"], steps: int) -> Float[Array, "n steps+1"]:
    """Return the openings of each grasp, from the first touch to the end, m."""
    # The excess over STRAIGHT_OPENING shrinks by the same factor in every step. The angle of the square goes with the
    # square root of that excess, so the square turns faster the straighter it is.
    return opening_at(touching(pose)[:, None], jnp.linspace(0, 1, steps + 1, dtype=pose.dtype)[None])


def opening_at(first: Float[Array, "..."], share: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the opening, m, after a fraction (0 to 1) of the steps of a grasp that begins at the opening `first`."""
    return STRAIGHT_OPENING + (first - STRAIGHT_OPENING) * (CLEARANCE / (first - STRAIGHT_OPENING)) ** share


def paths(pose: Float[Array, "n 3"], steps: int) -> Float[Array, "n steps+1 4"]:
    """Return the path of each grasp, as configurations of `Hand.two_fingers`."""
    opening = openings(pose, steps)
    still = jnp.zeros_like(opening)
    return jnp.stack([still, still, still, opening], axis=-1)


def random_poses(key: Array, n: int, dtype: str) -> Float[Array, "n 3"]:
    """Return `n` random start poses of the square."""
    at = jax.random.uniform(key, (n, 3), dtype, -1, 1)
    turn = jnp.sign(at[:, 2]) * (MIN_ANGLE + (MAX_ANGLE - MIN_ANGLE) * jnp.abs(at[:, 2]))
    return jnp.stack([MAX_OFFSET * at[:, 0], MAX_OFFSET * at[:, 1], turn], axis=-1)


def fan() -> np.ndarray:
    """Return the 27 start poses of the square over which errors are maximized, (27, 3)."""
    places, turns = (-1.0, 0.0, 1.0), (-MAX_ANGLE, MIN_ANGLE, (MIN_ANGLE + MAX_ANGLE) / 2)
    return np.array([(MAX_OFFSET * x, MAX_OFFSET * y, turn) for x in places for y in places for turn in turns])


def final_poses(steps: int, dtype: str) -> np.ndarray:
    """Return the final poses of the fan in float64, (27, 3), as computed in `steps` steps in `dtype`."""
    here = reference_push.task("quartic", dtype)._replace(hand=hand(dtype))
    return np.asarray(_final(here, jnp.asarray(fan(), dtype), jnp.asarray(steps)), np.float64)


@jax.jit
def _final(here: reference_push.Task, poses: Float[Array, "n 3"], steps: Array) -> Array:
    """Return the final poses of grasps, step by step, so that one program does any number of steps."""

    def one(pose: Array, first: Array) -> Array:
        def closing(share):
            return jnp.zeros(4, first.dtype).at[3].set(opening_at(first, share))

        return reference_push.stepped(here._replace(pose=pose), closing, steps, FRICTION)

    return jax.vmap(one)(poses, touching(poses))


@cache
def reference() -> np.ndarray:
    """Return the converged final poses of the fan: in float64, with steps of some 2 um."""
    return final_poses(reference_push.REFERENCE_STEPS, "float64")


@cache
def errors(dtype: str) -> dict[int, float]:
    """Return the largest error of the fan, mm, for each number of steps."""
    return reference_push.largest_errors(lambda steps: final_poses(steps, dtype), reference(), "quartic")
