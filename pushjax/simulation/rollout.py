"""Rollouts of pushes and grasps: one step, and a path of steps.

Quasi-static motion does not depend on time, so a step is a displacement of the hand; `pushjax.simulation.step` has the
scheme of a step. The only state is the pose of the pushed slider.

If no motion satisfies every contact, the hand has jammed, and it stops there for good.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.autodiff import keep_found
from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_non_negative,
    check_shape,
    check_type,
    common_dtype,
    concrete,
    traced,
)
from pushjax._internal.jit import quick_jit
from pushjax._math.vec import Scalar, Vec3
from pushjax.contact.problem import to_scalars
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.status import Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form, LimitSurface
from pushjax.friction.table import Table, TransformedForm
from pushjax.geometry.shape import Shape
from pushjax.simulation.detection import MAX_PENETRATION, num_contacts
from pushjax.simulation.hand import Hand
from pushjax.simulation.path import checked_path
from pushjax.simulation.step import (
    ScalarStep,
    finger_motions,
    holding_distance,
    max_penetration,
    step_in_scalars,
    unstack_finger_poses,
)
from pushjax.simulation.substeps import divided, stopping

OVERLAPS = 4096  # poses whose overlaps are computed together


class Slider(eqx.Module):
    """The pushed object.

    Attributes:
        shape: Outline, in the slider's body frame.
        surface: Limit surface, in the slider's body frame.
    """

    shape: Shape
    surface: LimitSurface

    def __check_init__(self):
        check_type("shape", self.shape, Shape)
        check_type("surface", self.surface, LimitSurface)


class Step(eqx.Module):
    """Result of one step of a push.

    Twist, wrench, force and mode are the solution of the contact problem when the slider is halfway through its motion,
    in the body frame of that halfway pose. Where nothing pushes, twist, wrench and force are zero, and the modes are
    SEPARATED. Otherwise the wrench lies on the limit surface ("on H = 1" below), and the forces sum to it. Contacts are
    in the order of the fingers. A round finger has one contact, or two on an outline that is not convex. A pad has two
    contacts in general, one on a disk, and three on a polygon that is not convex.

    The contact point moves in a straight line, and the rest of the slider turns about it. So the pose after the step
    agrees with the exponential of the twist to second order only. For a step that was divided
    (`pushjax.simulation.substeps`), the twist is the sum over its parts, and wrench, force and mode are those of the
    last part in which the slider moved.

    MOVING, FREE, JAMMED and GRASPED promise a bound on the overlap after the step. The bound is the overlap before the
    step or, if that is more, a tenth of the largest displacement of the fingers in the step, but at least 1e-5 of the
    surface's length. The exception is one round finger on a convex outline. Its overlap is recorded, but is not
    checked, and the step is not tried again. In all measurements it was below the bound.

    Attributes:
        pose: Pose of the slider after the step, (3,), world, m and rad.
        twist: Twist of the slider over the step, (3,), body frame, m and rad.
        wrench: Wrench on the slider, (3,), body frame, N and N m, on H = 1.
        force: Forces along normal and tangent of each contact, (contacts, 2), N, on H = 1.
        mode: `ContactMode` of each contact, (contacts,).
        status: `Status` of the step.
        overlap: Depth of the deepest finger in the slider after the step, m, computed from the whole outline; negative
            where all are apart. Not differentiated.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    wrench: Float[Array, "3"]
    force: Float[Array, "contacts 2"]
    mode: Int[Array, "contacts"]
    status: Int[Array, ""]
    overlap: Float[Array, ""]


class Trajectory(eqx.Module):
    """A push, step by step: the fields of `Step` with a leading axis of steps, and the configurations of the hand.

    At a jam the hand stops, within a sixteenth of a step before the jam. The status is then JAMMED, or GRASPED if every
    finger holds the slider, at this step and at every step after it, and nothing moves any more.

    Attributes:
        pose: Poses of the slider, (steps + 1, 3), world, m and rad; the first is the start.
        configuration: Actual configurations of the hand, (steps + 1, dof): the path up to a jam, then where the hand
            stopped.
        twist: Twist of the slider over each step, (steps, 3), body frame, m and rad.
        wrench: Wrench on the slider in each step, (steps, 3), body frame, N and N m, on H = 1.
        force: Forces along normal and tangent of each contact, (steps, contacts, 2), N, on H = 1.
        mode: `ContactMode` of each contact, (steps, contacts).
        status: `Status` of each step, (steps,).
        overlap: Depth of the deepest finger in the slider after each step, (steps,), m. Not differentiated.
    """

    pose: Float[Array, "steps+1 3"]
    configuration: Float[Array, "steps+1 dof"]
    twist: Float[Array, "steps 3"]
    wrench: Float[Array, "steps 3"]
    force: Float[Array, "steps contacts 2"]
    mode: Int[Array, "steps contacts"]
    status: Int[Array, "steps"]
    overlap: Float[Array, "steps"]

    @property
    def failed(self) -> Bool[Array, "steps"]:
        """Steps whose status is a failure (`Status.failed`), (steps,); there the slider stays where it was."""
        return jnp.isin(self.status, jnp.array([s for s in Status if s.failed], self.status.dtype))

    @property
    def stopped(self) -> Int[Array, ""]:
        """Index of the step at which the hand jammed or grasped, or -1."""
        return _first(stopping(self.status))

    @property
    def first_failure(self) -> Int[Array, ""]:
        """Index of the first failed step, or -1."""
        return _first(self.failed)


