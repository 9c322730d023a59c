"""What is timed: each case makes its work for a floating type and a batch, and says what to count it in."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import pushjax as pj
from pushjax.bench import grasps, needed, tasks
from pushjax.bench.measure import on_cpu
from pushjax.problems import random_contacts_problem

TILE = 4000  # pushes at once, of a larger batch: what they work on stays in the cache
NEEDED_OF = 12  # pushes whose FLOPs are counted
PAIRS = 400  # of a fit


class Work(NamedTuple):
    """One program to time. steps: of each of the batch, in contact. needed: FLOPs of such a step that the mathematics
    needs, if they have been counted. error_mm: worst final pose of the fan at this number of steps. host: a function to
    be called as it is, not one to compile."""

    case: str
    dtype: str
    batch: int
    steps: float
    function: Callable
    args: tuple
    needed: float | None = None
    error_mm: float | None = None
    host: bool = False


def push(dtype: str, batch: int, model: str = "quartic", steps: int | None = None) -> Work:
    """Pushes of the fan's range, each with a surface and a friction of its own; final poses."""
    by_steps = tasks.errors(model, dtype)
    steps = tasks.fewest_steps(by_steps) if steps is None else steps
    one, args = each_push(model, dtype, batch, steps)

    def final(*args):
        return in_tiles(lambda *each: one(*each).pose[-1], args, batch)

    modes = jax.vmap(lambda *each: one(*each).mode)(*jax.tree.map(lambda leaf: leaf[: min(batch, 500)], args))
    contact = float(np.mean(np.asarray(modes) != pj.ContactMode.SEPARATED))
    count = _needed(args, dtype) if model == "quartic" else None
    return Work(f"push_{model}", dtype, batch, steps * contact, final, args, count, by_steps.get(steps))


def gradient(dtype: str, batch: int) -> Work:
    """d (x + y + theta) of the final pose by the surface, the path and the friction, of the same pushes."""
    plain = push(dtype, batch)
    derivative = jax.grad(lambda args: jnp.sum(plain.function(*args)))
    return plain._replace(case="gradient", function=lambda *args: derivative(args), needed=None)


def grasp(dtype: str, batch: int, steps: int | None = None, varied: bool = False) -> Work:
    """Two fingers close on the square, askew, and turn it; final poses. varied: each has a surface of its own."""
    by_steps = grasps.errors(dtype) if steps is None else {}
    steps = tasks.fewest_steps(by_steps) if steps is None else steps
    one, args = each_grasp(grasps.hand(dtype), dtype, batch, steps)

    def final(*args):
        return in_tiles(lambda *each: one(*each).pose[-1], args, batch)

    name = "grasp_two_fingers"
    if varied:
        surface = tasks.task("quartic", dtype).slider.surface
        name, args = "grasp_surfaces", (*args, _surfaces(surface, jax.random.key(0), batch))
    return Work(name, dtype, batch, steps, final, args, None, by_steps.get(steps))


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


def fit(dtype: str, batch: int, degree: int) -> Work:
    """Surfaces of `degree` from `PAIRS` wrench-twist pairs each, as a user has them: with checks and report."""

    def surfaces(*args):
        return jax.vmap(lambda *each: pj.fit_limit_surface(*each, degree=degree, report=True))(*args)

    name = {2: "ellipsoid", 4: "quartic"}[degree]
    return Work(f"fit_{name}", dtype, batch, 1.0, surfaces, pairs(dtype, batch))


def pairs(dtype: str, batch: int) -> tuple:
    """Wrenches and twists (batch, PAIRS, 3) and lengths (batch,) of the square on its 64 points."""
    support = tasks.cast(pj.Support.uniform(pj.Polygon.rectangle(tasks.SIDE, tasks.SIDE)), "float64")
    keys = jax.random.split(jax.random.key(0), batch)
    return tasks.cast(jax.jit(jax.vmap(lambda key: support.wrench_twist_pairs(key, PAIRS)))(keys), dtype)


def monte_carlo(dtype: str, batch: int) -> Work:
    """Pushes under random friction from end to end: a key in, numpy and the summary out."""
    steps = 8  # 0.1 mm, see `push`; the tip touches in all of them
    here = tasks.task("quartic", dtype)
    path = tasks.paths(jnp.array([0.01], dtype), jnp.array([0.2], dtype), steps)[0]
    model = tasks.cast(pj.FrictionModel(dof=20, friction=(0.15, 0.35)), dtype)

    def summary(key):
        pushes = pj.monte_carlo(key, batch, here.slider, here.hand, path, pose=here.pose, model=model)
        return pushes.summary()

    return Work("monte_carlo", dtype, batch, steps, summary, (jax.random.key(1),), host=True)


def in_tiles(function: Callable, args: tuple, batch: int) -> Any:
    """`vmap`, of no more than TILE at once; what has no cache to keep it in does all at once."""
    if batch <= TILE or not on_cpu():
        return jax.vmap(function)(*args)
    return jax.lax.map(lambda each: function(*each), args, batch_size=TILE)


def each_push(model: str, dtype: str, batch: int, steps: int) -> tuple[Callable[..., pj.Trajectory], tuple]:
    """What makes one; and surface, path and friction of each, all different, so that no work can be shared."""
    here = tasks.task(model, dtype)
    keys = jax.random.split(jax.random.key(0), 4)

    def uniform(key, low, high):
        return jax.random.uniform(key, (batch,), dtype, low, high)

    def one(surface: Any, path: Any, friction: Any) -> pj.Trajectory:
        return here._replace(slider=pj.Slider(here.slider.shape, surface)).push(path, friction)

    surface = _surfaces(here.slider.surface, keys[0], batch)
    path = tasks.paths(
        uniform(keys[1], -tasks.REACH, tasks.REACH), uniform(keys[2], -tasks.STEEPEST, tasks.STEEPEST), steps
    )
    return one, (surface, path, uniform(keys[3], 0.15, 0.35))


def each_grasp(hand: pj.Hand, dtype: str, batch: int, steps: int) -> tuple[Callable[..., pj.Trajectory], tuple]:
    """What makes one, of one surface unless a third argument gives another; and pose and path of each. hand: whose
    last coordinate is the opening."""
    slider, friction = tasks.task("quartic", dtype).slider, jnp.asarray(grasps.FRICTION, dtype)

    def one(pose: Any, path: Any, surface: Any = slider.surface) -> pj.Trajectory:
        return pj.rollout(pj.Slider(slider.shape, surface), hand, path, pose=pose, friction=friction)

    poses = grasps.random_poses(jax.random.key(1), batch, dtype)
    return one, (poses, grasps.paths(poses, steps))


def _surfaces(surface: pj.LimitSurface, key: Array, batch: int) -> pj.LimitSurface:
    """As many, each scaled differently; their lengths are the same."""
    scale = 1 + 0.01 * jax.random.normal(key, (batch,), surface.length.dtype)

    def each(leaf):
        return scale.reshape(-1, *(1,) * leaf.ndim) * leaf[None] if leaf.ndim else jnp.broadcast_to(leaf, (batch,))

    return jax.tree.map(each, surface)


def _needed(args: tuple, dtype: str) -> float:
    """FLOPs of a step, the mean of some of the pushes of a quartic."""
    surface, path, friction = jax.tree.map(lambda leaf: np.asarray(leaf[:NEEDED_OF], float), args)
    shape = tasks.square("quartic").shape
    assert isinstance(shape, pj.Polygon)
    vertices = [(float(x), float(y)) for x, y in np.asarray(shape.vertices)]
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
