"""Rollouts of pushes and grasps: one step, and a path of steps.

Quasi-static motion does not depend on time, so a step is a displacement of the hand; `pushjax.simulation.step` has the
scheme of a step. The state is the pose of the pushed slider, with few exceptions (`rollout`).

If no motion satisfies every contact, the hand has jammed, and it stops there for good. A step in which the hand stays
changes nothing.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from pushjax._internal.checks import ArrayLike, as_float, check_finite, check_shape, check_type
from pushjax._internal.jit import is_staging, quick_jit
from pushjax._math.vec import Vec3
from pushjax.contact.problem import check_solver, form_and_friction
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.feet import FeetForm
from pushjax.friction.limit_surface import Form
from pushjax.friction.table import Table, TransformedForm
from pushjax.geometry.shape import Shape
from pushjax.simulation.arguments import (
    check_opening,
    checked_arguments,
    checked_fixtures,
    checked_scene,
    checked_table,
    warn_about_units,
)
from pushjax.simulation.detection import num_contacts
from pushjax.simulation.domain import poses_are_moderate
from pushjax.simulation.fixtures import Fixture, Fixtures, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.prepared_push import FrictionAt, prepared_push
from pushjax.simulation.several_sliders import SlidersFriction, simulate_sliders
from pushjax.simulation.slider import Slider
from pushjax.simulation.substeps import simulate_in_substeps
from pushjax.simulation.trajectory import Step, Trajectory, trajectory_of
from pushjax.simulation.whole_steps import simulate_in_whole_steps

MIN_SIZE, SIZE_RATIO = 32, 4  # steps that programs are compiled for: 32, 128, 512, ...


def step(
    slider: Slider | Sequence[Slider],
    hand: Hand,
    q0: ArrayLike,
    q1: ArrayLike,
    *,
    pose: ArrayLike,
    friction: ArrayLike,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
    between: ArrayLike | None = None,
) -> Step:
    """Move the hand from one configuration to another: a rollout of one step, which is divided where it must be.

    Some faults raise no error, but show in the status of the step. It is OVERLAPPING if a finger or a fixture starts
    too deep in the slider, and INVALID if a traced value is not finite or a traced friction is negative.

    Args:
        slider: The slider, or a tuple of several, as in `rollout`.
        hand: The hand.
        q0: Configuration of the hand before the step, (dof,), world, m and rad.
        q1: Configuration of the hand after the step, (dof,), world, m and rad.
        pose: Pose of the slider before the step, (3,), world, m and rad; of several, (sliders, 3).
        friction: Coefficient of friction mu between fingers and slider, a scalar or (fingers,).
        solver: Solver of contact problems, as in `rollout`.
        table: A table whose friction depends on direction or place, as in `rollout`.
        fixtures: Walls and bodies that the slider may touch, as in `rollout`.
        between: Coefficient of friction of several sliders with each other, as in `rollout`.

    Returns:
        The result of the step. Of several sliders, pose, twist and wrench have an axis for them.

    Raises:
        ValueError: For arguments of a wrong shape, and for more contacts than the solver can solve. Where they are not
            traced, also for values that are not finite, a negative friction, or a hand that is closed on itself. For
            several sliders as in `rollout`.
        TypeError: For a slider, hand, solver, table or fixture of another type.
    """
    if isinstance(slider, tuple | list):
        check_type("hand", hand, Hand)
        path = [as_float(q, name=name) for name, q in (("q0", q0), ("q1", q1))]
        for name, q in zip(("q0", "q1"), path, strict=True):
            check_shape(name, q, (hand.dof,))
        scene = checked_scene(slider, hand, jnp.stack(path), pose, friction, between, solver, table, fixtures)
        before, after = scene.path
        return _step(scene.slider, scene.hand, before, after, scene.start, scene.friction, None, None, scene.fixtures)
    if between is not None:
        raise ValueError("between is for several sliders; got one")
    one: Any = slider
    one, hand, start, mu, dtype = checked_arguments(one, hand, pose, friction, q0, q1)
    ends = as_float(q0, dtype, "q0"), as_float(q1, dtype, "q1")
    for name, q in zip(("q0", "q1"), ends, strict=True):
        check_shape(name, q, (hand.dof,))
        check_finite(name, q)
        check_opening(hand, q)
    check_solver(solver)
    warn_about_units(one, start, *ends)
    fixed = checked_fixtures(fixtures, dtype)
    return _step(one, hand, *ends, start, mu, solver, checked_table(table, dtype), fixed)


@quick_jit
def _step(slider, hand, q0, q1, pose, friction, solver, table, fixtures) -> Step:
    push = _simulated(slider, hand, jnp.stack([q0, q1]), pose, friction, solver, table, fixtures)
    fields = {name: getattr(push, name)[-1] for name in Step.__dataclass_fields__}
    return Step(**fields)


def rollout(
    slider: Slider | Sequence[Slider],
    hand: Hand,
    path: ArrayLike,
    *,
    pose: ArrayLike,
    friction: ArrayLike,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
    fixtures: Sequence[Wall | Fixture] = (),
    between: ArrayLike | None = None,
) -> Trajectory:
    """Push the slider, or several that push each other, along a path of hand configurations.

    There is no state besides the slider's pose: a push continues with `rollout(..., rest_of_path, pose=push.pose[-1])`.
    Four things are remembered within a rollout only. A hand that has jammed stays where it is. The step after a failed
    one is not divided. Where several motions satisfy all contacts, the one that continues is taken. And a path of n
    steps has at most 4 n + 64 trials of a step or a part of one.

    The result is differentiable, in forward and reverse mode, in slider, hand, path, pose, friction and table. Use
    `vmap` for batches.

    Args:
        slider: The slider; or a tuple of several, each pair of which has a disk or a polygon.
        hand: The hand.
        path: Configurations of the hand, (steps + 1, dof), world, m and rad (`line`, `resample` or any recording). The
            size of the steps sets the accuracy.
        pose: Pose of the slider at the start, (3,), world, m and rad; of several, (sliders, 3).
        friction: Coefficient of friction mu between fingers and slider, a scalar or (fingers,).
        solver: Solver of contact problems. The default suits every hand. Where several motions satisfy all contacts,
            the default takes the one that continues, if one does. `Exhaustive()` takes the one of largest power.
        table: A table whose friction depends on direction or place; None for uniform friction.
        fixtures: Walls (`Wall`) and bodies (`Fixture`) that stay where they are, and that the slider may touch.
            Their contacts come after those of the fingers.
        between: Coefficient of friction of several sliders with each other, a scalar or (sliders, sliders).

    Returns:
        The push, step by step. Of several sliders, pose, twist and wrench have an axis for them. The contacts are those
        of the first slider with each finger, of the second one, and so on; then those with fixtures; then those of
        sliders 1 and 0, 2 and 0, 2 and 1, and so on. They are in the frame of the first of the two, or of the second
        one if only that one is not convex. A slider that rests has a zero twist, and a wrench inside its limit surface.

    Raises:
        ValueError: As in `step`; for several sliders also without `between`, or with a solver or a table, which are
            for one. Also for a finger or a fixture that starts inside the slider by more than a fifth of
            the surface's length, where this is not traced (a smaller overlap is pushed out in the first step). For
            traced values the `status` of each step shows the failure instead, and `first_failure` gives the step.
        TypeError: As in `step`.

    Examples:
        >>> import numpy as np, pushjax as pj
        >>> slider = Slider(pj.Polygon.rectangle(0.09, 0.06), pj.Ellipsoid(np.eye(3), length=0.03))
        >>> path = pj.line((-0.05, 0.01), (0.0, 0.01), steps=20)
        >>> push = rollout(slider, pj.Hand.finger(0.005), path, pose=(0.0, 0.0, 0.0), friction=0.3)
        >>> print(pj.Status(int(push.status[-1])).name, np.asarray(push.pose[-1]).round(3))
        MOVING [ 0.047 -0.01  -0.234]

    Reference: Zhou et al. 2017, section IV.A, and open problem 2 of section VII. The header of
    `pushjax.simulation.step` has the scheme.
    """
    scene = checked_scene(slider, hand, path, pose, friction, between, solver, table, fixtures)
    slider, hand, path_array, start, mu, table, fixed = scene
    checked = slider, hand, path_array, start, mu, solver, table, fixed
    return _rollout(*checked) if is_staging() else _rollout_with_padding(*checked)


def _simulated(slider, hand, path, pose, friction, solver, table, fixtures, num_steps=None) -> Trajectory:
    if isinstance(slider, tuple):
        constant = SlidersFriction.of(tuple(one.surface for one in slider), *friction)
        shapes = tuple(one.shape for one in slider)
        return simulate_sliders(shapes, hand, path, pose, lambda step: constant, fixtures, num_steps)
    uniform = form_and_friction(slider.surface, friction)
    friction_at = friction_on_table(table, lambda step, pose: uniform)
    return simulate(slider.shape, hand, path, pose, solver, friction_at, fixtures, num_steps)


_rollout = quick_jit(_simulated)


def _rollout_with_padding(slider, hand, path, *rest) -> Trajectory:
    """Roll out a path that is filled up to one of a few lengths, so that paths of many lengths share a program."""
    # Compiling takes seconds. The path ends with copies of its last configuration, which are not simulated.
    steps, size = len(path) - 1, MIN_SIZE
    while size < steps:
        size *= SIZE_RATIO
    xp = jnp if isinstance(path, Tracer) else np  # with NumPy nothing is compiled for the padding
    padded = jnp.asarray(xp.concatenate([path, xp.broadcast_to(path[-1], (size - steps, path.shape[1]))]))
    return _first_steps(_rollout(slider, hand, padded, *rest, num_steps=jnp.asarray(steps)), steps)


@partial(jax.jit, static_argnums=1)
def _first_steps(push: Trajectory, steps: int) -> Trajectory:
    """Return the first steps of a push."""
    extra = {"pose": 1, "configuration": 1}  # these have one row more than there are steps, the start
    arrays = [name for name in Trajectory.__dataclass_fields__ if name != "contacts"]
    return dataclasses.replace(push, **{name: getattr(push, name)[: steps + extra.get(name, 0)] for name in arrays})


def friction_on_table(table: Table | None, friction_at: FrictionAt) -> FrictionAt:
    """Return the friction on a table (None for a uniform one), given the friction on a uniform table."""
    if table is None:
        return friction_at
    valid = table.is_valid()  # if False, the coefficients of friction are NaN, so every step is INVALID
    known = jax.tree.map(lambda leaf: jnp.where(valid, leaf, 0.0), table)

    def friction_at_table(step: Array, pose: Vec3) -> tuple[Form, Array]:
        form, mu = friction_at(step, pose)
        return TransformedForm(form, known.wrench_transform(pose, form.length)), jnp.where(valid, mu, jnp.nan)

    return friction_at_table


def simulate(
    shape: Shape,
    hand: Hand,
    path: Array,  # (steps + 1, dof), world
    pose: Array,  # at the start, (3,), world
    solver: ContactSolver | StickingSolver | None,
    friction_at: FrictionAt,  # all of its surfaces must have the same length
    fixtures: Fixtures = (),
    num_steps: Array | None = None,  # steps to simulate; None for all. The rest of the result has no meaning
) -> Trajectory:
    """Roll out a path, with arguments that have been checked. `rollout` is the public function."""
    first_form = friction_at(jnp.zeros((), jnp.int32), Vec3.of(pose))[0]
    if isinstance(first_form, FeetForm) and solver is None:

        def alone_at(step: Array) -> SlidersFriction:
            form, mu = friction_at(step, Vec3.of(pose))
            return SlidersFriction((form,), mu, jnp.zeros((1, 1), pose.dtype))

        push = simulate_sliders((shape,), hand, path, pose[None], alone_at, fixtures, num_steps)
        of_slider = {name: getattr(push, name)[:, 0] for name in ("pose", "twist", "wrench")}
        return dataclasses.replace(push, **of_slider)
    push, first_pose = prepared_push(shape, hand, path, pose, solver, friction_at, fixtures)
    push, start = push._replace(num_steps=num_steps), Vec3.of(first_pose)
    sizes = [num_contacts(body, push.outline) for body in (*hand.fingers, *(each.finger for each in push.fixtures))]
    others = [f"finger {k}" for k in range(len(hand.fingers))] + [f"fixture {k}" for k in range(len(fixtures))]
    contacts = tuple(("slider 0", name) for name, size in zip(others, sizes, strict=True) for _ in range(size))
    if len(contacts) == 1:
        records = simulate_in_whole_steps(push, start)
        fraction = jnp.zeros_like(start.x)
    else:
        records, fraction = simulate_in_substeps(push, start)
    length = push.friction_at(jnp.zeros((), jnp.int32), start)[0].length
    valid = poses_are_moderate(pose, length)
    return trajectory_of(records, length, path, first_pose, fraction, pose, valid, contacts)
