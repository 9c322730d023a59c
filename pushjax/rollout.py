"""Pushes: one step, and a path of them.

Time does not matter to quasi-static motion, so a step is a displacement of the hand. Within it (body frame, after
turning the hand's displacement by the slider's angle):

1. the finger travels freely until it meets the slider (exactly, see `contacts`); the rest of the step pushes;
2. predict: solve the contact where they meet, and move the slider half of that;
3. correct: solve the contact as seen from halfway, with the halfway angle, and move the slider by that.

This is the midpoint rule: second order within a mode and, because motion is continuous across modes, across
changes of mode too. The gap of the meeting is part of the contact problem, so an overlap is pushed out within one step
and what the rule leaves does not add up (the paper's open problem 2: Zhou et al. 2017, section VII).

The slider is moved so that its contact point goes exactly where the contact problem says, in the world, and the
rest turns about it. Where the finger sticks, slip is then zero to rounding, not to the order of the scheme.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._checks import Numeric, as_float, common_dtype, finite, non_negative, shaped, traced
from pushjax._vec import Scalar, Vec2, Vec3, select, settle, turn
from pushjax.contacts import DEEPEST_OVERLAP, meet
from pushjax.hands import Hand, checked_path
from pushjax.limit_surface import Form, LimitSurface
from pushjax.shapes import Outline, Shape
from pushjax.solve import Contact, ScalarRoot, SingleMotion, StickingSolver, solve_single
from pushjax.solve.contacts import usable
from pushjax.status import ContactMode, Status


class Slider(eqx.Module):
    """What is pushed: its outline and how it slides, both in its body frame."""

    shape: Shape
    surface: LimitSurface


class Step(eqx.Module):
    """One step of a push.

    pose: (3,), world, after the step. twist: (3,), the slider's over the step, and wrench: (3,), force: (contacts, 2)
    along normal and tangent (N, on H = 1), mode: (contacts,) are those of the contact halfway, in the body frame
    halfway; zero and SEPARATED where nothing pushes. The pose after is that before moved by the twist to the second
    order (the contact point goes straight), not its exponential. status: `Status`.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    wrench: Float[Array, "3"]
    force: Float[Array, "contacts 2"]
    mode: Int[Array, "contacts"]
    status: Int[Array, ""]


class Trajectory(eqx.Module):
    """A push, step by step; fields as in `Step`, with a leading axis of steps (pose: steps + 1, the start included)."""

    pose: Float[Array, "steps+1 3"]
    twist: Float[Array, "steps 3"]
    wrench: Float[Array, "steps 3"]
    force: Float[Array, "steps contacts 2"]
    mode: Int[Array, "steps contacts"]
    status: Int[Array, "steps"]

    @property
    def failed(self) -> Bool[Array, "steps"]:
        """Steps whose status is a failure (`Status.failed`); there the slider was left where it was."""
        return jnp.isin(self.status, jnp.array([s for s in Status if s.failed], self.status.dtype))

    @property
    def first_failure(self) -> Int[Array, ""]:
        """Index of the first failed step, or -1."""
        return jnp.where(jnp.any(self.failed, axis=-1), jnp.argmax(self.failed, axis=-1), -1)


class _Record(NamedTuple):
    """A step's outcome in scalars: what the scan stacks."""

    pose: Vec3
    twist: Vec3
    wrench: Vec3
    force: Vec2
    mode: Int[Array, ""]
    status: Int[Array, ""]


def _world(record: _Record, length: Scalar) -> Step:
    """Arrays of a record; also of a stacked one, whose scalars have an axis of steps."""
    wrench = (record.wrench.x, record.wrench.y, record.wrench.z * length)
    return Step(
        pose=jnp.stack(record.pose, axis=-1),
        twist=jnp.stack(record.twist, axis=-1),
        wrench=jnp.stack(wrench, axis=-1),
        force=jnp.stack(record.force, axis=-1)[..., None, :],
        mode=record.mode[..., None],
        status=record.status,
    )


class _Placed(NamedTuple):
    """A pose, and the unit vector of its angle: sines cost as much as a contact."""

    pose: Vec3
    angle: Vec2

    @staticmethod
    def at(pose: Vec3) -> "_Placed":
        return _Placed(pose, settle(turn(pose.z), pose.x))

    def local(self, world: Vec2) -> Vec2:
        """A world point in the body frame."""
        return (world - self.pose.xy).unrotate(self.angle)

    def moved(self, contact: Vec2, motion: Vec3, seen: Vec2) -> "_Placed":
        """After the body twist `motion`; the slider's point `contact` goes straight, the twist turned by `seen`."""
        straight = (motion.xy + contact.perp().scale(motion.z)).rotate(seen)
        theta = self.pose.z + motion.z
        angle = settle(turn(theta), self.pose.x)
        swing = contact.rotate(angle) - contact.rotate(self.angle)
        return _Placed(Vec3(self.pose.x + straight.x - swing.x, self.pose.y + straight.y - swing.y, theta), angle)