def _first(steps: Bool[Array, "... steps"]) -> Int[Array, "..."]:
    """Index of the first step that is True, or -1."""
    return jnp.where(jnp.any(steps, axis=-1), jnp.argmax(steps, axis=-1), -1)


def _world(record: ScalarStep, length: Scalar) -> Step:
    """Convert a record to arrays; a stacked record, whose scalars have an axis of steps, too."""
    wrench = (record.wrench.x, record.wrench.y, record.wrench.z * length)
    return Step(
        pose=jnp.stack(record.pose, axis=-1),
        twist=jnp.stack(record.twist, axis=-1),
        wrench=jnp.stack(wrench, axis=-1),
        force=jnp.stack([jnp.stack(force, axis=-1) for force in record.force], axis=-2),
        mode=jnp.stack(record.mode, axis=-1),
        status=record.status,
        overlap=record.overlap,
    )


def check_slider_and_hand(slider: Slider, hand: Hand) -> None:
    """Raise TypeError unless `slider` and `hand` are of their types."""
    check_type("slider", slider, Slider)
    check_type("slider.shape", slider.shape, Shape)
    check_type("slider.surface", slider.surface, LimitSurface)
    check_type("hand", hand, Hand)


def checked_arguments(
    slider: Slider, hand: Hand, pose: ArrayLike, friction: ArrayLike, *paths: ArrayLike, pushes: int | None = None
):
    """Cast everything to one floating dtype, and check it as far as its values are known.

    Args:
        slider: The slider.
        hand: The hand.
        pose: Pose of the slider, (3,), world.
        friction: Coefficient of friction mu, a scalar or (fingers,).
        *paths: Configurations, which only help to decide the dtype.
        pushes: If given, `pose` may also be (pushes, 3).

    Returns:
        Slider, hand, pose, friction (fingers,), and the dtype.
    """
    check_slider_and_hand(slider, hand)
    dtype = common_dtype(slider, hand, pose, friction, *paths)
    start, mu = as_float(pose, dtype), as_float(friction, dtype)
    if pushes is None or start.ndim == 1:
        check_shape("pose", start, (3,))
    elif start.shape != (pushes, 3):
        raise ValueError(f"pose has shape {start.shape}; expected (3,) or ({pushes}, 3)")
    check_finite("pose", start)
    fingers = len(hand.fingers)
    if mu.shape not in ((), (fingers,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({fingers},), one per finger")
    check_finite("friction", mu)
    check_non_negative("friction", mu)
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype), (slider, hand))
    return *cast, start, jnp.broadcast_to(mu, (fingers,)), dtype


def checked_rollout_arguments(
    slider: Slider, hand: Hand, path: ArrayLike, pose: ArrayLike, friction: ArrayLike, pushes: int | None = None
):
    """Prepare the arguments of a rollout: slider, hand, path, start and friction, in one dtype and checked.

    `path` is as in `rollout`; the other arguments are as in `checked_arguments`.
    """
    slider, hand, start, mu, dtype = checked_arguments(slider, hand, pose, friction, path, pushes=pushes)
    p = checked_path(path, hand.dof, dtype)
    check_opening(hand, p)
    check_start(slider, hand, start, p[0])
    return slider, hand, p, start, mu


