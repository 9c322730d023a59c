"""What is pushed in the benchmarks: a 90 mm square by a round tip, 50 mm, and the converged answer.

Pushes are laid out so that the tip touches at the start and stays on its side: what is counted are steps in contact.
The process must allow float64 (`measure.both_dtypes`), for the converged answers.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import pushjax as pj

SIDE, RADIUS, TRAVEL, FRICTION = 0.09, 0.00475, 0.05, 0.25
REACH, STEEPEST = 0.03, np.radians(30)  # how far from the middle of the side, and from its normal
REFERENCE_STEPS = 3200
ALLOWED_MM = 0.1
LENGTH = 0.0367  # m, makes angles commensurate with positions: the square's radius of gyration
STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64)


class Task(NamedTuple):
    """Slider, hand and where the slider starts, all in one floating type."""

    slider: pj.Slider
    hand: pj.Hand
    pose: Float[Array, "3"]

    def push(self, path: Array, friction: Array | float = FRICTION) -> pj.Trajectory:
        return pj.rollout(self.slider, self.hand, path, pose=self.pose, friction=friction)


@cache
def square(model: str) -> pj.Slider:
    """Uniform pressure, as 64 points; its "quartic" or "ellipsoid"."""
    block = pj.Polygon.rectangle(SIDE, SIDE)
    pairs = pj.Support.uniform(block).wrench_twist_pairs(jax.random.key(0), 400)
    return pj.Slider(block, pj.fit_limit_surface(*pairs, degree={"quartic": 4, "ellipsoid": 2}[model]))


def task(model: str, dtype: str) -> Task:
    return cast(Task(square(model), pj.Hand.finger(RADIUS), jnp.zeros(3)), dtype)


def cast(tree: Any, dtype: str) -> Any:
    """All floating numbers in `dtype`."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)


def paths(offset: Float[Array, "n"], angle: Float[Array, "n"], steps: int) -> Float[Array, "n steps+1 2"]:
    """Of tips that touch the side x = -SIDE / 2 at the start, and go at an angle from its inward normal."""
    start = jnp.stack([jnp.full_like(offset, -SIDE / 2 - RADIUS), offset], axis=-1)
    along = TRAVEL * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    share = jnp.linspace(0, 1, steps + 1, dtype=offset.dtype)
    return start[:, None] + share[None, :, None] * along[:, None]


def fan() -> tuple[np.ndarray, np.ndarray]:
    """Offsets and angles of 63 pushes: every 7.5 mm, every 10 degrees; they stick, slide, and change between."""
    offset, angle = np.meshgrid(np.linspace(-REACH, REACH, 9), np.linspace(-STEEPEST, STEEPEST, 7))
    return offset.ravel(), angle.ravel()


def final_poses(model: str, steps: int, dtype: str) -> np.ndarray:
    """Of the fan: (63, 3)."""
    offset, angle = (jnp.asarray(part, dtype) for part in fan())
    return np.asarray(_final(task(model, dtype), paths(offset, angle, 1), jnp.asarray(steps)), np.float64)


@jax.jit
def _final(here: Task, ends: Float[Array, "n 2 2"], steps: Array) -> Array:
    """`push` step by step, so that one program does any number of steps."""

    def one(ends: Array) -> Array:
        def at(k):
            return ends[0] + (k / steps).astype(ends.dtype) * (ends[1] - ends[0])

        def step(k, pose):
            return pj.step(here.slider, here.hand, at(k), at(k + 1), pose=pose, friction=FRICTION).pose

        return jax.lax.fori_loop(0, steps, step, here.pose)

    return jax.vmap(one)(ends)


@cache
def reference(model: str) -> np.ndarray:
    """Of the fan, converged: float64, steps of 16 um."""
    return final_poses(model, REFERENCE_STEPS, "float64")


def error_mm(pose: np.ndarray, other: np.ndarray, length: float = LENGTH) -> np.ndarray:
    """(n,) mm: the larger of the distance of two poses (n, 3) and length times the angle between them."""
    apart = np.abs(pose - other)
    return 1e3 * np.maximum(np.hypot(apart[:, 0], apart[:, 1]), length * apart[:, 2])


@cache
def errors(model: str, dtype: str) -> dict[int, float]:
    """Worst error of the fan, mm, by the number of steps."""
    length = float(square(model).surface.length)
    exact = reference(model)
    return {steps: float(error_mm(final_poses(model, steps, dtype), exact, length).max()) for steps in STEPS}


def fewest_steps(by_steps: dict[int, float], allowed_mm: float = ALLOWED_MM) -> int:
    """The fewest steps from which on the error stays within what is allowed."""
    fine = [steps for steps in by_steps if all(e <= allowed_mm for n, e in by_steps.items() if n >= steps)]
    if not fine:
        raise ValueError(f"no number of steps up to {max(by_steps)} comes within {allowed_mm} mm")
    return min(fine)