def _advance(
    form: Form,
    outline: Outline,
    radius: Scalar,
    friction: Scalar,
    solver: StickingSolver,
    pose: Vec3,
    before: Vec2,
    after: Vec2,
) -> _Record:
    """One step of one finger from `before` to `after` (world)."""
    path = after - before
    start = _Placed.at(pose)
    local = settle((start.local(before), path.unrotate(start.angle)), pose.x)
    met = meet(outline, local[0], local[1], radius, form.length)
    meeting_point = before + path.scale(met.start)
    pushed = path.scale(jnp.where(met.reached, 1 - met.start, 0.0))
    gap = jnp.where(met.reached, met.gap, 1.0)  # else out of reach

    def stage(carry, share):
        """Solve the contact as it is when `share` of the last stage's motion is done."""
        twist, point, angle, status = carry
        there = start.moved(point, twist.scale(share), angle)
        seen = settle(outline.closest(there.local(meeting_point + pushed.scale(share))), pose.x)
        contact = Contact(seen.point, -seen.normal, pushed.unrotate(there.angle), friction, gap)
        motion = solve_single(form, contact, solver)
        # A failed prediction must show, whatever the correction made of it
        status = jnp.where(status == Status.MOVING, motion.status, jnp.maximum(status, motion.status))
        return (motion.twist, seen.point, there.angle, status), motion

    zero = jnp.zeros_like(pose.x)
    begin = (Vec3(zero, zero, zero), Vec2(zero, zero), start.angle, jnp.zeros((), jnp.int8))
    (twist, point, angle, status), motions = jax.lax.scan(stage, begin, jnp.array([0.0, 0.5], zero.dtype))
    motion: SingleMotion = jax.tree.map(lambda leaf: leaf[-1], motions)
    moved = start.moved(point, twist, angle).pose
    status = jnp.where(met.overlapping & (status != Status.INVALID), Status.OVERLAPPING, status).astype(jnp.int8)
    return _guarded(motion, moved, pose, status)


def _ground(slider: Slider, friction: Scalar) -> tuple[Form, Scalar]:
    """The limit surface in scalars, and the friction; that is NaN, so every contact invalid, if the surface is."""
    form, known = usable(slider.surface.form())
    return form, jnp.where(known, friction, jnp.nan)


def _guarded(motion: SingleMotion, moved: Vec3, pose: Vec3, status: Int[Array, ""]) -> _Record:
    """The record of a step; without motion the slider stays, untouched by arithmetic that might have failed."""
    finite_pose = jnp.isfinite(moved.x + moved.y + moved.z)
    moves = settle((status == Status.MOVING) & finite_pose, pose.x)
    status = jnp.where((status == Status.MOVING) & ~finite_pose, Status.INVALID, status).astype(jnp.int8)

    def kept(moving):
        return type(moving)(*(jnp.where(moves, entry, 0.0) for entry in moving))

    return _Record(
        select(moves, moved, pose),
        kept(motion.twist),
        kept(motion.wrench),
        kept(motion.force),
        jnp.where(moves, motion.mode, ContactMode.SEPARATED).astype(jnp.int8),
        status,
    )


def _arguments(slider: Slider, hand: Hand, pose: Numeric, friction: Numeric, *paths: Numeric):
    """Everything in one floating dtype, and checked as far as values are known."""
    dtype = common_dtype(slider, hand, pose, friction, *paths)
    start, mu = as_float(pose, dtype), as_float(friction, dtype)
    shaped("pose", start, (3,))
    finite("pose", start)
    fingers = hand.radius.shape[0]
    if mu.shape not in ((), (fingers,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({fingers},), one per finger")
    finite("friction", mu)
    non_negative("friction", mu)
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype), (slider, hand))
    return *cast, start, jnp.broadcast_to(mu, (fingers,)), dtype