def check_start(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> None:
    """Raise ValueError if a finger starts too deep in the slider, unless values are traced.

    Args:
        slider: The slider.
        hand: The hand.
        poses: Poses of the slider, (3,) or (pushes, 3), world.
        configuration: First configuration of the hand, (dof,).
    """
    if traced((slider, hand, poses, configuration)):
        return
    many = np.atleast_2d(poses)
    some, found = min(len(many), OVERLAPS), []
    for first in range(0, len(many), some):  # parts of equal size; the last one is padded
        part = many[np.minimum(np.arange(first, first + some), len(many) - 1)]
        found.append(np.asarray(overlaps(slider, hand, jnp.asarray(part), configuration)))
    overlap = np.concatenate(found)
    worst = int(np.argmax(overlap))
    allowed = MAX_PENETRATION * float(slider.surface.length)
    if overlap[worst] > allowed:
        where = "" if poses.ndim == 1 else f" at pose {worst}"
        raise ValueError(
            f"path starts with the hand inside the slider{where}: a finger overlaps it by {1e3 * overlap[worst]:.3g} "
            f"mm; at most {1e3 * allowed:.3g} mm ({MAX_PENETRATION:g} of the surface's length) is pushed out"
        )


@quick_jit
def overlaps(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> Array:
    """Depth of the deepest finger in the slider, m, for each pose."""
    where = unstack_finger_poses(hand.poses(configuration))
    grips = finger_motions(hand, jnp.zeros(len(hand.fingers), poses.dtype), where, where)
    return jax.vmap(lambda pose: max_penetration(slider.shape.outline(), grips, Vec3.of(pose), 0.0))(poses)


def check_opening(hand: Hand, path: Array) -> None:
    """Raise ValueError if a path closes the hand on itself, unless values are traced."""
    least, known = hand.least, concrete(path)
    if least is None or known is None or traced(least):
        return
    narrow = np.flatnonzero(np.atleast_2d(known)[:, -1] < float(least))
    if narrow.size:
        raise ValueError(
            f"path closes the hand on itself: d is {np.atleast_2d(known)[narrow[0], -1]:.6g} m at index {narrow[0]}; "
            f"with these fingers it must be at least {float(least):.6g} m"
        )


def step(
    slider: Slider,
    hand: Hand,
    q0: ArrayLike,
    q1: ArrayLike,
    *,
    pose: ArrayLike,
    friction: ArrayLike,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
) -> Step:
    """Move the hand from one configuration to another; this is the one step that `rollout` scans.

    A traced value that is not finite, a traced negative friction, and a finger inside the slider show in the status of
    the step.

    Args:
        slider: The slider.
        hand: The hand.
        q0: Configuration of the hand before the step, (dof,), world, m.
        q1: Configuration of the hand after the step, (dof,), world, m.
        pose: Pose of the slider before the step, (3,), world, m and rad.
        friction: Coefficient of friction mu between fingers and slider, a scalar or (fingers,).
        solver: Solver of contact problems, as in `rollout`.
        table: A table whose friction depends on direction or place, as in `rollout`.

    Returns:
        The result of the step.

    Raises:
        ValueError: For arguments of a wrong shape, and for more contacts than the solver can solve. Where they are not
            traced, also for values that are not finite, a negative friction, or a hand that is closed on itself.
    """
    slider, hand, start, mu, dtype = checked_arguments(slider, hand, pose, friction, q0, q1)
    ends = as_float(q0, dtype), as_float(q1, dtype)
    for name, q in zip(("q0", "q1"), ends, strict=True):
        check_shape(name, q, (hand.dof,))
        check_finite(name, q)
        check_opening(hand, q)
    return _step(slider, hand, *ends, start, mu, solver, checked_table(table, dtype))


@quick_jit
def _step(slider, hand, q0, q1, pose, friction, solver, table) -> Step:
    uniform = to_scalars(slider.surface, friction)
    friction_at = on_table(table, lambda step, pose: uniform)
    push = simulate(slider.shape, hand, jnp.stack([q0, q1]), pose, solver, friction_at)
    fields = {name: getattr(push, name)[-1] for name in Step.__dataclass_fields__}
    return Step(**fields)


def rollout(
    slider: Slider,
    hand: Hand,
    path: ArrayLike,
    *,
    pose: ArrayLike,
    friction: ArrayLike,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
) -> Trajectory:
    """Push the slider along a path of hand configurations.

    There is no state besides the slider's pose: a push continues with `rollout(..., rest_of_path, pose=push.pose[-1])`.

    The result is differentiable, in forward and reverse mode, in slider, hand, path, pose, friction and table. Use
    `vmap` for batches.

    A hand that turns while it holds the slider needs kinematics that give the angles of the fingers. If they give only
    centers, every finger moves in a straight line in each step, along the chord of its arc. Two fingers that hold
    something between them then close on it by the sagitta of the arc.

    Args:
        slider: The slider.
        hand: The hand.
        path: Configurations of the hand, (steps + 1, dof), world, m (`line`, `resample` or any recording). The size of
            the steps sets the accuracy.
        pose: Pose of the slider at the start, (3,), world, m and rad.
        friction: Coefficient of friction mu between fingers and slider, a scalar or (fingers,).
        solver: Solver of contact problems. The default first solves the contact that is pressed most, as if there were
            no other. If another contact does not separate in that solution, several contacts are solved together
            (`pushjax.contact.single_first`). If several motions satisfy all contacts, `Exhaustive()` gives the one of
            largest power, which the default need not do.
        table: A table whose friction depends on direction or place; None for uniform friction.

    Returns:
        The push, step by step.

    Raises:
        ValueError: As in `step`. Also for a finger that starts inside the slider by more than a fifth of the surface's
            length, where this is not traced (a smaller overlap is pushed out in the first step). For traced values the
            `status` of each step shows the failure instead, and `first_failure` gives the step.

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
    slider, hand, p, start, mu = checked_rollout_arguments(slider, hand, path, pose, friction)
    return _rollout(slider, hand, p, start, mu, solver, checked_table(table, start.dtype))


@quick_jit
def _rollout(slider, hand, path, pose, friction, solver, table) -> Trajectory:
    uniform = to_scalars(slider.surface, friction)
    friction_at = on_table(table, lambda step, pose: uniform)
    return simulate(slider.shape, hand, path, pose, solver, friction_at)


# From the index of a step and the pose before it: H of the limit surface, and the friction of each finger.
FrictionAt = Callable[[Array, Vec3], tuple[Form, Array]]


def checked_table(table: Table | None, dtype: Any) -> Table | None:
    """Return the table in a floating dtype. Raises TypeError for anything else than a table or None."""
    if table is None:
        return None
    check_type("table", table, Table)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), table)


def on_table(table: Table | None, friction_at: FrictionAt) -> FrictionAt:
    """Return the friction on a table from that on a uniform one. If the table is not finite, no contact is valid."""
    if table is None:
        return friction_at
    known = jnp.isfinite(sum(jnp.sum(leaf) for leaf in jax.tree.leaves(table)))

    def changed(step: Array, pose: Vec3) -> tuple[Form, Array]:
        form, mu = friction_at(step, pose)
        return TransformedForm(form, table.warp(pose, form.length)), jnp.where(known, mu, jnp.nan)

    return changed


def simulate(
    shape: Shape,
    hand: Hand,
    path: Array,
    pose: Array,
    solver: ContactSolver | StickingSolver | None,
    friction_at: FrictionAt,
) -> Trajectory:
    """Roll out a path.

    Args:
        shape: Outline of the slider.
        hand: The hand.
        path: Configurations of the hand, (steps + 1, dof).
        pose: Pose of the slider at the start, (3,), world.
        solver: Solver of contact problems; None for the default.
        friction_at: Function that gives limit surface and friction of a step, from its index and the pose before it.
            All surfaces must have the same length.
    """
    outline, poses, steps = shape.outline(), hand.poses(path), len(path) - 1
    start = Vec3.of(pose)

    def grips_at(step: Array, mu: Array):
        before, after = (jax.lax.dynamic_index_in_dim(poses, step + k, keepdims=False) for k in (0, 1))
        return finger_motions(hand, mu, unstack_finger_poses(before), unstack_finger_poses(after))

    if sum(num_contacts(finger, outline) for finger in hand.fingers) == 1:
        records, share = _undivided(outline, steps, grips_at, solver, start, friction_at), jnp.zeros_like(start.x)
    else:
        records, share = divided(outline, steps, grips_at, solver, start, friction_at)
    done = _world(records, friction_at(jnp.zeros((), jnp.int32), start)[0].length)
    stopped = _first(stopping(done.status))
    reached = jnp.where(stopped >= 0, stopped, steps)
    index = jnp.arange(steps + 1)
    # in a step that was divided the hand stops on the way
    onward = jax.lax.stop_gradient(share) * (path[jnp.minimum(reached + 1, steps)] - path[reached])
    configuration = path[jnp.minimum(index, reached)] + jnp.where(index > reached, 1.0, 0.0)[:, None] * onward[None]
    poses = jnp.concatenate([pose[None], done.pose])
    return Trajectory(poses, configuration, done.twist, done.wrench, done.force, done.mode, done.status, done.overlap)


def _undivided(outline, steps, grips_at, solver, start, friction_at) -> ScalarStep:
    """Records of all steps for one round finger on a convex outline, which has only one contact to check."""

    def body(pose: Vec3, step: Array):
        form, mu = friction_at(step, pose)
        grips = grips_at(step, mu)
        before = max_penetration(outline, grips, pose, 0.0)  # contact detection starts with the same query
        record, _ = step_in_scalars(form, outline, grips, solver, pose, before, holding_distance(grips, form.length))
        return record.pose, record._replace(overlap=before)

    body = jax.checkpoint(body, prevent_cse=False, policy=keep_found)
    last, records = jax.lax.scan(body, start, jnp.arange(steps))
    grips = grips_at(jnp.asarray(steps - 1), friction_at(jnp.asarray(steps - 1), last)[1])
    final = max_penetration(outline, grips, last, 1.0)
    return records._replace(overlap=jnp.concatenate([records.overlap[1:], final[None]]))
