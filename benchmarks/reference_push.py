"""The push of the benchmarks, in which a round tip pushes a 90 mm square by 50 mm, and its converged answer.

The tip touches the square at the start and stays on its side, because only steps in contact are counted. The converged
answers need a process that allows float64 (`timing.both_dtypes`).
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import pushjax as pj

SIDE, RADIUS, TRAVEL, FRICTION = 0.09, 0.00475, 0.05, 0.25
# Largest distance of a start from the middle of the side, m, and largest angle of a path from its normal, rad.
MAX_OFFSET, MAX_ANGLE = 0.03, np.radians(30)
REFERENCE_STEPS = 3200
ALLOWED_MM = 0.1
LENGTH = 0.0367  # m, radius of gyration of the square, which makes angles commensurate with positions
STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64)


class Task(NamedTuple):
    """Slider, hand and start pose of a push, all in one floating type."""

    slider: pj.Slider
    hand: pj.Hand
    pose: Float[Array, "3"]

    def push(self, path: Array, friction: Array | float = FRICTION) -> pj.Trajectory:
        """Simulate one push along `path`."""
        return pj.rollout(self.slider, self.hand, path, pose=self.pose, friction=friction)


@cache
def square(model: str) -> pj.Slider:
    """Return the square under uniform pressure on 64 points, with the limit surface "quartic" or "ellipsoid"."""
    block = pj.Polygon.rectangle(SIDE, SIDE)
    pairs = pj.Support.uniform(block).wrench_twist_pairs(jax.random.key(0), 400)
    return pj.Slider(block, pj.fit_limit_surface(*pairs, degree={"quartic": 4, "ellipsoid": 2}[model]))


def t_block(hull: bool = False) -> pj.Polygon:
    """Return a T as large as the square, with its bar at the side that is pushed, or its convex hull."""
    bar, stem, half = -SIDE / 4, SIDE / 8, SIDE / 2
    inner = [] if hull else [(bar, stem)]
    upper = [(half, stem), *inner, (bar, half), (-half, half)]
    return pj.Polygon(np.array(upper + [(x, -y) for x, y in reversed(upper)]))


def task(model: str, dtype: str) -> Task:
    """Return the push of the square with the limit surface `model`, in `dtype`."""
    return cast(Task(square(model), pj.Hand.finger(RADIUS), jnp.zeros(3)), dtype)


def cast(tree: Any, dtype: str) -> Any:
    """Return the tree with all its floating-point arrays in `dtype`."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)


def paths(offset: Float[Array, "n"], angle: Float[Array, "n"], steps: int) -> Float[Array, "n steps+1 2"]:
    """Return the paths (m) of the centers of tips that touch the side x = -SIDE / 2 at the start."""
    # offset: of the start from the middle of the side, along y, m; angle: of the path from the inward normal, rad
    start = jnp.stack([jnp.full_like(offset, -SIDE / 2 - RADIUS), offset], axis=-1)
    along = TRAVEL * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    share = jnp.linspace(0, 1, steps + 1, dtype=offset.dtype)
    return start[:, None] + share[None, :, None] * along[:, None]


def fan() -> tuple[np.ndarray, np.ndarray]:
    """Return offsets and angles of 63 pushes: every 7.5 mm, every 10 degrees; they stick, slide, or change between."""
    offset, angle = np.meshgrid(np.linspace(-MAX_OFFSET, MAX_OFFSET, 9), np.linspace(-MAX_ANGLE, MAX_ANGLE, 7))
    return offset.ravel(), angle.ravel()


def final_poses(model: str, steps: int, dtype: str) -> np.ndarray:
    """Return the final poses of the fan in float64, (63, 3), as computed in `steps` steps in `dtype`."""
    offset, angle = (jnp.asarray(part, dtype) for part in fan())
    return np.asarray(_final(task(model, dtype), paths(offset, angle, 1), jnp.asarray(steps)), np.float64)


@jax.jit
def _final(here: Task, ends: Float[Array, "n 2 2"], steps: Array) -> Array:
    """Return the final poses of pushes, step by step, so that one program does any number of steps."""
    return jax.vmap(lambda each: stepped(here, lambda share: each[0] + share * (each[1] - each[0]), steps))(ends)


def stepped(here: Task, configuration: Callable[[Array], Array], steps: Array, friction: float = FRICTION) -> Array:
    """Return the final pose of a motion whose hand is at `configuration` after a fraction (0 to 1) of its steps."""

    def at(k):
        return configuration((k / steps).astype(here.pose.dtype))

    def step(k, pose):
        return pj.step(here.slider, here.hand, at(k), at(k + 1), pose=pose, friction=friction).pose

    return jax.lax.fori_loop(0, steps, step, here.pose)


@cache
def reference(model: str) -> np.ndarray:
    """Return the converged final poses of the fan: in float64, with steps of 16 um."""
    return final_poses(model, REFERENCE_STEPS, "float64")


def error_mm(pose: np.ndarray, other: np.ndarray, length: float = LENGTH) -> np.ndarray:
    """Return the larger of the distance and of `length` times the angle between poses (n, 3), as errors (n,), mm."""
    apart = np.abs(pose - other)
    return 1e3 * np.maximum(np.hypot(apart[:, 0], apart[:, 1]), length * apart[:, 2])


@cache
def errors(model: str, dtype: str) -> dict[int, float]:
    """Return the largest error of the fan, mm, for each number of steps."""
    return largest_errors(lambda steps: final_poses(model, steps, dtype), reference(model), model)


def largest_errors(poses: Callable[[int], np.ndarray], exact: np.ndarray, model: str) -> dict[int, float]:
    """Return the largest error of final poses, mm, for each number of steps."""
    length = float(square(model).surface.length)
    return {steps: float(error_mm(poses(steps), exact, length).max()) for steps in STEPS}


def fewest_steps(by_steps: dict[int, float], allowed_mm: float = ALLOWED_MM) -> int:
    """Return the fewest steps from which on the error stays at most `allowed_mm`, or raise ValueError."""
    fine = [steps for steps in by_steps if all(e <= allowed_mm for n, e in by_steps.items() if n >= steps)]
    if not fine:
        raise ValueError(f"no number of steps up to {max(by_steps)} comes within {allowed_mm} mm")
    return min(fine)
