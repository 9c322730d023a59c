"""The programs to time: each case makes one for a dtype and a batch, with the number of steps to divide its time by."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import pushjax as pj
from benchmarks import grasps, reference_push
from benchmarks.timing import on_cpu
from pushjax.testing.problems import random_contacts_problem

TILE = 4000  # pushes of a larger batch that are computed together, so that their data stay in the cache
MANY_STEPS = 8  # of a push or grasp whose error is not measured
SPACING = 0.03  # distance between the centers of two fingers that push side by side, m
PAIRS = 400  # wrench-twist pairs of a fit


class Work(NamedTuple):
    """One program to time."""

    case: str  # name of the row
    dtype: str  # "float32" or "float64"
    batch: int  # number of pushes, grasps, problems, surfaces or fits
    steps: float  # mean number of steps in contact of each of the batch; one where there are no steps
    function: Callable  # of `args`
    args: tuple
    error_mm: float | None = None  # largest error of the final poses of the fan at this number of steps
    host: bool = False  # whether `function` is called as it is, instead of being compiled


def push(dtype: str, batch: int, model: str = "quartic", steps: int | None = None) -> Work:
    """Make a program for random pushes in the range of the fan, each with its own surface and friction."""
    by_steps = reference_push.errors(model, dtype)
    steps = reference_push.fewest_steps(by_steps) if steps is None else steps  # within `reference_push.ALLOWED_MM`
    one, args = each_push(model, dtype, batch, steps)

    modes = jax.vmap(lambda *each: one(*each).mode)(*jax.tree.map(lambda leaf: leaf[: min(batch, 500)], args))
    contact = float(np.mean(np.asarray(modes) != pj.ContactMode.SEPARATED))
    return Work(f"push_{model}", dtype, batch, steps * contact, final_poses(one, batch), args, by_steps.get(steps))


def gradient(dtype: str, batch: int) -> Work:
    """Make a program for the gradient of x + y + theta by surface, path and friction, of the same pushes."""
    plain = push(dtype, batch)
    derivative = jax.grad(lambda args: jnp.sum(plain.function(*args)))
    return plain._replace(case="gradient", function=lambda *args: derivative(args))


def grasp(dtype: str, batch: int, steps: int | None = None, varied: bool = False) -> Work:
    """Make a program for random grasps with one surface or `varied` ones: two fingers turn the askew square."""
    by_steps = grasps.errors(dtype) if steps is None else {}
    steps = reference_push.fewest_steps(by_steps) if steps is None else steps
    one, args = each_grasp(grasps.hand(dtype), dtype, batch, steps)

    name = "grasp_two_fingers"
    if varied:
        surface = reference_push.task("quartic", dtype).slider.surface
        name, args = "grasp_surfaces", (*args, _surfaces(surface, jax.random.key(0), batch))
    return Work(name, dtype, batch, steps, final_poses(one, batch), args, by_steps.get(steps))


def push_t(dtype: str, batch: int, where: str = "side") -> Work:
    """Make a program for random 50 mm pushes of a T on its bar ("side"), of its convex hull or into an inner corner."""
    here = reference_push.task("quartic", dtype)
    block = reference_push.cast(reference_push.t_block(hull=where == "hull"), dtype)
    here = here._replace(slider=pj.Slider(block, here.slider.surface))
    _, (_, path, friction) = each_push("quartic", dtype, batch, MANY_STEPS)  # the pushes of the square
    if where == "corner":  # where every finger touches bar and stem
        start = jnp.array(
            [-reference_push.SIDE / 4 + reference_push.RADIUS, reference_push.SIDE / 8 + reference_push.RADIUS], dtype
        )
        diagonal = jnp.array([[-1, -1], [1, -1]], dtype) / 2**0.5  # from the normal of the side to that of the corner
        path = start[None, None] + (path - path[:, :1]) @ diagonal

    name = {"side": "push_t", "hull": "push_t_hull", "corner": "push_t_corner"}[where]
    return Work(name, dtype, batch, MANY_STEPS, final_poses(here.push, batch), (path, friction))


def push_two_fingers(dtype: str, batch: int) -> Work:
    """Make a program for the final poses of random pushes of the square by two fingers side by side, by 50 mm."""
    here = reference_push.task("quartic", dtype)._replace(hand=grasps.hand(dtype))
    _, (_, path, friction) = each_push("quartic", dtype, batch, MANY_STEPS)
    path = path.at[..., 1].multiply(0.5)  # both fingers stay on the side
    still = jnp.zeros_like(path[..., 0])
    path = jnp.stack([path[..., 0], path[..., 1], still, still + SPACING], axis=-1)

    return Work("push_two_fingers", dtype, batch, MANY_STEPS, final_poses(here.push, batch), (path, friction))


def grasp_jaw(dtype: str, batch: int) -> Work:
    """Make a program for the final poses of random grasps of the askew square by a parallel jaw."""
    # Each begins where the first pad touches, and ends 1 mm before the straight square would be held, as in `grasp`.
    one, (pose, path) = each_grasp(grasps.jaw(dtype), dtype, batch, MANY_STEPS)
    diameter, share = 2 * reference_push.RADIUS, jnp.linspace(0, 1, MANY_STEPS + 1, dtype=dtype)
    centers = grasps.opening_at(grasps.touching_jaw(pose)[:, None] + diameter, share[None])  # as of round fingers
    path = path.at[..., 3].set(centers - diameter)

    return Work("grasp_jaw", dtype, batch, MANY_STEPS, final_poses(one, batch), (pose, path))


def push_row(dtype: str, batch: int, kind: str, count: int) -> Work:
    """Make a program for the final poses of disks or squares in a row that nearly touch, pushed along it by 50 mm."""
    steps, width, gap = 50, 0.06, 5e-4  # m
    shape = pj.Disk(width / 2) if kind == "disks" else pj.Polygon.rectangle(width, width)
    slider, hand = reference_push.cast((pj.Slider.uniform(shape, degree=2), pj.Hand.finger(0.005)), dtype)
    path = pj.line(jnp.array([-0.036, 0.0], dtype), jnp.array([0.014, 0.0], dtype), steps)
    scatter = jax.random.normal(jax.random.key(0), (batch, count, 3), dtype) * jnp.array([1e-5, 4e-3, 1e-2], dtype)
    poses = scatter + (width + gap) * jnp.arange(count, dtype=dtype)[:, None] * jnp.array([1, 0, 0], dtype)
    sliders, between = ((slider,) * count, jnp.asarray(0.2, dtype)) if count > 1 else (slider, None)

    def one(pose: Any) -> pj.Trajectory:
        friction = jnp.asarray(0.3, dtype)
        return pj.rollout(sliders, hand, path, pose=pose, friction=friction, between=between)

    poses = poses if count > 1 else poses[:, 0]
    return Work(f"push_{count}_{kind}", dtype, batch, steps, jax.vmap(lambda pose: one(pose).pose[-1]), (poses,))


def solve(dtype: str, batch: int, contacts: int) -> Work:
    """Make a program for the twists of random contact problems with `contacts` contacts."""
    draw = jax.vmap(lambda key: random_contacts_problem(key, contacts=contacts))
    problem = reference_push.cast(draw(jax.random.split(jax.random.key(contacts), batch)), dtype)

    def motion(*args):
        return in_tiles(lambda s, c: pj.solve_contacts(s, c).twist, args, batch)

    return Work(f"solve_{contacts}", dtype, batch, 1.0, motion, (problem.surface, problem.contacts))


def sampling(dtype: str, batch: int) -> Work:
    """Make a program for random quartics, certified convex, from the default sampler of `FrictionModel`."""
    surface = reference_push.task("quartic", dtype).slider.surface
    random = reference_push.cast(pj.FrictionModel(dof=20, friction=(0.15, 0.35)), dtype).around(surface)
    keys = jax.random.split(jax.random.key(0), batch)

    def surfaces(keys):
        return in_tiles(lambda key: random.sample(key)[0], (keys,), batch)

    return Work("sampling", dtype, batch, 1.0, surfaces, (keys,))


def fit(dtype: str, batch: int, degree: int) -> Work:
    """Make a program that fits surfaces to `PAIRS` pairs each, as a user does: with checks and a report."""

    def surfaces(*args):
        return jax.vmap(lambda *each: pj.fit_limit_surface(*each, degree=degree, report=True))(*args)

    name = {2: "ellipsoid", 4: "quartic"}[degree]
    return Work(f"fit_{name}", dtype, batch, 1.0, surfaces, pairs(dtype, batch))


def pairs(dtype: str, batch: int) -> tuple:
    """Return wrenches and twists, (batch, PAIRS, 3), and lengths, (batch,), of the square on its 64 points."""
    support = reference_push.cast(
        pj.Support.uniform(pj.Polygon.rectangle(reference_push.SIDE, reference_push.SIDE)), "float64"
    )
    keys = jax.random.split(jax.random.key(0), batch)
    return reference_push.cast(jax.jit(jax.vmap(lambda key: support.wrench_twist_pairs(key, PAIRS)))(keys), dtype)


def monte_carlo(dtype: str, batch: int) -> Work:
    """Make a program for pushes under random friction from end to end: from a key to NumPy arrays and their summary."""
    steps = 8  # within 0.1 mm, as in `push`; the tip touches in all of them
    here = reference_push.task("quartic", dtype)
    path = reference_push.paths(jnp.array([0.01], dtype), jnp.array([0.2], dtype), steps)[0]
    model = reference_push.cast(pj.FrictionModel(dof=20, friction=(0.15, 0.35)), dtype)

    def summary(key):
        pushes = pj.monte_carlo(key, batch, here.slider, here.hand, path, pose=here.pose, model=model)
        return pushes.summary()

    return Work("monte_carlo", dtype, batch, steps, summary, (jax.random.key(1),), host=True)


def final_poses(rollout: Callable[..., pj.Trajectory], batch: int) -> Callable[..., Array]:
    """Return the function from the arguments of a batch to its final poses, (batch, 3)."""

    def final(*args):
        return in_tiles(lambda *each: rollout(*each).pose[-1], args, batch)

    return final


def in_tiles(function: Callable, args: tuple, batch: int) -> Any:
    """Apply `vmap` to at most TILE of the batch at once on a CPU, and to the whole batch on an accelerator."""
    if batch <= TILE or not on_cpu():
        return jax.vmap(function)(*args)
    return jax.lax.map(lambda each: function(*each), args, batch_size=TILE)


def each_push(model: str, dtype: str, batch: int, steps: int) -> tuple[Callable[..., pj.Trajectory], tuple]:
    """Return the function of one push, and the surface, path and friction of each push."""
    # All of these differ between pushes, so that no work can be shared.
    here = reference_push.task(model, dtype)
    keys = jax.random.split(jax.random.key(0), 4)

    def uniform(key, low, high):
        return jax.random.uniform(key, (batch,), dtype, low, high)

    def one(surface: Any, path: Any, friction: Any) -> pj.Trajectory:
        return here._replace(slider=pj.Slider(here.slider.shape, surface)).push(path, friction)

    surface = _surfaces(here.slider.surface, keys[0], batch)
    offset = uniform(keys[1], -reference_push.MAX_OFFSET, reference_push.MAX_OFFSET)
    angle = uniform(keys[2], -reference_push.MAX_ANGLE, reference_push.MAX_ANGLE)
    path = reference_push.paths(offset, angle, steps)
    return one, (surface, path, uniform(keys[3], 0.15, 0.35))


def each_grasp(hand: pj.Hand, dtype: str, batch: int, steps: int) -> tuple[Callable[..., pj.Trajectory], tuple]:
    """Return the function of one grasp by a hand with an opening, and the pose and path of each grasp."""
    # All grasps have the same surface, unless the function's third argument gives another.
    slider, friction = reference_push.task("quartic", dtype).slider, jnp.asarray(grasps.FRICTION, dtype)

    def one(pose: Any, path: Any, surface: Any = slider.surface) -> pj.Trajectory:
        return pj.rollout(pj.Slider(slider.shape, surface), hand, path, pose=pose, friction=friction)

    poses = grasps.random_poses(jax.random.key(1), batch, dtype)
    return one, (poses, grasps.paths(poses, steps))


def _surfaces(surface: pj.LimitSurface, key: Array, batch: int) -> pj.LimitSurface:
    """Return `batch` copies of `surface`, each scaled by another factor; their lengths are the same."""
    scale = 1 + 0.01 * jax.random.normal(key, (batch,), surface.length.dtype)

    def each(leaf):
        return scale.reshape(-1, *(1,) * leaf.ndim) * leaf[None] if leaf.ndim else jnp.broadcast_to(leaf, (batch,))

    return jax.tree.map(each, surface)
