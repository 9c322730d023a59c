"""What is grasped in the benchmarks: the square of `tasks`, askew between two fingers, and the converged answer.

The fingers close along y until 1 mm more than the square and they need is left between them: by then they have turned
it nearly straight, and do not hold it yet (`pushjax` finds where a hand jams to one step only, others let it sink in).
Each grasp begins where its first finger touches, so that every step is one in contact.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import pushjax as pj
from pushjax.bench import tasks

FRICTION = 0.1
ASIDE, LEAST_TURN, MOST_TURN = 5e-3, 0.2, 0.4  # m, rad: where the square lies
FLAT = tasks.SIDE + 2 * tasks.RADIUS  # m, between the fingers' centres on the straight square
LEFT = 1e-3  # m more than that, at the end
TURNED = float(np.arccos(FLAT / (FLAT + LEFT)))  # rad: the angle at which the square then fits


def hand(dtype: str) -> pj.Hand:
    return tasks.cast(pj.Hand.two_fingers(tasks.RADIUS), dtype)


def touching(pose: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """The opening (m, between centres) at which the first finger touches the square at `pose`, on a side."""
    x, y, theta = pose.T
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    upper, lower = (sign * y + (FLAT / 2 - sign * x * sin) / cos for sign in (1, -1))
    return 2 * jnp.maximum(upper, lower)


def openings(pose: Float[Array, "n 3"], steps: int) -> Float[Array, "n steps+1"]:
    """From where each touches to the end, in steps that each leave the same share of what was left: the square swings
    by the root of it, the faster the straighter it is."""
    return opening_at(touching(pose)[:, None], jnp.linspace(0, 1, steps + 1, dtype=pose.dtype)[None])


def opening_at(first: Float[Array, "..."], share: Float[Array, "..."]) -> Float[Array, "..."]:
    """The opening (m) after this share of the steps, of a grasp that begins at the opening `first`."""
    return FLAT + (first - FLAT) * (LEFT / (first - FLAT)) ** share


def paths(pose: Float[Array, "n 3"], steps: int) -> Float[Array, "n steps+1 4"]:
    """Configurations of `Hand.two_fingers`."""
    opening = openings(pose, steps)
    still = jnp.zeros_like(opening)
    return jnp.stack([still, still, still, opening], axis=-1)


def random_poses(key: Array, n: int, dtype: str) -> Float[Array, "n 3"]:
    at = jax.random.uniform(key, (n, 3), dtype, -1, 1)
    turn = jnp.sign(at[:, 2]) * (LEAST_TURN + (MOST_TURN - LEAST_TURN) * jnp.abs(at[:, 2]))
    return jnp.stack([ASIDE * at[:, 0], ASIDE * at[:, 1], turn], axis=-1)


def fan() -> np.ndarray:
    """(27, 3): where the square lies before the grasps that errors are the worst of."""
    places, turns = (-1.0, 0.0, 1.0), (-MOST_TURN, LEAST_TURN, (LEAST_TURN + MOST_TURN) / 2)
    return np.array([(ASIDE * x, ASIDE * y, turn) for x in places for y in places for turn in turns])


def final_poses(steps: int, dtype: str) -> np.ndarray:
    """Of the fan: (27, 3)."""
    here = tasks.task("quartic", dtype)._replace(hand=hand(dtype))
    return np.asarray(_final(here, jnp.asarray(fan(), dtype), jnp.asarray(steps)), np.float64)


@jax.jit
def _final(here: tasks.Task, poses: Float[Array, "n 3"], steps: Array) -> Array:
    """Step by step, so that one program does any number of steps."""

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
    """Of the fan, converged: float64, steps of some 2 um."""
    return final_poses(tasks.REFERENCE_STEPS, "float64")


@cache
def errors(dtype: str) -> dict[int, float]:
    """Worst error of the fan, mm, by the number of steps."""
    length = float(tasks.square("quartic").surface.length)
    exact = reference()
    return {n: float(tasks.error_mm(final_poses(n, dtype), exact, length).max()) for n in tasks.STEPS}
