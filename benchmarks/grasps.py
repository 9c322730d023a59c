"""The grasp of the benchmarks, in which two fingers turn the askew square of `tasks`, and its converged answer.

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
from benchmarks import tasks

FRICTION = 0.1
# Start pose of the square: largest offset in x and y (m), least and largest |angle| (rad).
ASIDE, LEAST_TURN, MOST_TURN = 5e-3, 0.2, 0.4
FLAT = tasks.SIDE + 2 * tasks.RADIUS  # m, opening (between the fingers' centers) that touches the straight square
LEFT = 1e-3  # m, by how much the opening at the end exceeds FLAT
TURNED = float(np.arccos(FLAT / (FLAT + LEFT)))  # rad, angle at which the square fits the opening at the end


def hand(dtype: str) -> pj.Hand:
    """Return the hand of two fingers, in `dtype`."""
    return tasks.cast(pj.Hand.two_fingers(tasks.RADIUS), dtype)


def touching(pose: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Return the opening at which the first finger touches the square at `pose`, on a side.

    Args:
        pose: Poses of the square.

    Returns:
        Distances between the fingers' centers, m.
    """
    x, y, theta = pose.T
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    upper, lower = (sign * y + (FLAT / 2 - sign * x * sin) / cos for sign in (1, -1))
    return 2 * jnp.maximum(upper, lower)


def openings(pose: Float[Array, "n 3"], steps: int) -> Float[Array, "n steps+1"]:
    """Return the openings of each grasp, from the first touch to the end, m.

    The excess over FLAT shrinks by the same factor in every step. The angle of the square goes with the square root of
    that excess, so the square turns faster the straighter it is.

    Args:
        pose: Start poses of the square.
        steps: Number of steps.
    """
    return opening_at(touching(pose)[:, None], jnp.linspace(0, 1, steps + 1, dtype=pose.dtype)[None])


def opening_at(first: Float[Array, "..."], share: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the opening after a fraction of the steps.

    Args:
        first: Opening at which the grasp begins, m.
        share: Fraction of the steps, from 0 to 1.

    Returns:
        Openings, m.
    """
    return FLAT + (first - FLAT) * (LEFT / (first - FLAT)) ** share


def paths(pose: Float[Array, "n 3"], steps: int) -> Float[Array, "n steps+1 4"]:
    """Return the path of each grasp, as configurations of `Hand.two_fingers`.

    Args:
        pose: Start poses of the square.
        steps: Number of steps.
    """
    opening = openings(pose, steps)
    still = jnp.zeros_like(opening)
    return jnp.stack([still, still, still, opening], axis=-1)


def random_poses(key: Array, n: int, dtype: str) -> Float[Array, "n 3"]:
    """Return `n` random start poses of the square."""
    at = jax.random.uniform(key, (n, 3), dtype, -1, 1)
    turn = jnp.sign(at[:, 2]) * (LEAST_TURN + (MOST_TURN - LEAST_TURN) * jnp.abs(at[:, 2]))
    return jnp.stack([ASIDE * at[:, 0], ASIDE * at[:, 1], turn], axis=-1)


def fan() -> np.ndarray:
    """Return the 27 start poses of the square over which errors are maximized, (27, 3)."""
    places, turns = (-1.0, 0.0, 1.0), (-MOST_TURN, LEAST_TURN, (LEAST_TURN + MOST_TURN) / 2)
    return np.array([(ASIDE * x, ASIDE * y, turn) for x in places for y in places for turn in turns])


def final_poses(steps: int, dtype: str) -> np.ndarray:
    """Return the final poses of the fan in float64, (27, 3), as computed in `steps` steps in `dtype`."""
    here = tasks.task("quartic", dtype)._replace(hand=hand(dtype))
    return np.asarray(_final(here, jnp.asarray(fan(), dtype), jnp.asarray(steps)), np.float64)


@jax.jit
def _final(here: tasks.Task, poses: Float[Array, "n 3"], steps: Array) -> Array:
    """Return the final poses of grasps, step by step, so that one program does any number of steps."""

    def one(pose: Array, first: Array) -> Array:
        def at(k):
            opening = opening_at(first, (k / steps).astype(first.dtype))
            return jnp.zeros(4, first.dtype).at[3].set(opening)

        def step(k, pose):
            return pj.step(here.slider, here.hand, at(k), at(k + 1), pose=pose, friction=FRICTION).pose

        return jax.lax.fori_loop(0, steps, step, pose)

    return jax.vmap(one)(poses, touching(poses))


@cache
def reference() -> np.ndarray:
    """Return the converged final poses of the fan: in float64, with steps of some 2 um."""
    return final_poses(tasks.REFERENCE_STEPS, "float64")


@cache
def errors(dtype: str) -> dict[int, float]:
    """Return the largest error of the fan, mm, for each number of steps."""
    length = float(tasks.square("quartic").surface.length)
    exact = reference()
    return {n: float(tasks.error_mm(final_poses(n, dtype), exact, length).max()) for n in tasks.STEPS}
