"""What is timed: each case makes its work for a floating type and a batch, and says what to count it in."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.bench import needed, tasks
from pushjax.problems import random_contacts_problem

TILE = 4000  # pushes at once, of a larger batch: what they work on stays in the cache
GRASP_STEPS, GRASP_FRICTION = 50, 0.1
NEEDED_OF = 12  # pushes whose FLOPs are counted


class Work(NamedTuple):
    """One program to time. steps: of each of the batch, in contact. needed: FLOPs of such a step that the mathematics
    needs, if they have been counted. error_mm: worst final pose of the fan at this number of steps."""

    case: str
    dtype: str
    batch: int
    steps: float
    function: Callable
    args: tuple
    needed: float | None = None
    error_mm: float | None = None


def push(dtype: str, batch: int, model: str = "quartic", steps: int | None = None) -> Work:
    """Pushes of the fan's range, each with a surface and a friction of its own; final poses."""
    by_steps = tasks.errors(model, dtype)
    steps = tasks.fewest_steps(by_steps) if steps is None else steps
    here, args = _varied(model, dtype, batch, steps)

    def one(surface: Any, path: Any, friction: Any) -> Any:
        slider = pj.Slider(here.slider.shape, surface)
        return here._replace(slider=slider).push(path, friction)

    def final(*args):
        return in_tiles(lambda *each: one(*each).pose[-1], args, batch)

    modes = jax.vmap(lambda *each: one(*each).mode)(*jax.tree.map(lambda leaf: leaf[: min(batch, 500)], args))
    contact = float(np.mean(np.asarray(modes) != pj.ContactMode.SEPARATED))
    count = _needed(here, args, dtype) if model == "quartic" else None
    return Work(f"push_{model}", dtype, batch, steps * contact, final, args, count, by_steps.get(steps))


def gradient(dtype: str, batch: int) -> Work:
    """d (x + y + theta) of the final pose by the surface, the path and the friction, of the same pushes."""
    plain = push(dtype, batch)
    derivative = jax.grad(lambda args: jnp.sum(plain.function(*args)))
    return plain._replace(case="gradient", function=lambda *args: derivative(args), needed=None)


def grasp(dtype: str, batch: int) -> Work:
    """Two fingers close 30 mm on the square, askew, which turns it until they hold it."""
    here = tasks.task("quartic", dtype)
    hand = tasks.cast(pj.Hand.two_fingers(tasks.RADIUS), dtype)
    wide = tasks.SIDE + 2 * tasks.RADIUS
    opening = jnp.linspace(wide + 0.025, wide - 0.005, GRASP_STEPS + 1, dtype=dtype)
    path = jnp.zeros((GRASP_STEPS + 1, 4), dtype).at[:, 3].set(opening)
    askew = jax.random.uniform(jax.random.key(1), (batch, 3), dtype, -1, 1) * jnp.array([[5e-3, 5e-3, 0.4]], dtype)

    def one(pose):
        return pj.rollout(here.slider, hand, path, pose=pose, friction=jnp.asarray(GRASP_FRICTION, dtype))

    modes = np.asarray(jax.vmap(lambda pose: one(pose).mode)(askew[: min(batch, 200)]))
    contact = float(np.mean((modes != pj.ContactMode.SEPARATED).any(axis=-1)))

    def final(poses):
        return in_tiles(lambda pose: one(pose).pose[-1], (poses,), batch)

    return Work("grasp_two_fingers", dtype, batch, GRASP_STEPS * contact, final, (askew,))


def solve(dtype: str, batch: int, contacts: int) -> Work:
    """Random contact problems."""
    draw = jax.vmap(lambda key: random_contacts_problem(key, contacts=contacts))
    problem = tasks.cast(draw(jax.random.split(jax.random.key(contacts), batch)), dtype)

    def motion(*args):
        return in_tiles(lambda s, c: pj.solve_contacts(s, c).twist, args, batch)

    return Work(f"solve_{contacts}", dtype, batch, 1.0, motion, (problem.surface, problem.contacts))


def sampling(dtype: str, batch: int) -> Work:
    """Random quartics, certified convex, by the paper's sampler."""
    surface = tasks.task("quartic", dtype).slider.surface
    random = tasks.cast(pj.FrictionModel(dof=20, friction=(0.15, 0.35)), dtype).around(surface)
    keys = jax.random.split(jax.random.key(0), batch)

    def surfaces(keys):
        return in_tiles(lambda key: random.sample(key)[0], (keys,), batch)

    return Work("sampling", dtype, batch, 1.0, surfaces, (keys,))


def in_tiles(function: Callable, args: tuple, batch: int) -> Any:
    """`vmap`, of no more than TILE at once."""
    if batch <= TILE:
        return jax.vmap(function)(*args)
    return jax.lax.map(lambda each: function(*each), args, batch_size=TILE)


def _varied(model: str, dtype: str, batch: int, steps: int) -> tuple[tasks.Task, tuple]:
    """A task; and surface, path and friction of each push, all different, so that no work can be shared."""
    here = tasks.task(model, dtype)
    keys = jax.random.split(jax.random.key(0), 4)

    def uniform(key, low, high):
        return jax.random.uniform(key, (batch,), dtype, low, high)

    scale = 1 + 0.01 * jax.random.normal(keys[0], (batch,), dtype)

    def each(leaf):
        return scale.reshape(-1, *(1,) * leaf.ndim) * leaf[None] if leaf.ndim else jnp.broadcast_to(leaf, (batch,))

    surface = jax.tree.map(each, here.slider.surface)
    path = tasks.paths(
        uniform(keys[1], -tasks.REACH, tasks.REACH), uniform(keys[2], -tasks.STEEPEST, tasks.STEEPEST), steps
    )
    return here, (surface, path, uniform(keys[3], 0.15, 0.35))


def _needed(here: tasks.Task, args: tuple, dtype: str) -> float:
    """FLOPs of a step, the mean of some of the pushes."""
    surface, path, friction = jax.tree.map(lambda leaf: np.asarray(leaf[:NEEDED_OF], float), args)
    assert isinstance(here.slider.shape, pj.Polygon)
    vertices = [(float(x), float(y)) for x, y in np.asarray(here.slider.shape.vertices)]
    counts = []
    for k in range(len(path)):
        task = needed.Push(
            vertices,
            [float(c) for c in surface.coefficients[k]],
            float(surface.length[k]),
            tasks.RADIUS,
            float(friction[k]),
            float(jnp.finfo(dtype).eps) ** 0.8,
        )
        points = [(float(x), float(y)) for x, y in path[k]]
        counts.append(needed.push(task, points, (0.0, 0.0, 0.0))[1] / (len(points) - 1))
    return float(np.mean(counts))