def _check_start(slider: Slider, hand: Hand, pose: Array, configuration: Array) -> None:
    if traced((slider, hand, pose, configuration)):
        return
    overlap = float(_overlap(slider, hand, pose, configuration))
    allowed = DEEPEST_OVERLAP * float(slider.surface.length)
    if overlap > allowed:
        raise ValueError(
            f"path starts with the hand inside the slider: a finger overlaps it by {1e3 * overlap:.3g} mm; at most "
            f"{1e3 * allowed:.3g} mm ({DEEPEST_OVERLAP:g} of the surface's length) is pushed out"
        )


@eqx.filter_jit
def _overlap(slider: Slider, hand: Hand, pose: Array, configuration: Array) -> Scalar:
    """By how much the finger overlaps the slider, m."""
    (center,) = hand.centers(tuple(configuration))
    local = _Placed.at(Vec3.of(pose)).local(center)
    return hand.radius[0] - slider.shape.outline().closest(local).distance


def step(
    slider: Slider,
    hand: Hand,
    q0: Numeric,
    q1: Numeric,
    *,
    pose: Numeric,
    friction: Numeric,
    solver: StickingSolver | None = None,
) -> Step:
    """Move the hand from configuration `q0` (dof,) to `q1` (dof,), world, m: the one step that `rollout` scans.

    pose: (3,), the slider's, world. friction: mu between fingers and slider, a scalar or (fingers,).

    Raises ValueError for arguments of the wrong shape, not finite, or a negative friction, where they are not traced;
    where they are, and for a finger that is inside the slider, the step's status says so.
    """
    slider, hand, start, mu, dtype = _arguments(slider, hand, pose, friction, q0, q1)
    ends = as_float(q0, dtype), as_float(q1, dtype)
    for name, q in zip(("q0", "q1"), ends, strict=True):
        shaped(name, q, (hand.dof,))
        finite(name, q)
    return _step(slider, hand, *ends, start, mu, ScalarRoot() if solver is None else solver)


@eqx.filter_jit
def _step(slider, hand, q0, q1, pose, friction, solver) -> Step:
    (before,), (after,) = hand.centers(tuple(q0)), hand.centers(tuple(q1))
    outline = slider.shape.outline()
    form, mu = _ground(slider, friction[0])
    record = _advance(form, outline, hand.radius[0], mu, solver, Vec3.of(pose), before, after)
    return _world(record, form.length)


def rollout(
    slider: Slider,
    hand: Hand,
    path: Numeric,
    *,
    pose: Numeric,
    friction: Numeric,
    solver: StickingSolver | None = None,
) -> Trajectory:
    """Push the slider along a path of hand configurations.

    path: (steps + 1, dof), world, m (`line`, `resample` or any recording); the step's size sets the accuracy. pose:
    (3,), the slider's at the start, world, m and rad. friction: mu between fingers and slider, a scalar or (fingers,).
    There is no other state: a push goes on with `rollout(..., rest_of_path, pose=push.pose[-1])`.

    Differentiable, forward and reverse, in slider, hand, path, pose and friction. Batches come from `vmap`.

    Raises ValueError for arguments of the wrong shape, not finite, a negative friction, or a finger that starts inside
    the slider by more than a fifth of the surface's length (less is pushed out in the first step), where they are not
    traced; where they are, `status` says so at every step, and `first_failure` where.

    Source: Zhou et al. 2017, section IV.A, and open problem 2 of section VII; this module's header has the scheme.
    """
    slider, hand, start, mu, dtype = _arguments(slider, hand, pose, friction, path)
    p = checked_path(path, hand.dof, dtype)
    _check_start(slider, hand, start, p[0])
    return _rollout(slider, hand, p, start, mu, ScalarRoot() if solver is None else solver)


@eqx.filter_jit
def _rollout(slider, hand, path, pose, friction, solver) -> Trajectory:
    outline, radius = slider.shape.outline(), hand.radius[0]
    form, mu = _ground(slider, friction[0])
    columns = tuple(path.T)

    def body(pose: Vec3, ends):
        (before,), (after,) = (hand.centers(q) for q in ends)
        record = _advance(form, outline, radius, mu, solver, pose, before, after)
        return record.pose, record

    ends = tuple(c[:-1] for c in columns), tuple(c[1:] for c in columns)
    # Only poses are kept for reverse mode and a step is worked out again there: writing out everything a step
    # computes, and reading it back, took twice as long as computing it again.
    body = jax.checkpoint(body, prevent_cse=False)
    _, records = jax.lax.scan(body, Vec3.of(pose), ends)
    steps = _world(records, form.length)
    poses = jnp.concatenate([pose[None], steps.pose])
    return Trajectory(poses, steps.twist, steps.wrench, steps.force, steps.mode, steps.status)
