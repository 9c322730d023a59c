"""Pushes and grasps: one step, and a path of them.

Time does not matter to quasi-static motion, so a step is a displacement of the hand; `advance` has its scheme. The
pushed slider's pose is all the state there is.

Where no motion satisfies every contact the hand has jammed: it stops there, for good.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._autodiff import keep_found
from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, instance, non_negative, shaped, traced
from pushjax._programs import quickly_compiled
from pushjax._vec import Scalar, Vec3
from pushjax.advance import Record, advance, columns, deepest, grips_of, holding
from pushjax.contacts import DEEPEST_OVERLAP, count
from pushjax.hands import Hand, checked_path
from pushjax.limit_surface import Form, LimitSurface, WarpedForm
from pushjax.shapes import Shape
from pushjax.solve import ContactSolver, StickingSolver
from pushjax.solve.contacts import ground
from pushjax.status import Status
from pushjax.substeps import divided, stopping
from pushjax.table import Table

OVERLAPS = 4096  # poses that are looked at together


class Slider(eqx.Module):
    """What is pushed: its outline and how it slides, both in its body frame."""

    shape: Shape
    surface: LimitSurface

    def __check_init__(self):
        instance("shape", self.shape, Shape)
        instance("surface", self.surface, LimitSurface)


class Step(eqx.Module):
    """One step of a push.

    pose: (3,), world, after the step. twist: (3,), the slider's over the step, and wrench: (3,), force: (contacts, 2)
    along normal and tangent (N, on H = 1), mode: (contacts,) are those of the contact halfway, in the body frame
    halfway; zero and SEPARATED where nothing pushes. Contacts are in the order of the fingers: one of a round finger,
    two on an outline that is not convex; two of a pad, one on a disk, three on a polygon that is not convex. The pose
    after is that before moved by the twist to the second order (the contact point goes straight), not its exponential.
    Of a step that was divided (`pushjax.substeps`), the twist is the sum over its parts, and wrench, force and mode are
    those of the last part in which the slider moved. status: `Status`. overlap: how deep the deepest finger is inside
    the slider after the step, m, by the whole outline; negative where all are apart. It is a constant to derivatives.

    MOVING, FREE, JAMMED and GRASPED promise that no finger is deeper inside than before, or than a tenth of how far the
    fingers go in the step (a hundred thousandth of the surface's length, if that is more). A step of one round finger
    on a convex outline is not tried again: its overlap is recorded, and was less than that in all that was measured.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    wrench: Float[Array, "3"]
    force: Float[Array, "contacts 2"]
    mode: Int[Array, "contacts"]
    status: Int[Array, ""]
    overlap: Float[Array, ""]


class Trajectory(eqx.Module):
    """A push, step by step; fields as in `Step`, with a leading axis of steps (pose: steps + 1, the start included).

    configuration: where the hand really was: the path, up to a jam. There the hand stops, within a sixteenth of a step
    before the jam; and status says JAMMED, or GRASPED if every finger holds the slider, at this step and every one
    after it; nothing moves any more.
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
        """Steps whose status is a failure (`Status.failed`); there the slider was left where it was."""
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


def _world(record: Record, length: Scalar) -> Step:
    """Arrays of a record; also of a stacked one, whose scalars have an axis of steps."""
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


def check_kinds(slider: Slider, hand: Hand) -> None:
    """Raises TypeError for anything else."""
    instance("slider", slider, Slider)
    instance("slider.shape", slider.shape, Shape)
    instance("slider.surface", slider.surface, LimitSurface)
    instance("hand", hand, Hand)


def arguments(slider: Slider, hand: Hand, pose: Numeric, friction: Numeric, *paths: Numeric, pushes: int | None = None):
    """Everything in one floating dtype, and checked as far as values are known. pushes: that many poses may be given
    in place of one."""
    check_kinds(slider, hand)
    dtype = common_dtype(slider, hand, pose, friction, *paths)
    start, mu = as_float(pose, dtype), as_float(friction, dtype)
    if pushes is None or start.ndim == 1:
        shaped("pose", start, (3,))
    elif start.shape != (pushes, 3):
        raise ValueError(f"pose has shape {start.shape}; expected (3,) or ({pushes}, 3)")
    finite("pose", start)
    fingers = len(hand.fingers)
    if mu.shape not in ((), (fingers,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({fingers},), one per finger")
    finite("friction", mu)
    non_negative("friction", mu)
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype), (slider, hand))
    return *cast, start, jnp.broadcast_to(mu, (fingers,)), dtype


def prepared(slider: Slider, hand: Hand, path: Numeric, pose: Numeric, friction: Numeric, pushes: int | None = None):
    """What every rollout begins with: slider, hand, path, start and friction as `arguments` gives them, all checked."""
    slider, hand, start, mu, dtype = arguments(slider, hand, pose, friction, path, pushes=pushes)
    p = checked_path(path, hand.dof, dtype)
    check_opening(hand, p)
    check_start(slider, hand, start, p[0])
    return slider, hand, p, start, mu


def check_start(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> None:
    """poses: (3,), or (pushes, 3)."""
    if traced((slider, hand, poses, configuration)):
        return
    many = np.atleast_2d(poses)
    some, found = min(len(many), OVERLAPS), []
    for first in range(0, len(many), some):  # as many at once, however many there are
        part = many[np.minimum(np.arange(first, first + some), len(many) - 1)]
        found.append(np.asarray(overlaps(slider, hand, jnp.asarray(part), configuration)))
    overlap = np.concatenate(found)
    worst = int(np.argmax(overlap))
    allowed = DEEPEST_OVERLAP * float(slider.surface.length)
    if overlap[worst] > allowed:
        where = "" if poses.ndim == 1 else f" at pose {worst}"
        raise ValueError(
            f"path starts with the hand inside the slider{where}: a finger overlaps it by {1e3 * overlap[worst]:.3g} "
            f"mm; at most {1e3 * allowed:.3g} mm ({DEEPEST_OVERLAP:g} of the surface's length) is pushed out"
        )


@quickly_compiled
def overlaps(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> Array:
    """By how much the deepest finger overlaps the slider, m, of each pose."""
    where = columns(hand.poses(configuration))
    grips = grips_of(hand, jnp.zeros(len(hand.fingers), poses.dtype), where, where)
    return jax.vmap(lambda pose: deepest(slider.shape.outline(), grips, Vec3.of(pose), 0.0))(poses)


def check_opening(hand: Hand, path: Array) -> None:
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
    q0: Numeric,
    q1: Numeric,
    *,
    pose: Numeric,
    friction: Numeric,
    solver: ContactSolver | StickingSolver | None = None,
) -> Step:
    """Move the hand from configuration `q0` (dof,) to `q1` (dof,), world, m: the one step that `rollout` scans.

    pose: (3,), the slider's, world. friction: mu between fingers and slider, a scalar or (fingers,). solver: as in
    `rollout`.

    Raises ValueError for arguments of the wrong shape, not finite, a negative friction, or a hand closed on itself,
    where they are not traced, and for more contacts than the solver solves. A traced value that is not finite or a
    negative friction, and a finger inside the slider, show in the step's status.
    """
    slider, hand, start, mu, dtype = arguments(slider, hand, pose, friction, q0, q1)
    ends = as_float(q0, dtype), as_float(q1, dtype)
    for name, q in zip(("q0", "q1"), ends, strict=True):
        shaped(name, q, (hand.dof,))
        finite(name, q)
        check_opening(hand, q)
    return _step(slider, hand, *ends, start, mu, solver)


@quickly_compiled
def _step(slider, hand, q0, q1, pose, friction, solver) -> Step:
    grounded = ground(slider.surface, friction)
    push = scan(slider.shape, hand, jnp.stack([q0, q1]), pose, solver, lambda step, pose: grounded)
    fields = {name: getattr(push, name)[-1] for name in Step.__dataclass_fields__}
    return Step(**fields)


def rollout(
    slider: Slider,
    hand: Hand,
    path: Numeric,
    *,
    pose: Numeric,
    friction: Numeric,
    solver: ContactSolver | StickingSolver | None = None,
    table: Table | None = None,
) -> Trajectory:
    """Push the slider along a path of hand configurations.

    path: (steps + 1, dof), world, m (`line`, `resample` or any recording); the step's size sets the accuracy. pose:
    (3,), the slider's at the start, world, m and rad. friction: mu between fingers and slider, a scalar or (fingers,).
    solver: of contact problems. By default the contact that is pressed most is solved alone, and several together only
    where another does not come apart (`pushjax.solve.single_first`). `Exhaustive()` gives, of several motions, the one
    of largest power. table: one whose friction depends on direction or place; None for an even one. There is no other
    state: a push goes on with `rollout(..., rest_of_path, pose=push.pose[-1])`.

    Differentiable, forward and reverse, in slider, hand, path, pose, friction and table. Batches come from `vmap`.

    Raises ValueError as `step` does, and for a finger that starts inside the slider by more than a fifth of the
    surface's length (less is pushed out in the first step), where it is not traced. For traced values the `status` of
    each step says so instead, and `first_failure` which step.

    A hand whose kinematics give angles may turn with what it holds; of one that gives only centres, every finger goes
    straight in each step, and two that hold something between them close on it by the arc's sagitta.

    Source: Zhou et al. 2017, section IV.A, and open problem 2 of section VII; the header of `advance` has the scheme.

    >>> import numpy as np, pushjax as pj
    >>> slider = Slider(pj.Polygon.rectangle(0.09, 0.06), pj.Ellipsoid(np.eye(3), length=0.03))
    >>> path = pj.line((-0.05, 0.01), (0.0, 0.01), steps=20)
    >>> push = rollout(slider, pj.Hand.finger(0.005), path, pose=(0.0, 0.0, 0.0), friction=0.3)
    >>> print(pj.Status(int(push.status[-1])).name, np.asarray(push.pose[-1]).round(3))
    MOVING [ 0.047 -0.01  -0.234]
    """
    slider, hand, p, start, mu = prepared(slider, hand, path, pose, friction)
    if table is not None:
        instance("table", table, Table)
        table = jax.tree.map(lambda leaf: leaf.astype(start.dtype), table)
    return _rollout(slider, hand, p, start, mu, solver, table)


@quickly_compiled
def _rollout(slider, hand, path, pose, friction, solver, table) -> Trajectory:
    form, mu = ground(slider.surface, friction)
    if table is None:
        return scan(slider.shape, hand, path, pose, solver, lambda step, pose: (form, mu))
    mu = jnp.where(jnp.isfinite(sum(jnp.sum(leaf) for leaf in jax.tree.leaves(table))), mu, jnp.nan)

    def on_table(step: Array, pose: Vec3) -> tuple[Form, Array]:
        return WarpedForm(form, table.warp(pose, form.length)), mu

    return scan(slider.shape, hand, path, pose, solver, on_table)


def scan(
    shape: Shape,
    hand: Hand,
    path: Array,
    pose: Array,
    solver: ContactSolver | StickingSolver | None,
    grounded: Callable[[Array, Vec3], tuple[Form, Array]],
) -> Trajectory:
    """The rollout itself. `grounded` gives a step's surface and friction, by its index and the pose before it; all are
    of one length."""
    outline, poses, steps = shape.outline(), hand.poses(path), len(path) - 1
    start = Vec3.of(pose)

    def grips_at(step: Array, mu: Array):
        before, after = (jax.lax.dynamic_index_in_dim(poses, step + k, keepdims=False) for k in (0, 1))
        return grips_of(hand, mu, columns(before), columns(after))

    if sum(count(finger, outline) for finger in hand.fingers) == 1:
        records, share = _undivided(outline, steps, grips_at, solver, start, grounded), jnp.zeros_like(start.x)
    else:
        records, share = divided(outline, steps, grips_at, solver, start, grounded)
    done = _world(records, grounded(jnp.zeros((), jnp.int32), start)[0].length)
    stopped = _first(stopping(done.status))
    reached = jnp.where(stopped >= 0, stopped, steps)
    index = jnp.arange(steps + 1)
    # in a step that was divided the hand stops on the way
    onward = jax.lax.stop_gradient(share) * (path[jnp.minimum(reached + 1, steps)] - path[reached])
    configuration = path[jnp.minimum(index, reached)] + jnp.where(index > reached, 1.0, 0.0)[:, None] * onward[None]
    poses = jnp.concatenate([pose[None], done.pose])
    return Trajectory(poses, configuration, done.twist, done.wrench, done.force, done.mode, done.status, done.overlap)


def _undivided(outline, steps, grips_at, solver, start, grounded) -> Record:
    """The record of every step of a round finger on a convex outline, whose one contact is all there is to see."""

    def body(pose: Vec3, step: Array):
        form, mu = grounded(step, pose)
        grips = grips_at(step, mu)
        before = deepest(outline, grips, pose, 0.0)  # what detection begins with
        record, _ = advance(form, outline, grips, solver, pose, before, holding(grips, form.length))
        return record.pose, record._replace(overlap=before)

    body = jax.checkpoint(body, prevent_cse=False, policy=keep_found)
    last, records = jax.lax.scan(body, start, jnp.arange(steps))
    grips = grips_at(jnp.asarray(steps - 1), grounded(jnp.asarray(steps - 1), last)[1])
    final = deepest(outline, grips, last, 1.0)
    return records._replace(overlap=jnp.concatenate([records.overlap[1:], final[None]]))
